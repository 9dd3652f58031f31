#include "core/overlap_lookup.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <vector>

#include "core/moved_camera.hpp"
#include "core/parallel.hpp"

namespace planish {
namespace {

constexpr float NOT_A_NUMBER = std::numeric_limits<float>::quiet_NaN();
/// A pixel this near to a column or row lies on it [px]: float32 points do not project back any better.
constexpr double SNAP_PX = 1e-3;

/// Bilinear weights of one coordinate: 1 - f at `first`, f at `first + 1` (not needed where f = 0).
struct Weight {
    int first;
    double f;
};

bool weigh(double coordinate, int size, Weight& out) {
    if (!(coordinate > -SNAP_PX && coordinate < size - 1 + SNAP_PX)) return false;
    const double nearest = std::round(coordinate);
    if (std::abs(coordinate - nearest) < SNAP_PX) {
        out = {static_cast<int>(nearest), 0.0};
        return true;
    }
    out.first = static_cast<int>(std::floor(coordinate));
    out.f = coordinate - out.first;
    return true;
}

Eigen::Vector3d vector_at(const Image<const float>& image, int v, int u) {
    return Eigen::Map<const Eigen::Vector3f>(image.at(v, u)).cast<double>();
}

/// A place between the pixels of an image.
struct Place {
    Weight u{}, v{};
    bool inside;

    Place(const Eigen::Vector2d& pixel, int width, int height)
        : inside(weigh(pixel.x(), width, u) && weigh(pixel.y(), height, v)) {}
};

/// Distance of x (frame of a) from the surface of a at a pixel, or NaN.
double distance_at(const OrganisedSurface& a, const Place& place, const Eigen::Vector3d& x,
                   const Eigen::Vector3d& normal_b, double max_distance) {
    constexpr double NONE = std::numeric_limits<double>::quiet_NaN();
    const Weight &u = place.u, &v = place.v;
    const Eigen::Vector3d n = vector_at(a.normals, v.first + (v.f > 0.5), u.first + (u.f > 0.5));
    // Compare with "not greater" so that a missing normal of b (NaN) does not exclude the point.
    if (!(n.x() == n.x()) || n.dot(normal_b) < 0) return NONE;
    double sum = 0, smallest = std::numeric_limits<double>::infinity(), largest = -smallest;
    for (int j = 0; j <= (v.f > 0); ++j)
        for (int i = 0; i <= (u.f > 0); ++i) {
            const double weight = (j ? v.f : 1 - v.f) * (i ? u.f : 1 - u.f);
            const double d = n.dot(x - vector_at(a.points, v.first + j, u.first + i));
            if (!(d == d)) return NONE;
            sum += weight * d;
            smallest = std::min(smallest, d);
            largest = std::max(largest, d);
        }
    // Neighbours on two layers: there is no surface between them.
    if (largest - smallest > max_distance || std::abs(sum) > max_distance) return NONE;
    return sum;
}

}  // namespace

void look_up_distance(const OrganisedSurface& a, const OrganisedSurface& b, const Eigen::Matrix4d& T_a_b,
                      double max_distance, int threads, const Image<float>& distances, const Image<float>& pixels) {
    const Eigen::Matrix3d R = T_a_b.topLeftCorner<3, 3>();
    const Eigen::Vector3d t = T_a_b.topRightCorner<3, 1>();
    const MovedCamera camera(a.camera, R, t);
    const int width = b.points.width;
    std::fill_n(distances.data, distances.pixels(), NOT_A_NUMBER);
    if (!pixels.empty()) std::fill_n(pixels.data, 2 * pixels.pixels(), NOT_A_NUMBER);
    parallel_tasks(static_cast<std::size_t>(b.points.height), threads, [&](std::size_t row) {
        const int v = static_cast<int>(row);
        std::array<int, kAhead> columns{};
        for (int next = 0; next < width;) {
            Places places;
            int count = 0;
            for (; next < width && count < kAhead; ++next) {
                const float* point = b.points.at(v, next);
                if (std::isnan(point[2])) continue;
                columns[count] = next;
                places.x[count] = point[0];
                places.y[count] = point[1];
                places.z[count] = point[2];
                ++count;
            }
            camera.project(places);
            for (int i = 0; i < count; ++i) {
                if (!(places.z[i] > 0)) continue;
                const int u = columns[i];
                const Eigen::Vector2d pixel(places.u[i], places.v[i]);
                const Place place(pixel, a.points.width, a.points.height);
                if (!place.inside) continue;
                const double distance = distance_at(a, place, R * vector_at(b.points, v, u) + t,
                                                    R * vector_at(b.normals, v, u), max_distance);
                if (!(distance == distance)) continue;
                *distances.at(v, u) = static_cast<float>(distance);
                if (pixels.empty()) continue;
                pixels.at(v, u)[0] = static_cast<float>(pixel.x());
                pixels.at(v, u)[1] = static_cast<float>(pixel.y());
            }
        }
    });
}

void cell_medians(const Image<const float>& map, int size, int min_count, int threads, const Image<float>& medians) {
    parallel_for(static_cast<std::size_t>(medians.height), threads, [&](std::size_t first, std::size_t last) {
        std::vector<float> values;
        for (int row = static_cast<int>(first); row < static_cast<int>(last); ++row)
            for (int column = 0; column < medians.width; ++column) {
                values.clear();
                for (int v = row * size; v < std::min(map.height, (row + 1) * size); ++v)
                    for (int u = column * size; u < std::min(map.width, (column + 1) * size); ++u)
                        if (const float value = *map.at(v, u); value == value) values.push_back(value);
                float median = NOT_A_NUMBER;
                if (!values.empty() && static_cast<int>(values.size()) >= min_count) {
                    const auto middle = values.begin() + static_cast<std::ptrdiff_t>(values.size() / 2);
                    std::nth_element(values.begin(), middle, values.end());
                    median = *middle;
                    if (values.size() % 2 == 0) median = 0.5F * (median + *std::max_element(values.begin(), middle));
                }
                *medians.at(row, column) = median;
            }
    });
}

}  // namespace planish
