#include "core/registration/nearest_pixels.hpp"

#include <array>
#include <cmath>
#include <cstddef>

#include "core/common/moved_camera.hpp"

namespace planish {

std::vector<NearestPixel> nearest_pixels(const Image<const float>& points_b, int stride, const Camera& camera_a,
                                         int height_a, int width_a, const Eigen::Matrix3d& R_a_b,
                                         const Eigen::Vector3d& t_a_b) {
    const MovedCamera camera(camera_a, R_a_b, t_a_b);
    std::vector<NearestPixel> out;
    Places places;
    std::array<std::int32_t, kAhead> taken{};
    int count = 0;
    const auto project = [&] {
        camera.project(places);
        for (int i = 0; i < count; ++i) {
            const double u = std::nearbyint(places.u[i]), v = std::nearbyint(places.v[i]);
            if (!(places.z[i] > 0 && u >= 0 && v >= 0 && u < width_a && v < height_a)) continue;
            const float* x = points_b.data + std::ptrdiff_t{3} * taken[i];
            const auto pixel = static_cast<std::int32_t>(v) * width_a + static_cast<std::int32_t>(u);
            out.push_back({taken[i], pixel, R_a_b * Eigen::Vector3d(x[0], x[1], x[2]) + t_a_b});
        }
        count = 0;
    };
    for (int v = 0; v < points_b.height; v += stride)
        for (int u = 0; u < points_b.width; u += stride) {
            const float* x = points_b.at(v, u);
            if (std::isnan(x[2])) continue;
            taken[count] = v * points_b.width + u;
            places.x[count] = x[0];
            places.y[count] = x[1];
            places.z[count] = x[2];
            if (++count == kAhead) project();
        }
    project();
    return out;
}

}  // namespace planish
