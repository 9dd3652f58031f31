#include "core/registration/match.hpp"

#include <Eigen/Core>
#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <numeric>

#include "core/common/parallel.hpp"

namespace planish {
namespace {

constexpr std::int32_t none = std::numeric_limits<std::int32_t>::max();
/// Farther than any pair can be.
constexpr float apart = std::numeric_limits<float>::infinity();
/// Descriptors of a and b whose distances are computed in one go: they and the distances stay in the cache.
constexpr int tile_a = 128, tile_b = 256;
/// Distances that are looked at together before any is by itself.
constexpr int chunk = 32;

/// Descriptors as columns, sorted by size, so that what fits in size is one range.
struct Sorted {
    Eigen::MatrixXf columns;
    Eigen::ArrayXf squared;
    std::vector<std::int32_t> index;
    std::vector<double> log_size;

    explicit Sorted(const Descriptors& d)
        : columns(static_cast<Eigen::Index>(d.length), static_cast<Eigen::Index>(d.size.size())),
          squared(static_cast<Eigen::Index>(d.size.size())),
          index(d.size.size()) {
        std::iota(index.begin(), index.end(), 0);
        std::ranges::stable_sort(index, [&](std::int32_t i, std::int32_t j) { return d.size[i] < d.size[j]; });
        for (std::size_t k = 0; k < index.size(); ++k) {
            const std::uint8_t* row = d.values.data() + index[k] * d.length;
            const auto column = static_cast<Eigen::Index>(k);
            for (std::size_t i = 0; i < d.length; ++i) columns(static_cast<Eigen::Index>(i), column) = row[i];
            squared[column] = columns.col(column).squaredNorm();
            log_size.push_back(std::log(d.size[index[k]]));
        }
    }
    [[nodiscard]] int count() const { return static_cast<int>(index.size()); }
};

/// The two nearest so far, as floats that hold whole numbers.
struct Running {
    std::int32_t best = -1;
    float best_squared = apart, second_squared = apart;

    void add(float squared, std::int32_t which) {
        if (squared < best_squared || (squared == best_squared && which < best)) {
            second_squared = best_squared;
            best_squared = squared;
            best = which;
        } else {
            second_squared = std::min(second_squared, squared);
        }
    }
    void add(const Running& other) {
        if (other.best < 0) return;
        add(other.best_squared, other.best);
        second_squared = std::min(second_squared, other.second_squared);
    }
    [[nodiscard]] Nearest result() const {
        const auto whole = [](float value) { return value == apart ? none : static_cast<std::int32_t>(value); };
        return {best, whole(best_squared), whole(second_squared)};
    }
};

/// The nearest of each descriptor of one side, and beyond which distance another one changes nothing.
struct Side {
    std::vector<Running> nearest;
    std::vector<float> limit;

    explicit Side(std::size_t count) : nearest(count), limit(count, apart) {}
    void add(int row, float squared, std::int32_t which) {
        nearest[row].add(squared, which);
        limit[row] = nearest[row].second_squared;
    }
};

/// Squared distances of a tile, and what they change. Most change nothing, which is seen of many at a time.
class Tile {
  public:
    Tile(const Sorted& a, const Sorted& b, double reach) : a_(a), b_(b), reach_(reach) {}

    void visit(int first_a, int count_a, int first_b, int count_b, Side& of_a, Side& of_b) {
        products_.resize(count_a, count_b);
        products_.noalias() =
            a_.columns.middleCols(first_a, count_a).transpose() * b_.columns.middleCols(first_b, count_b);
        for (int j = 0; j < count_b; ++j) {
            const auto begin = a_.log_size.begin() + first_a, end = begin + count_a;
            const double size = b_.log_size[first_b + j];
            const auto low = static_cast<int>(std::lower_bound(begin, end, size - reach_) - begin);
            const auto high = static_cast<int>(std::upper_bound(begin, end, size + reach_) - begin);
            int i = low;
            for (; i + chunk <= high; i += chunk)
                look_at<true>(products_.col(j).data() + i, first_a + i, chunk, first_b + j, of_a, of_b);
            if (i < high) look_at<false>(products_.col(j).data() + i, first_a + i, high - i, first_b + j, of_a, of_b);
        }
    }

  private:
    /// Distances of some descriptors of a, a whole chunk or less, to one of b.
    template <bool whole>
    void look_at(const float* products, int first_a, int rest, int row_b, Side& of_a, Side& of_b) const {
        const int count = whole ? chunk : rest;
        const float* __restrict squared_a = a_.squared.data() + first_a;
        const float* __restrict limit_a = of_a.limit.data() + first_a;
        const float squared_b = b_.squared[row_b], limit_b = of_b.limit[row_b];
        std::array<float, chunk> distance;
        int any = 0;
        for (int i = 0; i < count; ++i) {
            distance[i] = (squared_a[i] + squared_b) - 2.0F * products[i];
            any |= distance[i] <= (limit_a[i] > limit_b ? limit_a[i] : limit_b) ? 1 : 0;
        }
        if (any == 0) return;
        for (int i = 0; i < count; ++i) {
            if (distance[i] > limit_a[i] && distance[i] > limit_b) continue;
            of_a.add(first_a + i, distance[i], b_.index[row_b]);
            of_b.add(row_b, distance[i], a_.index[first_a + i]);
        }
    }

    const Sorted &a_, &b_;
    double reach_;
    Eigen::MatrixXf products_;
};

std::vector<Nearest> in_given_order(const std::vector<Running>& sorted, const std::vector<std::int32_t>& index) {
    std::vector<Nearest> out(sorted.size());
    for (std::size_t k = 0; k < sorted.size(); ++k) out[index[k]] = sorted[k].result();
    return out;
}

}  // namespace

BothNearest nearest_descriptors(const Descriptors& a, const Descriptors& b, double max_size_ratio, int threads) {
    const Sorted sa(a), sb(b);
    const double reach = std::log(max_size_ratio);
    Side of_a(sa.index.size());
    // Each thread keeps its own nearest of b; which of two is nearer does not depend on who found it.
    const auto workers = static_cast<std::size_t>(std::max(threads, 1));
    std::vector<Side> partial(workers, Side(sb.index.size()));
    const int tiles = (sa.count() + tile_a - 1) / tile_a;
    parallel_for(workers, threads, [&](std::size_t first, std::size_t last) {
        Tile tile(sa, sb, reach);
        for (std::size_t worker = first; worker < last; ++worker)
            for (int k = static_cast<int>(worker); k < tiles; k += static_cast<int>(workers)) {
                const int begin = k * tile_a, count = std::min(tile_a, sa.count() - begin);
                const auto low = std::ranges::lower_bound(sb.log_size, sa.log_size[begin] - reach);
                const auto high = std::ranges::upper_bound(sb.log_size, sa.log_size[begin + count - 1] + reach);
                const int first_b = static_cast<int>(low - sb.log_size.begin());
                const int last_b = static_cast<int>(high - sb.log_size.begin());
                for (int j = first_b; j < last_b; j += tile_b)
                    tile.visit(begin, count, j, std::min(tile_b, last_b - j), of_a, partial[worker]);
            }
    });
    std::vector<Running> of_b(sb.index.size());
    for (const Side& part : partial)
        for (std::size_t j = 0; j < of_b.size(); ++j) of_b[j].add(part.nearest[j]);
    return {in_given_order(of_a.nearest, sa.index), in_given_order(of_b, sb.index)};
}

}  // namespace planish
