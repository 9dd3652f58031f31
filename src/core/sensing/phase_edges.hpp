#pragma once

#include <cstdint>

#include "core/common/image.hpp"

namespace planish {

/// A phase map: absolute position, its standard deviation, both NaN where there is none, and the reasons why.
struct PhaseMaps {
    Image<const float> position_px, sigma_px;
    Image<const std::uint16_t> rejected;
};

struct PhaseMapsOut {
    Image<float> position_px, sigma_px;
    Image<std::uint16_t> rejected;
};

/// Rejects with the bit `reason` the two pixels beside every jump of a phase map, along rows and along columns.
///
/// A difference of two neighbours is a jump where fewer than two of the four differences before and after it on the
/// same line resemble it, that is, lie within max(`jump_px`, `sigmas` sigma of such a comparison). A slope, however
/// steep, and a crease resemble themselves; a pixel that mixes two surfaces does not.
void phase_edges(const PhaseMaps& maps, float jump_px, float sigmas, std::uint16_t reason, int threads,
                 const PhaseMapsOut& out);

}  // namespace planish
