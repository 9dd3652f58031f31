#include "core/sensing/triangulate.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <vector>

#include "core/common/lens.hpp"
#include "core/common/parallel.hpp"

namespace planish {
namespace {

constexpr float kNaN = std::numeric_limits<float>::quiet_NaN();
/// Below this sine of the angle between the rays [rad] there is no triangulation.
constexpr float kMinSine = 1e-4F;
/// Newton steps of the inverse distortion: one or two for real lenses. After a step of `kLastStep` [px] the next would
/// be below rounding: it is squared times the curvature of the distortion, 1e-3 per pixel at most.
constexpr int kMaxNewton = 20;
constexpr float kLastStep = 0.05F;
constexpr int kChunk = 256;
using Floats = std::array<float, kChunk>;

/// Ideal pixels (x, y) of distorted ones, both relative to the lens's centre; NaN where there is none.
void undistort(const Lens& lens, const float* u, const float* v, int n, float* x, float* y) {
    std::copy_n(u, n, x);
    std::copy_n(v, n, y);
    for (int step = 0; step < kMaxNewton; ++step) {
        int left = 0;
        for (int i = 0; i < n; ++i) {
            const Lens::Place a = lens.along(x[i], y[i], 1, 0), b = lens.along(x[i], y[i], 0, 1);
            const float ru = u[i] - a.u, rv = v[i] - a.v, below = 1 / (a.du * b.dv - b.du * a.dv);
            const float dx = (b.dv * ru - b.du * rv) * below, dy = (a.du * rv - a.dv * ru) * below;
            x[i] += dx;
            y[i] += dy;
            left |= std::fabs(dx) + std::fabs(dy) > kLastStep ? 1 : 0;
        }
        if (left == 0) return;
    }
    for (int i = 0; i < n; ++i) {
        const Lens::Place a = lens.along(x[i], y[i], 1, 0);
        x[i] = std::fabs(u[i] - a.u) + std::fabs(v[i] - a.v) < kLastStep ? x[i] : kNaN;
    }
}

/// Inverse of the camera matrix without its centre: normalised = (x + skew * y, y) / f of ideal pixels about the
/// centre.
struct Inverse {
    float xx, xy, yy;
    explicit Inverse(const Camera& c)
        : xx(static_cast<float>(1 / c.fx)),
          xy(static_cast<float>(-c.skew / (c.fx * c.fy))),
          yy(static_cast<float>(1 / c.fy)) {}
};

class Triangulation {
  public:
    Triangulation(const ViewGeometry& own, const Camera& other)
        : own_inverse_(own.camera),
          other_inverse_(other),
          own_u_(static_cast<float>(own.camera.cx)),
          own_v_(static_cast<float>(own.camera.cy)),
          focal_(static_cast<float>(0.5 * (other.fx + other.fy))),
          lens_(other, false),
          R_sensor_own_(own.camera.R_camera_sensor.transpose().cast<float>()),
          R_other_own_((other.R_camera_sensor * own.camera.R_camera_sensor.transpose()).cast<float>()),
          center_(own.camera.center_sensor().cast<float>()),
          t_(other.to_camera(own.camera.center_sensor()).cast<float>()) {}

    /// Pixels [first, first + n) of row v.
    void solve(int v, int first, int n, const float* shift, const float* pixel, const float* sigma, float* points,
               float* point_sigma, float* miss) const {
        Floats pu, pv, bx, by;
        for (int i = 0; i < n; ++i) {
            pu[i] = pixel[2 * i] - lens_.cu;
            pv[i] = pixel[2 * i + 1] - lens_.cv;
        }
        const Lens lens = lens_;
        undistort(lens, pu.data(), pv.data(), n, bx.data(), by.data());
        const Inverse own = own_inverse_, other = other_inverse_;
        const Eigen::Matrix3f R = R_other_own_, S = R_sensor_own_;
        const Eigen::Vector3f t = t_, center = center_;
        const float u0 = static_cast<float>(first) - own_u_, v0 = static_cast<float>(v) - own_v_, focal = focal_;
        for (int i = 0; i < n; ++i) {
            const float px = u0 + static_cast<float>(i) + shift[2 * i], py = v0 + shift[2 * i + 1];
            const float rx = own.xx * px + own.xy * py, ry = own.yy * py;
            const float qx = R(0, 0) * rx + R(0, 1) * ry + R(0, 2), qy = R(1, 0) * rx + R(1, 1) * ry + R(1, 2),
                        qz = R(2, 0) * rx + R(2, 1) * ry + R(2, 2);
            const float nx = other.xx * bx[i] + other.xy * by[i], ny = other.yy * by[i];
            // The point t + s q has its image at (nx, ny) where s (q - n q_z) = n t_z - t: two equations, solved along
            // the epipolar line, the direction of the right-hand side.
            const float ex = nx * t[2] - t[0], ey = ny * t[2] - t[1], dx = qx - nx * qz, dy = qy - ny * qz;
            const float squared = ex * ex + ey * ey, s = squared / (dx * ex + dy * ey);
            const float x = t[0] + s * qx, y = t[1] + s * qy, z = t[2] + s * qz, inverse_z = 1 / z;
            // The image moves by `motion` [focal lengths] per unit of s.
            const float image_x = x * inverse_z, image_y = y * inverse_z;
            const float motion_x = (qx - image_x * qz) * inverse_z, motion_y = (qy - image_y * qz) * inverse_z;
            const float length = std::sqrt(rx * rx + ry * ry + 1);
            const float below = 1 / std::sqrt(motion_x * motion_x + motion_y * motion_y);
            const bool good =
                (s > 0) & (z > 0) & (dx * dx + dy * dy >= kMinSine * kMinSine * (qx * qx + qy * qy + qz * qz));
            points[3 * i] = good ? center[0] + s * (S(0, 0) * rx + S(0, 1) * ry + S(0, 2)) : kNaN;
            points[3 * i + 1] = good ? center[1] + s * (S(1, 0) * rx + S(1, 1) * ry + S(1, 2)) : kNaN;
            points[3 * i + 2] = good ? center[2] + s * (S(2, 0) * rx + S(2, 1) * ry + S(2, 2)) : kNaN;
            point_sigma[i] = good ? sigma[i] / focal * below * length : kNaN;
            miss[i] = good ? focal * ((nx - image_x) * motion_y - (ny - image_y) * motion_x) * below : kNaN;
        }
    }

  private:
    Inverse own_inverse_, other_inverse_;
    float own_u_, own_v_, focal_;
    Lens lens_;
    Eigen::Matrix3f R_sensor_own_, R_other_own_;
    Eigen::Vector3f center_, t_;
};

}  // namespace

void triangulate(const ViewGeometry& own, const Camera& other, Image<const float> pixel, Image<const float> sigma,
                 int threads, const TriangulateResult& out) {
    const Triangulation triangulation(own, other);
    const std::vector<float> no_shift(2 * kChunk, 0.0F);
    parallel_for(static_cast<std::size_t>(pixel.height), threads, [&](std::size_t begin, std::size_t end) {
        for (std::size_t i = begin; i < end; ++i) {
            const int v = static_cast<int>(i);
            for (int u = 0; u < pixel.width; u += kChunk) {
                const float* shift = own.shift_px.empty() ? no_shift.data() : own.shift_px.at(v, u);
                triangulation.solve(v, u, std::min(kChunk, pixel.width - u), shift, pixel.at(v, u), sigma.at(v, u),
                                    out.points_sensor.at(v, u), out.sigma_mm.at(v, u), out.miss_px.at(v, u));
            }
        }
    });
}

}  // namespace planish
