#include "core/texture/split_bands.hpp"

#include <algorithm>
#include <cstddef>
#include <limits>

#include "core/common/parallel.hpp"
#include "core/texture/blocks.hpp"

namespace planish {
namespace {

constexpr float kInfinity = std::numeric_limits<float>::infinity();
/// Shares of what is known are never divided by less.
constexpr float kLeastShare = 1e-6F;

/// The pixel that lies at `at` in an image of `count`, reflected at its outermost pixels.
int reflected(int at, int count) {
    if (count == 1) return 0;
    const int period = 2 * (count - 1), held = ((at % period) + period) % period;
    return held < count ? held : period - held;
}

/// One row after the other.
class Splitter {
  public:
    Splitter(const Image<const float>& value, const std::vector<float>& bell)
        : value_(value),
          bell_(bell),
          reach_(static_cast<int>(bell.size()) / 2),
          total_(value.width + 2 * reach_),
          share_(total_.size()),
          sum_(value.width),
          weight_(value.width) {}

    void split(int v, float* __restrict fine, float* __restrict coarse) {
        sum_columns(v);
        sum_rows();
        const float* __restrict line = value_.row(v);
        for (int u = 0; u < value_.width; ++u) {
            const float mean = sum_[u] / std::max(weight_[u], kLeastShare);
            fine[u] = line[u] - mean;
            coarse[u] = line[u] == line[u] ? mean : line[u];
        }
    }

  private:
    void sum_columns(int v) {
        const int width = value_.width;
        float* __restrict total = total_.data() + reach_;
        float* __restrict share = share_.data() + reach_;
        std::fill(total_.begin(), total_.end(), 0.0F);
        std::fill(share_.begin(), share_.end(), 0.0F);
        for (int k = 0; k <= reach_; ++k) {
            // The bell is symmetric: two rows at a time.
            const float* above = value_.row(reflected(v + k - reach_, value_.height));
            const float* below = value_.row(reflected(v - k + reach_, value_.height));
            const float weight = k < reach_ ? bell_[k] : 0.5F * bell_[k];
            for (int u = 0; u < width; ++u) {
                const bool first = above[u] == above[u], second = below[u] == below[u];
                total[u] += weight * ((first ? above[u] : 0.0F) + (second ? below[u] : 0.0F));
                share[u] += weight * ((first ? 1.0F : 0.0F) + (second ? 1.0F : 0.0F));
            }
        }
        for (int d = 1; d <= reach_; ++d)
            for (float* sums : {total, share}) {
                sums[-d] = sums[reflected(-d, width)];
                sums[width - 1 + d] = sums[reflected(width - 1 + d, width)];
            }
    }

    void sum_rows() {
        std::fill(sum_.begin(), sum_.end(), 0.0F);
        std::fill(weight_.begin(), weight_.end(), 0.0F);
        float* __restrict sum = sum_.data();
        float* __restrict weight = weight_.data();
        for (int k = 0; k <= reach_; ++k) {
            const float *total = total_.data() + k, *share = share_.data() + k;
            const int apart = 2 * (reach_ - k);
            const float by = k < reach_ ? bell_[k] : 0.5F * bell_[k];
            for (int u = 0; u < value_.width; ++u) {
                sum[u] += by * (total[u] + total[u + apart]);
                weight[u] += by * (share[u] + share[u + apart]);
            }
        }
    }

    Image<const float> value_;
    const std::vector<float>& bell_;
    int reach_;
    std::vector<float> total_, share_, sum_, weight_;
};

}  // namespace

void split_bands(const Image<const float>& value, const std::vector<float>& bell, int factor, int threads,
                 const Bands& out) {
    const int width = value.width;
    parallel_for(out.count.height, threads, [&](std::size_t first, std::size_t last) {
        Splitter splitter(value, bell);
        BlockAdder fine(width, factor), coarse(width, factor);
        const std::vector<unsigned char> everything(width, 1);
        std::vector<float> squares(width);
        const auto add = [&](const float* line, BlockAdder& adder) {
            for (int u = 0; u < width; ++u) squares[u] = line[u] * line[u];
            adder.add(squares.data(), -kInfinity, kInfinity, everything.data());
        };
        for (auto y = static_cast<int>(first); y < static_cast<int>(last); ++y) {
            for (int v = y * factor; v < std::min(value.height, (y + 1) * factor); ++v) {
                splitter.split(v, out.fine.row(v), out.coarse.row(v));
                add(out.fine.row(v), fine);
                add(out.coarse.row(v), coarse);
            }
            fine.finish(out.fine_squares.row(y), out.count.row(y));
            coarse.finish(out.coarse_squares.row(y), out.count.row(y));
        }
    });
}

}  // namespace planish
