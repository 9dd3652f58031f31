#pragma once

#include <Eigen/Core>
#include <cstdint>

#include "core/camera.hpp"
#include "core/image.hpp"

namespace planish {

/// A texture image of a: the places (h, w, 2) of its pixels on the grid of a's camera, those that ask (h, w), 0 = does
/// not, and the surface on that grid (H, W, 3).
struct TextureSurface {
    Image<const float> places;
    Image<const std::uint8_t> own;
    Image<const float> points, normals;
};

/// Where the pixels of a texture image of a lie in b's image under T_b_a: `source` (h, w, 2) takes b's pixel; NaN where
/// a has no surface, b's camera does not see that side of the surface, or where b's point (H, W, 3) at the nearest
/// pixel lies farther than `gate` from it, along its normal.
void locate_texture(const TextureSurface& a, const Camera& camera_b, const Image<const float>& points_b,
                    const Eigen::Matrix3d& R_b_a, const Eigen::Vector3d& t_b_a, double gate, int threads,
                    const Image<float>& source);

}  // namespace planish
