#pragma once

#include "core/common/camera.hpp"
#include "core/common/image.hpp"
#include "core/sensing/triangulate.hpp"

namespace planish {

/// Decoded positions along one projector axis and their standard deviations; empty where the axis is not encoded.
struct DecodedAxis {
    Image<const float> position_px, sigma_px;
};

struct IntersectResult {
    Image<float> points_sensor;  ///< three channels [mm], on the ray of the own pixel; NaN where none
    Image<float> sigma_mm;       ///< standard deviation along that ray
    Image<float> miss_px;        ///< decoded less own place in the projector, across the ray's image; NaN without check
    Image<float> miss_sigma_px;  ///< its standard deviation
};

/// The point of each pixel's ray whose image in the projector has the decoded positions, distortion included.
///
/// The ray's image in the undistorted projector is a straight line; the place on it is found by Gauss-Newton steps on
/// the weighted squares of the decoded axes. Pixels without a position along `axes[primary]` have no point. Nor have
/// points behind a device, or outside the projector's picture (width, height) and at its rim.
void intersect(const ViewGeometry& own, const Camera& projector, int width, int height, const DecodedAxis axes[2],
               int primary, int threads, const IntersectResult& out);

}  // namespace planish
