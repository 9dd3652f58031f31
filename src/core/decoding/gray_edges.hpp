#pragma once

#include <cstdint>
#include <vector>

#include "core/common/image.hpp"
#include "core/decoding/decode_gray.hpp"

namespace planish {

/// What the edges of a Gray code are located with.
struct GrayEdgeSettings {
    float cell_px = 1;                        ///< length of a cell [projector px]
    float saturation = 255;                   ///< grey level at and above which a value is clipped
    float noise_offset = 1, noise_slope = 0;  ///< variance of a grey value I: offset + slope I
    float max_signal_sigma = 0.1F;            ///< pixels whose normalised signal is noisier are dark
    float edge_bias_px = 0;                   ///< systematic error of an edge among near ones, added to its noise
};

struct GrayEdgeResult {
    Image<float> position_px, sigma_px, mean, modulation;
    Image<std::uint16_t> rejected;
};

/// Positions between the edges of a Gray code that stands alone, line by line along the rows.
///
/// `bits` stands from the most significant to the least; `white` and `black` may be null. A bit's edge lies where its
/// normalised signal, made linear by the inverse of the normal distribution (an edge blurred by a Gaussian), crosses
/// zero between two pixels. A pixel between two successive edges takes its position from both.
template <class T>
void gray_edges(const std::vector<GrayBit<T>>& bits, const T* white, const T* black, const GrayEdgeSettings& settings,
                int threads, const GrayEdgeResult& out);

extern template void gray_edges(const std::vector<GrayBit<std::uint8_t>>&, const std::uint8_t*, const std::uint8_t*,
                                const GrayEdgeSettings&, int, const GrayEdgeResult&);
extern template void gray_edges(const std::vector<GrayBit<std::uint16_t>>&, const std::uint16_t*, const std::uint16_t*,
                                const GrayEdgeSettings&, int, const GrayEdgeResult&);

}  // namespace planish
