#pragma once

#include <cstdint>

#include "core/image.hpp"

namespace planish {

/// Marks with 1 the two pixels beside every jump of a phase map, along rows and along columns.
///
/// A difference of two neighbours is a jump where fewer than two of the four differences before and after it on the
/// same line resemble it, that is, lie within max(`jump_px`, `sigmas` sigma of such a comparison). A slope, however
/// steep, and a crease resemble themselves; a pixel that mixes two surfaces does not.
void phase_edges(Image<const float> position_px, Image<const float> sigma_px, float jump_px, float sigmas, int threads,
                 Image<std::uint8_t> edge);

}  // namespace planish
