#pragma once

#include <limits>

namespace planish {

/// Least and greatest of `count` values, NaN left out; of none, infinity and its negative.
///
/// Several running values side by side, so that the loop vectorises; the result does not depend on the order.
inline void range(const float* __restrict values, int count, float& least, float& greatest) {
    constexpr int lanes = 16;
    constexpr float far = std::numeric_limits<float>::infinity();
    float low[lanes], high[lanes];
    for (int k = 0; k < lanes; ++k) low[k] = far, high[k] = -far;
    int i = 0;
    for (; i + lanes <= count; i += lanes)
        for (int k = 0; k < lanes; ++k) {
            low[k] = values[i + k] < low[k] ? values[i + k] : low[k];  // false for NaN
            high[k] = values[i + k] > high[k] ? values[i + k] : high[k];
        }
    for (; i < count; ++i) {
        low[0] = values[i] < low[0] ? values[i] : low[0];
        high[0] = values[i] > high[0] ? values[i] : high[0];
    }
    for (int k = 1; k < lanes; ++k) {
        low[0] = low[k] < low[0] ? low[k] : low[0];
        high[0] = high[k] > high[0] ? high[k] : high[0];
    }
    least = low[0];
    greatest = high[0];
}

}  // namespace planish
