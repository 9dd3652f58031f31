#pragma once

#include <Eigen/Core>
#include <Eigen/LU>
#include <utility>

#include "core/common/camera.hpp"

namespace planish {

/// The distortion of a camera as a shift in pixels, in single precision and free of branches, for loops over pixels.
///
/// Rounding: the shift is added to the ideal pixel, so that the result is good to about one unit in the last place of
/// the pixel, 1e-4 px at 1000 px.
struct Lens {
    /// pixel = A n + (cu, cv), n the normalised coordinates.
    float a00, a01, a10, a11, i00, i01, i10, i11, cu, cv;
    /// Radial factor less one: r2 (n0 + r2 (n1 + r2 n2)) / (1 + r2 (d0 + r2 (d1 + r2 d2))).
    float n0, n1, n2, d0, d1, d2;
    /// Tangential terms, and thin prism terms of x and of y.
    float p1, p2, s1, s2, s3, s4;

    /// `transposed`: of the camera's image with rows and columns exchanged.
    Lens(const Camera& c, bool transposed) {
        Eigen::Matrix2d A;
        A << c.fx, c.skew, 0, c.fy;
        auto k = c.k;
        double u = c.cx, v = c.cy;
        if (transposed) {
            A << c.fy, 0, c.skew, c.fx;
            std::swap(u, v);
            std::swap(k[2], k[3]);
            std::swap(k[8], k[10]);
            std::swap(k[9], k[11]);
        }
        const Eigen::Matrix2f a = A.cast<float>(), i = A.inverse().cast<float>();
        const auto f = [](double x) { return static_cast<float>(x); };
        a00 = a(0, 0), a01 = a(0, 1), a10 = a(1, 0), a11 = a(1, 1);
        i00 = i(0, 0), i01 = i(0, 1), i10 = i(1, 0), i11 = i(1, 1);
        cu = f(u), cv = f(v);
        n0 = f(k[0] - k[5]), n1 = f(k[1] - k[6]), n2 = f(k[4] - k[7]);
        d0 = f(k[5]), d1 = f(k[6]), d2 = f(k[7]);
        p1 = f(k[2]), p2 = f(k[3]), s1 = f(k[8]), s2 = f(k[9]), s3 = f(k[10]), s4 = f(k[11]);
    }

    /// A distorted pixel, relative to (cu, cv), and its derivative along a direction.
    struct Place {
        float u, v, du, dv;
    };

    /// Image of the ideal pixel (x, y), relative to (cu, cv), and its derivative as the ideal pixel moves by (dx, dy).
    [[nodiscard]] Place along(float x, float y, float dx, float dy) const {
        const float nx = i00 * x + i01 * y, ny = i10 * x + i11 * y;
        const float tx = i00 * dx + i01 * dy, ty = i10 * dx + i11 * dy;
        const float r2 = nx * nx + ny * ny, dr2 = 2 * (nx * tx + ny * ty), xy = nx * ny, dxy = tx * ny + nx * ty;
        const float below = 1 / (1 + r2 * (d0 + r2 * (d1 + r2 * d2)));
        const float radial = r2 * (n0 + r2 * (n1 + r2 * n2)) * below;
        const float turn =
            (n0 + r2 * (2 * n1 + 3 * r2 * n2) - radial * (d0 + r2 * (2 * d1 + 3 * r2 * d2))) * below * dr2;
        const float sx = nx * radial + 2 * p1 * xy + p2 * (r2 + 2 * nx * nx) + r2 * (s1 + r2 * s2);
        const float sy = ny * radial + 2 * p2 * xy + p1 * (r2 + 2 * ny * ny) + r2 * (s3 + r2 * s4);
        const float gx = tx * radial + nx * turn + 2 * p1 * dxy + p2 * (dr2 + 4 * nx * tx) + dr2 * (s1 + 2 * r2 * s2);
        const float gy = ty * radial + ny * turn + 2 * p2 * dxy + p1 * (dr2 + 4 * ny * ty) + dr2 * (s3 + 2 * r2 * s4);
        return {x + a00 * sx + a01 * sy, y + a10 * sx + a11 * sy, dx + a00 * gx + a01 * gy, dy + a10 * gx + a11 * gy};
    }
};

}  // namespace planish
