#pragma once

#include <cstdint>

#include "core/common/image.hpp"

namespace planish {

struct IslandLimits {
    float depth_per_pixel = 0;  ///< largest depth difference of connected neighbours, as a share of the depth
    float sigmas = 0;           ///< and beyond it, in sigma of the two points
    int min_pixels = 0;         ///< smaller islands are marked
};

/// Marks with 1 the valid pixels of islands: sets of 4-connected pixels without a jump in depth. Valid are those with a
/// depth and, where `excluded` is not empty, 0 there.
void islands(Image<const float> depth_mm, Image<const float> sigma_mm, Image<const std::uint8_t> excluded,
             const IslandLimits& limits, int threads, Image<std::uint8_t> small);

}  // namespace planish
