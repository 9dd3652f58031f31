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

    /// The image (1 + value) level and its variance.
    void read(const float* place, float* __restrict image, float* __restrict variance) {
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
        combine(image, variance);
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

    void combine(float* __restrict image, float* __restrict variance) const {
        for (std::size_t i = 0; i < known_.size(); ++i) {
            float w[4];
            cubic_weights(across_[i], w);
            const float* c = columns_.data() + 4 * i;
            const float value = w[0] * c[0] + w[1] * c[1] + w[2] * c[2] + w[3] * c[3];
            const float level = value == value ? level_[i] * known_[i] : kNaN;
            image[i] = (1 + value) * level;
            variance[i] = variance_[i] * gain_[i] * level * level;
        }
    }

    ContrastView view_;
    std::vector<int> pixel_, nearest_, block_;
    std::vector<float> known_, across_, down_, columns_, gain_, block_x_, block_y_, variance_, level_;
};

}  // namespace

void compensated_image(const ContrastView& view, const Image<const float>& place, int height, int width, int threads,
                       const Image<float>& image, const Image<float>& variance) {
    parallel_for(height, threads, [&](std::size_t first, std::size_t last) {
        if (!place.empty() && (view.value.width < 4 || view.value.height < 4)) {
            // Nowhere are there all the pixels that cubic convolution takes.
            for (const auto* map : {&image, &variance})
                std::fill(map->row(static_cast<int>(first)), map->row(static_cast<int>(last)), kNaN);
            return;
        }
        if (!place.empty()) {
            ReadRow row(view, width);
            for (auto v = static_cast<int>(first); v < static_cast<int>(last); ++v)
                row.read(place.row(v), image.row(v), variance.row(v));
            return;
        }
        BlockLerp levels(view.level, view.factor, width);
        std::vector<float> row(width);
        for (auto v = static_cast<int>(first); v < static_cast<int>(last); ++v) {
            levels.row(v, row.data());
            const float* __restrict level = row.data();
            const float *value = view.value.row(v), *spread = view.variance.row(v);
            float* __restrict grey = image.row(v);
            float* __restrict noise = variance.row(v);
            for (int u = 0; u < width; ++u) {
                grey[u] = (1 + value[u]) * level[u];
                noise[u] = spread[u] * level[u] * level[u];
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
