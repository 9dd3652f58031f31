#pragma once

#include <Eigen/Core>
#include <cstdint>

#include "core/common/camera.hpp"
#include "core/common/image.hpp"

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

/// What is known of a map of distances: number, sum of squares [mm^2], and area of its pixels [mm^2].
struct Known {
    std::int64_t count = 0;
    double squares = 0, area = 0;

    Known& operator+=(const Known& other) {
        count += other.count;
        squares += other.squares;
        area += other.area;
        return *this;
    }
};

/// Sums over the pixels whose distance (H, W) is not NaN, each with its own area (H, W).
Known known_distances(const Image<const float>& distances, const Image<const float>& areas, int threads);

/// Area (H, W) of the surface that each pixel covers [mm^2], from its tangents (H, W, 6) along u and v; 0 where there
/// is none. |u x v| by Lagrange's identity.
void pixel_areas(const Image<const float>& tangents, int threads, const Image<float>& areas);

/// Median (rows, columns) over square cells of `size` px of a map with NaN: NaN where fewer than `min_count` values.
/// Returns the same for any order of equal values; an even count gives the mean of the middle two.
void cell_medians(const Image<const float>& map, int size, int min_count, int threads, const Image<float>& medians);

}  // namespace planish
