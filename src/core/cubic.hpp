#pragma once

#include <cmath>

namespace planish {

/// Cubic convolution (Keys 1981, a = -1/2): exact for parabolas, zero beyond two samples.
inline float cubic_weight(float x) {
    const float d = std::fabs(x);
    if (d < 1.0F) return (1.5F * d - 2.5F) * d * d + 1.0F;
    if (d < 2.0F) return ((-0.5F * d + 2.5F) * d - 4.0F) * d + 2.0F;
    return 0.0F;
}

}  // namespace planish
