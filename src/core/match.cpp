#include "core/match.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <numeric>

#include "core/parallel.hpp"

namespace planish {
namespace {

constexpr std::int32_t none = std::numeric_limits<std::int32_t>::max();

std::int32_t dot(const std::int16_t* x, const std::int16_t* y, std::size_t n) {
    std::int32_t sum = 0;
    for (std::size_t i = 0; i < n; ++i) sum += static_cast<std::int32_t>(x[i]) * y[i];
    return sum;
}

/// Descriptors as int16 (so that products pair up in one instruction), sorted by size: what fits in size is one range.
struct Sorted {
    std::vector<std::int16_t> values;
    std::vector<std::int32_t> norm, index;
    std::vector<double> log_size;

    explicit Sorted(const Descriptors& d) : values(d.values.size()), norm(d.size.size()), index(d.size.size()) {
        std::iota(index.begin(), index.end(), 0);
        std::ranges::stable_sort(index, [&](std::int32_t i, std::int32_t j) { return d.size[i] < d.size[j]; });
        for (std::size_t k = 0; k < index.size(); ++k) {
            std::int16_t* row = values.data() + k * d.length;
            std::copy_n(d.values.data() + index[k] * d.length, d.length, row);
            norm[k] = dot(row, row, d.length);
            log_size.push_back(std::log(d.size[index[k]]));
        }
    }
};

}  // namespace

Nearest nearest_descriptors(const Descriptors& a, const Descriptors& b, double max_size_ratio, int threads) {
    const Sorted sa(a), sb(b);
    const std::size_t count = a.size.size(), n = a.length;
    const double reach = std::log(max_size_ratio);
    Nearest out{std::vector<std::int32_t>(count, -1), std::vector<std::int32_t>(count, none),
                std::vector<std::int32_t>(count, none)};
    parallel_for(count, threads, [&](std::size_t first, std::size_t last) {
        for (std::size_t k = first; k < last; ++k) {
            const std::int16_t* row = sa.values.data() + k * n;
            const auto begin = std::ranges::lower_bound(sb.log_size, sa.log_size[k] - reach) - sb.log_size.begin();
            const auto end = std::ranges::upper_bound(sb.log_size, sa.log_size[k] + reach) - sb.log_size.begin();
            std::int32_t best = none, second = none, which = -1;
            for (auto j = begin; j < end; ++j) {
                const std::int32_t squared = sa.norm[k] + sb.norm[j] - 2 * dot(row, sb.values.data() + j * n, n);
                const std::int32_t original = sb.index[j];
                if (squared < best || (squared == best && original < which)) {
                    second = best;
                    best = squared;
                    which = original;
                } else if (squared < second) {
                    second = squared;
                }
            }
            const std::int32_t i = sa.index[k];
            out.best[i] = which;
            out.best_squared[i] = best;
            out.second_squared[i] = second;
        }
    });
    return out;
}

}  // namespace planish
