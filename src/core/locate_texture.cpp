#include "core/locate_texture.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <limits>

#include "core/between_pixels.hpp"
#include "core/moved_camera.hpp"
#include "core/parallel.hpp"

namespace planish {
namespace {

constexpr float NOT_A_NUMBER = std::numeric_limits<float>::quiet_NaN();

Eigen::Vector3d vector_at(const Image<const float>& image, int v, int u) {
    return Eigen::Map<const Eigen::Vector3f>(image.at(v, u)).cast<double>();
}

/// A point of a's surface between the pixels of its camera, and its normal, not yet of unit length.
struct SurfacePoint {
    Eigen::Vector3d point, normal;
};

SurfacePoint surface_at(const TextureSurface& a, const float* place) {
    const PixelShare across(place[0], a.points.width), down(place[1], a.points.height);
    const auto read = [&](const Image<const float>& map) -> Eigen::Vector3d {
        const Eigen::Array4f found = between_pixels(map, down.index, across.index, across.share, down.share);
        return found.head<3>().matrix().cast<double>();
    };
    return {read(a.points), read(a.normals)};
}

}  // namespace

void locate_texture(const TextureSurface& a, const Camera& camera_b, const Image<const float>& points_b,
                    const Eigen::Matrix3d& R_b_a, const Eigen::Vector3d& t_b_a, double gate, int threads,
                    const Image<float>& source) {
    const MovedCamera camera(camera_b, R_b_a, t_b_a);
    // The distance between the surfaces is the same in the frame of a.
    const Eigen::Matrix3d R_a_b = R_b_a.transpose();
    const Eigen::Vector3d t_a_b = -R_a_b * t_b_a, centre = R_a_b * camera_b.center_sensor() + t_a_b;
    const double right = points_b.width - 0.5, bottom = points_b.height - 0.5;
    const int width = a.places.width;
    parallel_tasks(static_cast<std::size_t>(a.places.height), threads, [&](std::size_t row) {
        const int v = static_cast<int>(row);
        std::fill_n(source.at(v, 0), 2 * static_cast<std::size_t>(width), NOT_A_NUMBER);
        std::array<int, kAhead> columns{};
        std::array<SurfacePoint, kAhead> surface;
        for (int next = 0; next < width;) {
            Places places;
            int count = 0;
            for (; next < width && count < kAhead; ++next) {
                if (*a.own.at(v, next) == 0) continue;
                columns[count] = next;
                surface[count] = surface_at(a, a.places.at(v, next));
                const Eigen::Vector3d& point = surface[count].point;
                places.x[count] = point[0];
                places.y[count] = point[1];
                places.z[count] = point[2];
                ++count;
            }
            if (count == 0) continue;
            camera.project(places);
            for (int i = 0; i < count; ++i) {
                const double x = places.u[i], y = places.v[i];
                if (!(places.z[i] > 0 && x > -0.5 && y > -0.5 && x < right && y < bottom)) continue;
                const Eigen::Vector3d& point = surface[i].point;
                const Eigen::Vector3d normal = surface[i].normal.normalized();
                if (!((point - centre).dot(normal) < 0)) continue;
                const Eigen::Vector3d other =
                    vector_at(points_b, static_cast<int>(std::nearbyint(y)), static_cast<int>(std::nearbyint(x)));
                if (!(std::abs((R_a_b * other + t_a_b - point).dot(normal)) <= gate)) continue;
                float* out = source.at(v, columns[i]);
                out[0] = static_cast<float>(x);
                out[1] = static_cast<float>(y);
            }
        }
    });
}

}  // namespace planish
