#pragma once

#include <cstdint>
#include <memory>
#include <span>

#include "core/common/grey_noise.hpp"
#include "core/common/image.hpp"

namespace planish {

/// Steps are handled in groups of so many, missing ones being zero.
constexpr int kStepGroup = 8;

/// The grey values of all images of one camera, those of a pixel side by side.
struct TemporalStack {
    int steps = 0, padded = 0, height = 0, width = 0;
    std::unique_ptr<std::uint16_t[]> grey;

    [[nodiscard]] const std::uint16_t* at(int v, int u) const {
        return grey.get() + (static_cast<std::size_t>(v) * width + u) * padded;
    }
};

template <class T>
TemporalStack interleave(std::span<const T* const> images, int height, int width, int threads);

extern template TemporalStack interleave(std::span<const std::uint8_t* const>, int, int, int);
extern template TemporalStack interleave(std::span<const std::uint16_t* const>, int, int, int);

/// Mean of each pixel's vector over all steps, and the length of what is left without it.
struct TemporalStatistics {
    Image<float> mean, norm;
    Image<std::uint8_t> saturated;  ///< number of steps at saturation
};

void temporal_statistics(const TemporalStack& stack, float saturation, int threads, const TemporalStatistics& out);

/// Coefficients of the cubic B-spline from five pixels along a row or column: 1 + y + y^2 with y = (-1, 2, -1) / 6, the
/// first terms of the inverse of its smoothing 1 - y. What is left is y^3: 0.07 % at a period of 8 px. A quasi-
/// interpolant (de Boor & Fix 1973) is local, and its noise depends little on the place between the pixels.
constexpr float kQuasiInterpolant[5] = {1.0F / 36, -5.0F / 18, 3.0F / 2, -5.0F / 18, 1.0F / 36};

/// The unit vectors (I - mean) / norm of a camera as a field between pixels: coefficients of a cubic B-spline. Texture
/// is gone from unit vectors, so that interpolation mixes the pattern alone.
class UnitVectorField {
  public:
    /// Pixels with `usable` 0 or a saturated step take no part: around them there are no coefficients.
    UnitVectorField(const TemporalStack& stack, const TemporalStatistics& statistics, Image<const std::uint8_t> usable,
                    int threads);
    /// Coefficients of a pixel; the first one NaN where there are none.
    [[nodiscard]] const float* at(int v, int u) const {
        return coefficients_.get() + (static_cast<std::size_t>(v) * width_ + u) * padded_;
    }
    [[nodiscard]] int height() const { return height_; }
    [[nodiscard]] int width() const { return width_; }
    [[nodiscard]] int padded() const { return padded_; }

  private:
    int height_, width_, padded_;
    std::unique_ptr<float[]> coefficients_;
};

}  // namespace planish
