#include "core/sensing/block_index.hpp"

#include "core/common/parallel.hpp"

namespace planish {

BlockIndex::BlockIndex(Image<const float> position, int threads)
    : rows_((position.height + kBlock - 1) / kBlock),
      columns_((position.width + kBlock - 1) / kBlock),
      ranges_(static_cast<std::size_t>(rows_) * columns_) {
    parallel_for(static_cast<std::size_t>(rows_), threads, [&](std::size_t begin, std::size_t end) {
        for (std::size_t row = begin; row < end; ++row) measure_row(position, static_cast<int>(row));
    });
    for (const Range& range : ranges_) {
        low_ = std::min(low_, range.low);
        high_ = std::max(high_, range.high);
    }
    per_bin_ = static_cast<float>(kBins) / (high_ - low_ + 1e-6F);
    const auto visit = [&](const auto& action) {
        for (std::size_t i = 0; i < ranges_.size(); ++i) {
            if (ranges_[i].low > ranges_[i].high) continue;
            const std::size_t first = i / columns_ * kBins;
            for (std::size_t b = bin(ranges_[i].low); b <= bin(ranges_[i].high); ++b) action(first + b, i % columns_);
        }
    };
    // Two passes: count the entries of each list, then write them.
    start_.assign(static_cast<std::size_t>(rows_) * kBins + 1, 0);
    visit([&](std::size_t list, std::size_t) { ++start_[list + 1]; });
    for (std::size_t i = 1; i < start_.size(); ++i) start_[i] += start_[i - 1];
    entries_.resize(start_.back());
    std::vector<std::uint32_t> next(start_.begin(), start_.end() - 1);
    visit([&](std::size_t list, std::size_t column) { entries_[next[list]++] = static_cast<std::uint16_t>(column); });
}

void BlockIndex::measure_row(Image<const float> position, int row) {
    const int width = position.width, bottom = std::min((row + 1) * kBlock, position.height - 1);
    std::vector<float> low(static_cast<std::size_t>(width), std::numeric_limits<float>::infinity());
    std::vector<float> high(static_cast<std::size_t>(width), -std::numeric_limits<float>::infinity());
    for (int v = row * kBlock; v <= bottom; ++v) {
        const float* p = position.row(v);
        // NaN compares false and is left out.
        for (int u = 0; u < width; ++u) {
            low[u] = p[u] < low[u] ? p[u] : low[u];
            high[u] = p[u] > high[u] ? p[u] : high[u];
        }
    }
    for (int column = 0; column < columns_; ++column) {
        Range& range = ranges_[static_cast<std::size_t>(row) * columns_ + column];
        const int right = std::min((column + 1) * kBlock, width - 1);
        for (int u = column * kBlock; u <= right; ++u) {
            range.low = std::min(range.low, low[u]);
            range.high = std::max(range.high, high[u]);
        }
    }
}

}  // namespace planish
