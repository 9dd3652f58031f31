#include "core/grazing.hpp"

#include <cmath>
#include <limits>

#include "core/parallel.hpp"

namespace planish {
namespace {

/// Change per pixel from the neighbours on both sides, or from the one there is; 0 where there is none.
float slope(float before, float here, float after) {
    const bool has_before = before == before, has_after = after == after;
    if (has_before && has_after) return 0.5F * (after - before);
    if (has_before) return here - before;
    return has_after ? after - here : 0.0F;
}

}  // namespace

void grazing_points(Image<const float> depth, Image<const float> sigma, Image<const std::uint8_t> lit,
                    const GrazingLimits& limits, int threads, Image<std::uint8_t> grazing) {
    const int height = depth.height, width = depth.width;
    constexpr float kNaN = std::numeric_limits<float>::quiet_NaN();
    const auto z = [&](int v, int u) { return v < 0 || v >= height || u < 0 || u >= width ? kNaN : *depth.at(v, u); };
    const auto unlit = [&](int v, int u) { return v >= 0 && v < height && u >= 0 && u < width && *lit.at(v, u) == 0; };
    parallel_for(static_cast<std::size_t>(height), threads, [&](std::size_t begin, std::size_t end) {
        for (std::size_t i = begin; i < end; ++i) {
            const int v = static_cast<int>(i);
            for (int u = 0; u < width; ++u) {
                const float here = *depth.at(v, u);
                std::uint8_t& mark = *grazing.at(v, u);
                mark = 0;
                if (!(here == here)) continue;
                const float along = slope(z(v, u - 1), here, z(v, u + 1)), down = slope(z(v - 1, u), here, z(v + 1, u));
                const float change = std::sqrt(along * along + down * down);
                const bool rim = unlit(v, u - 1) || unlit(v, u + 1) || unlit(v - 1, u) || unlit(v + 1, u);
                mark = change > limits.max_slope * limits.pixel_size * here ||
                               (rim && limits.rim_px * change > limits.sigmas * *sigma.at(v, u))
                           ? 1
                           : 0;
            }
        }
    });
}

}  // namespace planish
