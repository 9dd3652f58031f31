#include "core/decoding/decode_gray.hpp"

#include <algorithm>

#include "core/common/parallel.hpp"

namespace planish {

template <class T>
void decode_gray(const std::vector<GrayBit<T>>& bits, Image<const float> threshold, int threads, Image<float> cell) {
    const auto width = static_cast<std::size_t>(cell.width);
    parallel_for(static_cast<std::size_t>(cell.height), threads, [&](std::size_t begin, std::size_t end) {
        std::vector<std::int32_t> index(width);
        for (std::size_t v = begin; v < end; ++v) {
            const std::size_t offset = v * width;
            std::fill(index.begin(), index.end(), 0);
            std::int32_t* __restrict code = index.data();
            for (const auto& bit : bits) {
                const T* __restrict image = bit.image + offset;
                // Binary bit = Gray bit XOR the binary bit above it.
                if (bit.inverse != nullptr) {
                    const T* __restrict inverse = bit.inverse + offset;
                    for (std::size_t u = 0; u < width; ++u)
                        code[u] = 2 * code[u] + ((code[u] & 1) ^ (image[u] > inverse[u] ? 1 : 0));
                } else {
                    const float* __restrict limit = threshold.row(static_cast<int>(v));
                    for (std::size_t u = 0; u < width; ++u)
                        code[u] = 2 * code[u] + ((code[u] & 1) ^ (static_cast<float>(image[u]) > limit[u] ? 1 : 0));
                }
            }
            float* out = cell.row(static_cast<int>(v));
            for (std::size_t u = 0; u < width; ++u) out[u] = static_cast<float>(code[u]);
        }
    });
}

template void decode_gray(const std::vector<GrayBit<std::uint8_t>>&, Image<const float>, int, Image<float>);
template void decode_gray(const std::vector<GrayBit<std::uint16_t>>&, Image<const float>, int, Image<float>);

}  // namespace planish
