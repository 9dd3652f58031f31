#pragma once

#include <Eigen/Core>
#include <cstdint>

#include "core/common/camera.hpp"
#include "core/common/image.hpp"

namespace planish {

/// A texture image of a: the places (h, w, 2) of its pixels on the grid of a's camera, those that ask (h, w), 0 = does
/// not, and the surface on that grid (H, W, 3).
struct TextureSurface {
    Image<const float> places;
    Image<const std::uint8_t> own;
    Image<const float> points, normals;
};

/// Another measurement on its camera's grid: points (H, W, 3), contrast and its standard deviation (H, W), NaN where
/// unknown.
struct TexturedPoints {
    Image<const float> points, value, sigma;
};

/// What lies at the pixels of a texture image of a (all maps of its size); of channels as said.
struct AlignedTexture {
    Image<float> source;         ///< (h, w, 2) pixel of b; NaN where not common
    Image<float> value, sigma;   ///< texture of b there, interpolated linearly; 0 where not common
    Image<std::uint8_t> common;  ///< 1 where b has its surface and texture
};

/// b's texture on a texture image of a under T_b_a. A pixel is not common where a has no surface, b's camera does not
/// see that side of it, b's point at the nearest pixel lies farther than `gate` from it, along its normal, or b's
/// standard deviation is unknown at one of the four pixels around.
void align_texture(const TextureSurface& a, const Camera& camera_b, const TexturedPoints& b,
                   const Eigen::Matrix3d& R_b_a, const Eigen::Vector3d& t_b_a, double gate, int threads,
                   const AlignedTexture& out);

}  // namespace planish
