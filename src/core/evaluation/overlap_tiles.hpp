#pragma once

#include <Eigen/Core>
#include <vector>

#include "core/common/image.hpp"

namespace planish {

/// A texture: values (H, W) and their standard deviations (H, W), NaN where there is none.
struct Contrast {
    Image<const float> value;
    Image<const float> sigma;
};

/// A square of a's pixel grid whose shift is asked for. J_a, J_b [px / mm]: how the pixel in a's and in b's camera
/// moves when a point of a moves along the two tangent directions of the tile. `offset_b` [px] is added to the pixels
/// in b: what the distance of the two surfaces along the normal, seen at an angle, moves there.
struct Tile {
    int row = 0;
    int column = 0;
    Eigen::Matrix2d J_a, J_b;
    Eigen::Vector2d offset_b;
};

/// Where the texture of a tile of a is found in b: displacement along the tangent directions of the tile [mm].
struct TileShift {
    Eigen::Vector2d shift_mm{0, 0};
    Eigen::Matrix2d covariance{Eigen::Matrix2d::Zero()};
    int pixels = 0;
    double correlation = 0;
    /// How much larger the variance is than the covariance says, because residuals of neighbouring pixels belong
    /// together (interpolation, highlights, depth noise); from blocks of CLUSTER_PX, noisy for a single tile.
    double inflation = 1;
    bool converged = false;
};

/// Shift of every tile of `size` px by least squares on the texture (Lucas and Kanade 1981, in the inverse
/// compositional form of Baker and Matthews 2004), from the shift `start_mm`. `pixels_b` (H, W of a, 2) is the pixel in
/// b of each point of a, NaN where b does not see it.
///
/// The steps use the gradient of a only, which b's interpolation does not touch: its noise then does not pull the
/// result to whole pixels. The curvature is the product of the gradients of a and b, whose noises are independent.
std::vector<TileShift> tile_shifts(const Contrast& a, const Contrast& b, const Image<const float>& pixels_b,
                                   const std::vector<Tile>& tiles, int size, const Eigen::Vector2d& start_mm,
                                   int threads);

/// Sum over all tiles of the correlation coefficient of a and b, for each of the shifts [mm]; b bilinear, unweighted.
std::vector<double> shift_scores(const Contrast& a, const Contrast& b, const Image<const float>& pixels_b,
                                 const std::vector<Tile>& tiles, int size, const std::vector<Eigen::Vector2d>& shifts,
                                 int threads);

/// One shift [mm] for all tiles together, by the same least squares: where the texture of single tiles is weaker than
/// its noise, it keeps their own search out of the many local optima of the noise.
Eigen::Vector2d common_shift(const Contrast& a, const Contrast& b, const Image<const float>& pixels_b,
                             const std::vector<Tile>& tiles, int size, const Eigen::Vector2d& start_mm, int threads);

}  // namespace planish
