#pragma once

#include <Eigen/Core>
#include <cstdint>
#include <vector>

#include "core/common/camera.hpp"
#include "core/common/image.hpp"

namespace planish {

/// A point of b in the image of a's camera.
struct NearestPixel {
    std::int32_t pixel_b, pixel_a;  ///< flat indices; of a the nearest pixel
    Eigen::Vector3d point;          ///< in frame a
};

/// Every `stride`-th point of b (H, W, 3) along both axes that lies in front of a's camera and in its image, moved into
/// a; row by row.
std::vector<NearestPixel> nearest_pixels(const Image<const float>& points_b, int stride, const Camera& camera_a,
                                         int height_a, int width_a, const Eigen::Matrix3d& R_a_b,
                                         const Eigen::Vector3d& t_a_b);

}  // namespace planish
