#pragma once

#include <Eigen/Geometry>
#include <algorithm>
#include <array>
#include <cmath>

#include "core/common/cubic.hpp"
#include "core/common/moved_camera.hpp"
#include "core/common/prefetch.hpp"
#include "core/refinement/joint.hpp"

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

/// Four pixels around a place, and their weights in linear interpolation.
struct Cell {
    int u = 0, v = 0;
    float fx = 0, fy = 0;  ///< how far behind the first of them
    std::array<float, 4> w{};

    Cell() = default;
    Cell(double x, double y)  // neither is negative
        : u(static_cast<int>(x)), v(static_cast<int>(y)), fx(static_cast<float>(x - u)), fy(static_cast<float>(y - v)) {
        w = {(1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy};
    }
    /// The four pixels' first channel, in the order of the weights.
    [[nodiscard]] std::array<const float*, 4> corners(const Image<const float>& map) const {
        const float *p = map.at(v, u), *q = map.at(v + 1, u);
        return {p, p + map.channels, q, q + map.channels};
    }
};

/// Cubic convolution; NaN where one of the 16 values is.
inline float cubic(const Image<const float>& map, const Cell& cell) {
    using Four = Eigen::Array4f;
    const Four wx = cubic_weights(cell.fx), wy = cubic_weights(cell.fy);
    const auto step = static_cast<std::ptrdiff_t>(map.width);
    const float* p = map.at(cell.v - 1, cell.u - 1);
    const Four along = wy[0] * Four::Map(p) + wy[1] * Four::Map(p + step) + wy[2] * Four::Map(p + 2 * step) +
                       wy[3] * Four::Map(p + 3 * step);
    return (along * wx).sum();
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

/// Where a pixel of b, moved into a, meets the surface of a.
struct Meeting {
    int v = 0, u = 0;         ///< the pixel of b
    Cell cell;                ///< where it lies in a's image
    Eigen::Array4f x;         ///< the point of b in frame a, and 0
    Eigen::Array4f lever;     ///< the same from the point that rotations turn about
    Eigen::Array4f normal;    ///< of a, and the variance of a's texture
    Eigen::Array4f gradient;  ///< of a's texture, and the displacement of a's surface by the blur [mm]
    float variance = 0;       ///< of a's points along the normal [mm^2]
    float distance = 0;       ///< along a's normal [mm]
};

/// The next pixel of a window, row by row.
struct Cursor {
    int left, right, bottom, v, u;

    Cursor(int top, int left_, int bottom_, int right_)
        : left(left_), right(right_), bottom(bottom_), v(top), u(left_) {}
    [[nodiscard]] bool done() const { return v >= bottom; }
    void next_row(int stride) {
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
        std::array<int, kAhead> rows, columns;
        Places p;
        const int count = take(next, p, rows, columns);
        if (count == 0) return 0;
        const Moved moved = move(p);
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
            m.x << moved.x[0][i], moved.x[1][i], moved.x[2][i], 0.0F;
            m.lever << moved.lever[0][i], moved.lever[1][i], moved.lever[2][i], 0.0F;
            prefetch_around(m);
            ++met;
        }
        return met;
    }

    /// Calls `use_one` with the pixels of a tile of b that can be compared. They lie close together in a, too,
    /// whichever way it is turned; while some are used, memory answers what was asked for by the next.
    template <class Use>
    void each_meeting(int top, int left, Use use_one) const {
        const int bottom = std::min(b.values.height, top + o.tile), right = std::min(b.values.width, left + o.tile);
        std::array<std::array<Meeting, kAhead>, 2> found;
        int waiting = 0, turn = 0;
        const auto use_waiting = [&] {
            for (int i = 0; i < waiting; ++i) use_one(found[turn][i]);
        };
        for (Cursor next(top, left, bottom, right); !next.done();) {
            const int coming = find(next, found[1 - turn]);
            use_waiting();
            waiting = coming;
            turn = 1 - turn;
        }
        use_waiting();
    }

    /// The surface between four pixels: half way between the chord through their points, which cuts a curved surface
    /// off, and their planes, which exceed it by as much: exact to the second order.
    void look_up(Meeting& m) const {
        const auto corners = m.cell.corners(a.values);
        using Four = Eigen::Array4f;
        // Three times four channels: point and its variance, normal and the texture's variance, gradient and blur.
        Four normals = Four::Zero(), gradients = Four::Zero(), chord = Four::Zero(), planes = Four::Zero();
        const Four x = m.x;
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
        m.normal = normals;
        m.gradient = gradients;
        m.variance = -chord[3];
        m.distance = 0.5F * (both[0] + both[1] + both[2]);
    }

    /// A direction that stands at a pixel of b, in b's own frame.
    [[nodiscard]] Eigen::Vector3f of_b(const Meeting& m, int channel) const {
        return Eigen::Vector3f::Map(b.values.at(m.v, m.u) + channel);
    }

    /// Looks a's surface up; false where there is none, or the two would hide or pierce one another.
    [[nodiscard]] bool compare(Meeting& m) const {
        look_up(m);
        if (!(std::fabs(m.distance) <= o.max_distance)) return false;
        const Eigen::Vector3f normal = m.normal.head<3>();
        return normal.dot(R_float * of_b(m, joint::normal)) >= o.min_cosine;
    }

  private:
    /// Points in frame a, and from the point that rotations turn about, coordinate by coordinate.
    struct Moved {
        std::array<std::array<float, kAhead>, 3> x, lever;
    };

    /// Takes the next points of b; returns how many there are.
    int take(Cursor& next, Places& p, std::array<int, kAhead>& rows, std::array<int, kAhead>& columns) const {
        int count = 0;
        const std::ptrdiff_t along = static_cast<std::ptrdiff_t>(o.stride) * joint::channels;
        while (count < kAhead && next.v < next.bottom) {
            const float* point = b.values.at(next.v, next.u);
            const std::uint8_t* use = b.use.at(next.v, next.u);
            const std::ptrdiff_t down = next.v + o.stride < next.bottom ? along * b.values.width : 0;
            for (; next.u < next.right && count < kAhead; next.u += o.stride, point += along, use += o.stride) {
                prefetch(point + down);
                if (std::isnan(point[2]) || *use == 0) continue;
                p.x[count] = point[0];
                p.y[count] = point[1];
                p.z[count] = point[2];
                rows[count] = next.v;
                columns[count] = next.u;
                ++count;
            }
            if (next.u >= next.right) next.next_row(o.stride);
        }
        return count;
    }

    [[nodiscard]] Moved move(const Places& p) const {
        const Eigen::Matrix3d M = R;
        const Eigen::Vector3d s = t, centre = about;
        Moved out;
        for (int i = 0; i < kAhead; ++i) {
            const double x = M(0, 0) * p.x[i] + M(0, 1) * p.y[i] + M(0, 2) * p.z[i] + s[0];
            const double y = M(1, 0) * p.x[i] + M(1, 1) * p.y[i] + M(1, 2) * p.z[i] + s[1];
            const double z = M(2, 0) * p.x[i] + M(2, 1) * p.y[i] + M(2, 2) * p.z[i] + s[2];
            out.x[0][i] = static_cast<float>(x);
            out.x[1][i] = static_cast<float>(y);
            out.x[2][i] = static_cast<float>(z);
            out.lever[0][i] = static_cast<float>(x - centre[0]);
            out.lever[1][i] = static_cast<float>(y - centre[1]);
            out.lever[2][i] = static_cast<float>(z - centre[2]);
        }
        return out;
    }

    /// Asks for the values that `compare` reads of a; of its texture, neighbours read the same lines.
    void prefetch_around(const Meeting& m) const {
        for (int row = 0; row < 2; ++row) {
            const float* p = a.values.at(m.cell.v + row, m.cell.u);
            prefetch(p);
            prefetch(p + 2 * joint::channels - 1);
        }
    }
};

}  // namespace planish
