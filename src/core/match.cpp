#include "core/match.hpp"

#include <Eigen/Core>
#include <algorithm>
#include <cmath>
#include <limits>
#include <numeric>

#include "core/parallel.hpp"

namespace planish {
namespace {

constexpr std::int32_t none = std::numeric_limits<std::int32_t>::max();
/// A distance no pair can have: it marks pairs whose sizes differ.
constexpr float apart = std::numeric_limits<float>::infinity();
/// Descriptors of a and b whose distances are computed in one go: they and the distances stay in the cache.
constexpr int tile_a = 128, tile_b = 256;

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

/// Squared distances of a tile, and what they change. Only rows and columns that hold something nearer than what is
/// known are looked through; after the first tiles these are few.
class Tile {
  public:
    Tile(const Sorted& a, const Sorted& b, double reach) : a_(a), b_(b), reach_(reach) {}

    void visit(int first_a, int count_a, int first_b, int count_b, std::vector<Running>& of_a,
               std::vector<Running>& of_b) {
        distance_.resize(count_a, count_b);
        distance_.matrix().noalias() =
            a_.columns.middleCols(first_a, count_a).transpose() * b_.columns.middleCols(first_b, count_b);
        nearest_.setConstant(count_a, apart);
        for (int j = 0; j < count_b; ++j) {
            auto column = distance_.col(j);
            column = (a_.squared.segment(first_a, count_a) + b_.squared[first_b + j]) - 2.0F * column;
            part_by_size(first_a, count_a, first_b + j, j);
            nearest_ = nearest_.min(column);
            Running& seen = of_b[first_b + j];
            if (column.minCoeff() > seen.second_squared) continue;
            for (int i = 0; i < count_a; ++i)
                if (column[i] != apart) seen.add(column[i], a_.index[first_a + i]);
        }
        for (int i = 0; i < count_a; ++i) {
            Running& seen = of_a[first_a + i];
            if (nearest_[i] > seen.second_squared) continue;
            for (int j = 0; j < count_b; ++j)
                if (distance_(i, j) != apart) seen.add(distance_(i, j), b_.index[first_b + j]);
        }
    }

  private:
    void part_by_size(int first_a, int count_a, int row_b, int j) {
        const auto begin = a_.log_size.begin() + first_a, end = begin + count_a;
        const double size = b_.log_size[row_b];
        if (*begin >= size - reach_ && *(end - 1) <= size + reach_) return;
        const auto low = std::lower_bound(begin, end, size - reach_) - begin;
        const auto high = std::upper_bound(begin, end, size + reach_) - begin;
        distance_.col(j).head(low).setConstant(apart);
        distance_.col(j).tail(count_a - high).setConstant(apart);
    }

    const Sorted &a_, &b_;
    double reach_;
    Eigen::ArrayXXf distance_;
    Eigen::ArrayXf nearest_;
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
    std::vector<Running> of_a(sa.index.size()), of_b(sb.index.size());
    // Each thread keeps its own nearest of b; which of two is nearer does not depend on who found it.
    const auto workers = static_cast<std::size_t>(std::max(threads, 1));
    std::vector<std::vector<Running>> partial(workers, std::vector<Running>(of_b.size()));
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
    for (const auto& part : partial)
        for (std::size_t j = 0; j < of_b.size(); ++j) of_b[j].add(part[j]);
    return {in_given_order(of_a, sa.index), in_given_order(of_b, sb.index)};
}

}  // namespace planish
