#pragma once

#include <Eigen/Core>
#include <cstdint>
#include <vector>

#include "core/common/image.hpp"

namespace planish {

/// The value (h, w, C) at the central pixel of every block of `factor` x `factor` pixels of an image (H, W, C); the
/// last blocks may end before their centre, and take their last pixel.
void block_centres(const Image<const float>& image, int factor, const Image<float>& out);

/// Marks with 1 the blocks (h, w) of `factor` x `factor` pixels that any of the places (.., .., 2) falls into, or,
/// outside, the nearest; the rest with 0. NaN falls into none.
void mark_blocks(const Image<const float>& places, int factor, const Image<std::uint8_t>& out);

/// Replaces NaN by the mean of the known among the 3 x 3 around, those at the rim counted again for what is beyond;
/// twice, so two blocks far. What is left becomes `otherwise`.
void fill_gaps(const Image<const float>& blocks, float otherwise, const Image<float>& out);

/// A point source over a matt surface: irradiance max(cos(incidence), least_cosine) / distance^2 (Lambert's law) at
/// points (h, w, 3) with normals (h, w, 3) of any length; NaN where there is no point or the normal has no length.
void lambert(const Image<const float>& points, const Image<const float>& normals, const Eigen::Vector3f& source,
             float least_cosine, const Image<float>& out);

}  // namespace planish
