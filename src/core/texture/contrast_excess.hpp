#pragma once

#include "core/texture/contrast.hpp"

namespace planish {

/// One kind of a camera's images: its pixels that count and its low-pass (h, w).
struct Level {
    Exposed exposed;
    Image<const float> level;
};

/// How much the relative grey values I / level of two kinds of images differ, in standard deviations.
struct Scatter {
    int count = 0;        ///< pixels that count in both
    float deviation = 0;  ///< median absolute deviation from the median
};

/// Of every `step`-th pixel along rows and columns, from step / 2 on. `expected` (h, w) is the variance of the
/// difference by noise.
Scatter contrast_scatter(const Level& first, const Level& other, const Image<const float>& expected, int factor,
                         int step);

}  // namespace planish
