#include "core/sensing/islands.hpp"

#include <algorithm>
#include <cmath>
#include <cstring>
#include <limits>
#include <vector>

#include "core/common/parallel.hpp"

namespace planish {
namespace {

/// Disjoint sets with path halving; the smaller index is the root, so that the result does not depend on the order.
class Sets {
  public:
    std::uint32_t add() {
        parent_.push_back(static_cast<std::uint32_t>(parent_.size()));
        return parent_.back();
    }
    std::uint32_t root(std::uint32_t i) {
        while (parent_[i] != i) i = parent_[i] = parent_[parent_[i]];
        return i;
    }
    void join(std::uint32_t a, std::uint32_t b) {
        a = root(a);
        b = root(b);
        parent_[std::max(a, b)] = std::min(a, b);
    }
    /// Adds the sets of `other`; returns the number that its first one has here.
    std::uint32_t append(const Sets& other) {
        const auto first = static_cast<std::uint32_t>(parent_.size());
        for (const std::uint32_t i : other.parent_) parent_.push_back(first + i);
        return first;
    }

  private:
    std::vector<std::uint32_t> parent_;
};

/// Successive pixels [begin, end) of a row that are connected.
struct Run {
    int begin, end;
};

/// A row of depths (NaN where not valid) and its runs.
class Row {
  public:
    explicit Row(int width)
        : depth_(static_cast<std::size_t>(width) + 1, std::numeric_limits<float>::quiet_NaN()),
          sigma_(depth_.size()),
          joined_(depth_.size()) {}

    void take(const float* depth, const float* sigma, const std::uint8_t* excluded) {
        const int width = static_cast<int>(depth_.size()) - 1;
        float* z = depth_.data();
        for (int u = 0; u < width; ++u) z[u] = depth[u];
        if (excluded != nullptr)
            for (int u = 0; u < width; ++u) z[u] = excluded[u] == 0 ? z[u] : std::numeric_limits<float>::quiet_NaN();
        std::copy_n(sigma, width, sigma_.begin());
    }

    template <class Action>
    void runs(const IslandLimits& limits, const Action& action) {
        const int width = static_cast<int>(depth_.size()) - 1;
        // joined[u]: connected with the pixel to the right; never at the last one.
        connect(depth_.data() + 1, sigma_.data() + 1, depth_.data(), sigma_.data(), width, limits, joined_.data());
        for (int u = 0; u < width; ++u) {
            if (!(depth_[u] == depth_[u])) continue;
            const void* end = std::memchr(joined_.data() + u, 0, static_cast<std::size_t>(width - u));
            const int last = static_cast<int>(static_cast<const std::uint8_t*>(end) - joined_.data());
            action(Run{u, last + 1});
            u = last;
        }
    }

    /// joined[u]: connected with the pixel of the row above.
    const std::uint8_t* joined_with(const Row& above, const IslandLimits& limits) {
        connect(depth_.data(), sigma_.data(), above.depth_.data(), above.sigma_.data(),
                static_cast<int>(depth_.size()) - 1, limits, joined_.data());
        return joined_.data();
    }

  private:
    static void connect(const float* z, const float* s, const float* other_z, const float* other_s, int n,
                        const IslandLimits& limits, std::uint8_t* joined) {
        const float share = limits.depth_per_pixel, sigmas = limits.sigmas;
        for (int u = 0; u < n; ++u) {
            const float sigma = std::sqrt(s[u] * s[u] + other_s[u] * other_s[u]);
            joined[u] = std::fabs(z[u] - other_z[u]) <= share * z[u] + sigmas * sigma ? 1 : 0;
        }
    }

