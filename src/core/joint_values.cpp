#include "core/joint_values.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <limits>

#include "core/joint.hpp"
#include "core/parallel.hpp"

namespace planish {
namespace {

constexpr float NOT_A_NUMBER = std::numeric_limits<float>::quiet_NaN();

/// Derivative by pixels, of the sixth order where seven pixels in a row are known: the gradient of fine texture is that
/// of its interpolation.
float slope(const float* at, std::ptrdiff_t step, int before, int after) {
    const float near = at[step] - at[-step];
    if (before >= 3 && after >= 3) {
        const float wide =
            0.75F * near - 0.15F * (at[2 * step] - at[-2 * step]) + (at[3 * step] - at[-3 * step]) / 60.0F;
        if (wide == wide) return wide;
    }
    return 0.5F * near;
}

/// Gradient of the texture along the surface at a pixel [1/mm].
std::array<float, 3> gradient_at(const Image<const float>& texture, const float* tangents, int v, int u) {
    std::array<float, 3> out{NOT_A_NUMBER, NOT_A_NUMBER, NOT_A_NUMBER};
    const int width = texture.width, height = texture.height;
    if (u == 0 || v == 0 || u + 1 == width || v + 1 == height) return out;
    const float* at = texture.at(v, u);
    const float f_u = slope(at, 1, u, width - 1 - u), f_v = slope(at, width, v, height - 1 - v);
    const float *x_u = tangents, *x_v = tangents + 3;
    const float e = x_u[0] * x_u[0] + x_u[1] * x_u[1] + x_u[2] * x_u[2];
    const float f = x_u[0] * x_v[0] + x_u[1] * x_v[1] + x_u[2] * x_v[2];
    const float g = x_v[0] * x_v[0] + x_v[1] * x_v[1] + x_v[2] * x_v[2];
    const float determinant = e * g - f * f;
    if (!(determinant > 0)) return out;
    const float alpha = (g * f_u - f * f_v) / determinant, beta = (e * f_v - f * f_u) / determinant;
    for (int i = 0; i < 3; ++i) out[i] = alpha * x_u[i] + beta * x_v[i];
    return out;
}

void write_pixel(const JointSources& in, const JointValueOptions& o, int v, int u, float* out) {
    const Eigen::Vector3f point = Eigen::Vector3f::Map(in.points.at(v, u)),
                          n = Eigen::Vector3f::Map(in.normals.at(v, u));
    const Eigen::Vector3f ray = point - o.centre;
    const float by_blur = *in.by_blur.at(v, u), uncertain = o.blur_sigma * by_blur;
    const float along = *in.sigma.at(v, u) * ray.dot(n) / ray.norm();
    Eigen::Vector3f::Map(out + joint::point) = point - o.blur * by_blur * n;
    out[joint::variance_distance] = along * along + uncertain * uncertain;
    Eigen::Vector3f::Map(out + joint::normal) = n;
    const float texture = *in.texture.at(v, u), sigma = *in.texture_sigma.at(v, u);
    const auto number = static_cast<float>(o.spacing * o.spacing);
    out[joint::variance_texture] = texture == texture ? sigma * sigma / number : NOT_A_NUMBER;
    const auto gradient = gradient_at(in.texture, in.tangents.at(v, u), v, u);
    std::copy(gradient.begin(), gradient.end(), out + joint::gradient);
    out[joint::blur] = uncertain;
}

}  // namespace

void joint_values(const JointSources& in, const JointValueOptions& options, int threads, const Image<float>& values) {
    parallel_tasks(static_cast<std::size_t>(values.height), threads, [&](std::size_t row) {
        const int v = static_cast<int>(row);
        for (int u = 0; u < values.width; ++u)
            write_pixel(in, options, v * options.spacing, u * options.spacing, values.at(v, u));
    });
}

}  // namespace planish
