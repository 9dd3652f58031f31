#pragma once

#include <Eigen/Geometry>
#include <array>
#include <cmath>

#include "core/joint.hpp"
#include "core/moved_camera.hpp"

namespace planish {

/// Tukey's biweight is 0 from so many scales on (95 % efficiency under normal noise, Holland and Welsch 1977).
constexpr float kTukey = 4.685F;

struct Influence {
    float weight;  ///< psi(r) / r
    float slope;   ///< psi'(r)
};

/// Tukey's biweight: 1 at 0.
inline Influence tukey(float residual, float scale) {
    const float x = residual / (kTukey * scale), xx = x * x;
    const float y = 1.0F - xx;
    return y > 0 ? Influence{y * y, y * (1.0F - 5.0F * xx)} : Influence{0, 0};
}

inline Eigen::Vector3d vector_of(const float* pixel, int channel) {
    return {pixel[channel], pixel[channel + 1], pixel[channel + 2]};
}

/// Four pixels around a place, and their weights in linear interpolation.
struct Cell {
    int u = 0, v = 0;
    std::array<float, 4> w{};

    Cell() = default;
    Cell(double x, double y) : u(static_cast<int>(x)), v(static_cast<int>(y)) {  // neither is negative
        const auto fx = static_cast<float>(x - u), fy = static_cast<float>(y - v);
        w = {(1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy};
    }
    /// The four pixels' first channel, in the order of the weights.
    [[nodiscard]] std::array<const float*, 4> corners(const Image<const float>& map) const {
        const float *p = map.at(v, u), *q = map.at(v + 1, u);
        return {p, p + map.channels, q, q + map.channels};
    }
};

/// Weights of cubic convolution (Keys 1981, a = -1/2) for a place the fraction f behind the second of four pixels.
inline std::array<float, 4> cubic_weights(float f) {
    const float f2 = f * f, f3 = f2 * f;
    return {-0.5F * f3 + f2 - 0.5F * f, 1.5F * f3 - 2.5F * f2 + 1.0F, -1.5F * f3 + 2.0F * f2 + 0.5F * f,
            0.5F * f3 - 0.5F * f2};
}

/// Cubic convolution; NaN where one of the 16 values is.
inline float cubic(const Image<const float>& map, double x, double y) {
    const int u = static_cast<int>(x), v = static_cast<int>(y);
    const auto wx = cubic_weights(static_cast<float>(x - u)), wy = cubic_weights(static_cast<float>(y - v));
    std::array<float, 4> along{};
    for (int j = 0; j < 4; ++j) {
        const float* p = map.at(v - 1 + j, u - 1);
        for (int i = 0; i < 4; ++i) along[i] += wy[j] * p[i];
    }
    return along[0] * wx[0] + along[1] * wx[1] + along[2] * wx[2] + along[3] * wx[3];
}

using Row6 = std::array<float, 8>;  ///< six numbers, filled up to what one instruction takes

inline Row6 jacobian(const Eigen::Vector3f& lever, const Eigen::Vector3f& direction) {
    return {lever[1] * direction[2] - lever[2] * direction[1],
            lever[2] * direction[0] - lever[0] * direction[2],
            lever[0] * direction[1] - lever[1] * direction[0],
            direction[0],
            direction[1],
            direction[2],
            0,
            0};
}

/// Asks for what will be read soon.
inline void prefetch([[maybe_unused]] const void* place) {
#if defined(__GNUC__)
    __builtin_prefetch(place);
#endif
}

/// Where a pixel of b, moved into a, meets the surface of a.
struct Meeting {
    int v = 0, u = 0;              ///< the pixel of b
    Eigen::Vector3d x, in_camera;  ///< the point of b, in frame a and in a's camera
    Eigen::Array4f x_float;        ///< and 0
    Eigen::Vector2d at;            ///< its pixel there
    Cell cell;
    Eigen::Vector3f normal_a, normal_b;  ///< in frame a
    Eigen::Vector3f gradient_a;          ///< of a's texture
    float variance_texture = 0;          ///< of a's texture
    float variance_distance = 0;         ///< of a's points along the normal [mm^2]
    float blur_a = 0;                    ///< displacement of a's surface by the blur [mm]
    float distance = 0;                  ///< along a's normal [mm]
    float sigma = 0;                     ///< its standard deviation [mm]
};

/// The next pixel of a window, row by row.
struct Cursor {
    int left, right, bottom, v, u;

    Cursor(int top, int left_, int bottom_, int right_)
        : left(left_), right(right_), bottom(bottom_), v(top), u(left_) {}
    [[nodiscard]] bool done() const { return v >= bottom; }
    void advance(int stride) {
        u += stride;
        if (u < right) return;
        u = left;
        v += stride;
    }
};

/// One measurement b against another one a.
struct JointPair {
    const JointMaps &a, &b;
    const Camera& camera;
    Eigen::Matrix3d R;
    Eigen::Matrix3f R_float;
    Eigen::Vector3d t, about;
    MovedCamera to_a;
    JointOptions o;

