#pragma once

#include <cstdint>

#include "core/common/image.hpp"

namespace planish {

/// Distances of positions that count as agreement, and how much of the surroundings inter-reflection covers.
struct RepairLimits {
    float period_px = 0;     ///< of the finest fringes
    float tolerance_px = 0;  ///< neighbours on one surface differ by at most max(this, `sigmas` sigma), period / 4
    float sigmas = 5;
    int reflection_pixels = 15;  ///< of the 5 x 5 around that must be suspected too: light by two ways covers areas
};

/// Decides about doubtful pixels from their neighbours, in place; no phase is changed.
///
/// A pixel is looked at where it is rejected as a slip alone, or where it differs from the pixel to its left or right
/// by more than a quarter of a period. Where at least five valid neighbours agree, and the pixel agrees with their
/// median up to whole periods, it takes the median's periods; a pixel that was not rejected only if no more than one
/// neighbour is at its own position (two slips side by side; else it is the corner of a surface). Three that agree and
/// lie whole periods away make it a slip. Slips that stay, and pixels suspected of inter-reflection among enough
/// others, are rejected for good (NaN); the other suspects are acquitted.
void repair_periods(Image<float> position_px, Image<float> sigma_px, Image<std::uint16_t> rejected,
                    const RepairLimits& limits, int threads);

}  // namespace planish
