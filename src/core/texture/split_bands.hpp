#pragma once

#include <vector>

#include "core/common/image.hpp"

namespace planish {

/// A contrast (H, W) in two bands, and per block (h, w) the sum of squares in both and the number of known pixels.
struct Bands {
    Image<float> fine, coarse;
    Image<float> fine_squares, coarse_squares, count;
};

/// Parts a contrast: the coarse band is its average over known pixels under a separable bell (an odd number of
/// weights, symmetric, their sum 1; beyond the image lies its reflection), the fine one what is left. NaN stays where
/// it is.
void split_bands(const Image<const float>& value, const std::vector<float>& bell, int factor, int threads,
                 const Bands& out);

}  // namespace planish
