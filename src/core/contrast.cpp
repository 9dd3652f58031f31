#include "core/contrast.hpp"

#include <algorithm>
#include <cmath>
#include <limits>

#include "core/blocks.hpp"
#include "core/parallel.hpp"

namespace planish {
namespace {

constexpr float kNaN = std::numeric_limits<float>::quiet_NaN();

/// The row of what is seen, or of ones.
const unsigned char* seen_row(const Exposed& exposed, int v, const std::vector<unsigned char>& everything) {
    return exposed.seen.empty() ? everything.data() : exposed.seen.row(v);
}

/// The sums of one pixel row: numerator and weight of the mean, and its variance times the squared weight.
struct Sums {
    std::vector<float> value, weight, variance;
    std::vector<std::vector<float>> known;
    std::vector<unsigned char> everything;

    explicit Sums(int width, std::size_t images)
        : value(width),
          weight(width),
          variance(width),
          known(images, std::vector<float>(width)),
          everything(width, 1) {}
};

void add_image(const Exposed& exposed, int v, const float* __restrict inverse, const float* __restrict weight,
               Sums& sums, std::size_t k) {
    const float* __restrict line = exposed.image.row(v);
    float* __restrict known = sums.known[k].data();
    float* __restrict value = sums.value.data();
    float* __restrict total = sums.weight.data();
    const unsigned char* __restrict seen = seen_row(exposed, v, sums.everything);
    const float low = exposed.low, high = exposed.high;
    for (int u = 0; u < exposed.image.width; ++u) {
        const bool counts = (line[u] > low) & (line[u] < high) & (seen[u] != 0);
        const float w = counts ? weight[u] : 0.0F, grey = counts ? line[u] : 0.0F;
        known[u] = counts ? 1.0F : 0.0F;
        value[u] += w * grey * inverse[u];
        total[u] += w;
    }
}

}  // namespace

void block_sums(const Exposed& exposed, int factor, int threads, const Image<float>& sum, const Image<float>& count) {
    const Image<const float>& image = exposed.image;
    const float low = exposed.low, high = exposed.high;
    parallel_for(sum.height, threads, [&](std::size_t first, std::size_t last) {
        std::vector<float> column_sum(image.width), column_count(image.width);
        const std::vector<unsigned char> everything(image.width, 1);
        for (std::size_t y = first; y < last; ++y) {
            std::fill(column_sum.begin(), column_sum.end(), 0.0F);
            std::fill(column_count.begin(), column_count.end(), 0.0F);
            const int top = static_cast<int>(y) * factor, bottom = std::min(image.height, top + factor);
            for (int v = top; v < bottom; ++v) {
                const float* __restrict line = image.row(v);
                const unsigned char* __restrict seen = seen_row(exposed, v, everything);
                for (int u = 0; u < image.width; ++u) {
                    const bool counts = (line[u] > low) & (line[u] < high) & (seen[u] != 0);
                    column_sum[u] += counts ? line[u] : 0.0F;
                    column_count[u] += counts ? 1.0F : 0.0F;
                }
            }
            for (int x = 0; x < sum.width; ++x) {
                const int left = x * factor, right = std::min(image.width, left + factor);
                float s = 0, n = 0;
                for (int u = left; u < right; ++u) s += column_sum[u], n += column_count[u];
                *sum.at(static_cast<int>(y), x) = s;
                *count.at(static_cast<int>(y), x) = n;
            }
        }
    });
}

void camera_contrast(const std::vector<Exposed>& images, const ContrastPlan& plan, int threads,
                     const Image<float>& value, const Image<float>& variance) {
    const std::size_t kinds = images.size();
    const int width = value.width;
    parallel_for(plan.weight[0].height, threads, [&](std::size_t first, std::size_t last) {
        Sums sums(width, kinds);
        std::vector<float> inverse(width);
        std::vector<std::vector<float>> weight(kinds, std::vector<float>(width));
        std::vector<std::vector<float>> noise(kinds * kinds, std::vector<float>(width));
        std::vector<BlockLerp> levels;
        for (const auto& map : plan.inverse_level) levels.emplace_back(map, plan.factor, width);
        for (std::size_t y = first; y < last; ++y) {
            const int top = static_cast<int>(y) * plan.factor, bottom = std::min(value.height, top + plan.factor);
            for (std::size_t k = 0; k < kinds; ++k)
                spread_blocks(plan.weight[k].row(static_cast<int>(y)), plan.factor, width, weight[k].data());
            for (std::size_t k = 0; k < kinds; ++k)
                for (std::size_t l = 0; l < kinds; ++l) {
                    float* __restrict out = noise[k * kinds + l].data();
                    spread_blocks(plan.noise[k * kinds + l].row(static_cast<int>(y)), plan.factor, width, out);
                    for (int u = 0; u < width; ++u) out[u] *= weight[k][u] * weight[l][u];
                }
            for (int v = top; v < bottom; ++v) {
                for (auto* line : {&sums.value, &sums.weight, &sums.variance})
                    std::fill(line->begin(), line->end(), 0.0F);
                for (std::size_t k = 0; k < kinds; ++k) {
                    levels[k].row(v, inverse.data());
                    add_image(images[k], v, inverse.data(), weight[k].data(), sums, k);
                }
                float* __restrict spread = sums.variance.data();
                for (std::size_t k = 0; k < kinds; ++k)
                    for (std::size_t l = 0; l < kinds; ++l) {
                        const float* __restrict part = noise[k * kinds + l].data();
                        const float* __restrict known_k = sums.known[k].data();
                        const float* __restrict known_l = sums.known[l].data();
                        for (int u = 0; u < width; ++u) spread[u] += part[u] * known_k[u] * known_l[u];
                    }
                float* __restrict out_value = value.row(v);
                float* __restrict out_variance = variance.row(v);
                for (int u = 0; u < width; ++u) {
                    const float total = sums.weight[u], per = total > 0 ? 1 / total : kNaN;
                    const float contrast = sums.value[u] * per - 1;
                    out_value[u] = std::clamp(contrast, -plan.limit, plan.limit);
                    out_variance[u] = spread[u] * per * per;
                }
            }
        }
    });
}

}  // namespace planish
