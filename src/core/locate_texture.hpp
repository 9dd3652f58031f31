#pragma once

#include <Eigen/Core>
#include <cstdint>

#include "core/camera.hpp"
#include "core/image.hpp"

namespace planish {

/// A texture image of a: points and normals (h, w, 3) of its surface, and its pixels that ask (h, w), 0 = does not.
struct TextureSurface {
    Image<const float> points, normals;
    Image<const std::uint8_t> own;
};

/// Where the pixels of a texture image of a lie in b's image under T_b_a: `source` (h, w, 2) takes b's pixel; NaN where
/// b's camera does not see that side of the surface, or where b's point (H, W, 3) at the nearest pixel lies farther
/// than `gate` from it, along its normal.
void locate_texture(const TextureSurface& a, const Camera& camera_b, const Image<const float>& points_b,
                    const Eigen::Matrix3d& R_b_a, const Eigen::Vector3d& t_b_a, double gate, int threads,
                    const Image<float>& source);

}  // namespace planish
