#include <algorithm>
#include <cmath>
#include <limits>
#include <optional>

#include "core/blocks.hpp"
#include "core/contrast.hpp"
#include "core/cubic.hpp"
#include "core/parallel.hpp"

namespace planish {
namespace {

constexpr float kNaN = std::numeric_limits<float>::quiet_NaN();

struct Read {
    float value = kNaN, variance = kNaN;
};

Read read_cubic(const ContrastView& view, float u, float v) {
    const int width = view.value.width, height = view.value.height;
    // False for NaN: no correspondence.
    if (!(u >= 1.0F && v >= 1.0F && u < static_cast<float>(width - 2) && v < static_cast<float>(height - 2))) return {};
    const int x = static_cast<int>(u), y = static_cast<int>(v);
    const float fx = u - static_cast<float>(x), fy = v - static_cast<float>(y);
    float wx[4], wy[4];
    cubic_weights(fx, wx);
    cubic_weights(fy, wy);
    const float squares_x = wx[0] * wx[0] + wx[1] * wx[1] + wx[2] * wx[2] + wx[3] * wx[3];
    const float squares_y = wy[0] * wy[0] + wy[1] * wy[1] + wy[2] * wy[2] + wy[3] * wy[3];
    float value = 0;
    for (int k = 0; k < 4; ++k) {
        const float* line = view.value.at(y + k - 1, x - 1);
        value += wy[k] * (wx[0] * line[0] + wx[1] * line[1] + wx[2] * line[2] + wx[3] * line[3]);
    }
    const float variance = *view.variance.at(y + (fy >= 0.5F), x + (fx >= 0.5F));
    return {value, variance * squares_x * squares_y};
}

/// Rows of one view on the organising grid.
class ViewRows {
  public:
    ViewRows(const ContrastView& view, int factor, int width)
        : view_(view),
          shading_map_(view.shading, factor, width),
          trust_map_(view.trust, factor, width),
          shading_(width),
          trust_(width),
          value_(width),
          variance_(width) {}

    /// Adds weight, weighted value, and the variance of that.
    void add(int v, float* __restrict weights, float* __restrict total, float* __restrict noise) {
        const auto width = static_cast<int>(shading_.size());
        const float* value = view_.value.row(v);
        const float* variance = view_.variance.row(v);
        if (!view_.place.empty()) {
            for (int u = 0; u < width; ++u) {
                const float* place = view_.place.at(v, u);
                const Read read = read_cubic(view_, place[0], place[1]);
                value_[u] = read.value;
                variance_[u] = read.variance;
            }
            value = value_.data();
            variance = variance_.data();
        }
        shading_map_.row(v, shading_.data());
        trust_map_.row(v, trust_.data());
        for (int u = 0; u < width; ++u) {
            const bool known = variance[u] > 0 && std::isfinite(value[u]) && shading_[u] > 0;
            const float per = known ? 1 / shading_[u] : 0.0F;
            const float weight = known ? 1 / (variance[u] * per * per) : 0.0F;
            const float corrected = known ? (1 + value[u]) * per - 1 : 0.0F;
            weights[u] += trust_[u] * weight;
            total[u] += trust_[u] * weight * corrected;
            noise[u] += trust_[u] * trust_[u] * weight;
        }
    }

  private:
    const ContrastView& view_;
    BlockLerp shading_map_, trust_map_;
    std::vector<float> shading_, trust_, value_, variance_;
};

}  // namespace

void merge_contrasts(const std::vector<ContrastView>& views, const Image<const unsigned char>& valid, int factor,
                     int threads, const Image<float>& value, const Image<float>& sigma) {
    const int width = value.width;
    parallel_for(value.height, threads, [&](std::size_t first, std::size_t last) {
        std::vector<ViewRows> rows;
        rows.reserve(views.size());
        for (const auto& view : views) rows.emplace_back(view, factor, width);
        std::vector<float> weights(width), total(width), noise(width);
        for (auto v = static_cast<int>(first); v < static_cast<int>(last); ++v) {
            for (auto* line : {&weights, &total, &noise}) std::fill(line->begin(), line->end(), 0.0F);
            for (auto& view : rows) view.add(v, weights.data(), total.data(), noise.data());
            const unsigned char* points = valid.row(v);
            for (int u = 0; u < width; ++u) {
                const float per = points[u] != 0 && weights[u] > 0 ? 1 / weights[u] : kNaN;
                value.row(v)[u] = total[u] * per;
                sigma.row(v)[u] = std::sqrt(noise[u]) * per;
            }
        }
    });
}

}  // namespace planish
