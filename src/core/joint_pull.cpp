#include "core/joint_pull.hpp"

#include <cstdlib>
#include <limits>

#include "core/joint_lookup.hpp"
#include "core/parallel.hpp"

namespace planish {
namespace {

using Matrix23 = Eigen::Matrix<double, 2, 3>;

/// Derivative of the pixel by the point in the sensor frame.
Matrix23 pixel_by_point(const Camera& camera, const Eigen::Vector3d& in_camera) {
    const double x = in_camera.x() / in_camera.z(), y = in_camera.y() / in_camera.z();
    Eigen::Matrix2d K;
    K << camera.fx, camera.skew, 0, camera.fy;
    Matrix23 perspective;
    perspective << 1, 0, -x, 0, 1, -y;
    return K * camera.distortion_jacobian({x, y}) * (perspective / in_camera.z()) * camera.R_camera_sensor;
}

/// Value of the cubic convolution (see `cubic`) and its slopes along u and v.
struct Sloped {
    double value, du, dv;
};

Sloped cubic_with_slopes(const Image<const float>& map, double x, double y) {
    const int u = static_cast<int>(std::floor(x)), v = static_cast<int>(std::floor(y));
    using Four = std::array<double, 4>;
    const auto weights = [](double f) -> Four {
        return {((-0.5 * f + 1.0) * f - 0.5) * f, (1.5 * f - 2.5) * f * f + 1.0, ((-1.5 * f + 2.0) * f + 0.5) * f,
                (0.5 * f - 0.5) * f * f};
    };
    const auto slopes = [](double f) -> Four {
        return {(-1.5 * f + 2.0) * f - 0.5, (4.5 * f - 5.0) * f, (-4.5 * f + 4.0) * f + 0.5, (1.5 * f - 1.0) * f};
    };
    const Four wx = weights(x - u), wy = weights(y - v), sx = slopes(x - u), sy = slopes(y - v);
    Sloped out{0, 0, 0};
    for (int j = 0; j < 4; ++j) {
        const float* p = map.at(v - 1 + j, u - 1);
        const double along = wx[0] * p[0] + wx[1] * p[1] + wx[2] * p[2] + wx[3] * p[3];
        out.value += wy[j] * along;
        out.dv += sy[j] * along;
        out.du += wy[j] * (sx[0] * p[0] + sx[1] * p[1] + sx[2] * p[2] + sx[3] * p[3]);
    }
    return out;
}

/// Slopes (3, 2) along u and v of a linearly interpolated vector.
Eigen::Matrix<double, 3, 2> slopes_of(const Image<const float>& map, const Cell& cell) {
    const float *p = map.at(cell.v, cell.u), *q = map.at(cell.v + 1, cell.u);
    const double below = cell.w[2] + cell.w[3], right = cell.w[1] + cell.w[3];
    Eigen::Matrix<double, 3, 2> out;
    for (int i = 0; i < 3; ++i) {
        out(i, 0) = (1 - below) * (p[i + 3] - p[i]) + below * (q[i + 3] - q[i]);
        out(i, 1) = (1 - right) * (q[i] - p[i]) + right * (q[i + 3] - p[i + 3]);
    }
    return out;
}

struct Problem {
    const JointMaps &a, &b;
    const Camera& camera;
    Eigen::Matrix3d R;
    Eigen::Vector3d t, about;
    JointOptions o;

    void add_texture(int v, int u, const Meeting& m, Matrix63& pull) const;
};

void Problem::add_texture(int v, int u, const Meeting& m, Matrix63& pull) const {
    const double value_b = *b.texture.at(v, u);
    const Sloped value_a = cubic_with_slopes(a.texture, m.at.x(), m.at.y());
    const Eigen::Vector3d gradient_a = m.cell.vector(a.gradient);
    const float* gb = b.gradient.at(v, u);
    const Eigen::Vector3d gradient_b = R * Eigen::Vector3d(gb[0], gb[1], gb[2]);
    const double sigma_a = m.cell.scalar(a.sigma), sigma_b = *b.sigma.at(v, u);
    const double sigma = std::sqrt(sigma_a * sigma_a + sigma_b * sigma_b);
    if (std::isnan(value_a.value + value_b + gradient_a.sum() + gradient_b.sum() + sigma)) return;
    const double r = (value_a.value - value_b) / sigma;
    const Influence influence = tukey(r, o.scale_texture);
    if (influence.weight == 0) return;
    const Matrix23 by_point = pixel_by_point(camera, m.in_camera) / sigma;
    const Eigen::Vector3d lever = m.x - about;
    const Vector6 J = jacobian(lever, 0.5 / sigma * (gradient_a + gradient_b));
    const Eigen::RowVector3d row = Eigen::RowVector2d(value_a.du, value_a.dv) * by_point;
    pull.noalias() += o.weight_texture * influence.slope * J * row;
    // a's gradient is looked up at the same place, so that it changes too.
    const Eigen::Matrix3d turn =
        0.5 * o.weight_texture * influence.weight * r * slopes_of(a.gradient, m.cell) * by_point;
    for (int i = 0; i < 3; ++i) pull.col(i) += jacobian(lever, turn.col(i));
}

}  // namespace

JointPull joint_pull(const JointMaps& a, const Camera& camera_a, const JointMaps& b, const Eigen::Matrix3d& R_a_b,
                     const Eigen::Vector3d& t_a_b, const Eigen::Vector3d& about, const JointOptions& options,
                     int threads) {
    const Problem problem{a, b, camera_a, R_a_b, t_a_b, about, options};
    const int width = b.points.width, height = b.points.height, tile = options.tile;
    JointPull result;
    result.tile_rows = (height + tile - 1) / tile;
    result.tile_columns = (width + tile - 1) / tile;
    const auto count = static_cast<std::size_t>(result.tile_rows) * result.tile_columns;
    result.tiles.assign(count, Matrix63::Zero());
    result.pixel.assign(count, -1);
    std::vector<int> nearest(count, std::numeric_limits<int>::max());
    // A row of tiles belongs to one thread alone.
    parallel_for(static_cast<std::size_t>(result.tile_rows), threads, [&](std::size_t begin, std::size_t end) {
        Meeting m;
        for (int v = static_cast<int>(begin) * tile; v < std::min(height, static_cast<int>(end) * tile);
             v += options.stride)
            for (int u = 0; u < width; u += options.stride) {
                if (!meet(a, b, camera_a, R_a_b, t_a_b, options, v, u, m)) continue;
                const auto k = static_cast<std::size_t>(v / tile) * result.tile_columns + u / tile;
                const int off = std::abs(v % tile - tile / 2) + std::abs(u % tile - tile / 2);
                if (off < nearest[k]) {
                    nearest[k] = off;
                    result.pixel[k] = static_cast<std::int64_t>(v) * width + u;
                }
                const double slope = tukey(m.distance, options.scale_distance).slope;
                const Vector6 J = jacobian(m.x - about, (m.normal_a + m.normal_b).normalized());
                result.tiles[k].noalias() += options.weight_distance * slope * J * m.normal_a.transpose();
                problem.add_texture(v, u, m, result.tiles[k]);
            }
    });
    return result;
}

}  // namespace planish
