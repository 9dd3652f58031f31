#include "core/sensing/intersect.hpp"

#include <Eigen/Geometry>
#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <limits>
#include <vector>

#include "core/common/parallel.hpp"

namespace planish {
namespace {

constexpr float kNaN = std::numeric_limits<float>::quiet_NaN();
/// Real lenses change the scale along the line by less than a tenth: the error is squared from step to step.
constexpr int kSteps = 4;
/// Largest last step [focal lengths] of a place that has been found (0.00002 px).
constexpr double kConverged = 1e-8;
/// Smallest share of an axis in the direction in which the ray's image runs; below it the axis says nothing.
constexpr double kMinShare = 1e-3;
/// Pixels so near to the rim of the projector's picture [own px] also see what lies beyond it, unlit: the lens blurs.
constexpr double kRim = 1.5;

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

/// One row of the pixels that have a position along the primary axis, in plain arrays: each loop over them vectorises.
struct Row {
    std::vector<std::size_t> at;              ///< their columns
    std::vector<double> x, y;                 ///< undistorted own pixel [focal lengths]
    std::array<std::vector<double>, 2> p, w;  ///< position and weight (1 / variance, 0 where there is none) per axis
    std::vector<double> qx, qy, qz;           ///< the ray in the projector's frame
    std::vector<double> fx, fy, ex, ey;       ///< its image in the undistorted projector: foot point and direction
    std::vector<double> place, step;          ///< place along it, and the last change of that
    std::vector<double> gu, gv, ru, rv;       ///< motion of the decoded position per place; decoded less own position
    std::vector<double> depth, sigma, miss, miss_sigma;

