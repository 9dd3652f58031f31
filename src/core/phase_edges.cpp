#include "core/phase_edges.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <vector>

#include "core/parallel.hpp"

namespace planish {
namespace {

/// A comparison of two differences without a common pixel has variance 4 sigma^2.
constexpr float kComparison = 2.0F;

/// Six pixels in line, the jump is asked for between the third and the fourth; sigma is that of the third.
inline bool is_jump(float a, float b, float c, float d, float e, float f, float sigma, float jump, float sigmas) {
    const float step = d - c, limit = std::max(jump, sigmas * kComparison * sigma);
    const std::array<float, 4> others{b - a, c - b, e - d, f - e};
    int known = 0, alike = 0;
    for (const float other : others) {
        known += other == other ? 1 : 0;
        alike += std::fabs(other - step) <= limit ? 1 : 0;
    }
    return step == step && alike < std::min(known, 2);
}

}  // namespace

void phase_edges(Image<const float> position, Image<const float> sigma, float jump, float sigmas, int threads,
                 Image<std::uint8_t> edge) {
    const int width = position.width, height = position.height;
    const std::vector<float> nothing(static_cast<std::size_t>(width) + 6, std::numeric_limits<float>::quiet_NaN());
    const auto row = [&](int v) { return v < 0 || v >= height ? nothing.data() : position.row(v); };
    // Jumps between v and v + 1 mark both rows: each row therefore asks for the pair above and the pair below it.
    const auto columns = [&](int v, std::uint8_t* __restrict out) {
        if (v < 0 || v + 1 >= height) return;
        const float *a = row(v - 2), *b = row(v - 1), *c = row(v), *d = row(v + 1), *e = row(v + 2), *f = row(v + 3);
        const float* s = sigma.row(v);
        for (int u = 0; u < width; ++u)
            out[u] |= is_jump(a[u], b[u], c[u], d[u], e[u], f[u], s[u], jump, sigmas) ? 1 : 0;
    };
    parallel_for(static_cast<std::size_t>(height), threads, [&](std::size_t begin, std::size_t end) {
        std::vector<float> line(nothing.begin(), nothing.end());
        std::vector<std::uint8_t> jumps(static_cast<std::size_t>(width));
        for (std::size_t i = begin; i < end; ++i) {
            const int v = static_cast<int>(i);
            std::uint8_t* out = edge.row(v);
            std::fill_n(out, width, std::uint8_t{0});
            columns(v - 1, out);
            columns(v, out);
            std::copy_n(position.row(v), width, line.begin() + 3);
            const float* p = line.data();
            const float* s = sigma.row(v);
            for (int u = 0; u < width; ++u)
                jumps[u] =
                    is_jump(p[u + 1], p[u + 2], p[u + 3], p[u + 4], p[u + 5], p[u + 6], s[u], jump, sigmas) ? 1 : 0;
            for (int u = 0; u < width; ++u) out[u] |= jumps[u];
            for (int u = 1; u < width; ++u) out[u] |= jumps[u - 1];
        }
    });
}

}  // namespace planish
