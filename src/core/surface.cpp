#include "core/surface.hpp"

#include <Eigen/Cholesky>
#include <Eigen/Geometry>
#include <cmath>
#include <limits>
#include <vector>

#include "core/parallel.hpp"

namespace planish {
namespace {

struct Fit {
    double w, w_u, w_v;
    bool ok;
};

/// Sums over the 2r + 1 pixels of one image row around each pixel, relative to a row's own reference value.
struct RowSums {
    std::vector<float> sum, moment, least, greatest;

    void fill(const float* line, int width, int r) {
        constexpr float nan = std::numeric_limits<float>::quiet_NaN();
        for (auto* v : {&sum, &moment, &least, &greatest}) v->assign(width, nan);
        for (int u = r; u < width - r; ++u) {
            float s = 0, m = 0, low = line[u], high = line[u];
            for (int k = -r; k <= r; ++k) {
                const float w = line[u + k];
                s += w;
                m += static_cast<float>(k) * w;
                low = std::min(low, w);
                high = std::max(high, w);
            }
            sum[u] = s;  // NaN as soon as one pixel of the window is
            moment[u] = m;
            least[u] = low;
            greatest[u] = high;
        }
    }
};

/// The fit over a whole window that lies on one surface: the normal equations are diagonal.
Fit fit_full_window(const std::vector<RowSums>& rows, int first, int u, int r, float centre, float limit) {
    float sum = 0, moment_u = 0, moment_v = 0, low = centre, high = centre;
    const int size = 2 * r + 1;
    for (int k = 0; k < size; ++k) {
        const RowSums& row = rows[(first + k) % size];
        sum += row.sum[u];
        moment_u += row.moment[u];
        moment_v += static_cast<float>(k - r) * row.sum[u];
        low = std::min(low, row.least[u]);
        high = std::max(high, row.greatest[u]);
    }
    if (!(high - centre <= limit && centre - low <= limit) || std::isnan(sum)) return {0, 0, 0, false};
    const auto n = static_cast<float>(size * size);
    const float spread = n * static_cast<float>(r * (r + 1)) / 3.0F;  // sum of k^2 over the window
    return {sum / n, moment_u / spread, moment_v / spread, true};
}

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

}  // namespace

void fit_surface(const Image<const float>& points, const Camera& camera, const SurfaceOptions& options, int threads,
                 const Image<float>& smoothed, const Image<float>& normals, const Image<float>& tangents) {
    const int width = points.width, height = points.height;
    const Eigen::Vector3d centre = camera.center_sensor();
    const Eigen::Vector3d axis = camera.R_camera_sensor.row(2);
    constexpr float nan = std::numeric_limits<float>::quiet_NaN();
    std::vector<float> inverse(points.pixels());
    parallel_for(static_cast<std::size_t>(height), threads, [&](std::size_t first, std::size_t last) {
        for (auto v = static_cast<int>(first); v < static_cast<int>(last); ++v)
            for (int u = 0; u < width; ++u) {
                const float* p = points.at(v, u);
                const double z = axis.dot(Eigen::Vector3d(p[0], p[1], p[2]) - centre);
                inverse[static_cast<std::size_t>(v) * width + u] = z > 0 ? static_cast<float>(1.0 / z) : nan;
            }
    });
    // Ray directions with camera z = 1 come from the points themselves: exact, whatever the lens distortion.
    const auto ray = [&](int v, int u) -> Eigen::Vector3d {
        const float* p = points.at(v, u);
        const Eigen::Vector3d x = Eigen::Vector3d(p[0], p[1], p[2]) - centre;
        return x / axis.dot(x);
    };
    const auto known = [&](int v, int u) {
        return u >= 0 && v >= 0 && u < width && v < height &&
               !std::isnan(inverse[static_cast<std::size_t>(v) * width + u]);
    };
    const double focal = std::min(camera.fx, camera.fy);
    const int r = options.radius, size = 2 * r + 1;
    parallel_for(static_cast<std::size_t>(height), threads, [&](std::size_t first, std::size_t last) {
        std::vector<RowSums> rows(size);
        const auto fill = [&](int v) {
            if (v >= 0 && v < height)
                rows[v % size].fill(inverse.data() + static_cast<std::size_t>(v) * width, width, r);
        };
        for (int v = static_cast<int>(first) - r; v < static_cast<int>(first) + r; ++v) fill(v);
        for (auto v = static_cast<int>(first); v < static_cast<int>(last); ++v) {
            fill(v + r);
            const bool full_rows = v >= r && v + r < height;
            for (int u = 0; u < width; ++u) {
                float* s = smoothed.at(v, u);
                float* n = normals.at(v, u);
                float* t = tangents.at(v, u);
                std::fill_n(s, 3, nan);
                std::fill_n(n, 3, nan);
                std::fill_n(t, 6, nan);
                if (!known(v, u)) continue;
                const float w0 = inverse[static_cast<std::size_t>(v) * width + u];
                // |dz| <= slope * lateral distance, lateral = r z / f, dw = dz / z^2.
                const auto limit = static_cast<float>(options.max_slope * (r + 1) * w0 / focal);
                Fit fit{0, 0, 0, false};
                if (full_rows && u >= r && u + r < width) fit = fit_full_window(rows, v - r, u, r, w0, limit);
                if (!fit.ok) fit = fit_inverse_depth(inverse, width, height, u, v, r, limit);
                const int ul = known(v, u - 1) ? u - 1 : u, ur = known(v, u + 1) ? u + 1 : u;
                const int vl = known(v - 1, u) ? v - 1 : v, vr = known(v + 1, u) ? v + 1 : v;
                if (!fit.ok || !(fit.w > 0) || ul == ur || vl == vr) continue;
                const Eigen::Vector3d d = ray(v, u);
                const Eigen::Vector3d d_u = (ray(v, ur) - ray(v, ul)) / (ur - ul);
                const Eigen::Vector3d d_v = (ray(vr, u) - ray(vl, u)) / (vr - vl);
                // X = C + d / w, differentiated along u and v.
                const Eigen::Vector3d x = centre + d / fit.w;
                const Eigen::Vector3d x_u = d_u / fit.w - d * (fit.w_u / (fit.w * fit.w));
                const Eigen::Vector3d x_v = d_v / fit.w - d * (fit.w_v / (fit.w * fit.w));
                Eigen::Vector3d normal = x_u.cross(x_v).normalized();
                if (normal.dot(d) > 0) normal = -normal;
                for (int i = 0; i < 3; ++i) {
                    s[i] = static_cast<float>(x[i]);
                    n[i] = static_cast<float>(normal[i]);
                    t[i] = static_cast<float>(x_u[i]);
                    t[i + 3] = static_cast<float>(x_v[i]);
                }
            }
        }
    });
}

}  // namespace planish
