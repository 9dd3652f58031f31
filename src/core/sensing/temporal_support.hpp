#pragma once

#include <cstdint>

#include "core/common/image.hpp"

namespace planish {

/// Takes the points of weak pixels away (NaN, rejected as dark) unless enough of the 24 pixels around have a point that
/// a continuous surface may have there. No point is moved. Chance spreads its matches over the whole curve: it does not
/// support itself.
void drop_unsupported(Image<const std::uint8_t> weak, int threads, Image<float> pixel_px, Image<float> sigma_px,
                      Image<std::uint16_t> rejected);

/// Takes the points of pixels away (NaN, unmatched) whose place in the other image, `height` x `width`, another pixel
/// far from them has with less `loss`: two surfaces cannot be seen at one place, one of them is hidden there.
void drop_contested(Image<const float> loss, int height, int width, Image<float> pixel_px, Image<float> sigma_px,
                    Image<std::uint16_t> rejected);

}  // namespace planish
