#include "core/refinement/joint_pull.hpp"

#include <cstdlib>
#include <limits>

#include "core/common/parallel.hpp"
#include "core/refinement/joint_lookup.hpp"

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

Sloped cubic_with_slopes(const Image<const float>& map, const Cell& cell) {
    using Four = Eigen::Array4f;
    const auto slopes = [](float f) -> Four {
        return {(-1.5F * f + 2.0F) * f - 0.5F, (4.5F * f - 5.0F) * f, (-4.5F * f + 4.0F) * f + 0.5F,
                (1.5F * f - 1.0F) * f};
    };
    const Four wx = cubic_weights(cell.fx), wy = cubic_weights(cell.fy), sx = slopes(cell.fx), sy = slopes(cell.fy);
    Sloped out{0, 0, 0};
    for (int j = 0; j < 4; ++j) {
        const Four p = Four::Map(map.at(cell.v - 1 + j, cell.u - 1));
        const double along = (wx * p).sum();
        out.value += wy[j] * along;
        out.dv += sy[j] * along;
        out.du += wy[j] * (sx * p).sum();
    }
    return out;
}

/// Slopes (3, 2) along u and v of a linearly interpolated vector.
Eigen::Matrix<double, 3, 2> slopes_of(const Image<const float>& map, const Cell& cell, int channel) {
    const auto q = cell.corners(map);
    const float below = cell.w[2] + cell.w[3], right = cell.w[1] + cell.w[3];
    Eigen::Matrix<double, 3, 2> out;
    for (int i = 0; i < 3; ++i) {
        const int c = channel + i;
        out(i, 0) = (1 - below) * (q[1][c] - q[0][c]) + below * (q[3][c] - q[2][c]);
        out(i, 1) = (1 - right) * (q[2][c] - q[0][c]) + right * (q[3][c] - q[1][c]);
    }
    return out;
}

Matrix63 outer(const Row6& J, const Eigen::RowVector3d& row) {
    Matrix63 out;
    for (int i = 0; i < 6; ++i) out.row(i) = J[i] * row;
    return out;
}

struct Problem : JointPair {
    using JointPair::JointPair;

    void add_distance(const Meeting& m, const TileWeight& weight, Matrix63& pull) const;
    void add_texture(const Meeting& m, const TileWeight& weight, Matrix63& pull) const;
};

void Problem::add_distance(const Meeting& m, const TileWeight& weight, Matrix63& pull) const {
    const float variance = m.variance + b.values.at(m.v, m.u)[joint::variance_distance];
    const float slope = tukey(m.distance / std::sqrt(variance), weight.scale).slope;
    const Eigen::Vector3f normal = m.normal.head<3>();
    const Row6 J = jacobian(m.lever.head<3>(), (normal + R_float * of_b(m, joint::normal)).normalized());
    pull += outer(J, weight.weight * slope / variance * normal.cast<double>().transpose());
}

void Problem::add_texture(const Meeting& m, const TileWeight& weight, Matrix63& pull) const {
    const float* pb = b.values.at(m.v, m.u);
    const double value_b = *b.texture.at(m.v, m.u);
    const Sloped value_a = cubic_with_slopes(a.texture, m.cell);
    const double variance = m.normal[3] + pb[joint::variance_texture];
    const double known = value_a.value + value_b + variance + m.gradient[0] + pb[joint::gradient];
    if (std::isnan(known)) return;
    const double share_a = 1 - 0.5 * weight.gain, share_b = 1 + 0.5 * weight.gain;
    const double sigma = std::sqrt(variance);
    const double r = (share_a * value_a.value - share_b * value_b - weight.offset) / sigma;
    const Influence influence = tukey(static_cast<float>(r), weight.scale);
    if (influence.weight == 0) return;
    const Eigen::Vector3d x = m.x.head<3>().cast<double>();
    const Matrix23 by_point = share_a * pixel_by_point(camera, camera.to_camera(x)) / sigma;
    const Eigen::Vector3f lever = m.lever.head<3>();
    const Eigen::Vector3d gradient = share_a * m.gradient.head<3>().matrix().cast<double>() +
                                     share_b * (R_float * of_b(m, joint::gradient)).cast<double>();
    const Row6 J = jacobian(lever, (0.5 / sigma * gradient).cast<float>());
    pull += outer(J, weight.weight * influence.slope * Eigen::RowVector2d(value_a.du, value_a.dv) * by_point);
    // a's gradient is looked up at the same place, so that it changes too.
    const Eigen::Matrix3d turn =
        0.5 * weight.weight * influence.weight * r * slopes_of(a.values, m.cell, joint::gradient) * by_point;
    for (int i = 0; i < 3; ++i) {
        const Row6 turned = jacobian(lever, turn.col(i).cast<float>());
        for (int k = 0; k < 6; ++k) pull(k, i) += turned[k];
    }
}

}  // namespace

JointPull joint_pull(const JointMaps& a, const Camera& camera_a, const JointMaps& b, const Eigen::Matrix3d& R_a_b,
                     const Eigen::Vector3d& t_a_b, const Eigen::Vector3d& about, const JointOptions& options,
                     const std::vector<TileWeight>& weights, int threads) {
    const Problem problem(a, camera_a, b, R_a_b, t_a_b, about, options);
    const int width = b.values.width, height = b.values.height, tile = options.tile;
    JointPull result;
    const auto [rows, columns] = tile_grid(b, tile);
    result.tile_rows = rows;
    result.tile_columns = columns;
    const auto count = static_cast<std::size_t>(rows) * columns;
    result.tiles.assign(count, Matrix63::Zero());
    result.pixel.assign(count, -1);
    std::vector<int> nearest(count, std::numeric_limits<int>::max());
    // A row of tiles belongs to one thread alone.
    parallel_for(static_cast<std::size_t>(result.tile_rows), threads, [&](std::size_t begin, std::size_t end) {
        std::array<Meeting, kAhead> found;
        for (int v = static_cast<int>(begin) * tile; v < std::min(height, static_cast<int>(end) * tile);
             v += options.stride)
            for (Cursor next(v, 0, v + 1, width); !next.done();) {
                const int count = problem.find(next, found);
                for (int i = 0; i < count; ++i) {
                    Meeting& m = found[i];
                    if (!problem.compare(m)) continue;
                    const auto k = static_cast<std::size_t>(v / tile) * result.tile_columns + m.u / tile;
                    const int off = std::abs(v % tile - tile / 2) + std::abs(m.u % tile - tile / 2);
                    if (off < nearest[k]) {
                        nearest[k] = off;
                        result.pixel[k] = static_cast<std::int64_t>(v) * width + m.u;
                    }
                    problem.add_distance(m, weights[2 * k], result.tiles[k]);
                    problem.add_texture(m, weights[2 * k + 1], result.tiles[k]);
                }
            }
    });
    return result;
}

}  // namespace planish
