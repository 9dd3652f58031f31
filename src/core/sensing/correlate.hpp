#pragma once

#include <Eigen/Core>
#include <cstdint>
#include <span>

#include "core/sensing/temporal.hpp"

namespace planish {

/// Limits of the search. The spans hold one value per number of steps that count, 0 ... all.
struct CorrelateSettings {
    int min_steps = 6;
    std::span<const float> max_loss;    ///< 1 - NCC^2 of a match; above it chance alone makes such correlations
    std::span<const float> sure_loss;   ///< above it a match needs neighbours that agree
    std::span<const float> max_misfit;  ///< sum of squared residuals over their variances
    float model_loss = 0;               ///< 1 - NCC^2 that is no noise but what no model tells (defocus, curvature)
    float min_gap = 25;                 ///< by so much a match must fit better than every other one
    /// Columns (low, high) of the other image to be searched, for every `range_spacing`-th pixel of the own image in
    /// both directions; NaN where none. Empty: all columns.
    Image<const float> range_px;
    int range_spacing = 16;
};

struct CorrelateCamera {
    const TemporalStack& stack;
    Image<const float> shift_px;  ///< of each pixel to its place without lens distortion; may be empty
    GreyNoise noise;
};

struct CorrelateResult {
    Image<float> pixel_px;  ///< (u, v) in the other camera, two channels; NaN where none
    Image<float> sigma_px;  ///< standard deviation along the epipolar curve
    Image<std::uint16_t> rejected;
};

/// For every pixel of `own`, the sub-pixel place on its epipolar curve in `other` where the grey values over time
/// correlate best (normalised: gain and offset are free).
///
/// F (3, 3) maps an undistorted pixel of `own` to its epipolar line in undistorted pixels of `other`, the lines being
/// nearer to rows than to columns. The search is complete: no pixel depends on its neighbours.
void correlate(const CorrelateCamera& own, const CorrelateCamera& other, const Eigen::Matrix3d& F,
               const CorrelateSettings& settings, int threads, const CorrelateResult& out);

}  // namespace planish
