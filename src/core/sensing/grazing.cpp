#include "core/sensing/grazing.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <vector>

#include "core/common/parallel.hpp"

namespace planish {
namespace {

/// Change per pixel from the neighbours on both sides, or from the one there is; 0 where there is none.
inline float slope(float before, float here, float after) {
    const bool has_before = before == before, has_after = after == after;
    const float one = has_before ? here - before : (has_after ? after - here : 0.0F);
    return has_before & has_after ? 0.5F * (after - before) : one;
}

/// A row with one value beyond either end.
class Framed {
  public:
    Framed(int width, float beyond) : values_(static_cast<std::size_t>(width) + 2, beyond) {}
    const float* take(const float* row) {
        std::copy_n(row, values_.size() - 2, values_.begin() + 1);
        return values_.data() + 1;
    }

  private:
    std::vector<float> values_;
};

/// Depth (framed) and rows around it, positions (framed) and rows around them. By value: see check_points.cpp.
void mark_row(const float* z, const float* above, const float* below, const float* sigma, const float* x,
              const float* x_above, const float* x_below, GrazingLimits limits, int n, std::uint8_t* mark) {
    const float steepest = limits.max_slope * limits.pixel_size, rim_px = limits.rim_px, sigmas = limits.sigmas;
    for (int u = 0; u < n; ++u) {
        const float along = slope(z[u - 1], z[u], z[u + 1]), down = slope(above[u], z[u], below[u]);
        const float change = std::sqrt(along * along + down * down);
        // NaN if any of the four neighbours is unlit.
        const float rim = (x[u - 1] + x[u + 1]) + (x_above[u] + x_below[u]);
        const bool steep = change > steepest * z[u], cut = (rim != rim) & (rim_px * change > sigmas * sigma[u]);
        mark[u] = ((z[u] == z[u]) & (steep | cut)) ? 1 : 0;
    }
}

}  // namespace

void grazing_points(Image<const float> depth, Image<const float> sigma, Image<const float> position,
                    const GrazingLimits& limits, int threads, Image<std::uint8_t> grazing) {
    constexpr float kNaN = std::numeric_limits<float>::quiet_NaN();
    const int height = depth.height, width = depth.width;
    // Beyond the image there is no depth, but nothing is unlit either.
    const std::vector<float> no_depth(static_cast<std::size_t>(width), kNaN),
        lit(static_cast<std::size_t>(width), 0.0F);
    parallel_for(static_cast<std::size_t>(height), threads, [&](std::size_t begin, std::size_t end) {
        Framed depths(width, kNaN), positions(width, 0.0F);
        for (int v = static_cast<int>(begin); v < static_cast<int>(end); ++v) {
            const float *z = depths.take(depth.row(v)), *x = positions.take(position.row(v)), *s = sigma.row(v);
            const float *above = v > 0 ? depth.row(v - 1) : no_depth.data(),
                        *below = v + 1 < height ? depth.row(v + 1) : no_depth.data();
            const float *x_above = v > 0 ? position.row(v - 1) : lit.data(),
                        *x_below = v + 1 < height ? position.row(v + 1) : lit.data();
            std::uint8_t* mark = grazing.row(v);
            mark_row(z, above, below, s, x, x_above, x_below, limits, width, mark);
        }
    });
}

}  // namespace planish
