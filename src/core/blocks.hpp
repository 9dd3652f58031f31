#pragma once

#include <algorithm>
#include <vector>

#include "core/image.hpp"

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
        : blocks_(blocks), factor_(factor), above_(width), below_(width), index_(width), share_(width) {
        for (int u = 0; u < width; ++u) index_[u] = split(u, blocks.width, share_[u]);
    }

    void row(int v, float* __restrict out) {
        float share = 0;
        const int y = split(v, blocks_.height, share);
        if (y != row_) {
            expand(y, above_);
            expand(std::min(y + 1, blocks_.height - 1), below_);
            row_ = y;
        }
        const float* __restrict a = above_.data();
        const float* __restrict b = below_.data();
        for (std::size_t u = 0; u < above_.size(); ++u) out[u] = a[u] + share * (b[u] - a[u]);
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
        const float* blocks = blocks_.row(y);
        for (std::size_t u = 0; u < line.size(); ++u) {
            const int x = index_[u], next = std::min(x + 1, blocks_.width - 1);
            line[u] = blocks[x] + share_[u] * (blocks[next] - blocks[x]);
        }
    }

    Image<const float> blocks_;
    int factor_;
    int row_ = -1;
    std::vector<float> above_, below_;
    std::vector<int> index_;
    std::vector<float> share_;
};

}  // namespace planish
