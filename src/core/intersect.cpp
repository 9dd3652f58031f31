#include "core/intersect.hpp"

#include <Eigen/Geometry>
#include <array>
#include <cmath>
#include <cstddef>
#include <limits>
#include <vector>

#include "core/parallel.hpp"

namespace planish {
namespace {

constexpr float kNaN = std::numeric_limits<float>::quiet_NaN();
/// Real lenses change the scale along the line by less than a tenth: the error is squared from step to step.
constexpr int kSteps = 4;
/// Largest last step [focal lengths] of a place that has been found (0.00002 px).
constexpr double kConverged = 1e-8;
/// Smallest share of an axis in the direction in which the ray's image runs; below it the axis says nothing.
constexpr double kMinShare = 1e-3;
/// Light may come from so far outside the projector's picture [px]: its lens blurs, its calibration errs.
constexpr double kMargin = 4.0;

/// Place of an undistorted point in the projector [px], and how it moves along a direction.
struct Moving {
    double u, v, du, dv;
};

/// Camera::distort and its derivative along (ex, ey), in plain numbers: loops over it vectorise.
inline Moving image_of(const Camera& c, double x, double y, double ex, double ey) {
    const auto& k = c.k;
    const double r2 = x * x + y * y, along = x * ex + y * ey;
    const double below = 1 / (1 + r2 * (k[5] + r2 * (k[6] + r2 * k[7])));
    const double radial = (1 + r2 * (k[0] + r2 * (k[1] + r2 * k[4]))) * below;
    const double slope = 2 * along * below *
                         (k[0] + r2 * (2 * k[1] + 3 * r2 * k[4]) - radial * (k[5] + r2 * (2 * k[6] + 3 * r2 * k[7])));
    const double cross = x * ey + y * ex;
    const double dx = x * radial + 2 * k[2] * x * y + k[3] * (r2 + 2 * x * x) + r2 * (k[8] + k[9] * r2);
    const double dy = y * radial + k[2] * (r2 + 2 * y * y) + 2 * k[3] * x * y + r2 * (k[10] + k[11] * r2);
    const double mx = ex * radial + x * slope + 2 * k[2] * cross + 2 * k[3] * (along + 2 * x * ex) +
                      2 * along * (k[8] + 2 * k[9] * r2);
    const double my = ey * radial + y * slope + 2 * k[2] * (along + 2 * y * ey) + 2 * k[3] * cross +
                      2 * along * (k[10] + 2 * k[11] * r2);
    return {c.fx * dx + c.skew * dy + c.cx, c.fy * dy + c.cy, c.fx * mx + c.skew * my, c.fy * my};
}

/// One row: decoded positions with their weights (1 / variance, 0 where there is none), and the own rays.
struct Row {
    std::vector<double> x, y;                   ///< undistorted own pixel [focal lengths]
    std::array<std::vector<double>, 2> p, w;    ///< position and weight per axis
    std::vector<double> depth, sigma, miss, miss_sigma;

