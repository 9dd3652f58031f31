#include "core/texture/contrast.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <stdexcept>

#include "core/common/parallel.hpp"
#include "core/texture/blocks.hpp"

namespace planish {
namespace {

constexpr float kNaN = std::numeric_limits<float>::quiet_NaN(), kMost = std::numeric_limits<float>::max();
/// Sums of weights are never divided by less.
constexpr float kLeastWeight = 1e-30F;

/// The row of what is seen, or of ones.
const unsigned char* seen_row(const Exposed& exposed, int v, const std::vector<unsigned char>& everything) {
    return exposed.seen.empty() ? everything.data() : exposed.seen.row(v);
}

/// 1 / level at all blocks, 0 where it is unknown.
std::vector<float> inverted(const Image<const float>& level) {
    std::vector<float> inverse(level.pixels());
    for (std::size_t i = 0; i < inverse.size(); ++i) inverse[i] = level.data[i] > 0 ? 1 / level.data[i] : 0.0F;
    return inverse;
}

/// Weights of K images, their part of the variance, and that of the covariance of the first and the last.
template <int K>
struct Weights {
    std::array<std::vector<float>, K> weight, noise;
    std::vector<float> common;

    explicit Weights(int width) : common(width) {
        for (auto* lines : {&weight, &noise})
            for (auto& line : *lines) line.resize(width);
    }

    /// Of a row of blocks.
    void compute(const ContrastPlan& plan, int y) {
        const int width = static_cast<int>(common.size());
        for (int k = 0; k < K; ++k) {
            const float* __restrict variance = plan.variance[k].row(y);
            float* __restrict out = weight[k].data();
            for (int x = 0; x < width; ++x) {
                const float w = variance[x] > 0 ? 1 / variance[x] : 0.0F;  // false for NaN
                out[x] = w <= kMost ? w : 0.0F;
            }
        }
        if (!plan.covariance.empty()) correlate(plan, y);
        for (int x = 0; x < width; ++x) {
            float total = 0;
            for (int k = 0; k < K; ++k) total += weight[k][x];
            total = total > kLeastWeight ? total : kLeastWeight;
            for (int k = 0; k < K; ++k) {
                const float w = weight[k][x] / total, variance = plan.variance[k].row(y)[x];
                weight[k][x] = w;
                noise[k][x] = w > 0 ? plan.noise_left * variance * w * w : 0.0F;
            }
            const float both = plan.covariance.empty() ? 0.0F : plan.covariance.row(y)[x];
            common[x] = both > 0 ? 2 * plan.noise_left * both * weight[0][x] * weight[K - 1][x] : 0.0F;
        }
    }

