#include "core/sensing/projector_residual.hpp"

#include <cmath>

#include "core/common/parallel.hpp"

namespace planish {

ProjectorRay::ProjectorRay(const Camera& projector, int axis, const Eigen::Vector3d& center_own)
    : lens_(projector, axis != 0),
      R_(projector.R_camera_sensor.cast<float>()),
      t_(projector.t_camera_sensor.cast<float>()),
      center_(center_own.cast<float>()),
      focal_(static_cast<float>(axis == 0 ? projector.fx : projector.fy)),
      focal_across_(static_cast<float>(axis == 0 ? projector.fy : projector.fx)),
      skew_(axis == 0 ? static_cast<float>(projector.skew) : 0.0F),
      skew_across_(axis == 0 ? 0.0F : static_cast<float>(projector.skew)) {
    if (axis != 0) {
        R_.row(0).swap(R_.row(1));
        std::swap(t_[0], t_[1]);
    }
}

void ProjectorRay::residual(const float* points, const float* sigma_mm, const float* position,
                            const float* position_sigma, int n, float* residual, float* residual_sigma) const {
    const Lens lens = lens_;
    const Eigen::Matrix3f R = R_;
    const Eigen::Vector3f t = t_, center = center_;
    const float fa = focal_, fb = focal_across_, skew_a = skew_, skew_b = skew_across_;
    for (int i = 0; i < n; ++i) {
        const float x = points[3 * i], y = points[3 * i + 1], z = points[3 * i + 2];
        const float rx = x - center[0], ry = y - center[1], rz = z - center[2];
        const float below = 1 / (R(2, 0) * x + R(2, 1) * y + R(2, 2) * z + t[2]);
        const float a = (R(0, 0) * x + R(0, 1) * y + R(0, 2) * z + t[0]) * below,
                    b = (R(1, 0) * x + R(1, 1) * y + R(1, 2) * z + t[1]) * below;
        // The normalised image moves by (da, db) as the point moves along its ray by the ray's length.
        const float dz = R(2, 0) * rx + R(2, 1) * ry + R(2, 2) * rz;
        const float da = (R(0, 0) * rx + R(0, 1) * ry + R(0, 2) * rz - a * dz) * below,
                    db = (R(1, 0) * rx + R(1, 1) * ry + R(1, 2) * rz - b * dz) * below;
        const Lens::Place at =
            lens.along(fa * a + skew_a * b, fb * b + skew_b * a, fa * da + skew_a * db, fb * db + skew_b * da);
        const float along = at.du / std::sqrt(rx * rx + ry * ry + rz * rz) * sigma_mm[i];
        residual[i] = at.u + lens.cu - position[i];
        residual_sigma[i] = std::sqrt(along * along + position_sigma[i] * position_sigma[i]);
    }
}

void projector_residual(const ProjectorRay& projector, Image<const float> points, Image<const float> sigma_mm,
                        Image<const float> position, Image<const float> position_sigma, int threads,
                        Image<float> residual, Image<float> residual_sigma) {
    parallel_for(static_cast<std::size_t>(points.height), threads, [&](std::size_t begin, std::size_t end) {
        for (int v = static_cast<int>(begin); v < static_cast<int>(end); ++v)
            projector.residual(points.row(v), sigma_mm.row(v), position.row(v), position_sigma.row(v), points.width,
                               residual.row(v), residual_sigma.row(v));
    });
}

}  // namespace planish
