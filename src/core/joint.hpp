#pragma once

#include <Eigen/Core>
#include <cstdint>
#include <vector>

#include "core/camera.hpp"
#include "core/image.hpp"

namespace planish {

using Matrix6 = Eigen::Matrix<double, 6, 6>;
using Vector6 = Eigen::Matrix<double, 6, 1>;
using Matrix62 = Eigen::Matrix<double, 6, 2>;

/// What the joint refinement needs of one measurement, on its organising camera's pixel grid (all maps of one size).
struct JointMaps {
    Image<const float> points;      ///< (H, W, 3) smoothed surface, NaN where none [mm]
    Image<const float> normals;     ///< (H, W, 3)
    Image<const float> texture;     ///< (H, W) prefiltered local contrast, NaN where unknown
    Image<const float> gradient;    ///< (H, W, 3) change of the texture per mm along the surface
    Image<const float> sigma;       ///< (H, W) noise of the texture
    Image<const std::uint8_t> use;  ///< (H, W) 0 = takes no part (held out)
};

struct JointOptions {
    double max_distance;     ///< surfaces farther apart than this do not belong together [mm]
    double min_cosine;       ///< of the angle between the two normals
    double scale_distance;   ///< robust standard deviation of the distances [mm]; infinite = all weights 1
    double scale_texture;    ///< robust standard deviation of the normalised texture differences
    double weight_distance;  ///< weight of a squared distance [1/mm^2]
    double weight_texture;   ///< weight of a squared normalised texture difference
    int stride;              ///< every n-th pixel of b along both axes
    int tile;                ///< edge of a tile of b [px]; multiple of stride
};

/// Normal equations of one kind of residual: H = J'WJ, g = J'Wr. `weights` and `slopes` are the sums of the robust
/// weights psi(r) / r and of psi'(r): g changes by slopes / weights of H.
struct Normal {
    Matrix6 H = Matrix6::Zero();
    Vector6 g = Vector6::Zero();
    double cost = 0, weights = 0, slopes = 0;
    std::int64_t count = 0;
};

struct JointSums {
    Normal distance, texture;
    /// Information from the product of both sides' normals or gradients, whose noises are independent: unlike H of
    /// `distance` and `texture` it is not inflated by that noise.
    Matrix6 H_distance_unbiased = Matrix6::Zero(), H_texture_unbiased = Matrix6::Zero();
    double correlation_ab = 0, correlation_aa = 0, correlation_bb = 0;
    JointSums& operator+=(const JointSums& other);
};

struct JointResult {
    JointSums sums;
    /// J'Wr of distance and texture (columns) per tile of b, row by row, for the clustered covariance.
    std::vector<Matrix62> tile_gradients;
    int tile_rows = 0, tile_columns = 0;
};

/// Residuals of surface distance and texture of b against a under T_a_b, and their derivatives with respect to
/// xi = [rotation, translation] in frame a about the point `about` (DESIGN section 4).
///
/// Each pixel of b is moved into a, projected into a's camera and looked up there. Gradients and normals are the mean
/// of both sides, which makes the estimate symmetric and second order (Malis 2004; Rusinkiewicz 2019). If `distances`
/// and `differences` are not empty (size of b's maps), residuals are written there, NaN where there is none.
JointResult joint_normal_equations(const JointMaps& a, const Camera& camera_a, const JointMaps& b,
                                   const Eigen::Matrix3d& R_a_b, const Eigen::Vector3d& t_a_b,
                                   const Eigen::Vector3d& about, const JointOptions& options, int threads,
                                   const Image<float>& distances, const Image<float>& differences);

}  // namespace planish