    std::vector<float> depth_, sigma_;
    std::vector<std::uint8_t> joined_;
};

/// The runs of several rows, connected among each other.
struct Strip {
    std::vector<Run> runs;
    std::vector<std::size_t> first{0};  ///< first run of each row, and one beyond the last
    Sets sets;
};

/// Calls join(i, j) for the runs i above and j below that share a joined column.
template <class Join>
void join_rows(const std::vector<Run>& above, std::size_t i, std::size_t i_end, const std::vector<Run>& below,
               std::size_t j, std::size_t j_end, const std::uint8_t* joined, const Join& join) {
    while (i < i_end && j < j_end) {
        const int begin = std::max(above[i].begin, below[j].begin), end = std::min(above[i].end, below[j].end);
        if (begin < end && std::memchr(joined + begin, 1, static_cast<std::size_t>(end - begin)) != nullptr) join(i, j);
        above[i].end < below[j].end ? ++i : ++j;
    }
}

constexpr int kRowsOfStrip = 64;

}  // namespace

void islands(Image<const float> depth, Image<const float> sigma, Image<const std::uint8_t> excluded,
             const IslandLimits& limits, int threads, Image<std::uint8_t> small) {
    const int height = depth.height, width = depth.width;
    const auto count = static_cast<std::size_t>((height + kRowsOfStrip - 1) / kRowsOfStrip);
    const auto take = [&](Row& row, int v) {
        row.take(depth.row(v), sigma.row(v), excluded.empty() ? nullptr : excluded.row(v));
    };
    std::vector<Strip> strips(count);
    parallel_for(count, threads, [&](std::size_t begin, std::size_t end) {
        Row row(width), above(width);
        for (std::size_t i = begin; i < end; ++i) {
            Strip& strip = strips[i];
            const int top = static_cast<int>(i) * kRowsOfStrip, bottom = std::min(top + kRowsOfStrip, height);
            for (int v = top; v < bottom; ++v) {
                std::swap(row, above);
                take(row, v);
                const std::size_t here = strip.first.back();
                row.runs(limits, [&](const Run& run) {
                    strip.runs.push_back(run);
                    strip.sets.add();
                });
                if (v > top)
                    join_rows(strip.runs, strip.first[strip.first.size() - 2], here, strip.runs, here,
                              strip.runs.size(), row.joined_with(above, limits), [&](std::size_t a, std::size_t b) {
                                  strip.sets.join(static_cast<std::uint32_t>(a), static_cast<std::uint32_t>(b));
                              });
                strip.first.push_back(strip.runs.size());
            }
        }
    });
    // The strips are few: their borders are joined one after the other.
    Sets all;
    std::vector<std::uint32_t> start(count);
    Row row(width), above(width);
    for (std::size_t i = 0; i < count; ++i) {
        start[i] = all.append(strips[i].sets);
        if (i == 0) continue;
        const Strip &upper = strips[i - 1], &lower = strips[i];
        const int v = static_cast<int>(i) * kRowsOfStrip;
        take(above, v - 1);
        take(row, v);
        join_rows(upper.runs, upper.first[upper.first.size() - 2], upper.runs.size(), lower.runs, 0, lower.first[1],
                  row.joined_with(above, limits), [&](std::size_t a, std::size_t b) {
                      all.join(start[i - 1] + static_cast<std::uint32_t>(a), start[i] + static_cast<std::uint32_t>(b));
                  });
    }
    std::vector<std::uint32_t> size;
    for (std::size_t i = 0; i < count; ++i) {
        size.resize(start[i] + strips[i].runs.size(), 0);
        for (std::size_t k = 0; k < strips[i].runs.size(); ++k)
            size[all.root(start[i] + static_cast<std::uint32_t>(k))] +=
                static_cast<std::uint32_t>(strips[i].runs[k].end - strips[i].runs[k].begin);
    }
    std::fill_n(small.data, small.pixels(), std::uint8_t{0});
    for (std::size_t i = 0; i < count; ++i)
        for (std::size_t r = 0; r + 1 < strips[i].first.size(); ++r)
            for (std::size_t k = strips[i].first[r]; k < strips[i].first[r + 1]; ++k) {
                if (size[all.root(start[i] + static_cast<std::uint32_t>(k))] >=
                    static_cast<std::uint32_t>(limits.min_pixels))
                    continue;
                const Run& run = strips[i].runs[k];
                std::uint8_t* mark = small.row(static_cast<int>(i) * kRowsOfStrip + static_cast<int>(r));
                std::fill(mark + run.begin, mark + run.end, std::uint8_t{1});
            }
}

}  // namespace planish
