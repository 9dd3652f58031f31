#include "core/registration/surface.hpp"

#include <Eigen/Cholesky>
#include <Eigen/Geometry>
#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <vector>

#include "core/common/parallel.hpp"

namespace planish {
namespace {

constexpr float kNaN = std::numeric_limits<float>::quiet_NaN();
constexpr double kMost = std::numeric_limits<double>::max();
/// Pixels that are computed together.
constexpr int kAhead = 16;

/// Value and slopes of the inverse depth; not `ok` where too little is known.
struct Fit {
    double w, w_u, w_v;
    bool ok;
};

/// Sums over the 2r + 1 pixels of one image row around each pixel, for the pixels that have as many on both sides.
struct RowSums {
    std::vector<float> sum, moment, least, greatest;

    void fill(const float* line, int width, int r) {
        for (auto* v : {&sum, &moment, &least, &greatest}) v->assign(width, kNaN);
        const int count = width - 2 * r;
        float* __restrict s = sum.data() + r;
        float* __restrict m = moment.data() + r;
        float* __restrict low = least.data() + r;
        float* __restrict high = greatest.data() + r;
        for (int u = 0; u < count; ++u) s[u] = m[u] = 0, low[u] = high[u] = line[u + r];
        for (int k = 0; k < 2 * r + 1; ++k) {
            const float* __restrict from = line + k;
            const auto at = static_cast<float>(k - r);
            for (int u = 0; u < count; ++u) {
                const float w = from[u];
                s[u] += w;  // NaN as soon as one pixel of the window is
                m[u] += at * w;
                low[u] = w < low[u] ? w : low[u];
                high[u] = w > high[u] ? w : high[u];
            }
        }
    }
};

/// Fits of one row of pixels; w is NaN where there is none. Behind the row there is room to compute more.
struct RowFits {
    std::vector<double> w, w_u, w_v;

    explicit RowFits(int width) {
        for (auto* v : {&w, &w_u, &w_v}) v->assign(width + kAhead, kNaN);
        for (auto* v : {&sum_, &moment_u_, &moment_v_, &low_, &high_}) v->resize(width);
    }

    /// Fits over whole windows that lie on one surface: the normal equations are diagonal. `line` is the row itself,
    /// `slope` the change of inverse depth over half the window, relative to it, that still is one surface.
    void fit(const std::vector<RowSums>& rows, int first, int r, const float* __restrict line, float slope) {
        const int size = 2 * r + 1, width = static_cast<int>(rows[0].sum.size());
        float* __restrict s = sum_.data();
        float* __restrict mu = moment_u_.data();
        float* __restrict mv = moment_v_.data();
        float* __restrict l = low_.data();
        float* __restrict h = high_.data();
        for (int u = 0; u < width; ++u) s[u] = mu[u] = mv[u] = 0, l[u] = h[u] = line[u];
        for (int k = 0; k < size; ++k) {
            const RowSums& row = rows[(first + k) % size];
            const float* __restrict sum = row.sum.data();
            const float* __restrict moment = row.moment.data();
            const float* __restrict least = row.least.data();
            const float* __restrict greatest = row.greatest.data();
            const auto at = static_cast<float>(k - r);
            for (int u = 0; u < width; ++u) {
                s[u] += sum[u];
                mu[u] += moment[u];
                mv[u] += at * sum[u];
            }
            for (int u = 0; u < width; ++u) l[u] = least[u] < l[u] ? least[u] : l[u];
            for (int u = 0; u < width; ++u) h[u] = greatest[u] > h[u] ? greatest[u] : h[u];
        }
        const auto n = static_cast<float>(size * size);
        const float spread = n * static_cast<float>(r * (r + 1)) / 3.0F;  // sum of k^2 over the window
        double* __restrict to_w = w.data();
        double* __restrict to_u = w_u.data();
        double* __restrict to_v = w_v.data();
        for (int u = 0; u < width; ++u) {
            const float limit = slope * line[u];
            const float one = (h[u] - line[u] <= limit ? 1.0F : 0.0F) * (line[u] - l[u] <= limit ? 1.0F : 0.0F);
            to_w[u] = one > 0 ? s[u] / n : kNaN;
            to_u[u] = mu[u] / spread;
            to_v[u] = mv[u] / spread;
        }
    }

