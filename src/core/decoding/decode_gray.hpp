#pragma once

#include <cstdint>
#include <vector>

#include "core/common/image.hpp"

namespace planish {

/// One Gray bit: lit where `image` is brighter than `inverse`, or than the threshold where there is no inverse.
template <class T>
struct GrayBit {
    const T* image = nullptr;
    const T* inverse = nullptr;
};

/// Cell index of every pixel from a reflected Gray code; `bits` from the most significant to the least.
template <class T>
void decode_gray(const std::vector<GrayBit<T>>& bits, Image<const float> threshold, int threads, Image<float> cell);

extern template void decode_gray(const std::vector<GrayBit<std::uint8_t>>&, Image<const float>, int, Image<float>);
extern template void decode_gray(const std::vector<GrayBit<std::uint16_t>>&, Image<const float>, int, Image<float>);

}  // namespace planish