    explicit Row(std::size_t width) : x(width), y(width), depth(width), sigma(width), miss(width), miss_sigma(width) {
        for (int i = 0; i < 2; ++i) {
            p[i].resize(width);
            w[i].resize(width);
        }
    }
};

/// From the own camera to the projector: x_projector = R x_own + t.
struct Transfer {
    Eigen::Matrix3d R;
    Eigen::Vector3d t;
    double width, height;
};

void fill(const ViewGeometry& own, const DecodedAxis axes[2], int v, std::size_t width, Row& row) {
    const bool distorted = !own.shift_px.empty();
    const Camera& c = own.camera;
    for (std::size_t u = 0; u < width; ++u) {
        const float* shift = distorted ? own.shift_px.at(v, static_cast<int>(u)) : nullptr;
        const double py = v + (distorted ? shift[1] : 0.0), px = static_cast<double>(u) + (distorted ? shift[0] : 0.0);
        row.y[u] = (py - c.cy) / c.fy;
        row.x[u] = (px - c.cx - c.skew * row.y[u]) / c.fx;
    }
    for (int i = 0; i < 2; ++i)
        for (std::size_t u = 0; u < width; ++u) {
            const float p = axes[i].position_px.empty() ? kNaN : axes[i].position_px.row(v)[u];
            const double s = axes[i].position_px.empty() ? 1.0 : axes[i].sigma_px.row(v)[u];
            const bool known = p == p && s > 0;
            row.p[i][u] = known ? p : 0.0;
            row.w[i][u] = known ? 1 / (s * s) : 0.0;
        }
}

void solve(const Transfer& go, const Camera& c, std::size_t width, Row& row) {
    const double* __restrict own_x = row.x.data();
    const double* __restrict own_y = row.y.data();
    const double* __restrict pu = row.p[0].data();
    const double* __restrict pv = row.p[1].data();
    const double* __restrict wu = row.w[0].data();
    const double* __restrict wv = row.w[1].data();
    double* __restrict depth = row.depth.data();
    double* __restrict sigma = row.sigma.data();
    double* __restrict miss = row.miss.data();
    double* __restrict miss_sigma = row.miss_sigma.data();
    const Eigen::Matrix3d& R = go.R;
    const double tx = go.t.x(), ty = go.t.y(), tz = go.t.z(), nan = kNaN;
    for (std::size_t u = 0; u < width; ++u) {
        const double x = own_x[u], y = own_y[u];
        const double qx = R(0, 0) * x + R(0, 1) * y + R(0, 2), qy = R(1, 0) * x + R(1, 1) * y + R(1, 2),
                     qz = R(2, 0) * x + R(2, 1) * y + R(2, 2);
        // The ray's image a x + b y + c = 0 (t x q), as foot point + place * direction.
        const double a = ty * qz - tz * qy, b = tz * qx - tx * qz, d = tx * qy - ty * qx;
        const double norm2 = a * a + b * b, norm = 1 / std::sqrt(norm2);
        const double ex = -b * norm, ey = a * norm, fx = -d * a / norm2, fy = -d * b / norm2;
        // Start without distortion, then Gauss-Newton on both axes.
        const double gu0 = c.fx * ex, gv0 = c.fy * ey;
        const double su = pu[u] - c.cx - c.fx * fx, sv = pv[u] - c.cy - c.fy * fy;
        double place = (wu[u] * gu0 * su + wv[u] * gv0 * sv) / (wu[u] * gu0 * gu0 + wv[u] * gv0 * gv0);
        double step = 0, weight = 0, gu = 0, gv = 0, ru = 0, rv = 0, at_u = 0, at_v = 0;
        for (int i = 0; i < kSteps; ++i) {
            const Moving m = image_of(c, fx + place * ex, fy + place * ey, ex, ey);
            at_u = m.u;
            at_v = m.v;
            gu = m.du;
            gv = m.dv;
            ru = pu[u] - at_u;
            rv = pv[u] - at_v;
            weight = wu[u] * gu * gu + wv[u] * gv * gv;
            step = (wu[u] * gu * ru + wv[u] * gv * rv) / weight;
            place += step;
        }
        // The depth s of x(s) = t + s q whose image is the place found: (q x n) s = -(t x n), least squares.
        const double nx = fx + place * ex, ny = fy + place * ey;
        const double ax = qy - qz * ny, ay = qz * nx - qx, az = qx * ny - qy * nx;
        const double bx = ty - tz * ny, by = tz * nx - tx, bz = tx * ny - ty * nx;
        const double s = -(ax * bx + ay * by + az * bz) / (ax * ax + ay * ay + az * az), z = tz + s * qz;
        const double mx = (qx - nx * qz) / z, my = (qy - ny * qz) / z, motion = std::sqrt(mx * mx + my * my);
        const double steepness = gu * gu + gv * gv;
        const double used = (wu[u] > 0 ? gu * gu : 0.0) + (wv[u] > 0 ? gv * gv : 0.0);
        const bool inside = (at_u > -0.5 - kMargin) & (at_u < go.width - 0.5 + kMargin) & (at_v > -0.5 - kMargin) &
                            (at_v < go.height - 0.5 + kMargin);
        const bool good = (std::fabs(step) < kConverged) & (s > 0) & (z > 0) & inside &
                          (used > kMinShare * kMinShare * steepness);
        depth[u] = good ? s : nan;
        sigma[u] = std::sqrt((1 + x * x + y * y) / weight) / motion;
        const bool both = good & (wu[u] > 0) & (wv[u] > 0);
        const double length = std::sqrt(steepness);
        miss[u] = both ? (ru * gv - rv * gu) / length : nan;
        miss_sigma[u] = both ? std::sqrt(gv * gv / wu[u] + gu * gu / wv[u]) / length : nan;
    }
}

}  // namespace

void intersect(const ViewGeometry& own, const Camera& projector, int width, int height, const DecodedAxis axes[2],
               int primary, int threads, const IntersectResult& out) {
    const Eigen::Matrix3d R_sensor_own = own.camera.R_camera_sensor.transpose();
    const Eigen::Vector3d center = own.camera.center_sensor();
    const Transfer go{projector.R_camera_sensor * R_sensor_own, projector.to_camera(center), static_cast<double>(width),
                      static_cast<double>(height)};
    const auto columns = static_cast<std::size_t>(out.sigma_mm.width);
    parallel_for(static_cast<std::size_t>(out.sigma_mm.height), threads, [&](std::size_t begin, std::size_t end) {
        Row row(columns);
        for (std::size_t i = begin; i < end; ++i) {
            const int v = static_cast<int>(i);
            fill(own, axes, v, columns, row);
            solve(go, projector, columns, row);
            float* point = out.points_sensor.row(v);
            for (std::size_t u = 0; u < columns; ++u) {
                const double s = row.w[primary][u] > 0 ? row.depth[u] : kNaN;
                const bool found = s == s;
                for (int k = 0; k < 3; ++k)
                    point[3 * u + k] = static_cast<float>(
                        center[k] +
                        s * (R_sensor_own(k, 0) * row.x[u] + R_sensor_own(k, 1) * row.y[u] + R_sensor_own(k, 2)));
                out.sigma_mm.row(v)[u] = found ? static_cast<float>(row.sigma[u]) : kNaN;
                out.miss_px.row(v)[u] = found ? static_cast<float>(row.miss[u]) : kNaN;
                out.miss_sigma_px.row(v)[u] = found ? static_cast<float>(row.miss_sigma[u]) : kNaN;
            }
        }
    });
}

}  // namespace planish
