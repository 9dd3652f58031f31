#include "core/simulation/counter_noise.hpp"

#include <cmath>
#include <vector>

namespace planish {

namespace {

/// Quantile of the normal distribution: Wichura, algorithm AS 241 (PPND7, 1988), relative error about 1e-7.
double normal_quantile(double p) {
    const double q = p - 0.5;
    if (std::abs(q) <= 0.425) {
        const double r = 0.180625 - q * q;
        return q * (((59.109374720 * r + 159.29113202) * r + 50.434271938) * r + 3.3871327179) /
               (((67.187563600 * r + 78.757757664) * r + 17.895169469) * r + 1.0);
    }
    double r = std::sqrt(-std::log(q < 0 ? p : 1.0 - p));
    double x;
    if (r <= 5.0) {
        r -= 1.6;
        x = (((0.17023821103 * r + 1.3067284816) * r + 2.7568153900) * r + 1.4234372777) /
            ((0.12021132975 * r + 0.73700164250) * r + 1.0);
    } else {
        r -= 5.0;
        x = (((0.017337203997 * r + 0.42868294337) * r + 3.0812263860) * r + 6.6579051150) /
            ((0.012258202635 * r + 0.24197894225) * r + 1.0);
    }
    return q < 0 ? -x : x;
}

constexpr int kTableBits = 12;
constexpr std::uint32_t kTableSize = 1u << kTableBits;
/// Table cells next to 0 and 1 where the quantile bends too much for a straight line (error elsewhere below 5e-5).
constexpr std::uint32_t kTailCells = 32;

struct QuantileTable {
    std::array<float, kTableSize + 1> value;
    QuantileTable() {
        for (std::uint32_t i = 0; i <= kTableSize; ++i) {
            const double p = std::min(std::max(i / double(kTableSize), 1e-9), 1.0 - 1e-9);
            value[i] = static_cast<float>(normal_quantile(p));
        }
    }
};

float to_normal(const QuantileTable& table, std::uint32_t bits) {
    const std::uint32_t cell = bits >> (32 - kTableBits);
    if (cell - kTailCells >= kTableSize - 2 * kTailCells) {
        return static_cast<float>(normal_quantile((bits + 0.5) * 0x1p-32));
    }
    const float fraction = static_cast<float>(bits & ((1u << (32 - kTableBits)) - 1)) * 0x1p-20f;
    return table.value[cell] + fraction * (table.value[cell + 1] - table.value[cell]);
}

}  // namespace

std::array<std::uint32_t, 4> philox(std::array<std::uint32_t, 4> c, std::array<std::uint32_t, 2> k) {
    for (int round = 0; round < 10; ++round) {
        const std::uint64_t a = std::uint64_t{0xD2511F53u} * c[0], b = std::uint64_t{0xCD9E8D57u} * c[2];
        c = {static_cast<std::uint32_t>(b >> 32) ^ c[1] ^ k[0], static_cast<std::uint32_t>(b),
             static_cast<std::uint32_t>(a >> 32) ^ c[3] ^ k[1], static_cast<std::uint32_t>(a)};
        k[0] += 0x9E3779B9u;
        k[1] += 0xBB67AE85u;
    }
    return c;
}

void normal_numbers(std::uint64_t seed, std::uint64_t stream, std::uint32_t first, std::span<float> out) {
    static const QuantileTable table;
    const std::array<std::uint32_t, 2> key{static_cast<std::uint32_t>(seed), static_cast<std::uint32_t>(seed >> 32)};
    const auto low = static_cast<std::uint32_t>(stream), high = static_cast<std::uint32_t>(stream >> 32);
    for (std::size_t i = 0; i < out.size(); i += 4) {
        const auto bits = philox({static_cast<std::uint32_t>((first + i) / 4), 0, low, high}, key);
        for (std::size_t j = 0; j < 4 && i + j < out.size(); ++j) out[i + j] = to_normal(table, bits[j]);
    }
}

}  // namespace planish
