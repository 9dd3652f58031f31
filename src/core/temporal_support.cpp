#include "core/temporal_support.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <vector>

#include "core/decode_phase.hpp"
#include "core/parallel.hpp"

namespace planish {
namespace {

constexpr int kRadius = 2, kNeeded = 6;
/// The corresponding place moves by at most so many pixels per pixel of the organising camera, and by noise.
constexpr float kSteepest = 3, kSigmas = 5;

int supporters(Image<const float> pixel, Image<const float> sigma, int v, int u) {
    int count = 0;
    const float own = *pixel.at(v, u), spread = *sigma.at(v, u);
    for (int y = std::max(v - kRadius, 0); y <= std::min(v + kRadius, pixel.height - 1); ++y)
        for (int x = std::max(u - kRadius, 0); x <= std::min(u + kRadius, pixel.width - 1); ++x) {
            if (y == v && x == u) continue;
            const float distance = std::hypot(static_cast<float>(y - v), static_cast<float>(x - u));
            const float limit = kSteepest * distance + kSigmas * std::hypot(spread, *sigma.at(y, x));
            count += std::fabs(*pixel.at(y, x) - own) <= limit ? 1 : 0;  // false for NaN
        }
    return count;
}

}  // namespace

void drop_unsupported(Image<const std::uint8_t> weak, int threads, Image<float> pixel_px, Image<float> sigma_px,
                      Image<std::uint16_t> rejected) {
    const Image<const float> pixel{pixel_px.data, pixel_px.height, pixel_px.width, pixel_px.channels};
    const Image<const float> sigma{sigma_px.data, sigma_px.height, sigma_px.width, 1};
    std::vector<std::uint8_t> drop(weak.pixels());
    const auto rows = [&](const auto& action) {
        parallel_for(static_cast<std::size_t>(weak.height), threads, [&](std::size_t begin, std::size_t end) {
            for (int v = static_cast<int>(begin); v < static_cast<int>(end); ++v)
                for (int u = 0; u < weak.width; ++u)
                    if (*weak.at(v, u) != 0) action(v, u, drop[static_cast<std::size_t>(v) * weak.width + u]);
        });
    };
    // First all are judged, then they are dropped: the order of the pixels must not matter.
    rows([&](int v, int u, std::uint8_t& out) { out = supporters(pixel, sigma, v, u) < kNeeded ? 1 : 0; });
    rows([&](int v, int u, const std::uint8_t& unsupported) {
        if (unsupported == 0) return;
        float* place = pixel_px.at(v, u);
        place[0] = place[1] = *sigma_px.at(v, u) = std::numeric_limits<float>::quiet_NaN();
        *rejected.at(v, u) = kDark;
    });
}

}  // namespace planish
