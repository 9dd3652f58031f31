#pragma once

#include "core/common/camera.hpp"
#include "core/common/image.hpp"

namespace planish {

struct SurfaceOptions {
    int radius = 3;          ///< half the window [px]
    double max_slope = 4.0;  ///< largest change of depth per change of position that still is one surface
};

/// Local plane fit on the pixel grid of a camera: for each valid pixel the point on its own ray on the plane through
/// its window, the normal (towards the camera) and the change of the point per pixel along u and v.
///
/// In the image of a plane the inverse depth is an affine function of the normalised image coordinates, so the fit is
/// linear in it and free of the bias of fitting depth. Windows take in only what lies on the same surface.
void fit_surface(const Image<const float>& points, const Camera& camera, const SurfaceOptions& options, int threads,
                 const Image<float>& smoothed, const Image<float>& normals, const Image<float>& tangents);

}  // namespace planish
