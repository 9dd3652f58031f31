#pragma once

#include "core/common/camera.hpp"
#include "core/common/image.hpp"

namespace planish {

/// For every pixel, the shift (u, v) to where it would lie without lens distortion (two channels).
///
/// Exact on every 16th pixel, between them by cubic Lagrange interpolation: within 1e-5 px for real lenses, at a
/// hundredth of the time of inverting the distortion everywhere.
void undistortion_shifts(const Camera& camera, int threads, Image<float> shifts);

}  // namespace planish
