#pragma once

#include <cstdint>

#include "core/common/image.hpp"

namespace planish {

struct GrazingLimits {
    float pixel_size = 0;  ///< width of a pixel on a surface that faces the camera, as a share of the depth
    float max_slope = 0;   ///< steepest depth per pixel, in pixel sizes: the tangent of the incidence angle
    float rim_px = 0;      ///< by how much a pixel beside an unlit one may look past its own centre
    float sigmas = 0;      ///< rim pixels whose depth changes by more than so many sigma over `rim_px` are marked
};

/// Marks with 1 the points on surfaces seen under grazing light, and those at the rim of the lit surface whose depth
/// depends on which part of the pixel is lit. `position_px` is NaN where the own camera could not decode one.
void grazing_points(Image<const float> depth_mm, Image<const float> sigma_mm, Image<const float> position_px,
                    const GrazingLimits& limits, int threads, Image<std::uint8_t> grazing);

}  // namespace planish
