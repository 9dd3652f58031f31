#pragma once

#include <Eigen/Core>
#include <array>

namespace planish {

/// Pinhole camera with the distortion model of OpenCV (k1 k2 p1 p2 k3 k4 k5 k6 s1 s2 s3 s4; no tilt), in float64.
/// Pixel (0, 0) is the centre of the first pixel. Source: OpenCV calib3d, "Detailed Description".
struct Camera {
    double fx, fy, cx, cy, skew;
    std::array<double, 12> k;
    Eigen::Matrix3d R_camera_sensor;
    Eigen::Vector3d t_camera_sensor;

    [[nodiscard]] Eigen::Vector3d to_camera(const Eigen::Vector3d& x_sensor) const {
        return R_camera_sensor * x_sensor + t_camera_sensor;
    }
    [[nodiscard]] Eigen::Vector3d center_sensor() const { return -R_camera_sensor.transpose() * t_camera_sensor; }

    /// Normalised, undistorted (x, y) to normalised, distorted.
    [[nodiscard]] Eigen::Vector2d distort(const Eigen::Vector2d& n) const {
        const double x = n.x(), y = n.y(), r2 = x * x + y * y, r4 = r2 * r2, r6 = r4 * r2;
        const double radial = (1 + k[0] * r2 + k[1] * r4 + k[4] * r6) / (1 + k[5] * r2 + k[6] * r4 + k[7] * r6);
        return {x * radial + 2 * k[2] * x * y + k[3] * (r2 + 2 * x * x) + k[8] * r2 + k[9] * r4,
                y * radial + k[2] * (r2 + 2 * y * y) + 2 * k[3] * x * y + k[10] * r2 + k[11] * r4};
    }

    /// Inverse of distort by fixed-point iteration (converges for every distortion that is one to one over the image).
    [[nodiscard]] Eigen::Vector2d undistort(const Eigen::Vector2d& d) const {
        Eigen::Vector2d n = d;
        for (int i = 0; i < 50; ++i) {
            const Eigen::Vector2d step = d - distort(n);
            n += step;
            if (step.squaredNorm() < 1e-26) break;
        }
        return n;
    }

    [[nodiscard]] Eigen::Vector2d to_pixel(const Eigen::Vector2d& distorted) const {
        return {fx * distorted.x() + skew * distorted.y() + cx, fy * distorted.y() + cy};
    }
    [[nodiscard]] Eigen::Vector2d from_pixel(const Eigen::Vector2d& pixel) const {
        const double y = (pixel.y() - cy) / fy;
        return {(pixel.x() - cx - skew * y) / fx, y};
    }

    /// Pixel (u, v) of a point in the sensor frame; the point must lie in front of the camera.
    [[nodiscard]] Eigen::Vector2d project(const Eigen::Vector3d& x_sensor) const {
        const Eigen::Vector3d x = to_camera(x_sensor);
        return to_pixel(distort({x.x() / x.z(), x.y() / x.z()}));
    }

    /// Direction in the sensor frame (z of the camera frame = 1, not normalised) of the ray through a pixel.
    [[nodiscard]] Eigen::Vector3d ray_sensor(const Eigen::Vector2d& pixel) const {
        const Eigen::Vector2d n = undistort(from_pixel(pixel));
        return R_camera_sensor.transpose() * Eigen::Vector3d(n.x(), n.y(), 1.0);
    }
};

}  // namespace planish
