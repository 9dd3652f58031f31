#pragma once

#include <Eigen/Core>
#include <cmath>

namespace planish {

/// Cubic convolution (Keys 1981, a = -1/2): exact for parabolas, zero beyond two samples.
inline float cubic_weight(float x) {
    const float d = std::fabs(x);
    const float inner = (1.5F * d - 2.5F) * d * d + 1.0F, outer = ((-0.5F * d + 2.5F) * d - 4.0F) * d + 2.0F;
    // Both are computed, so that loops over it vectorise.
    return d < 1.0F ? inner : d < 2.0F ? outer : 0.0F;
}

/// Its weights for the samples -1, 0, 1, 2 at `f` in [0, 1); for loops over many places, which vectorise.
inline void cubic_weights(float f, float* w) {
    w[0] = ((-0.5F * f + 1.0F) * f - 0.5F) * f;
    w[1] = (1.5F * f - 2.5F) * f * f + 1.0F;
    w[2] = ((-1.5F * f + 2.0F) * f + 0.5F) * f;
    w[3] = (0.5F * f - 0.5F) * f * f;
}

/// The same for one place by itself: all four at once.
inline Eigen::Array4f cubic_weights(float f) {
    const Eigen::Array4f once(-0.5F, 0.0F, 0.5F, 0.0F), twice(1.0F, -2.5F, 2.0F, -0.5F),
        thrice(-0.5F, 1.5F, -1.5F, 0.5F), second(0.0F, 1.0F, 0.0F, 0.0F);
    return ((thrice * f + twice) * f + once) * f + second;
}

}  // namespace planish
