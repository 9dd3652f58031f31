#include "core/repair_periods.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>

#include "core/parallel.hpp"
#include "core/rejection.hpp"

namespace planish {
namespace {

constexpr float kNaN = std::numeric_limits<float>::quiet_NaN();
constexpr int kMinNeighbours = 5;

struct Neighbours {
    std::array<float, 8> position;
    int count = 0;
};

Neighbours gather(Image<const float> position, Image<const std::uint16_t> rejected, int v, int u) {
    Neighbours found;
    for (int y = std::max(v - 1, 0); y <= std::min(v + 1, position.height - 1); ++y)
        for (int x = std::max(u - 1, 0); x <= std::min(u + 1, position.width - 1); ++x)
            if ((x != u || y != v) && *rejected.at(y, x) == 0) found.position[found.count++] = *position.at(y, x);
    return found;
}

/// Whole periods to take away, or NaN where the neighbours do not tell.
float surplus_periods(Neighbours near, float position, float period, float tolerance) {
    if (near.count < kMinNeighbours) return kNaN;
    const auto middle = near.position.begin() + near.count / 2, end = near.position.begin() + near.count;
    std::nth_element(near.position.begin(), middle, end);
    const float median = *middle;
    const auto agree = std::count_if(near.position.begin(), end,
                                     [&](float other) { return std::fabs(other - median) <= 2 * tolerance; });
    const float periods = std::round((position - median) / period);
    return agree >= kMinNeighbours && std::fabs(position - median - periods * period) <= tolerance ? periods : kNaN;
}

}  // namespace

void repair_periods(Image<const float> position, Image<const float> sigma, Image<const std::uint16_t> rejected,
                    float period, float tolerance, float sigmas, int threads, Image<float> out_position,
                    Image<float> out_sigma, Image<std::uint16_t> out_rejected) {
    const int width = position.width;
    const float near = 0.25F * period;
    parallel_for(static_cast<std::size_t>(position.height), threads, [&](std::size_t begin, std::size_t end) {
        for (std::size_t i = begin; i < end; ++i) {
            const int v = static_cast<int>(i);
            const float* p = position.row(v);
            const std::uint16_t* reason = rejected.row(v);
            float* out = out_position.row(v);
            float* out_s = out_sigma.row(v);
            std::uint16_t* out_reason = out_rejected.row(v);
            std::copy_n(p, width, out);
            std::copy_n(sigma.row(v), width, out_s);
            std::copy_n(reason, width, out_reason);
            for (int u = 0; u < width; ++u) {
                if (reason[u] != 0 && reason[u] != kSlip) continue;
                const bool alike = (u > 0 && std::fabs(p[u] - p[u - 1]) <= near) ||
                                   (u + 1 < width && std::fabs(p[u] - p[u + 1]) <= near);
                if (reason[u] == 0 && alike) continue;
                const float limit = std::max(tolerance, sigmas * out_s[u]);
                const float periods = surplus_periods(gather(position, rejected, v, u), p[u], period, limit);
                if (periods == periods) {
                    out[u] = p[u] - periods * period;
                    out_reason[u] = 0;
                } else if (reason[u] == kSlip) {
                    out[u] = out_s[u] = kNaN;
                }
            }
        }
    });
}

}  // namespace planish
