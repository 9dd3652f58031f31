#pragma once

#include <cstdint>

#include "core/image.hpp"

namespace planish {

/// Corrects single pixels whose whole number of periods is wrong, from their eight neighbours.
///
/// A pixel is looked at where it is rejected for its code alone, or where it differs from the pixels to its left and
/// right by more than a quarter of a period. Where at least five valid neighbours agree, and the pixel agrees with
/// their median up to whole periods, it takes the median's periods; its phase stays as measured. To agree means to
/// differ by at most max(`tolerance_px`, `sigmas` sigma). Code pixels that stay are rejected for good (NaN).
void repair_periods(Image<const float> position_px, Image<const float> sigma_px, Image<const std::uint16_t> rejected,
                    float period_px, float tolerance_px, float sigmas, int threads, Image<float> out_position_px,
                    Image<float> out_sigma_px, Image<std::uint16_t> out_rejected);

}  // namespace planish
