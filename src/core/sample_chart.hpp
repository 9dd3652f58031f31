#pragma once

#include "core/image.hpp"

namespace planish {

/// Value and standard deviation of a map at the places `source` (h, w, 2) of a chart, by cubic convolution. Where chart
/// pixels are larger than the map's, the kernel widens with them: what the chart cannot show is averaged, not folded
/// into it. `sigma` is that of errors of which the share `interpolated` of the variance has been read by cubic
/// convolution before, so that neighbours share it; the rest is independent. NaN where too much of the kernel's window
/// is NaN.
void sample_chart(const Image<const float>& value, const Image<const float>& sigma, const Image<const float>& source,
                  float interpolated, int threads, const Image<float>& out_value, const Image<float>& out_sigma);

}  // namespace planish
