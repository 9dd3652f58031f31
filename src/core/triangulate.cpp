#include "core/triangulate.hpp"

#include <Eigen/Geometry>
#include <algorithm>
#include <cmath>
#include <limits>

#include "core/parallel.hpp"

namespace planish {
namespace {

constexpr float kNaN = std::numeric_limits<float>::quiet_NaN();
/// Below this sine of the angle between the rays [rad] there is no triangulation.
constexpr double kMinSine = 1e-4;

/// Undistorted normalised coordinates of a pixel, the shift interpolated between pixels.
Eigen::Vector3d normalised(const ViewGeometry& view, double u, double v) {
    Eigen::Vector2d pixel(u, v);
    if (!view.shift_px.empty()) {
        const int left = std::clamp(static_cast<int>(u), 0, view.shift_px.width - 2);
        const int top = std::clamp(static_cast<int>(v), 0, view.shift_px.height - 2);
        const double fu = u - left, fv = v - top;
        const float* a = view.shift_px.at(top, left);
        const float* b = view.shift_px.at(top + 1, left);
        for (int i = 0; i < 2; ++i)
            pixel[i] += (1 - fv) * ((1 - fu) * a[i] + fu * a[i + 2]) + fv * ((1 - fu) * b[i] + fu * b[i + 2]);
    }
    const Eigen::Vector2d n = view.camera.from_pixel(pixel);
    return {n.x(), n.y(), 1.0};
}

Eigen::Vector3d own_ray(const ViewGeometry& view, int u, int v) {
    Eigen::Vector2d pixel(u, v);
    if (!view.shift_px.empty()) {
        const float* shift = view.shift_px.at(v, u);
        pixel += Eigen::Vector2d(shift[0], shift[1]);
    }
    const Eigen::Vector2d n = view.camera.from_pixel(pixel);
    return {n.x(), n.y(), 1.0};
}

}  // namespace

void triangulate(const ViewGeometry& own, const ViewGeometry& other, Image<const float> pixel, Image<const float> sigma,
                 int threads, const TriangulateResult& out) {
    const Eigen::Matrix3d R_sensor_own = own.camera.R_camera_sensor.transpose();
    const Eigen::Matrix3d R_other_own = other.camera.R_camera_sensor * R_sensor_own;
    const Eigen::Vector3d center = own.camera.center_sensor(), t = other.camera.to_camera(center);
    const double focal = 0.5 * (other.camera.fx + other.camera.fy);

    parallel_for(static_cast<std::size_t>(pixel.height), threads, [&](std::size_t begin, std::size_t end) {
        for (std::size_t i = begin; i < end; ++i) {
            const int v = static_cast<int>(i);
            for (int u = 0; u < pixel.width; ++u) {
                float* point = out.points_sensor.at(v, u);
                float& point_sigma = *out.sigma_mm.at(v, u);
                float& miss = *out.miss_px.at(v, u);
                point[0] = point[1] = point[2] = point_sigma = miss = kNaN;
                const float* p = pixel.at(v, u);
                if (!(p[0] == p[0])) continue;
                const Eigen::Vector3d ray = own_ray(own, u, v), q = R_other_own * ray;
                const Eigen::Vector3d b = normalised(other, p[0], p[1]);
                // Nearest point of x(s) = t + s q to the line along b: (q x b) s = -(t x b) in the least squares sense.
                const Eigen::Vector3d qb = q.cross(b), tb = t.cross(b);
                const double squared = qb.squaredNorm(), depth = -qb.dot(tb) / squared;
                const Eigen::Vector3d x = t + depth * q;
                if (!(depth > 0) || !(x.z() > 0) || squared < kMinSine * kMinSine * q.squaredNorm()) continue;
                // Image of the point in the other camera moves by `motion` [focal lengths] per unit of depth.
                const double inverse_z = 1 / x.z();
                const Eigen::Vector2d image = x.head<2>() * inverse_z;
                const Eigen::Vector2d motion = (q.head<2>() - image * q.z()) * inverse_z;
                const double inverse_motion = 1 / motion.norm();
                const Eigen::Vector2d off = b.head<2>() - image;
                const Eigen::Vector3d sensor = center + depth * (R_sensor_own * ray);
                for (int k = 0; k < 3; ++k) point[k] = static_cast<float>(sensor[k]);
                point_sigma = static_cast<float>(*sigma.at(v, u) / focal * inverse_motion * ray.norm());
                miss = static_cast<float>(focal * (off.x() * motion.y() - off.y() * motion.x()) * inverse_motion);
            }
        }
    });
}

void projector_residual(const Camera& projector, int axis, const Eigen::Vector3d& center, Image<const float> points,
                        Image<const float> sigma_mm, Image<const float> position, Image<const float> position_sigma,
                        int threads, Image<float> residual, Image<float> residual_sigma) {
    constexpr double kStep = 0.01;  // mm along the ray, for the derivative
    parallel_for(static_cast<std::size_t>(points.height), threads, [&](std::size_t begin, std::size_t end) {
        for (std::size_t i = begin; i < end; ++i) {
            const int v = static_cast<int>(i);
            for (int u = 0; u < points.width; ++u) {
                const float* p = points.at(v, u);
                if (!(p[2] == p[2])) {
                    *residual.at(v, u) = *residual_sigma.at(v, u) = kNaN;
                    continue;
                }
                const Eigen::Vector3d x(p[0], p[1], p[2]);
                const double here = projector.project(x)[axis];
                const double beyond = projector.project(x + kStep * (x - center).normalized())[axis];
                const double along = (beyond - here) / kStep * *sigma_mm.at(v, u), own = *position_sigma.at(v, u);
                *residual.at(v, u) = static_cast<float>(here - *position.at(v, u));
                *residual_sigma.at(v, u) = static_cast<float>(std::sqrt(along * along + own * own));
            }
        }
    });
}

}  // namespace planish
