#pragma once

#include <Eigen/Core>
#include <cstdint>

#include "core/image.hpp"

namespace planish {

/// A decoded camera for the search: absolute position, its sigma and, where the lens distorts, the shift (u, v) of each
/// pixel to its undistorted place.
struct PhaseView {
    Image<const float> position_px, sigma_px, shift_px;
};

struct CorrespondResult {
    Image<float> pixel_px;  ///< (u, v) in the other camera, two channels; NaN where none
    Image<float> sigma_px;  ///< standard deviation of u, the coordinate along which the search runs
};

/// For every pixel of `own`, the sub-pixel place of equal position in `other`, on the pixel's exact epipolar curve.
///
/// F (3, 3) maps an undistorted pixel of `own` to its epipolar line in undistorted pixels of `other`, the lines being
/// nearer to rows than to columns. A crossing lies between two successive columns whose positions, interpolated along
/// the column at the curve, enclose the one looked for. Started from the neighbour to the left; where that fails, the
/// whole curve is searched. Of several crossings the one nearest to the continuation of the row counts; without one,
/// none.
void correspond(const PhaseView& own, const PhaseView& other, const Eigen::Matrix3d& F, int threads,
                const CorrespondResult& out);

}  // namespace planish
