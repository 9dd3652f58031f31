#pragma once

#include <array>
#include <cstdint>
#include <vector>

#include "core/sensing/temporal.hpp"

namespace planish {

/// One camera's data for the fit.
struct TemporalView {
    const TemporalStack& stack;
    const TemporalStatistics& statistics;
    Image<const std::uint8_t> usable;
    GreyNoise noise;
};

/// The vector of one pixel of the organising camera: grey values and what is left without their mean over the steps
/// below saturation; the others have weight 0.
struct OwnVector {
    int steps = 0;  ///< that count
    float mean = 0, norm = 0;
    std::vector<float> centred, weight, variance;
};

/// The other camera's unit vector at a place between the pixels, its derivative along the curve, and their noise.
struct VectorSample {
    std::vector<float> value, slope;
    /// Noise of a step k of one pixel: noise_offset + noise_slope * value_k. Weights of the pixels: sums of their
    /// squares for the value and for the slope, and of their products.
    float noise_offset = 0, noise_slope = 0;
    float value_weight = 0, slope_weight = 0, cross_weight = 0;
    std::vector<float> weight;  ///< of each step, 0 where the own or the other camera is saturated
    int steps = 0;
};

/// A straight piece of an epipolar curve: v = row + slope * (u - column).
struct CurvePiece {
    double column = 0, row = 0, slope = 0;
    [[nodiscard]] double at(double u) const { return row + slope * (u - column); }
};

/// Place of the best correlation on the curve.
struct TemporalFit {
    bool found = false;
    bool vague = false;  ///< the vectors are alike, but do not change along the curve by more than noise
    double u = 0;
    float sigma = 0;
    float loss = 1;           ///< 1 - NCC^2
    float expected_loss = 1;  ///< what noise alone makes of it
    float misfit = 0;         ///< sum of squared residuals over their variances, steps - 3 degrees of freedom
    int steps = 0;
};

class TemporalFitter {
  public:
    TemporalFitter(const TemporalView& other, const UnitVectorField& field, int min_steps);
    /// Maximises the temporal correlation from column `start` on: by the spline, or where it has gaps or
    /// steps are saturated, by the pixels themselves, 4 x 2 or 2 x 2 of them (`linear`: by these in any case).
    TemporalFit fit(const OwnVector& own, const CurvePiece& curve, double start, bool linear);

  private:
    bool sample_spline(const OwnVector& own, const CurvePiece& curve, double u);
    bool sample_pixels(const OwnVector& own, const CurvePiece& curve, double u, int taps);
    bool sample(const OwnVector& own, const CurvePiece& curve, double u, int& taps);
    bool weigh_steps(const OwnVector& own, int first_u, int last_u, int top);
    void set_noise(int u, int v);
    bool solve(const OwnVector& own, const CurvePiece& curve, bool last, double& step, TemporalFit& out);

    const TemporalView& other_;
    const UnitVectorField& field_;
    int min_steps_;
    VectorSample sample_;
    std::vector<float> pixel_;
};

}  // namespace planish
