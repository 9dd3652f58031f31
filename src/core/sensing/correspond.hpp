#pragma once

#include <Eigen/Core>
#include <cstdint>

#include "core/common/image.hpp"
#include "core/sensing/curve_search.hpp"

namespace planish {

/// The organising camera: absolute position, its sigma and, where the lens distorts, the shift (u, v) of each pixel to
/// its undistorted place.
struct OwnView {
    Image<const float> position_px, sigma_px, shift_px;
};

struct CorrespondResult {
    Image<float> pixel_px;  ///< (u, v) in the other camera, two channels; NaN where none
    Image<float> sigma_px;  ///< standard deviation of u, the coordinate along which the search runs
};

/// For every pixel of `own`, the sub-pixel place of equal position in `other`, on the pixel's exact epipolar curve.
///
/// F (3, 3) maps an undistorted pixel of `own` to its epipolar line in undistorted pixels of `other` (exchanged like
/// its maps), the lines being nearer to rows than to columns. A crossing lies between two successive columns whose
/// positions, interpolated along the column at the curve, enclose the one looked for. Looked for first where the row
/// above continues, then where the pixel to the left does; where both fail, on the whole curve. Of several crossings
/// the one nearest to the continuation counts; without one, none. The start decides which crossing is found, not
/// where in it: that depends on it by rounding alone (1e-4 px).
void correspond(const OwnView& own, const OtherView& other, const Eigen::Matrix3d& F, int threads,
                const CorrespondResult& out);

}  // namespace planish
