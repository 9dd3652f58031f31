#pragma once

#include <cstdint>
#include <vector>

#include "core/common/image.hpp"

namespace planish {

/// Second differences of a weighted sum of images, with the grey level they belong to.
struct NoiseSamples {
    std::vector<float> level, residual;
};

/// A weighted sum of images in which everything but noise cancels, and where it is taken.
template <class T>
struct NoiseContrast {
    std::vector<const T*> images;
    std::vector<float> weights;  ///< sum of squares 1
    std::vector<int> rows;       ///< first of the three rows of each group
    bool along_rows = false;     ///< second differences between neighbours of a row; else of a column
    bool level_beside = false;   ///< the level comes from the pixels beside: where the sum itself is the grey value
    float saturation = 255;      ///< pixels that reach it in any image are left out
};

/// Residuals (1, -2, 1) / sqrt(6) of the contrast: their variance is that of a single grey value.
template <class T>
NoiseSamples sample_noise(const NoiseContrast<T>& contrast, int height, int width);

/// Mean level, clipped variance and number of the residuals of each of `bins` equal steps of level.
struct NoiseBins {
    std::vector<double> level, variance;
    std::vector<std::int64_t> count;
};

/// The variance starts from the 68.27 % quantile and leaves out, three times, what is beyond `clip_sigmas`; the
/// standard deviation used for that is at least `min_sigma`.
NoiseBins bin_noise(const std::vector<float>& level, const std::vector<float>& residual, int bins, float clip_sigmas,
                    float min_sigma);

}  // namespace planish
