#include "core/decoding/repair_periods.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <vector>

#include "core/common/parallel.hpp"
#include "core/common/rejection.hpp"

namespace planish {
namespace {

constexpr float kNaN = std::numeric_limits<float>::quiet_NaN();
/// Neighbours that must agree to correct a pixel, and to call it a slip.
constexpr int kMinToCorrect = 5, kMinToReject = 3;
/// A pixel with more neighbours at its own position is no slip but the corner of a surface.
constexpr int kMaxAllies = 1;
constexpr float kMaxTolerancePeriods = 0.25F;

struct Maps {
    Image<float> position, sigma;
    Image<std::uint16_t> rejected;
};

struct Decision {
    std::size_t pixel = 0;
    float position = 0;
    std::uint16_t reason = 0;
};

struct Neighbours {
    std::array<float, 8> position;
    int count = 0;
};

Neighbours gather(const Maps& maps, int v, int u) {
    Neighbours found;
    for (int y = std::max(v - 1, 0); y <= std::min(v + 1, maps.position.height - 1); ++y)
        for (int x = std::max(u - 1, 0); x <= std::min(u + 1, maps.position.width - 1); ++x)
            if ((x != u || y != v) && (*maps.rejected.at(y, x) & ~kInterreflection) == 0)
                found.position[found.count++] = *maps.position.at(y, x);
    return found;
}

/// Whole periods too many by the median of the neighbours, how many of them say so (0: they do not tell), and how many
/// side with the pixel itself.
struct Surplus {
    float periods = 0;
    int witnesses = 0, allies = 0;
};

Surplus surplus_periods(Neighbours near, float position, float period, float tolerance) {
    if (near.count < kMinToReject) return {};
    const auto middle = near.position.begin() + near.count / 2, end = near.position.begin() + near.count;
    std::nth_element(near.position.begin(), middle, end);
    const float median = *middle, periods = std::round((position - median) / period);
    if (!(std::fabs(position - median - periods * period) <= tolerance)) return {};
    const auto count = [&](float like) {
        const auto alike = [&](float other) { return std::fabs(other - like) <= 2 * tolerance; };
        return static_cast<int>(std::count_if(near.position.begin(), end, alike));
    };
    return {periods, count(median), count(position)};
}

int count_suspects(const Image<std::uint16_t>& rejected, int v, int u) {
    int suspects = 0;
    for (int y = std::max(v - 2, 0); y <= std::min(v + 2, rejected.height - 1); ++y)
        for (int x = std::max(u - 2, 0); x <= std::min(u + 2, rejected.width - 1); ++x)
            suspects += (*rejected.at(y, x) & kInterreflection) != 0 ? 1 : 0;
    return suspects;
}

/// 1 where a pixel of a row must be looked at.
void find_doubtful(float near, int width, const float* __restrict p, const std::uint16_t* __restrict reason,
                   std::uint8_t* __restrict doubtful) {
    const auto look = [&](int u, bool alike) {
        return static_cast<std::uint8_t>(reason[u] == kSlip || reason[u] == kInterreflection ||
                                         (reason[u] == 0 && !alike));
    };
    for (int u = 1; u < width - 1; ++u) {
        // Not a short circuit, so that the loop vectorises.
        const int alike =
            static_cast<int>(std::fabs(p[u] - p[u - 1]) <= near) & static_cast<int>(std::fabs(p[u] - p[u + 1]) <= near);
        const int marked = static_cast<int>(reason[u] == kSlip) | static_cast<int>(reason[u] == kInterreflection);
        doubtful[u] = static_cast<std::uint8_t>(marked | (static_cast<int>(reason[u] == 0) & (alike ^ 1)));
    }
    doubtful[0] = look(0, width > 1 && std::fabs(p[0] - p[1]) <= near);
    if (width > 1) doubtful[width - 1] = look(width - 1, std::fabs(p[width - 1] - p[width - 2]) <= near);
}

void decide(const Maps& maps, const RepairLimits& limits, int v, int u, std::vector<Decision>& decisions) {
    const std::uint16_t reason = *maps.rejected.at(v, u);
    const float position = *maps.position.at(v, u);
    const auto pixel = static_cast<std::size_t>(maps.position.at(v, u) - maps.position.data);
    if (reason == kInterreflection) {
        const bool guilty = count_suspects(maps.rejected, v, u) >= limits.reflection_pixels;
        decisions.push_back({pixel, guilty ? kNaN : position, guilty ? reason : std::uint16_t{0}});
        return;
    }
    const float tolerance = std::min(std::max(limits.tolerance_px, limits.sigmas * *maps.sigma.at(v, u)),
                                     kMaxTolerancePeriods * limits.period_px);
    const Surplus found = surplus_periods(gather(maps, v, u), position, limits.period_px, tolerance);
    const bool slipped = found.periods != 0 && (reason == kSlip || found.allies <= kMaxAllies);
    if (reason == kSlip && found.periods == 0 && found.witnesses >= kMinToCorrect)
        decisions.push_back({pixel, position, 0});
    else if (slipped && found.witnesses >= kMinToCorrect)
        decisions.push_back({pixel, position - found.periods * limits.period_px, 0});
    else if (reason == kSlip || (slipped && found.witnesses >= kMinToReject))
        decisions.push_back({pixel, kNaN, kSlip});
}

}  // namespace

void repair_periods(Image<float> position, Image<float> sigma, Image<std::uint16_t> rejected,
                    const RepairLimits& limits, int threads) {
    const Maps maps{position, sigma, rejected};
    const auto height = static_cast<std::size_t>(position.height);
    // Decided on the maps as they came, then carried out: the result does not depend on the order.
    std::vector<std::vector<Decision>> by_row(height);
    parallel_for(height, threads, [&](std::size_t begin, std::size_t end) {
        std::vector<std::uint8_t> doubtful(position.width);
        for (std::size_t v = begin; v < end; ++v) {
            const int row = static_cast<int>(v);
            find_doubtful(0.25F * limits.period_px, position.width, position.row(row), rejected.row(row),
                          doubtful.data());
            auto next = std::find(doubtful.begin(), doubtful.end(), 1);
            for (; next != doubtful.end(); next = std::find(next + 1, doubtful.end(), 1))
                decide(maps, limits, row, static_cast<int>(next - doubtful.begin()), by_row[v]);
        }
    });
    for (const auto& decisions : by_row)
        for (const Decision& decision : decisions) {
            position.data[decision.pixel] = decision.position;
            rejected.data[decision.pixel] = decision.reason;
            if (decision.reason != 0) sigma.data[decision.pixel] = kNaN;
        }
}

}  // namespace planish
