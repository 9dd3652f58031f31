#include <Eigen/Core>
#include <algorithm>
#include <cmath>
#include <limits>
#include <vector>

#include "core/common/cubic.hpp"
#include "core/common/parallel.hpp"
#include "core/texture/blocks.hpp"
#include "core/texture/contrast.hpp"

namespace planish {
namespace {

constexpr float kNaN = std::numeric_limits<float>::quiet_NaN(), kMost = std::numeric_limits<float>::max(),
                kInfinity = std::numeric_limits<float>::infinity();

/// One row of places on another camera's grid, in the steps that loops over whole rows vectorise.
class ReadRow {
  public:
    ReadRow(const ContrastView& view, int width)
        : view_(view),
          pixel_(width),
          nearest_(width),
          block_(width),
          known_(width),
          across_(width),
          down_(4 * width),
          columns_(4 * width),
          gain_(width),
          block_x_(width),
          block_y_(width),
          variance_(width),
          level_(width) {}

    /// The image (1 + value) level and `gain` times its variance.
    void read(const float* place, float gain, float* __restrict image, float* __restrict variance) {
        locate(place);
        const float *values = view_.value.data, *blocks = view_.level.data;
        const int stride = view_.value.width, next_row = view_.level.height > 1 ? view_.level.width : 0,
                  next_column = view_.level.width > 1 ? 1 : 0;
        for (std::size_t u = 0; u < pixel_.size(); ++u) {
            // Where a place is none, all of this is read at the first pixel and comes to nothing.
            const float *line = values + pixel_[u], *weight = down_.data() + 4 * u;
            Eigen::Array4f sum = weight[0] * Eigen::Map<const Eigen::Array4f>(line);
            for (int k = 1; k < 4; ++k) sum += weight[k] * Eigen::Map<const Eigen::Array4f>(line + k * stride);
            Eigen::Map<Eigen::Array4f>(columns_.data() + 4 * u) = sum;
            variance_[u] = view_.variance.data[nearest_[u]];
            const float *above = blocks + block_[u], *below = above + next_row;
            const float a = above[0] + block_x_[u] * (above[next_column] - above[0]);
            const float b = below[0] + block_x_[u] * (below[next_column] - below[0]);
            level_[u] = a + block_y_[u] * (b - a);
        }
        combine(gain, image, variance);
    }

  private:
    /// Pixels, blocks and weights of all places.
    void locate(const float* __restrict place) {
        const int width = view_.value.width, blocks_wide = view_.level.width;
        const auto right = static_cast<float>(width - 2), bottom = static_cast<float>(view_.value.height - 2);
        const auto factor = static_cast<float>(view_.factor);
        const float last_x = static_cast<float>(std::max(0, blocks_wide - 2)),
                    last_y = static_cast<float>(std::max(0, view_.level.height - 2));
        int* __restrict pixel = pixel_.data();
        int* __restrict nearest = nearest_.data();
        int* __restrict block = block_.data();
        float* __restrict known = known_.data();
        float* __restrict across = across_.data();
        float* __restrict down = down_.data();
        float* __restrict gain = gain_.data();
        float* __restrict block_x = block_x_.data();
        float* __restrict block_y = block_y_.data();
        const auto size = static_cast<int>(pixel_.size());
        for (int i = 0; i < size; ++i) {
            const float at_u = place[2 * i], at_v = place[2 * i + 1];
            // False for NaN: no correspondence.
            const bool inside = (at_u >= 1.0F) & (at_v >= 1.0F) & (at_u < right) & (at_v < bottom);
            const float u = inside ? at_u : 1.0F, v = inside ? at_v : 1.0F;
            const int x = static_cast<int>(u), y = static_cast<int>(v);
            const float fx = u - static_cast<float>(x), fy = v - static_cast<float>(y);
            float wx[4], wy[4];
            cubic_weights(fx, wx);
            cubic_weights(fy, wy);
            known[i] = inside ? 1.0F : kNaN;
            pixel[i] = (y - 1) * width + x - 1;
            nearest[i] = (y + (fy >= 0.5F ? 1 : 0)) * width + x + (fx >= 0.5F ? 1 : 0);
            across[i] = fx;
            down[4 * i] = wy[0], down[4 * i + 1] = wy[1], down[4 * i + 2] = wy[2], down[4 * i + 3] = wy[3];
            gain[i] = (wx[0] * wx[0] + wx[1] * wx[1] + wx[2] * wx[2] + wx[3] * wx[3]) *
                      (wy[0] * wy[0] + wy[1] * wy[1] + wy[2] * wy[2] + wy[3] * wy[3]);
            // Between the centres of blocks; beyond the outer ones the rim's value.
            const float bx = std::max((u + 0.5F) / factor - 0.5F, 0.0F),
                        by = std::max((v + 0.5F) / factor - 0.5F, 0.0F);
            const int left = static_cast<int>(std::min(bx, last_x)), top = static_cast<int>(std::min(by, last_y));
            block[i] = top * blocks_wide + left;
            block_x[i] = std::min(bx - static_cast<float>(left), 1.0F);
            block_y[i] = std::min(by - static_cast<float>(top), 1.0F);
        }
    }

