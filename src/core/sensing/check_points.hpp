#pragma once

#include <Eigen/Core>
#include <cstdint>

#include "core/common/image.hpp"
#include "core/sensing/projector_residual.hpp"

namespace planish {

/// Bits of the rejections that are given here.
struct CheckReasons {
    std::uint16_t unmatched, outside, mismatch;
};

struct CheckLimits {
    float max_miss_px = 0;      ///< largest distance of the point's image from the corresponding pixel
    float projector_px = 0;     ///< disagreement with the projector that is allowed,
    float sigmas = 0;           ///< and on top of it, in standard deviations
    Eigen::Vector3f low, high;  ///< the points' box [mm]
};

/// What is known of the points of one image; the projector may be null.
struct CheckedPoints {
    Image<const float> points_sensor, sigma_mm, miss_px, position_px, position_sigma_px;
    const ProjectorRay* projector = nullptr;
    Eigen::Vector4f depth_row;  ///< camera z of a point (x, y, z, 1)
};

/// Adds to `rejected` the reasons that a point itself gives, without looking at its neighbours, and writes the depth
/// [mm] of those without any reason, NaN elsewhere. `unmatched` is for pixels that had no reason yet to have no point.
void check_points(const CheckedPoints& points, const CheckLimits& limits, const CheckReasons& reasons, int threads,
                  Image<std::uint16_t> rejected, Image<float> depth_mm);

/// Sets the values (one to three channels) of all rejected pixels to NaN.
void drop_rejected(Image<const std::uint16_t> rejected, int threads, Image<float> values);

}  // namespace planish