  private:
    std::vector<float> sum_, moment_u_, moment_v_, low_, high_;
};

/// Affine fit of the inverse depth in the window around (u0, v0), over pixels within `limit` of the centre's.
Fit fit_inverse_depth(const std::vector<float>& inverse, int width, int height, int u0, int v0, int r, float limit) {
    const float centre = inverse[static_cast<std::size_t>(v0) * width + u0];
    float n = 0, su = 0, sv = 0, suu = 0, suv = 0, svv = 0, sw = 0, suw = 0, svw = 0;
    for (int v = std::max(0, v0 - r); v <= std::min(height - 1, v0 + r); ++v) {
        const float* line = inverse.data() + static_cast<std::size_t>(v) * width;
        const float dv = static_cast<float>(v - v0);
        for (int u = std::max(0, u0 - r); u <= std::min(width - 1, u0 + r); ++u) {
            const float dw = line[u] - centre;
            // False for NaN too: invalid neighbours drop out without a branch.
            const float m = std::fabs(dw) <= limit ? 1.0F : 0.0F;
            const float value = m > 0 ? dw : 0.0F;
            const float du = static_cast<float>(u - u0);
            n += m;
            su += m * du;
            sv += m * dv;
            suu += m * du * du;
            suv += m * du * dv;
            svv += m * dv * dv;
            sw += value;
            suw += du * value;
            svw += dv * value;
        }
    }
    if (n < 6) return {0, 0, 0, false};
    Eigen::Matrix3d N;
    N << n, su, sv, su, suu, suv, sv, suv, svv;
    const double determinant = N.determinant();
    if (!(determinant > 1e-3 * n)) return {0, 0, 0, false};
    const Eigen::Vector3d x = N.ldlt().solve(Eigen::Vector3d(sw, suw, svw));
    return {centre + x[0], x[1], x[2], true};
}

/// Directions, of depth 1, of the rays of one row of pixels, a NaN before and behind it, where a pixel is unknown too.
/// They come from the points themselves: exact, whatever the lens distortion.
struct Rays {
    std::vector<double> x, y, z;

    explicit Rays(int width) {
        for (auto* v : {&x, &y, &z}) v->assign(width + 2 + kAhead, kNaN);
    }

    void clear() {
        for (auto* v : {&x, &y, &z}) std::fill(v->begin(), v->end(), kNaN);
    }

    void read(const float* __restrict points, int width, const Eigen::Vector3d& centre, const Eigen::Vector3d& axis) {
        const double cx = centre[0], cy = centre[1], cz = centre[2], ax = axis[0], ay = axis[1], az = axis[2];
        double* __restrict to_x = x.data() + 1;
        double* __restrict to_y = y.data() + 1;
        double* __restrict to_z = z.data() + 1;
        for (int u = 0; u < width; ++u) {
            const double dx = points[3 * u] - cx, dy = points[3 * u + 1] - cy, dz = points[3 * u + 2] - cz;
            const double depth = ax * dx + ay * dy + az * dz, per = (depth > 0 ? 1.0 : kNaN) / depth;
            to_x[u] = dx * per;
            to_y[u] = dy * per;
            to_z[u] = dz * per;
        }
    }
};

/// The rays of three rows, one coordinate.
struct Around {
    const double *above, *here, *below;

