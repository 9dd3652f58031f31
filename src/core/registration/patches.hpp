#pragma once

#include <array>
#include <cstdint>
#include <span>
#include <vector>

#include "core/common/image.hpp"

namespace planish {

/// Where a patch lies: patch pixel (x, y) from its centre is chart pixel (u, v) + axes * (x, y).
struct PatchPlace {
    std::int32_t chart;
    double u, v;
    std::array<double, 4> axes;  ///< row by row
};

/// A pair of places that may be the same, by their indices in a and b.
struct PatchPair {
    std::int32_t a, b;
};

struct PatchOptions {
    int radius;        ///< of the compared disc [patch px]
    int reach;         ///< largest offset searched along x and along y [patch px]
    int turns;         ///< rotations tried on either side of none
    double turn_step;  ///< [rad]
};

/// How the patch of a lies in that of b: its pixel x is pixel offset + R(turn) x of b's patch.
struct PatchAlignment {
    double correlation = 0;   ///< normalised, over the part of the disc that both charts hold
    double x = 0, y = 0;      ///< offset [patch px]
    double turn = 0;          ///< [rad]
    std::int32_t pixels = 0;  ///< compared pixels; 0 = the patches share nothing
};

/// The alignment of greatest normalised cross-correlation of each pair.
///
/// Charts are images of zero mean with zeros where there is no texture, which then counts on neither side. The search
/// is exhaustive over rotations and whole-pixel offsets; around the best it goes on with half the rotation step, and
/// parabolas through the greatest value and its neighbours give the fractions.
std::vector<PatchAlignment> align_patches(std::span<const Image<const float>> charts_a,
                                          std::span<const Image<const float>> charts_b,
                                          std::span<const PatchPlace> places_a, std::span<const PatchPlace> places_b,
                                          std::span<const PatchPair> pairs, const PatchOptions& options, int threads);

}  // namespace planish
