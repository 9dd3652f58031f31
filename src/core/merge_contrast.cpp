#include <Eigen/Core>
#include <algorithm>
#include <cmath>
#include <limits>
#include <vector>

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

Read read_cubic(const Image<const float>& values, const Image<const float>& variances, float u, float v) {
    const int width = values.width, height = values.height;
    // False for NaN: no correspondence.
    if (!(u >= 1.0F && v >= 1.0F && u < static_cast<float>(width - 2) && v < static_cast<float>(height - 2))) return {};
    const int x = static_cast<int>(u), y = static_cast<int>(v);
    const float fx = u - static_cast<float>(x), fy = v - static_cast<float>(y);
    float wx[4], wy[4];
    cubic_weights(fx, wx);
    cubic_weights(fy, wy);
    const float squares_x = wx[0] * wx[0] + wx[1] * wx[1] + wx[2] * wx[2] + wx[3] * wx[3];
    const float squares_y = wy[0] * wy[0] + wy[1] * wy[1] + wy[2] * wy[2] + wy[3] * wy[3];
    Eigen::Array4f columns = Eigen::Array4f::Zero();
    for (int k = 0; k < 4; ++k) columns += wy[k] * Eigen::Map<const Eigen::Array4f>(values.at(y + k - 1, x - 1));
    const float value = (columns * Eigen::Map<const Eigen::Array4f>(wx)).sum();
    const float variance = *variances.at(y + (fy >= 0.5F), x + (fx >= 0.5F));
    return {value, variance * squares_x * squares_y};
}

}  // namespace

void compensated_image(const ContrastView& view, const Image<const float>& place, int height, int width, int threads,
                       const Image<float>& image, const Image<float>& variance) {
    parallel_for(height, threads, [&](std::size_t first, std::size_t last) {
        BlockLerp levels(view.level, view.factor, width);
        std::vector<float> row(width);
        for (auto v = static_cast<int>(first); v < static_cast<int>(last); ++v) {
            if (place.empty()) levels.row(v, row.data());
            for (int u = 0; u < width; ++u) {
                Read read;
                float level = row[u];
                if (place.empty()) {
                    read = {*view.value.at(v, u), *view.variance.at(v, u)};
                } else {
                    const float* at = place.at(v, u);
                    read = read_cubic(view.value, view.variance, at[0], at[1]);
                    level = read.value == read.value ? between_blocks(view.level, view.factor, at[0], at[1]) : kNaN;
                }
                *image.at(v, u) = (1 + read.value) * level;
                *variance.at(v, u) = read.variance * level * level;
            }
        }
    });
}

void merge_contrasts(const std::vector<SeenImage>& images, const Image<const unsigned char>& valid, int factor,
                     int threads, const Image<float>& value, const Image<float>& sigma) {
    const int width = value.width;
    parallel_for(value.height, threads, [&](std::size_t first, std::size_t last) {
        std::vector<BlockLerp> expected_maps, trust_maps;
        for (const auto& image : images) {
            expected_maps.emplace_back(image.expected, factor, width);
            trust_maps.emplace_back(image.trust, factor, width);
        }
        std::vector<float> expected(width), trust(width), weights(width), total(width), noise(width);
        for (auto v = static_cast<int>(first); v < static_cast<int>(last); ++v) {
            for (auto* line : {&weights, &total, &noise}) std::fill(line->begin(), line->end(), 0.0F);
            for (std::size_t i = 0; i < images.size(); ++i) {
                expected_maps[i].row(v, expected.data());
                trust_maps[i].row(v, trust.data());
                const float* grey = images[i].image.row(v);
                const float* variance = images[i].variance.row(v);
                for (int u = 0; u < width; ++u) {
                    const bool known = variance[u] > 0 && std::isfinite(grey[u]) && expected[u] > 0;
                    const float weight = known ? expected[u] * expected[u] / variance[u] : 0.0F;
                    const float contrast = known ? grey[u] / expected[u] - 1 : 0.0F;
                    weights[u] += trust[u] * weight;
                    total[u] += trust[u] * weight * contrast;
                    noise[u] += trust[u] * trust[u] * weight;
                }
            }
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
