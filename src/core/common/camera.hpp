#pragma once

#include <Eigen/Core>
#include <array>
#include <limits>

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

    /// Derivative of distort; `slope` is d radial / d r2.
    [[nodiscard]] Eigen::Matrix2d distortion_jacobian(const Eigen::Vector2d& n) const {
        const double x = n.x(), y = n.y(), r2 = x * x + y * y;
        const double below = 1 + r2 * (k[5] + r2 * (k[6] + r2 * k[7]));
        const double radial = (1 + r2 * (k[0] + r2 * (k[1] + r2 * k[4]))) / below;
        const double slope =
            (k[0] + r2 * (2 * k[1] + 3 * r2 * k[4]) - radial * (k[5] + r2 * (2 * k[6] + 3 * r2 * k[7]))) / below;
        const double cross = 2 * x * y * slope + 2 * k[2] * x + 2 * k[3] * y;
        const double prism_x = 2 * (k[8] + 2 * k[9] * r2), prism_y = 2 * (k[10] + 2 * k[11] * r2);
        Eigen::Matrix2d J;
        J << radial + 2 * x * x * slope + 2 * k[2] * y + 6 * k[3] * x + prism_x * x, cross + prism_x * y,
            cross + prism_y * x, radial + 2 * y * y * slope + 6 * k[2] * y + 2 * k[3] * x + prism_y * y;
        return J;
    }

    /// Inverse of distort by Newton's method: three to five steps for real lenses, barrel or pincushion. NaN where no
    /// ray belongs to the pixel (beyond the range in which the distortion is one to one).
    [[nodiscard]] Eigen::Vector2d undistort(const Eigen::Vector2d& d) const {
        Eigen::Vector2d n = d;
        for (int i = 0; i < 20; ++i) {
            const Eigen::Vector2d residual = d - distort(n);
            if (residual.squaredNorm() < 1e-26) return n;
            const Eigen::Matrix2d J = distortion_jacobian(n);
            const double determinant = J(0, 0) * J(1, 1) - J(0, 1) * J(1, 0);
            n += Eigen::Vector2d(J(1, 1) * residual.x() - J(0, 1) * residual.y(),
                                 J(0, 0) * residual.y() - J(1, 0) * residual.x()) /
                 determinant;
        }
        return Eigen::Vector2d::Constant(std::numeric_limits<double>::quiet_NaN());
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
