#pragma once

#include <array>

#include "core/common/camera.hpp"

namespace planish {

/// Points that are projected together: as many as the compiler takes at once, and memory takes to answer.
constexpr int kAhead = 16;

/// Points, before in their own frame and then in that of the camera, and their pixels.
struct Places {
    std::array<double, kAhead> x{}, y{}, z{}, u, v;
};

/// A camera as another frame sees it: what `Camera::project` does to points R x + t, for several at a time.
struct MovedCamera {
    Camera camera;
    Eigen::Matrix3d R;
    Eigen::Vector3d t;

    MovedCamera(const Camera& camera_, const Eigen::Matrix3d& R_, const Eigen::Vector3d& t_)
        : camera(camera_), R(camera_.R_camera_sensor * R_), t(camera_.to_camera(t_)) {}

    void project(Places& p) const {
        // Copies, which nothing that is written can change.
        const Camera c = camera;
        const Eigen::Matrix3d M = R;
        const Eigen::Vector3d s = t;
        for (int i = 0; i < kAhead; ++i) {
            const double x = p.x[i], y = p.y[i], z = p.z[i];
            p.x[i] = M(0, 0) * x + M(0, 1) * y + M(0, 2) * z + s[0];
            p.y[i] = M(1, 0) * x + M(1, 1) * y + M(1, 2) * z + s[1];
            p.z[i] = M(2, 0) * x + M(2, 1) * y + M(2, 2) * z + s[2];
            const double over_z = 1.0 / p.z[i];
            const Eigen::Vector2d pixel = c.to_pixel(c.distort({p.x[i] * over_z, p.y[i] * over_z}));
            p.u[i] = pixel[0];
            p.v[i] = pixel[1];
        }
    }
};

}  // namespace planish
