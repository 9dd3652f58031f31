#include "core/check_points.hpp"

#include <cmath>
#include <limits>
#include <vector>

#include "core/parallel.hpp"

namespace planish {
namespace {

constexpr float kNaN = std::numeric_limits<float>::quiet_NaN();

}  // namespace

void check_points(const CheckedPoints& in, const CheckLimits& limits, const CheckReasons& reasons, int threads,
                  Image<std::uint16_t> rejected, Image<float> depth) {
    const int width = rejected.width;
    const Eigen::Vector3f low = limits.low, high = limits.high;
    const Eigen::Vector4f toward = in.depth_row;
    const int unmatched = reasons.unmatched, outside = reasons.outside, mismatch = reasons.mismatch;
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
            // Without a point the numbers are NaN, and comparisons of NaN are false.
            for (int u = 0; u < width; ++u) {
                const float a = p[3 * u], b = p[3 * u + 1], c = p[3 * u + 2];
                const bool out =
                    (a < low[0]) | (a > high[0]) | (b < low[1]) | (b > high[1]) | (c < low[2]) | (c > high[2]);
                const bool off = (std::fabs(miss[u]) > limits.max_miss_px) |
                                 (std::fabs(r[u]) > limits.projector_px + limits.sigmas * s[u]);
                reason[u] = (c == c ? 0 : unmatched) | (out ? outside : 0) | (off ? mismatch : 0);
                z[u] = toward[0] * a + toward[1] * b + toward[2] * c + toward[3];
            }
            std::uint16_t* mask = rejected.row(v);
            for (int u = 0; u < width; ++u) {
                const std::int32_t before = mask[u], now = before | (before == 0 ? reason[u] : reason[u] & ~unmatched);
                mask[u] = static_cast<std::uint16_t>(now);
                z[u] = now == 0 ? z[u] : kNaN;
            }
        }
    });
}

void drop_rejected(Image<const std::uint16_t> rejected, int threads, Image<float> values) {
    const int width = rejected.width, channels = values.channels;
    parallel_for(static_cast<std::size_t>(rejected.height), threads, [&](std::size_t begin, std::size_t end) {
        for (int v = static_cast<int>(begin); v < static_cast<int>(end); ++v) {
            const std::uint16_t* mask = rejected.row(v);
            float* x = values.row(v);
            if (channels == 1) {
                for (int u = 0; u < width; ++u) x[u] = mask[u] == 0 ? x[u] : kNaN;
            } else if (channels == 2) {
                for (int u = 0; u < width; ++u) {
                    x[2 * u] = mask[u] == 0 ? x[2 * u] : kNaN;
                    x[2 * u + 1] = mask[u] == 0 ? x[2 * u + 1] : kNaN;
                }
            } else {
                for (int u = 0; u < width; ++u)
                    for (int k = 0; k < channels; ++k) x[channels * u + k] = mask[u] == 0 ? x[channels * u + k] : kNaN;
            }
        }
    });
}

}  // namespace planish