    JointPair(const JointMaps& a_, const Camera& camera_, const JointMaps& b_, const Eigen::Matrix3d& R_,
              const Eigen::Vector3d& t_, const Eigen::Vector3d& about_, const JointOptions& o_)
        : a(a_),
          b(b_),
          camera(camera_),
          R(R_),
          R_float(R_.cast<float>()),
          t(t_),
          about(about_),
          to_a(camera_, R_, t_),
          o(o_) {}

    /// Finds where the next pixels of b, up to `kAhead` of them, lie in a's image. Returns the number of those that can
    /// be compared.
    [[nodiscard]] int find(Cursor& next, std::array<Meeting, kAhead>& found) const {
        std::array<int, kAhead> rows{}, columns{};
        Places p;
        int count = 0;
        for (; count < kAhead && next.v < next.bottom; next.advance(o.stride)) {
            const float* point = b.values.at(next.v, next.u);
            if (next.v + o.stride < next.bottom) prefetch(b.values.at(next.v + o.stride, next.u));
            if (std::isnan(point[2]) || *b.use.at(next.v, next.u) == 0) continue;
            rows[count] = next.v;
            columns[count] = next.u;
            p.x[count] = point[0];
            p.y[count] = point[1];
            p.z[count] = point[2];
            ++count;
        }
        if (count == 0) return 0;
        to_a.project(p);
        int met = 0;
        const double right = a.values.width - 2, bottom = a.values.height - 2;
        for (int i = 0; i < count; ++i) {
            if (!(p.z[i] > 0 && p.u[i] >= 1 && p.v[i] >= 1 && p.u[i] < right && p.v[i] < bottom)) continue;
            Meeting& m = found[met];
            m.cell = Cell(p.u[i], p.v[i]);
            if (*a.use.at(m.cell.v, m.cell.u) == 0) continue;
            m.v = rows[i];
            m.u = columns[i];
            m.at = {p.u[i], p.v[i]};
            m.in_camera = {p.x[i], p.y[i], p.z[i]};
            m.x = R * vector_of(b.values.at(m.v, m.u), joint::point) + t;
            m.x_float << m.x.cast<float>().array(), 0.0F;
            prefetch_around(m);
            ++met;
        }
        return met;
    }

    /// The surface between four pixels: half way between the chord through their points, which cuts a curved surface
    /// off, and their planes, which exceed it by as much: exact to the second order.
    void look_up(Meeting& m) const {
        const auto corners = m.cell.corners(a.values);
        using Four = Eigen::Array4f;
        // Three times four channels: point and its variance, normal and the texture's variance, gradient and blur.
        Four normals = Four::Zero(), gradients = Four::Zero(), chord = Four::Zero(), planes = Four::Zero();
        const Four x = m.x_float;
        for (int k = 0; k < 4; ++k) {
            const float w = m.cell.w[k];
            const Four q = Four::Map(corners[k]), n = Four::Map(corners[k] + 4), g = Four::Map(corners[k] + 8);
            const Four off = w * (x - q);
            planes += n * off;
            chord += off;
            normals += w * n;
            gradients += w * g;
        }
        const Four both = planes + normals * chord;
        m.normal_a = normals.head<3>();
        m.gradient_a = gradients.head<3>();
        m.blur_a = gradients[3];
        m.variance_texture = normals[3];
        m.variance_distance = -chord[3];
        m.distance = 0.5F * (both[0] + both[1] + both[2]);
    }

    /// Looks a's surface up; false where there is none, or the two would hide or pierce one another.
    [[nodiscard]] bool compare(Meeting& m) const {
        const float* p = b.values.at(m.v, m.u);
        look_up(m);
        if (std::isnan(m.distance)) return false;
        m.normal_b = R_float * Eigen::Vector3f(p[joint::normal], p[joint::normal + 1], p[joint::normal + 2]);
        m.sigma = std::sqrt(m.variance_distance + p[joint::variance_distance]);
        return std::fabs(m.distance) <= o.max_distance && m.normal_a.dot(m.normal_b) >= o.min_cosine;
    }

  private:
    /// Asks for what `compare` reads of a.
    void prefetch_around(const Meeting& m) const {
        for (int row = 0; row < 2; ++row) {
            const float* p = a.values.at(m.cell.v + row, m.cell.u);
            prefetch(p);
            prefetch(p + 2 * joint::channels - 1);
        }
        for (int row = -1; row < 3; ++row) prefetch(a.texture.at(m.cell.v + row, m.cell.u));
    }
};

}  // namespace planish
