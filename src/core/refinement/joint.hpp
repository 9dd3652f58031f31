#pragma once

#include <Eigen/Core>
#include <array>
#include <cstdint>
#include <vector>

#include "core/common/camera.hpp"
#include "core/common/image.hpp"

namespace planish {

using Matrix6 = Eigen::Matrix<double, 6, 6>;
using Vector6 = Eigen::Matrix<double, 6, 1>;
using Matrix62 = Eigen::Matrix<double, 6, 2>;

/// Channels of `JointMaps::values`: what belongs to one pixel lies together.
namespace joint {
constexpr int point = 0;              ///< as measured, NaN where none [mm]
constexpr int variance_distance = 3;  ///< of the point along its normal [mm^2]
constexpr int normal = 4;             ///< unit, towards the sensor
constexpr int variance_texture = 7;   ///< of the texture's noise; NaN where there is no texture
constexpr int gradient = 8;           ///< change of the texture per mm along the surface
constexpr int blur = 11;  ///< displacement along the normal by the images' blur, one standard deviation [mm]
constexpr int channels = 12;
}  // namespace joint

/// What the joint refinement needs of one measurement, on its organising camera's pixel grid (all maps of one size).
struct JointMaps {
    Image<const float> values;      ///< (H, W, joint::channels)
    Image<const float> texture;     ///< (H, W) filtered local contrast, NaN where unknown
    Image<const std::uint8_t> use;  ///< (H, W) 0 = takes no part (held out)
};

struct JointOptions {
    double max_distance;  ///< surfaces farther apart than this do not belong together [mm]
    double min_cosine;    ///< of the angle between the two normals
    int stride;           ///< every n-th pixel of b along both axes
    int tile;             ///< edge of a tile of b [px]; multiple of stride
};

/// How residuals count in one tile of b, of one kind; of textures also what their shading is taken to be.
struct TileWeight {
    float scale;       ///< robust standard deviation of the residuals over their noise; infinite = all weigh alike
    float weight;      ///< of a squared residual over its noise; a tile whose both are 0 is not looked at
    float gain = 0;    ///< relative contrast of a's texture over b's: each is corrected by half of it
    float offset = 0;  ///< of a's texture over b's
};

/// What gain and offset of a tile's textures do, where they differ from what `TileWeight` holds: sums with the robust
/// weights w over residuals r, their derivatives J by xi, and by gain and offset (m and q, with the opposite sign).
struct Shading {
    Matrix62 change = Matrix62::Zero();                  ///< J'w [m q]
    Eigen::Matrix2d square = Eigen::Matrix2d::Zero();    ///< [m q]'w [m q]
    Eigen::Vector2d residual = Eigen::Vector2d::Zero();  ///< [m q]'w r
};

/// Normal equations of one kind of residual: H = J'WJ, g = J'Wr. `weights` and `slopes` are the sums of the robust
/// weights psi(r) / r and of psi'(r): g changes by slopes / weights of H. `blur` is the change of g by what the blur
/// may displace the points.
struct Normal {
    Matrix6 H = Matrix6::Zero();
    Vector6 g = Vector6::Zero(), blur = Vector6::Zero();
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
    /// Number and sum of absolute values of the residuals over their noise per tile: distance, texture.
    std::vector<std::array<double, 4>> tile_sizes;
    std::vector<Shading> tile_shading;  ///< per tile of b
    int tile_rows = 0, tile_columns = 0;
};

/// Residuals of surface distance and texture of b against a under T_a_b, and their derivatives with respect to
/// xi = [rotation, translation] in frame a about the point `about` (DESIGN section 4).
///
/// Each pixel of b is moved into a, projected into a's camera and looked up there. Residuals are in units of their
/// noise. Gradients and normals are the mean of both sides, which makes the estimate symmetric and second order (Malis
/// 2004; Rusinkiewicz 2019). `weights` (tile rows, tile columns, 2) are those of distance and texture. If `distances`
/// and `differences` are not empty (size of b's maps), residuals are written there, NaN where there is none.
JointResult joint_normal_equations(const JointMaps& a, const Camera& camera_a, const JointMaps& b,
                                   const Eigen::Matrix3d& R_a_b, const Eigen::Vector3d& t_a_b,
                                   const Eigen::Vector3d& about, const JointOptions& options,
                                   const std::vector<TileWeight>& weights, int threads, const Image<float>& distances,
                                   const Image<float>& differences);

/// Rows and columns of the tiles of b's maps.
inline std::array<int, 2> tile_grid(const JointMaps& b, int tile) {
    return {(b.values.height + tile - 1) / tile, (b.values.width + tile - 1) / tile};
}

}  // namespace planish
