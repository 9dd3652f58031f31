#pragma once

#include <Eigen/Core>

#include "core/camera.hpp"
#include "core/image.hpp"

namespace planish {

/// One organised measurement: points (H, W, 3), normals (H, W, 3), both NaN where there is none, and its camera.
struct OrganisedSurface {
    Image<const float> points;
    Image<const float> normals;
    Camera camera;
};

/// Signed distance (H, W of b) [mm] of b's points from the surface of a, along a's normal: positive where b is nearer
/// to a's camera. NaN where a has no surface on the way to the point, where the distance exceeds `max_distance`
/// (occluded, or another layer) and where the two surfaces face opposite ways.
///
/// Association is a look-up: the point, moved by T_a_b, is projected into a's camera; a's surface there is the
/// bilinear interpolation of its four neighbouring points. `pixels` (H, W of b, 2) takes the pixel in a, or is empty.
void look_up_distance(const OrganisedSurface& a, const OrganisedSurface& b, const Eigen::Matrix4d& T_a_b,
                      double max_distance, int threads, const Image<float>& distances, const Image<float>& pixels);

/// Median (rows, columns) over square cells of `size` px of a map with NaN: NaN where fewer than `min_count` values.
/// Returns the same for any order of equal values; an even count gives the mean of the middle two.
void cell_medians(const Image<const float>& map, int size, int min_count, int threads, const Image<float>& medians);

}  // namespace planish
