#pragma once

#include <cstdint>

#include "core/common/camera.hpp"
#include "core/common/image.hpp"

namespace planish {

/// A camera with the undistortion shift (u, v) of each pixel; without distortion the shifts are empty.
struct ViewGeometry {
    Camera camera;
    Image<const float> shift_px;
};

struct TriangulateResult {
    Image<float> points_sensor;  ///< three channels [mm], on the ray of the own pixel; NaN where none
    Image<float> sigma_mm;       ///< standard deviation along that ray
    Image<float> miss_px;        ///< distance of the point's image from the given pixel, across the epipolar line
};

/// The point of each own pixel's ray whose image in the other camera is nearest to the corresponding pixel, lens
/// distortion removed.
///
/// `sigma_px` is the standard deviation of the corresponding pixel along its epipolar line. Single precision: its
/// rounding is that of a pixel of 1e-4 px, a hundredth of the least standard deviations there are.
void triangulate(const ViewGeometry& own, const Camera& other, Image<const float> pixel_px, Image<const float> sigma_px,
                 int threads, const TriangulateResult& out);

}  // namespace planish
