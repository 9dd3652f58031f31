#pragma once

#include <algorithm>
#include <vector>

#include "core/common/image.hpp"

namespace planish {

/// The value of each block over its `factor` pixels of a row.
inline void spread_blocks(const float* blocks, int factor, int width, float* out) {
    for (int u = 0, x = 0; u < width; ++x)
        for (const int end = std::min(width, u + factor); u < end; ++u) out[u] = blocks[x];
}

/// Rows of pixels between the centres of blocks, by linear interpolation; beyond the outer centres the rim's value.
class BlockLerp {
  public:
    BlockLerp(const Image<const float>& blocks, int factor, int width)
        : blocks_(blocks), factor_(factor), above_(width), below_(width), index_(width), next_(width), share_(width) {
        for (int u = 0; u < width; ++u) {
            index_[u] = split(u, blocks.width, share_[u]);
            next_[u] = std::min(index_[u] + 1, blocks.width - 1);
        }
    }

    /// A row of pixels, to be interpolated where it is used; as long as no other is asked for.
    struct Row {
        const float *above, *below;
        float share;

        [[nodiscard]] float operator[](int u) const { return above[u] + share * (below[u] - above[u]); }
    };

    Row row(int v) {
        float share = 0;
        const int y = split(v, blocks_.height, share);
        if (y != row_) {
            if (row_ >= 0 && y == row_ + 1)
                above_.swap(below_);
            else
                expand(y, above_);
            expand(std::min(y + 1, blocks_.height - 1), below_);
            row_ = y;
        }
        return {above_.data(), below_.data(), share};
    }

    void row(int v, float* __restrict out) {
        const Row line = row(v);
        for (int u = 0; u < static_cast<int>(above_.size()); ++u) out[u] = line[u];
    }

  private:
    int split(int pixel, int count, float& share) const {
        const float place = (static_cast<float>(pixel) + 0.5F) / static_cast<float>(factor_) - 0.5F;
        const float held = std::clamp(place, 0.0F, static_cast<float>(count - 1));
        const int index = static_cast<int>(held);
        share = held - static_cast<float>(index);
        return index;
    }

    void expand(int y, std::vector<float>& line) const {
        const float *blocks = blocks_.row(y), *share = share_.data();
        const int *index = index_.data(), *next = next_.data(), width = static_cast<int>(line.size());
        float* __restrict out = line.data();
        for (int u = 0; u < width; ++u) out[u] = blocks[index[u]] + share[u] * (blocks[next[u]] - blocks[index[u]]);
    }

    Image<const float> blocks_;
    int factor_;
    int row_ = -1;
    std::vector<float> above_, below_;
    std::vector<int> index_, next_;
    std::vector<float> share_;
};

/// Sum and number of the values that count over one row of blocks, pixel row by pixel row.
class BlockAdder {
  public:
    BlockAdder(int width, int factor) : factor_(factor), sum_(width), count_(width) {}

    /// Values above `low` and below `high` count where `seen` is not 0; NaN never does.
    void add(const float* __restrict line, float low, float high, const unsigned char* __restrict seen) {
        float* __restrict sum = sum_.data();
        float* __restrict count = count_.data();
        for (int u = 0; u < static_cast<int>(sum_.size()); ++u) {
            const bool counts = (line[u] > low) & (line[u] < high) & (seen[u] != 0);
            sum[u] += counts ? line[u] : 0.0F;
            count[u] += counts ? 1.0F : 0.0F;
        }
    }

    /// Writes what was added since the last time.
    void finish(float* __restrict sums, float* __restrict counts) {
        const int width = static_cast<int>(sum_.size());
        for (int left = 0, x = 0; left < width; left += factor_, ++x) {
            float s = 0, n = 0;
            for (int u = left; u < std::min(width, left + factor_); ++u) s += sum_[u], n += count_[u];
            sums[x] = s;
            counts[x] = n;
        }
        std::fill(sum_.begin(), sum_.end(), 0.0F);
        std::fill(count_.begin(), count_.end(), 0.0F);
    }

  private:
    int factor_;
    std::vector<float> sum_, count_;
};

}  // namespace planish