    Around(const std::array<const Rays*, 3>& rows, std::vector<double> Rays::* axis, int u)
        : above((rows[0]->*axis).data() + u + 1),
          here((rows[1]->*axis).data() + u + 1),
          below((rows[2]->*axis).data() + u + 1) {}
};

/// Point, normal, change along u and along v of `kAhead` pixels, one coordinate after the other.
using Results = std::array<std::array<float, kAhead>, 12>;

/// The surface X = C + d / w at the pixels from u on, differentiated along u and v; NaN where it is unknown. The ray d
/// changes by the mean of the steps to the known neighbours.
void place(const std::array<const Rays*, 3>& rows, const RowFits& fits, int u, const Eigen::Vector3d& centre,
           Results& out) {
    const Around x(rows, &Rays::x, u), y(rows, &Rays::y, u), z(rows, &Rays::z, u);
    const double *w = fits.w.data() + u, *w_u = fits.w_u.data() + u, *w_v = fits.w_v.data() + u;
    const double cx = centre[0], cy = centre[1], cz = centre[2];
    for (int i = 0; i < kAhead; ++i) {
        const double left = x.here[i - 1] == x.here[i - 1] ? 1.0 : 0.0,
                     right = x.here[i + 1] == x.here[i + 1] ? 1.0 : 0.0;
        const double up = x.above[i] == x.above[i] ? 1.0 : 0.0, down = x.below[i] == x.below[i] ? 1.0 : 0.0;
        const double over_u = 1 / (left + right), over_v = 1 / (up + down);
        const double per = 1.0 / w[i], turn_u = w_u[i] * per * per, turn_v = w_v[i] * per * per;
        const auto along_u = [&](const Around& d) {
            const double to = right > 0 ? d.here[i + 1] : d.here[i], from = left > 0 ? d.here[i - 1] : d.here[i];
            return (to - from) * over_u * per - d.here[i] * turn_u;
        };
        const auto along_v = [&](const Around& d) {
            const double to = down > 0 ? d.below[i] : d.here[i], from = up > 0 ? d.above[i] : d.here[i];
            return (to - from) * over_v * per - d.here[i] * turn_v;
        };
        const double ux = along_u(x), uy = along_u(y), uz = along_u(z);
        const double vx = along_v(x), vy = along_v(y), vz = along_v(z);
        const double nx = uy * vz - uz * vy, ny = uz * vx - ux * vz, nz = ux * vy - uy * vx;
        const double towards = nx * x.here[i] + ny * y.here[i] + nz * z.here[i];
        const double unit = (towards > 0 ? -1.0 : 1.0) / std::sqrt(nx * nx + ny * ny + nz * nz);
        // 0 / 0 has made NaN of what has no neighbours; NaN in one is NaN in all.
        const double known = (w[i] > 0 ? 1.0 : kNaN) * (over_u * over_v * unit < kMost ? 1.0 : kNaN);
        out[0][i] = static_cast<float>((cx + x.here[i] * per) * known);
        out[1][i] = static_cast<float>((cy + y.here[i] * per) * known);
        out[2][i] = static_cast<float>((cz + z.here[i] * per) * known);
        out[3][i] = static_cast<float>(nx * unit * known);
        out[4][i] = static_cast<float>(ny * unit * known);
        out[5][i] = static_cast<float>(nz * unit * known);
        out[6][i] = static_cast<float>(ux * known);
        out[7][i] = static_cast<float>(uy * known);
        out[8][i] = static_cast<float>(uz * known);
        out[9][i] = static_cast<float>(vx * known);
        out[10][i] = static_cast<float>(vy * known);
        out[11][i] = static_cast<float>(vz * known);
    }
}

/// Everything about one row of pixels.
class Rows {
  public:
    Rows(const Image<const float>& points, const std::vector<float>& inverse, const Camera& camera,
         const SurfaceOptions& options)
        : points_(points),
          inverse_(inverse),
          centre_(camera.center_sensor()),
          axis_(camera.R_camera_sensor.row(2)),
          r_(options.radius),
          // |dz| <= slope * lateral distance, lateral = r z / f, dw = dz / z^2.
          slope_(static_cast<float>(options.max_slope * (r_ + 1) / std::min(camera.fx, camera.fy))),
          sums_(2 * r_ + 1),
          fits_(points.width),
          rays_{Rays(points.width), Rays(points.width), Rays(points.width)} {}

    /// To be called before the first row.
    void start(int v) {
        for (int k = v - r_; k < v + r_; ++k) sum(k);
        read(v - 1);
        read(v);
    }

