#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <span>

namespace planish {

/// One block of the Philox4x32-10 counter-based generator (Salmon et al., Parallel random numbers: as easy as 1, 2, 3,
/// SC 2011): four independent 32-bit numbers that depend on nothing but counter and key.
std::array<std::uint32_t, 4> philox(std::array<std::uint32_t, 4> counter, std::array<std::uint32_t, 2> key);

/// Standard normal numbers for elements [first, first + out.size()) of the stream `stream` of `seed`.
/// `first` must be a multiple of four, so that every element always comes from the same block.
void normal_numbers(std::uint64_t seed, std::uint64_t stream, std::uint32_t first, std::span<float> out);

}  // namespace planish