    explicit Row(std::size_t width) {
        at.reserve(width);
        for (auto* v : {&x,  &y,     &p[0], &p[1], &w[0], &w[1], &qx, &qy,    &qz,    &fx,   &fy,        &ex,
                        &ey, &place, &step, &gu,   &gv,   &ru,   &rv, &depth, &sigma, &miss, &miss_sigma})
            v->resize(width);
    }
};

/// From the own camera to the projector: x_projector = R x_own + t.
struct Transfer {
    Eigen::Matrix3d R;
    Eigen::Vector3d t;
    double width, height, focal_ratio;  ///< of the projector; its focal length over that of the camera
};

void gather(const ViewGeometry& own, const DecodedAxis axes[2], int primary, int v, Row& row) {
    const bool distorted = !own.shift_px.empty();
    const Camera& c = own.camera;
    const auto width = static_cast<std::size_t>(axes[primary].position_px.width);
    const float* wanted = axes[primary].position_px.row(v);
    const float* wanted_sigma = axes[primary].sigma_px.row(v);
    row.at.clear();
    for (std::size_t u = 0; u < width; ++u)
        if (wanted[u] == wanted[u] && wanted_sigma[u] > 0) row.at.push_back(u);
    for (std::size_t k = 0; k < row.at.size(); ++k) {
        const float* shift = distorted ? own.shift_px.at(v, static_cast<int>(row.at[k])) : nullptr;
        const double px = static_cast<double>(row.at[k]) + (distorted ? shift[0] : 0.0);
        row.y[k] = (v + (distorted ? shift[1] : 0.0) - c.cy) / c.fy;
        row.x[k] = (px - c.cx - c.skew * row.y[k]) / c.fx;
    }
    for (int i = 0; i < 2; ++i)
        for (std::size_t k = 0; k < row.at.size(); ++k) {
            const float p = axes[i].position_px.empty() ? kNaN : axes[i].position_px.row(v)[row.at[k]];
            const double s = axes[i].position_px.empty() ? 1.0 : axes[i].sigma_px.row(v)[row.at[k]];
            const bool known = p == p && s > 0;
            row.p[i][k] = known ? p : 0.0;
            row.w[i][k] = known ? 1 / (s * s) : 0.0;
        }
}

/// The rays' images in the undistorted projector, and the places on them that ignore its distortion.
void start(const Transfer& go, const Camera& c, std::size_t n, const double* __restrict x, const double* __restrict y,
           Row& row) {
    const double r00 = go.R(0, 0), r01 = go.R(0, 1), r02 = go.R(0, 2), r10 = go.R(1, 0), r11 = go.R(1, 1),
                 r12 = go.R(1, 2), r20 = go.R(2, 0), r21 = go.R(2, 1), r22 = go.R(2, 2);
    const double tx = go.t.x(), ty = go.t.y(), tz = go.t.z();
    const double focal_u = c.fx, focal_v = c.fy, center_u = c.cx, center_v = c.cy;
    double* __restrict qx = row.qx.data(), * __restrict qy = row.qy.data(), * __restrict qz = row.qz.data();
    double *__restrict fx = row.fx.data(), *__restrict fy = row.fy.data(), *__restrict ex = row.ex.data(),
                       *__restrict ey = row.ey.data(), *__restrict place = row.place.data();
    const double *__restrict pu = row.p[0].data(), *__restrict pv = row.p[1].data(), *__restrict wu = row.w[0].data(),
                             *__restrict wv = row.w[1].data();
    for (std::size_t k = 0; k < n; ++k) {
        const double a = r00 * x[k] + r01 * y[k] + r02, b = r10 * x[k] + r11 * y[k] + r12,
                     d = r20 * x[k] + r21 * y[k] + r22;
        // (t x q) n = 0: foot point of the origin, and unit direction.
        const double lx = ty * d - tz * b, ly = tz * a - tx * d, lz = tx * b - ty * a;
        const double inverse = 1 / (lx * lx + ly * ly), norm = std::sqrt(inverse);
        const double dx = -ly * norm, dy = lx * norm, foot_x = -lz * lx * inverse, foot_y = -lz * ly * inverse;
        const double gu = focal_u * dx, gv = focal_v * dy;
        const double su = pu[k] - center_u - focal_u * foot_x, sv = pv[k] - center_v - focal_v * foot_y;
        place[k] = (wu[k] * gu * su + wv[k] * gv * sv) / (wu[k] * gu * gu + wv[k] * gv * gv);
        qx[k] = a;
        qy[k] = b;
        qz[k] = d;
        fx[k] = foot_x;
        fy[k] = foot_y;
        ex[k] = dx;
        ey[k] = dy;
    }
}

/// One Gauss-Newton step of all pixels on the weighted squares of both axes.
void improve(const Camera c, std::size_t n, Row& row) {
    const double *__restrict fx = row.fx.data(), *__restrict fy = row.fy.data(), *__restrict ex = row.ex.data(),
                             *__restrict ey = row.ey.data();
    const double *__restrict pu = row.p[0].data(), *__restrict pv = row.p[1].data(), *__restrict wu = row.w[0].data(),
                             *__restrict wv = row.w[1].data();
    double* __restrict place = row.place.data(), * __restrict step = row.step.data();
    double *__restrict out_gu = row.gu.data(), *__restrict out_gv = row.gv.data(), *__restrict out_ru = row.ru.data(),
                       *__restrict out_rv = row.rv.data();
    for (std::size_t k = 0; k < n; ++k) {
        const Moving m = image_of(c, fx[k] + place[k] * ex[k], fy[k] + place[k] * ey[k], ex[k], ey[k]);
        const double ru = pu[k] - m.u, rv = pv[k] - m.v;
        step[k] = (wu[k] * m.du * ru + wv[k] * m.dv * rv) / (wu[k] * m.du * m.du + wv[k] * m.dv * m.dv);
        place[k] += step[k];
        out_gu[k] = m.du;
        out_gv[k] = m.dv;
        out_ru[k] = ru;
        out_rv[k] = rv;
    }
}

/// Depth, its standard deviation and the miss of each pixel; NaN where there is no point.
void finish(const Transfer& go, std::size_t n, Row& row) {
    const double tx = go.t.x(), ty = go.t.y(), tz = go.t.z();
    for (std::size_t k = 0; k < n; ++k) {
        // The depth s of x(s) = t + s q whose image is the place found: (q x n) s = -(t x n), least squares.
        const double nx = row.fx[k] + row.place[k] * row.ex[k], ny = row.fy[k] + row.place[k] * row.ey[k];
        const double qx = row.qx[k], qy = row.qy[k], qz = row.qz[k];
        const double ax = qy - qz * ny, ay = qz * nx - qx, az = qx * ny - qy * nx;
        const double bx = ty - tz * ny, by = tz * nx - tx, bz = tx * ny - ty * nx;
        const double s = -(ax * bx + ay * by + az * bz) / (ax * ax + ay * ay + az * az), z = tz + s * qz;
        const double mx = (qx - nx * qz) / z, my = (qy - ny * qz) / z, motion = std::sqrt(mx * mx + my * my);
        const double gu = row.gu[k], gv = row.gv[k], wu = row.w[0][k], wv = row.w[1][k];
        const double steepness = gu * gu + gv * gv;
        const double used = (wu > 0 ? gu * gu : 0.0) + (wv > 0 ? gv * gv : 0.0);
        const double at_u = row.p[0][k] - row.ru[k], at_v = row.p[1][k] - row.rv[k];
        // An own pixel is as wide as its share of both focal lengths and of the distances from both devices.
        const double rim = kRim * go.focal_ratio * s / z - 0.5;
        const bool inside = at_u > rim && at_u < go.width - 1 - rim && at_v > rim && at_v < go.height - 1 - rim;
        const bool good =
            std::fabs(row.step[k]) < kConverged && s > 0 && z > 0 && inside && used > kMinShare * kMinShare * steepness;
        const bool both = good && wu > 0 && wv > 0;
        row.depth[k] = good ? s : kNaN;
        row.sigma[k] =
            std::sqrt((1 + row.x[k] * row.x[k] + row.y[k] * row.y[k]) / (wu * gu * gu + wv * gv * gv)) / motion;
        row.miss[k] = both ? (row.ru[k] * gv - row.rv[k] * gu) / std::sqrt(steepness) : kNaN;
        row.miss_sigma[k] = both ? std::sqrt((gv * gv / wu + gu * gu / wv) / steepness) : kNaN;
    }
}

void write(const IntersectResult& out, int v, const Eigen::Vector3d& center, const Eigen::Matrix3d& R_sensor_own,
           const Row& row) {
    float* point = out.points_sensor.row(v);
    std::fill_n(point, 3 * out.sigma_mm.width, kNaN);
    for (const auto* map : {&out.sigma_mm, &out.miss_px, &out.miss_sigma_px})
        std::fill_n(map->row(v), out.sigma_mm.width, kNaN);
    for (std::size_t k = 0; k < row.at.size(); ++k) {
        const double s = row.depth[k];
        if (!(s == s)) continue;
        const std::size_t u = row.at[k];
        const Eigen::Vector3d x = center + s * (R_sensor_own * Eigen::Vector3d(row.x[k], row.y[k], 1.0));
        for (int i = 0; i < 3; ++i) point[3 * u + i] = static_cast<float>(x[i]);
        out.sigma_mm.row(v)[u] = static_cast<float>(row.sigma[k]);
        out.miss_px.row(v)[u] = static_cast<float>(row.miss[k]);
        out.miss_sigma_px.row(v)[u] = static_cast<float>(row.miss_sigma[k]);
    }
}

}  // namespace

void intersect(const ViewGeometry& own, const Camera& projector, int width, int height, const DecodedAxis axes[2],
               int primary, int threads, const IntersectResult& out) {
    const Eigen::Matrix3d R_sensor_own = own.camera.R_camera_sensor.transpose();
    const Eigen::Vector3d center = own.camera.center_sensor();
    const Transfer go{projector.R_camera_sensor * R_sensor_own, projector.to_camera(center), static_cast<double>(width),
                      static_cast<double>(height), projector.fx / own.camera.fx};
    const auto columns = static_cast<std::size_t>(out.sigma_mm.width);
    parallel_for(static_cast<std::size_t>(out.sigma_mm.height), threads, [&](std::size_t begin, std::size_t end) {
        Row row(columns);
        for (std::size_t i = begin; i < end; ++i) {
            const int v = static_cast<int>(i);
            gather(own, axes, primary, v, row);
            const std::size_t n = row.at.size();
            start(go, projector, n, row.x.data(), row.y.data(), row);
            for (int step = 0; step < kSteps; ++step) improve(projector, n, row);
            finish(go, n, row);
            write(out, v, center, R_sensor_own, row);
        }
    });
}

}  // namespace planish
