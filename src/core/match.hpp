#pragma once

#include <cstdint>
#include <span>
#include <vector>

namespace planish {

/// N descriptors of `length` whole numbers, row by row, and the sizes of their keypoints.
struct Descriptors {
    std::span<const std::uint8_t> values;
    std::span<const double> size;
    std::size_t length;
};

struct Nearest {
    std::vector<std::int32_t> best;            ///< per row of a: nearest row of b, -1 = none of fitting size
    std::vector<std::int32_t> best_squared;    ///< its squared distance
    std::vector<std::int32_t> second_squared;  ///< of the second nearest; INT32_MAX = none
};

/// Exhaustive nearest neighbours among keypoints whose sizes agree within the factor `max_size_ratio`. Whole numbers
/// all the way: the result is exact. Ties go to the first.
Nearest nearest_descriptors(const Descriptors& a, const Descriptors& b, double max_size_ratio, int threads);

}  // namespace planish
