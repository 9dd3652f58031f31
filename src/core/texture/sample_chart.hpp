#pragma once

#include <cstdint>

#include "core/common/image.hpp"

namespace planish {

/// What a chart shows: value and standard deviation of the contrast (h, w), 0 outside `mask`, which is 1 where there
/// are both and the surface.
struct SampledChart {
    Image<float> value, sigma;
    Image<std::uint8_t> mask;
};

/// Value and standard deviation of a map at the places `source` (h, w, 2) of a chart, by cubic convolution. Where chart
/// pixels are larger than the map's, the kernel widens with them: what the chart cannot show is averaged, not folded
/// into it. `sigma` is that of errors of which the share `interpolated` of the variance has been read by cubic
/// convolution before, so that neighbours share it; the rest is independent. Nothing is shown where too much of the
/// kernel's window is NaN, or where `known` (H, W) is 0 at one of the four pixels around.
void sample_chart(const Image<const float>& value, const Image<const float>& sigma,
                  const Image<const std::uint8_t>& known, const Image<const float>& source, float interpolated,
                  int threads, const SampledChart& out);

}  // namespace planish
