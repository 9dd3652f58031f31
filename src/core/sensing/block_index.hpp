#pragma once

#include <algorithm>
#include <cstdint>
#include <limits>
#include <span>
#include <vector>

#include "core/common/image.hpp"

namespace planish {

/// Which blocks of pixels may hold a position: per row of blocks and bin of position, a list of columns of blocks.
class BlockIndex {
  public:
    /// Width and height of a block; it also holds the first column and row of the next ones, for a crossing lies
    /// between pixels.
    static constexpr int kBlock = 16;

    BlockIndex(Image<const float> position, int threads);

    [[nodiscard]] int rows() const { return rows_; }
    [[nodiscard]] int columns() const { return columns_; }
    /// Columns of the blocks in a row of blocks whose range of positions may hold `target`.
    [[nodiscard]] std::span<const std::uint16_t> candidates(int row, float target) const {
        if (!(target >= low_ && target <= high_)) return {};
        const std::size_t list = static_cast<std::size_t>(row) * kBins + bin(target);
        return {entries_.data() + start_[list], entries_.data() + start_[list + 1]};
    }
    /// Whether the range of a block's positions holds `target`.
    [[nodiscard]] bool holds(int row, int column, float target) const {
        const Range& range = ranges_[static_cast<std::size_t>(row) * columns_ + column];
        return range.low <= target && target <= range.high;
    }

  private:
    static constexpr int kBins = 512;
    struct Range {
        float low = std::numeric_limits<float>::infinity(), high = -std::numeric_limits<float>::infinity();
    };

    [[nodiscard]] std::size_t bin(float p) const {
        return std::min<std::size_t>(static_cast<std::size_t>((p - low_) * per_bin_), kBins - 1);
    }
    void measure_row(Image<const float> position, int row);

    int rows_, columns_;
    float low_ = std::numeric_limits<float>::infinity(), high_ = -std::numeric_limits<float>::infinity(), per_bin_ = 0;
    std::vector<Range> ranges_;
    std::vector<std::uint32_t> start_;
    std::vector<std::uint16_t> entries_;
};

}  // namespace planish
