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

/// What is nearest to one descriptor among those of the other side.
struct Nearest {
    std::int32_t best = -1;       ///< its row, -1 = none of fitting size
    std::int32_t best_squared;    ///< its squared distance; INT32_MAX = none
    std::int32_t second_squared;  ///< of the second nearest; INT32_MAX = none
};

struct BothNearest {
    std::vector<Nearest> of_a;  ///< per row of a, among b
    std::vector<Nearest> of_b;  ///< per row of b, among a
};

/// Exhaustive nearest neighbours both ways, among keypoints whose sizes agree within the factor `max_size_ratio`.
///
/// Each distance is computed once and serves both directions. It follows from a matrix product in float32, which holds
/// whole numbers up to 2^24 exactly: at most 256 values of 8 bits, so that the result does not depend on the order of
/// summation. Ties go to the first row.
BothNearest nearest_descriptors(const Descriptors& a, const Descriptors& b, double max_size_ratio, int threads);

}  // namespace planish
