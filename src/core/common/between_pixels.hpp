#pragma once

#include <Eigen/Core>
#include <algorithm>

#include "core/common/image.hpp"

namespace planish {

/// The first of the two pixels around a place along an axis of `count` pixels, and how far beyond it the place lies
/// [px]; places outside belong to the outer pixels, NaN to the first.
struct PixelShare {
    int index;
    float share;

    PixelShare(float place, int count) {
        const auto last = static_cast<float>(std::max(0, count - 2));
        const float held = place > 0.0F ? place : 0.0F;
        index = static_cast<int>(held < last ? held : last);
        share = place - static_cast<float>(index);
    }
};

/// Linear interpolation of a map (H, W, 3) between the pixel (row, column) and the next ones: the first three of four
/// values. NaN where one of the four pixels is.
inline Eigen::Array4f between_pixels(const Image<const float>& map, int row, int column, float fu, float fv) {
    const float* corner = map.at(row, column);
    const int right = column + 1 < map.width ? 3 : 0, below = row + 1 < map.height ? 3 * map.width : 0;
    // Nothing lies behind the last pixel.
    const bool last = row + 2 >= map.height && column + 2 >= map.width;
    const auto at = [&](int offset) -> Eigen::Array4f {
        const float* p = corner + offset;
        if (last) return {p[0], p[1], p[2], 0.0F};
        return Eigen::Map<const Eigen::Array4f>(p);
    };
    return (1 - fv) * ((1 - fu) * at(0) + fu * at(right)) + fv * ((1 - fu) * at(below) + fu * at(below + right));
}

}  // namespace planish
