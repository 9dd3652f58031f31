#include "core/sensing/temporal_support.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <vector>

#include "core/common/parallel.hpp"
#include "core/common/rejection.hpp"

namespace planish {
namespace {

constexpr int kRadius = 2, kNeeded = 6;
/// The corresponding place moves by at most so many pixels per pixel of the organising camera, and by noise.
constexpr float kSteepest = 3, kSigmas = 5;
/// Pixels of the organising camera that lie further apart do not fall on one place of a surface that can be measured.
constexpr int kFar = 12;

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

void reject(int v, int u, Rejection reason, Image<float> pixel_px, Image<float> sigma_px,
            Image<std::uint16_t> rejected) {
    float* place = pixel_px.at(v, u);
    place[0] = place[1] = *sigma_px.at(v, u) = std::numeric_limits<float>::quiet_NaN();
    *rejected.at(v, u) = reason;
}

/// Own pixel that has a place of the other image with the least loss.
struct Claim {
    float loss = std::numeric_limits<float>::infinity();
    int v = -1, u = -1;
};

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
        if (unsupported != 0) reject(v, u, kDark, pixel_px, sigma_px, rejected);
    });
}

void drop_contested(Image<const float> loss, int height, int width, Image<float> pixel_px, Image<float> sigma_px,
                    Image<std::uint16_t> rejected) {
    std::vector<Claim> claims(static_cast<std::size_t>(height) * width);
    const auto pixels = [&](const auto& action) {
        for (int v = 0; v < loss.height; ++v)
            for (int u = 0; u < loss.width; ++u) {
                const float* place = pixel_px.at(v, u);
                const auto x = std::lround(place[0]), y = std::lround(place[1]);
                if (place[0] == place[0] && x >= 0 && y >= 0 && x < width && y < height)
                    action(v, u, claims.data() + static_cast<std::size_t>(y) * width, static_cast<int>(x));
            }
    };
    // One pixel after the other: of equal losses the first counts, for any number of threads.
    pixels([&](int v, int u, Claim* row, int x) {
        if (*loss.at(v, u) < row[x].loss) row[x] = {*loss.at(v, u), v, u};
    });
    pixels([&](int v, int u, const Claim* row, int x) {
        bool contested = false;
        for (int i = std::max(x - 1, 0); i <= std::min(x + 1, width - 1); ++i)
            contested = contested || (row[i].loss < *loss.at(v, u) &&
                                      std::max(std::abs(row[i].v - v), std::abs(row[i].u - u)) > kFar);
        if (contested) reject(v, u, kUnmatched, pixel_px, sigma_px, rejected);
    });
}

}  // namespace planish
