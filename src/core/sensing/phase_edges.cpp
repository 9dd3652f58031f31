#include "core/sensing/phase_edges.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <vector>

#include "core/common/parallel.hpp"

namespace planish {
namespace {

constexpr float kNaN = std::numeric_limits<float>::quiet_NaN();
/// A comparison of two differences without a common pixel has variance 4 sigma^2.
constexpr float kComparison = 2.0F;

/// Marks the jumps between the third and the fourth of six lines of pixels; sigma is that of the third.
void find_jumps(const float* a, const float* b, const float* c, const float* d, const float* e, const float* f,
                const float* sigma, float jump, float sigmas, int n, std::int32_t* jumps) {
    for (int u = 0; u < n; ++u) {
        const float step = d[u] - c[u], spread = sigmas * kComparison * sigma[u], limit = spread > jump ? spread : jump;
        const float s1 = b[u] - a[u], s2 = c[u] - b[u], s3 = e[u] - d[u], s4 = f[u] - e[u];
        const std::int32_t known = (s1 == s1 ? 1 : 0) + (s2 == s2 ? 1 : 0) + (s3 == s3 ? 1 : 0) + (s4 == s4 ? 1 : 0);
        const std::int32_t alike = (std::fabs(s1 - step) <= limit ? 1 : 0) + (std::fabs(s2 - step) <= limit ? 1 : 0) +
                                   (std::fabs(s3 - step) <= limit ? 1 : 0) + (std::fabs(s4 - step) <= limit ? 1 : 0);
        const std::int32_t needed = known < 2 ? known : 2;
        jumps[u] = (step == step) & (alike < needed) ? 1 : 0;
    }
}

/// Adds to the jumps above a row those below it and those on either side (`along`: one before the first pixel).
void join_marks(const std::int32_t* below, const std::int32_t* along, int n, std::int32_t* edge) {
    for (int u = 0; u < n; ++u) edge[u] |= below[u] | along[u] | along[u + 1];
}

void drop(const std::int32_t* edge, const float* values, int n, float* out) {
    for (int u = 0; u < n; ++u) out[u] = edge[u] == 0 ? values[u] : kNaN;
}

void reject(const std::int32_t* edge, const std::uint16_t* rejected, std::int32_t reason, int n, std::uint16_t* out) {
    for (int u = 0; u < n; ++u) out[u] = static_cast<std::uint16_t>(rejected[u] | (edge[u] != 0 ? reason : 0));
}

}  // namespace

void phase_edges(const PhaseMaps& maps, float jump, float sigmas, std::uint16_t reason, int threads,
                 const PhaseMapsOut& out) {
    const int width = maps.position_px.width, height = maps.position_px.height;
    const auto size = static_cast<std::size_t>(width);
    const std::vector<float> nothing(size, kNaN);
    const auto row = [&](int v) { return v < 0 || v >= height ? nothing.data() : maps.position_px.row(v); };
    // Jumps between rows v and v + 1.
    const auto below = [&](int v, std::int32_t* jumps) {
        find_jumps(row(v - 2), row(v - 1), row(v), row(v + 1), row(v + 2), row(v + 3),
                   v < 0 ? nothing.data() : maps.sigma_px.row(v), jump, sigmas, width, jumps);
    };
    parallel_for(static_cast<std::size_t>(height), threads, [&](std::size_t begin, std::size_t end) {
        // Three pixels beyond either end of the row, and one jump before its first pixel.
        std::vector<float> line(size + 6, kNaN);
        std::vector<std::int32_t> along(size + 1, 0), up(size), down(size);
        below(static_cast<int>(begin) - 1, down.data());
        for (int v = static_cast<int>(begin); v < static_cast<int>(end); ++v) {
            std::swap(up, down);
            below(v, down.data());
            const float *position = maps.position_px.row(v), *sigma = maps.sigma_px.row(v);
            std::copy_n(position, width, line.begin() + 3);
            const float* p = line.data() + 3;
            find_jumps(p - 2, p - 1, p, p + 1, p + 2, p + 3, sigma, jump, sigmas, width, along.data() + 1);
            join_marks(down.data(), along.data(), width, up.data());
            drop(up.data(), position, width, out.position_px.row(v));
            drop(up.data(), sigma, width, out.sigma_px.row(v));
            reject(up.data(), maps.rejected.row(v), reason, width, out.rejected.row(v));
        }
    });
}

}  // namespace planish
