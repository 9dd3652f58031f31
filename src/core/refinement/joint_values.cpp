#include "core/refinement/joint_values.hpp"

#include <algorithm>
#include <cstddef>
#include <limits>
#include <vector>

#include "core/common/parallel.hpp"
#include "core/refinement/joint.hpp"

namespace planish {
namespace {

constexpr float NOT_A_NUMBER = std::numeric_limits<float>::quiet_NaN();

/// Derivative by pixels along a row or down a column, of the sixth order where seven pixels in a row are known: the
/// gradient of fine texture is that of its interpolation. `at` is the texture at the first of `count` pixels.
void slopes(const float* __restrict at, std::ptrdiff_t step, int count, bool wide, float* __restrict out) {
    for (int i = 0; i < count; ++i) out[i] = 0.5F * (at[i + step] - at[i - step]);
    if (!wide) return;
    for (int i = 0; i < count; ++i) {
        const float found = 1.5F * out[i] - 0.15F * (at[i + 2 * step] - at[i - 2 * step]) +
                            (at[i + 3 * step] - at[i - 3 * step]) / 60.0F;
        out[i] = found == found ? found : out[i];
    }
}

/// Slopes of one row of the texture along u and along v; NaN at the border.
void row_slopes(const Image<const float>& texture, int v, float* along_u, float* along_v) {
    const int width = texture.width, before = v, after = texture.height - 1 - v;
    std::fill_n(along_u, width, NOT_A_NUMBER);
    std::fill_n(along_v, width, NOT_A_NUMBER);
    if (before == 0 || after == 0 || width < 3) return;
    const float* line = texture.row(v);
    slopes(line + 1, 1, width - 2, false, along_u + 1);
    if (width > 6) slopes(line + 3, 1, width - 6, true, along_u + 3);
    slopes(line + 1, width, width - 2, before >= 3 && after >= 3, along_v + 1);
}

/// Gradient of the texture along the surface from its slopes [1/mm].
void write_gradient(const float* tangents, float f_u, float f_v, float* out) {
    const float *x_u = tangents, *x_v = tangents + 3;
    const float e = x_u[0] * x_u[0] + x_u[1] * x_u[1] + x_u[2] * x_u[2];
    const float f = x_u[0] * x_v[0] + x_u[1] * x_v[1] + x_u[2] * x_v[2];
    const float g = x_v[0] * x_v[0] + x_v[1] * x_v[1] + x_v[2] * x_v[2];
    const float determinant = e * g - f * f, per = (determinant > 0 ? 1.0F : NOT_A_NUMBER) / determinant;
    const float alpha = (g * f_u - f * f_v) * per, beta = (e * f_v - f * f_u) * per;
    for (int i = 0; i < 3; ++i) out[i] = alpha * x_u[i] + beta * x_v[i];
}

/// Everything about a pixel but the texture: `v` and `u` are those of the whole resolution.
void write_point(const JointSources& in, const JointValueOptions& o, int v, int u, float* out) {
    const Eigen::Vector3f n = Eigen::Vector3f::Map(in.normals.at(v, u)),
                          point = Eigen::Vector3f::Map(in.points.at(v, u)) - *in.by_spline.at(v, u) * n;
    const Eigen::Vector3f ray = point - o.centre;
    const float by_blur = *in.by_blur.at(v, u), uncertain = o.blur_sigma * by_blur;
    const float sigma = *in.sigma.at(v, u), along = ray.dot(n);
    Eigen::Vector3f::Map(out + joint::point) = point - o.blur * by_blur * n;
    out[joint::variance_distance] = sigma * sigma * along * along / ray.squaredNorm() + uncertain * uncertain;
    Eigen::Vector3f::Map(out + joint::normal) = n;
    out[joint::blur] = uncertain;
}

}  // namespace

void joint_values(const JointSources& in, const JointValueOptions& options, int threads, const Image<float>& values) {
    const int n = options.spacing, width = values.width;
    const auto number = static_cast<float>(n * n);
    parallel_for(values.height, threads, [&](std::size_t first, std::size_t last) {
        std::vector<float> along_u(width), along_v(width);
        for (auto y = static_cast<int>(first); y < static_cast<int>(last); ++y) {
            if (in.slopes.empty()) row_slopes(in.texture, y, along_u.data(), along_v.data());
            for (int x = 0; x < width; ++x) {
                float* out = values.at(y, x);
                const int v = y * n, u = x * n;
                write_point(in, options, v, u, out);
                const float texture = *in.texture.at(y, x), sigma = *in.texture_sigma.at(v, u);
                out[joint::variance_texture] = texture == texture ? sigma * sigma / number : NOT_A_NUMBER;
                const float* slope = in.slopes.empty() ? nullptr : in.slopes.at(y, x);
                write_gradient(in.tangents.at(v, u), slope ? slope[0] : along_u[x], slope ? slope[1] : along_v[x],
                               out + joint::gradient);
            }
        }
    });
}

}  // namespace planish