  private:
    /// Inverts the covariance of the first and the last image.
    void correlate(const ContrastPlan& plan, int y) {
        const float* __restrict covariance = plan.covariance.row(y);
        const float* __restrict first = plan.variance[0].row(y);
        const float* __restrict last = plan.variance[K - 1].row(y);
        for (std::size_t x = 0; x < common.size(); ++x) {
            const float smaller = std::fmin(first[x], last[x]);
            const float held = smaller < covariance[x] ? smaller : covariance[x];
            const float determinant = first[x] * last[x] - held * held;
            if (!(determinant > 0 && determinant <= kMost)) continue;  // NaN: one is unknown
            weight[0][x] = (last[x] - held) / determinant;
            weight[K - 1][x] = (first[x] - held) / determinant;
        }
    }
};

/// One row of pixels of an image: grey values with their range, 1 / level, weight and noise.
struct Line {
    const float* grey;
    float low, high;
    BlockLerp::Row inverse;
    const float *weight, *noise;
};

template <int K>
void mix(const std::array<Line, K>& lines, const unsigned char* seen, const float* common, float limit, int width,
         float* __restrict value, float* __restrict variance) {
    for (int u = 0; u < width; ++u) {
        float sum = 0, total = 0, spread = 0, first = 0, last = 0;
        for (int k = 0; k < K; ++k) {
            const Line& line = lines[k];
            const float grey = line.grey[u];
            // False for NaN.
            const bool counts = (grey > line.low) & (grey < line.high) & (seen[u] != 0);
            const float known = counts ? 1.0F : 0.0F, weight = known * line.weight[u];
            sum += weight * (counts ? grey : 0.0F) * line.inverse[u];
            total += weight;
            spread += known * line.noise[u];
            if (k == 0) first = known;
            if (k == K - 1) last = known;
        }
        spread += first * last * common[u];
        const float per = total > 0 ? 1 / total : kNaN, contrast = sum * per - 1;
        const float less = contrast < limit ? contrast : limit, held = less > -limit ? less : -limit;
        value[u] = total > 0 ? held : kNaN;
        variance[u] = spread * per * per;
    }
}

template <int K>
void combine(const std::vector<Exposed>& images, const ContrastPlan& plan, int threads, const CameraContrast& out) {
    const int width = out.value.width, blocks = out.first_weight.width;
    std::array<std::vector<float>, K> inverse;
    for (int k = 0; k < K; ++k) inverse[k] = inverted(plan.level[k]);
    parallel_for(out.first_weight.height, threads, [&](std::size_t begin, std::size_t end) {
        const std::vector<unsigned char> everything(width, 1);
        Weights<K> of_blocks(blocks), of_pixels(width);
        std::vector<BlockLerp> levels;
        for (const auto& map : inverse)
            levels.emplace_back(Image<const float>{map.data(), out.first_weight.height, blocks}, plan.factor, width);
        for (auto y = static_cast<int>(begin); y < static_cast<int>(end); ++y) {
            of_blocks.compute(plan, y);
            std::copy(of_blocks.weight[0].begin(), of_blocks.weight[0].end(), out.first_weight.row(y));
            spread_blocks(of_blocks.common.data(), plan.factor, width, of_pixels.common.data());
            for (int k = 0; k < K; ++k) {
                spread_blocks(of_blocks.weight[k].data(), plan.factor, width, of_pixels.weight[k].data());
                spread_blocks(of_blocks.noise[k].data(), plan.factor, width, of_pixels.noise[k].data());
            }
            for (int v = y * plan.factor; v < std::min(out.value.height, (y + 1) * plan.factor); ++v) {
                std::array<Line, K> lines;
                for (int k = 0; k < K; ++k)
                    lines[k] = {images[k].image.row(v),
                                images[k].low,
                                images[k].high,
                                levels[k].row(v),
                                of_pixels.weight[k].data(),
                                of_pixels.noise[k].data()};
                mix<K>(lines, seen_row(images[0], v, everything), of_pixels.common.data(), plan.limit, width,
                       out.value.row(v), out.variance.row(v));
            }
        }
    });
}

}  // namespace

void block_sums(const Exposed& exposed, int factor, int threads, const Image<float>& sum, const Image<float>& count) {
    const Image<const float>& image = exposed.image;
    parallel_for(sum.height, threads, [&](std::size_t first, std::size_t last) {
        BlockAdder adder(image.width, factor);
        const std::vector<unsigned char> everything(image.width, 1);
        for (auto y = static_cast<int>(first); y < static_cast<int>(last); ++y) {
            for (int v = y * factor; v < std::min(image.height, (y + 1) * factor); ++v)
                adder.add(image.row(v), exposed.low, exposed.high, seen_row(exposed, v, everything));
            adder.finish(sum.row(y), count.row(y));
        }
    });
}

void camera_contrast(const std::vector<Exposed>& images, const ContrastPlan& plan, int threads,
                     const CameraContrast& out) {
    switch (images.size()) {
        case 1:
            return combine<1>(images, plan, threads, out);
        case 2:
            return combine<2>(images, plan, threads, out);
        case 3:
            return combine<3>(images, plan, threads, out);
        default:
            throw std::invalid_argument("one to three kinds of images");
    }
}

}  // namespace planish
