#pragma once

#include <Eigen/Geometry>
#include <array>
#include <cmath>

#include "core/joint.hpp"

namespace planish {

struct Influence {
    double weight;  ///< psi(r) / r
    double slope;   ///< psi'(r)
};

/// Tukey's biweight: 1 at 0, 0 from 4.685 scales on (95 % efficiency under normal noise, Holland and Welsch 1977).
inline Influence tukey(double residual, double scale) {
    const double x = residual / (4.685 * scale), xx = x * x;
    const double y = 1.0 - xx;
    return y > 0 ? Influence{y * y, y * (1.0 - 5.0 * xx)} : Influence{0, 0};
}

/// Four pixels around a place, and their weights in linear interpolation.
struct Cell {
    int u = 0, v = 0;
    std::array<float, 4> w{};

    Cell() = default;
    Cell(double x, double y) : u(static_cast<int>(std::floor(x))), v(static_cast<int>(std::floor(y))) {
        const auto fx = static_cast<float>(x - u), fy = static_cast<float>(y - v);
        w = {(1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy};
    }
    [[nodiscard]] Eigen::Vector3d vector(const Image<const float>& map) const {
        const float *p = map.at(v, u), *q = map.at(v + 1, u);
        Eigen::Vector3d out;
        for (int i = 0; i < 3; ++i) out[i] = w[0] * p[i] + w[1] * p[i + 3] + w[2] * q[i] + w[3] * q[i + 3];
        return out;
    }
    [[nodiscard]] double scalar(const Image<const float>& map) const {
        const float *p = map.at(v, u), *q = map.at(v + 1, u);
        return w[0] * p[0] + w[1] * p[1] + w[2] * q[0] + w[3] * q[1];
    }
};

/// Cubic convolution (Keys 1981, a = -1/2); NaN where one of the 16 values is.
inline double cubic(const Image<const float>& map, double x, double y) {
    const int u = static_cast<int>(std::floor(x)), v = static_cast<int>(std::floor(y));
    const auto weights = [](float f) -> std::array<float, 4> {
        const float f2 = f * f, f3 = f2 * f;
        return {-0.5F * f3 + f2 - 0.5F * f, 1.5F * f3 - 2.5F * f2 + 1.0F, -1.5F * f3 + 2.0F * f2 + 0.5F * f,
                0.5F * f3 - 0.5F * f2};
    };
    const auto wx = weights(static_cast<float>(x - u)), wy = weights(static_cast<float>(y - v));
    float sum = 0;
    for (int j = 0; j < 4; ++j) {
        const float* p = map.at(v - 1 + j, u - 1);
        sum += wy[j] * (wx[0] * p[0] + wx[1] * p[1] + wx[2] * p[2] + wx[3] * p[3]);
    }
    return sum;
}

inline Vector6 jacobian(const Eigen::Vector3d& lever, const Eigen::Vector3d& direction) {
    const Eigen::Vector3d moment = lever.cross(direction);
    Vector6 J;
    for (int i = 0; i < 3; ++i) {
        J[i] = moment[i];
        J[i + 3] = direction[i];
    }
    return J;
}

/// Where a pixel of b, moved into a, meets the surface of a.
struct Meeting {
    Eigen::Vector3d x, in_camera;  ///< the point of b, in frame a and in a's camera
    Eigen::Vector2d at;            ///< its pixel there
    Cell cell;
    Eigen::Vector3d normal_a, normal_b;  ///< in frame a
    double distance = 0;                 ///< along a's normal
};

/// False where the two have nothing in common at pixel (v, u) of b, or would hide or pierce one another.
inline bool meet(const JointMaps& a, const JointMaps& b, const Camera& camera, const Eigen::Matrix3d& R,
                 const Eigen::Vector3d& t, const JointOptions& o, int v, int u, Meeting& m) {
    const float* p = b.points.at(v, u);
    if (std::isnan(p[2]) || *b.use.at(v, u) == 0) return false;
    m.x = R * Eigen::Vector3d(p[0], p[1], p[2]) + t;
    m.in_camera = camera.to_camera(m.x);
    if (!(m.in_camera.z() > 0)) return false;
    m.at = camera.to_pixel(camera.distort({m.in_camera.x() / m.in_camera.z(), m.in_camera.y() / m.in_camera.z()}));
    if (!(m.at.x() >= 1 && m.at.y() >= 1 && m.at.x() < a.points.width - 2 && m.at.y() < a.points.height - 2))
        return false;
    m.cell = Cell(m.at.x(), m.at.y());
    if (*a.use.at(m.cell.v, m.cell.u) == 0) return false;
    const Eigen::Vector3d q = m.cell.vector(a.points);
    m.normal_a = m.cell.vector(a.normals);
    if (std::isnan(q.z()) || std::isnan(m.normal_a.z())) return false;
    const float* n = b.normals.at(v, u);
    m.normal_b = R * Eigen::Vector3d(n[0], n[1], n[2]);
    m.distance = m.normal_a.dot(m.x - q);
    return std::fabs(m.distance) <= o.max_distance && m.normal_a.dot(m.normal_b) >= o.min_cosine;
}

}  // namespace planish
