#pragma once

#include <cstdint>

#include "core/common/image.hpp"

namespace planish {

/// Noise of the two images: variance = offset + slope grey value, times `first` and `last` (1 / number of images).
struct PairNoise {
    float offset, slope, first, last;
};

/// Sums that one block of pixels contributes to a gradient least squares of the shift between two images.
///
/// t is the mean of both images (the second one scaled to the brightness of the first), e their difference, local means
/// taken off both; g is the gradient of t under a Gaussian, T and E are t and e under the same Gaussian.
enum ShiftSum { kUU, kUV, kUT, kVV, kVT, kTT, kUE, kVE, kTE, kEE, kFloor, kVariance, kShiftSums };

/// Side of a block [px].
constexpr int kShiftBlock = 16;

/// Sums over blocks of pixels, (H / kShiftBlock, W / kShiftBlock, kShiftSums).
///
/// `usable` is 1 where both images count, else 0; pixels within reach of the filter of one that does not, do not count.
/// kFloor sums the squared response of t to the second difference along rows and columns, (1 -2 1)^T (1 -2 1) / 6,
/// which sees white noise in full, but hardly any texture that a lens has blurred.
void shift_sums(Image<const float> first, Image<const float> last, Image<const std::uint8_t> usable,
                const PairNoise& noise, int threads, Image<double> sums);

}  // namespace planish
