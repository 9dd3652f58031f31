#include "core/sensing/check_points.hpp"

#include <cmath>
#include <limits>
#include <vector>

#include "core/common/parallel.hpp"

namespace planish {
namespace {

constexpr float kNaN = std::numeric_limits<float>::quiet_NaN();

// The loops are functions of values, not of references: what they write could otherwise be what they count to.

/// Reasons and depth of n points. Without a point the numbers are NaN, and comparisons of NaN are false.
void find_reasons(const float* p, const float* miss, const float* residual, const float* spread, CheckLimits limits,
                  CheckReasons reasons, Eigen::Vector4f toward, int n, std::int32_t* reason, float* z) {
    const int unmatched = reasons.unmatched, outside = reasons.outside, mismatch = reasons.mismatch;
    const Eigen::Vector3f low = limits.low, high = limits.high;
    for (int u = 0; u < n; ++u) {
        const float a = p[3 * u], b = p[3 * u + 1], c = p[3 * u + 2];
        const bool out = (a < low[0]) | (a > high[0]) | (b < low[1]) | (b > high[1]) | (c < low[2]) | (c > high[2]);
        const bool off = (std::fabs(miss[u]) > limits.max_miss_px) |
                         (std::fabs(residual[u]) > limits.projector_px + limits.sigmas * spread[u]);
        reason[u] = (c == c ? 0 : unmatched) | (out ? outside : 0) | (off ? mismatch : 0);
        z[u] = toward[0] * a + toward[1] * b + toward[2] * c + toward[3];
    }
}

/// `unmatched` is no reason where there is another one; where there is any, there is no depth.
void add_reasons(std::int32_t* reason, std::int32_t unmatched, int n, std::uint16_t* rejected, float* z) {
    for (int u = 0; u < n; ++u) {
        const std::int32_t before = rejected[u];
        reason[u] = before | (before == 0 ? reason[u] : reason[u] & ~unmatched);
    }
    for (int u = 0; u < n; ++u) rejected[u] = static_cast<std::uint16_t>(reason[u]);
    for (int u = 0; u < n; ++u) z[u] = reason[u] == 0 ? z[u] : kNaN;
}

template <int kChannels>
void drop(const std::uint16_t* rejected, int n, float* x) {
    for (int u = 0; u < n; ++u)
        for (int k = 0; k < kChannels; ++k) x[kChannels * u + k] = rejected[u] == 0 ? x[kChannels * u + k] : kNaN;
}

}  // namespace

void check_points(const CheckedPoints& in, const CheckLimits& limits, const CheckReasons& reasons, int threads,
                  Image<std::uint16_t> rejected, Image<float> depth) {
    const int width = rejected.width;
    const Eigen::Vector4f toward = in.depth_row;
    parallel_for(static_cast<std::size_t>(rejected.height), threads, [&](std::size_t begin, std::size_t end) {
        const auto size = static_cast<std::size_t>(width);
        std::vector<float> residual(size, 0.0F), spread(size, 0.0F);
        std::vector<std::int32_t> found(size);
        for (int v = static_cast<int>(begin); v < static_cast<int>(end); ++v) {
            const float *p = in.points_sensor.row(v), *miss = in.miss_px.row(v);
            if (in.projector != nullptr)
                in.projector->residual(p, in.sigma_mm.row(v), in.position_px.row(v), in.position_sigma_px.row(v), width,
                                       residual.data(), spread.data());
            float* z = depth.row(v);
            const float *r = residual.data(), *s = spread.data();
            std::int32_t* reason = found.data();
            find_reasons(p, miss, r, s, limits, reasons, toward, width, reason, z);
            add_reasons(reason, reasons.unmatched, width, rejected.row(v), z);
        }
    });
}

void drop_rejected(Image<const std::uint16_t> rejected, int threads, Image<float> values) {
    parallel_for(static_cast<std::size_t>(rejected.height), threads, [&](std::size_t begin, std::size_t end) {
        for (int v = static_cast<int>(begin); v < static_cast<int>(end); ++v) {
            if (values.channels == 3)
                drop<3>(rejected.row(v), rejected.width, values.row(v));
            else if (values.channels == 2)
                drop<2>(rejected.row(v), rejected.width, values.row(v));
            else
                drop<1>(rejected.row(v), rejected.width, values.row(v));
        }
    });
}

}  // namespace planish