    /// Rows in their order.
    void fit(int v, float* points, float* normals, float* tangents) {
        const int width = points_.width, height = points_.height;
        sum(v + r_);
        read(v + 1);
        const float* line = inverse_.data() + static_cast<std::size_t>(v) * width;
        if (v >= r_ && v + r_ < height)
            fits_.fit(sums_, v - r_, r_, line, slope_);
        else
            std::fill(fits_.w.begin(), fits_.w.end(), kNaN);
        for (int u = 0; u < width; ++u) {
            if (!std::isnan(fits_.w[u]) || std::isnan(line[u])) continue;
            const Fit fit = fit_inverse_depth(inverse_, width, height, u, v, r_, slope_ * line[u]);
            fits_.w[u] = fit.ok ? fit.w : kNaN;
            fits_.w_u[u] = fit.w_u;
            fits_.w_v[u] = fit.w_v;
        }
        const std::array<const Rays*, 3> rows{&rays_[(v + 2) % 3], &rays_[v % 3], &rays_[(v + 1) % 3]};
        Results found;
        for (int u = 0; u < width; u += kAhead) {
            place(rows, fits_, u, centre_, found);
            for (int i = 0; i < std::min(kAhead, width - u); ++i) {
                const int at = u + i;
                for (int k = 0; k < 3; ++k) points[3 * at + k] = found[k][i];
                for (int k = 0; k < 3; ++k) normals[3 * at + k] = found[3 + k][i];
                for (int k = 0; k < 6; ++k) tangents[6 * at + k] = found[6 + k][i];
            }
        }
    }

  private:
    void sum(int v) {
        if (v >= 0 && v < points_.height)
            sums_[v % sums_.size()].fill(inverse_.data() + static_cast<std::size_t>(v) * points_.width, points_.width,
                                         r_);
    }
    void read(int v) {
        Rays& rays = rays_[(v + 3) % 3];
        if (v >= 0 && v < points_.height)
            rays.read(points_.row(v), points_.width, centre_, axis_);
        else
            rays.clear();
    }

    Image<const float> points_;
    const std::vector<float>& inverse_;
    Eigen::Vector3d centre_, axis_;
    int r_;
    float slope_;
    std::vector<RowSums> sums_;
    RowFits fits_;
    std::array<Rays, 3> rays_;
};

/// 1 / depth of each pixel, NaN where there is none before the camera.
void invert_depths(const float* __restrict points, int count, const Eigen::Vector3d& centre,
                   const Eigen::Vector3d& axis, float* __restrict out) {
    const double cx = centre[0], cy = centre[1], cz = centre[2], ax = axis[0], ay = axis[1], az = axis[2];
    for (int u = 0; u < count; ++u) {
        const double depth = ax * (points[3 * u] - cx) + ay * (points[3 * u + 1] - cy) + az * (points[3 * u + 2] - cz);
        out[u] = static_cast<float>((depth > 0 ? 1.0 : kNaN) / depth);
    }
}

}  // namespace

void fit_surface(const Image<const float>& points, const Camera& camera, const SurfaceOptions& options, int threads,
                 const Image<float>& smoothed, const Image<float>& normals, const Image<float>& tangents) {
    const int width = points.width;
    const Eigen::Vector3d centre = camera.center_sensor(), axis = camera.R_camera_sensor.row(2);
    std::vector<float> inverse(points.pixels());
    parallel_for(points.height, threads, [&](std::size_t first, std::size_t last) {
        for (auto v = static_cast<int>(first); v < static_cast<int>(last); ++v)
            invert_depths(points.row(v), width, centre, axis, inverse.data() + static_cast<std::size_t>(v) * width);
    });
    parallel_for(points.height, threads, [&](std::size_t first, std::size_t last) {
        Rows rows(points, inverse, camera, options);
        rows.start(static_cast<int>(first));
        for (auto v = static_cast<int>(first); v < static_cast<int>(last); ++v)
            rows.fit(v, smoothed.row(v), normals.row(v), tangents.row(v));
    });
}

}  // namespace planish