    void combine(float gain, float* __restrict image, float* __restrict variance) const {
        for (std::size_t i = 0; i < known_.size(); ++i) {
            float w[4];
            cubic_weights(across_[i], w);
            const float* c = columns_.data() + 4 * i;
            const float value = w[0] * c[0] + w[1] * c[1] + w[2] * c[2] + w[3] * c[3];
            const float level = value == value ? level_[i] * known_[i] : kNaN;
            image[i] = (1 + value) * level;
            variance[i] = variance_[i] * gain_[i] * level * level * gain;
        }
    }

    ContrastView view_;
    std::vector<int> pixel_, nearest_, block_;
    std::vector<float> known_, across_, down_, columns_, gain_, block_x_, block_y_, variance_, level_;
};

/// The image and its variance at the camera's own pixels.
void own_row(const ContrastView& view, int v, const BlockLerp::Row& level, float gain, float* __restrict image,
             float* __restrict variance) {
    const float *value = view.value.row(v), *spread = view.variance.row(v);
    for (int u = 0; u < view.value.width; ++u) {
        const float light = level[u];
        image[u] = (1 + value[u]) * light;
        variance[u] = spread[u] * light * light * gain;
    }
}

/// Sums of one row over the cameras.
struct Merged {
    std::vector<float> weight, total, noise;

    explicit Merged(int width) : weight(width), total(width), noise(width) {}

    void add(const float* __restrict image, const float* __restrict variance, const float* __restrict expected,
             const float* __restrict trust) {
        float* __restrict weights = weight.data();
        float* __restrict totals = total.data();
        float* __restrict noises = noise.data();
        for (int u = 0; u < static_cast<int>(weight.size()); ++u) {
            // 0 for NaN. Factors and divisors of 1 instead of branches, so that the loop vectorises.
            const float known = (variance[u] > 0 ? 1.0F : 0.0F) * (std::fabs(image[u]) <= kMost ? 1.0F : 0.0F) *
                                (expected[u] > 0 ? 1.0F : 0.0F);
            const float light = known > 0 ? expected[u] : 1.0F, grey = known > 0 ? image[u] : 0.0F;
            const float by = trust[u] * (known * light * light / (known > 0 ? variance[u] : 1.0F));
            weights[u] += by;
            totals[u] += by * (grey / light - 1);
            noises[u] += trust[u] * by;
        }
    }

    void finish(const unsigned char* valid, float* __restrict value, float* __restrict sigma) {
        for (int u = 0; u < static_cast<int>(weight.size()); ++u) {
            const bool known = (valid[u] != 0) & (weight[u] > 0);
            const float per = (known ? 1.0F : kNaN) / (known ? weight[u] : 1.0F);
            value[u] = total[u] * per;
            sigma[u] = std::sqrt(noise[u]) * per;
        }
        for (auto* line : {&weight, &total, &noise}) std::fill(line->begin(), line->end(), 0.0F);
    }
};

}  // namespace

void compensated_image(const ContrastView& view, const Image<const float>& place,
                       const Image<const unsigned char>& seen, float gain, int threads, const CompensatedImage& out) {
    const int width = out.image.width;
    // Where there are fewer pixels than cubic convolution takes, nothing is known.
    const bool tiny = !place.empty() && (view.value.width < 4 || view.value.height < 4);
    parallel_for(out.sum.height, threads, [&](std::size_t first, std::size_t last) {
        BlockAdder adder(width, view.factor);
        BlockLerp levels(view.level, view.factor, width);
        ReadRow reader(view, place.empty() ? 0 : width);
        for (auto y = static_cast<int>(first); y < static_cast<int>(last); ++y) {
            for (int v = y * view.factor; v < std::min(out.image.height, (y + 1) * view.factor); ++v) {
                float *image = out.image.row(v), *variance = out.variance.row(v);
                if (tiny) {
                    std::fill_n(image, width, kNaN);
                    std::fill_n(variance, width, kNaN);
                } else if (place.empty()) {
                    own_row(view, v, levels.row(v), gain, image, variance);
                } else {
                    reader.read(place.row(v), gain, image, variance);
                }
                adder.add(image, -kInfinity, kInfinity, seen.row(v));
            }
            adder.finish(out.sum.row(y), out.count.row(y));
        }
    });
}

void merge_contrasts(const std::vector<SeenImage>& images, const Image<const unsigned char>& valid, int factor,
                     int threads, const Image<float>& value, const Image<float>& sigma) {
    const int width = value.width;
    parallel_for(value.height, threads, [&](std::size_t first, std::size_t last) {
        std::vector<BlockLerp> expected, trust;
        for (const auto& image : images) {
            expected.emplace_back(image.expected, factor, width);
            trust.emplace_back(image.trust, factor, width);
        }
        Merged sums(width);
        std::vector<float> light(width), share(width);
        for (auto v = static_cast<int>(first); v < static_cast<int>(last); ++v) {
            for (std::size_t i = 0; i < images.size(); ++i) {
                expected[i].row(v, light.data());
                trust[i].row(v, share.data());
                sums.add(images[i].image.row(v), images[i].variance.row(v), light.data(), share.data());
            }
            sums.finish(valid.row(v), value.row(v), sigma.row(v));
        }
    });
}

}  // namespace planish
