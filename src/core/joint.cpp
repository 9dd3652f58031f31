#include "core/joint.hpp"

#include <cmath>
#include <limits>

#include "core/joint_lookup.hpp"
#include "core/parallel.hpp"

namespace planish {

JointSums& JointSums::operator+=(const JointSums& other) {
    for (auto [mine, theirs] : {std::pair{&distance, &other.distance}, std::pair{&texture, &other.texture}}) {
        mine->H += theirs->H;
        mine->g += theirs->g;
        mine->cost += theirs->cost;
        mine->weights += theirs->weights;
        mine->slopes += theirs->slopes;
        mine->count += theirs->count;
    }
    H_distance_unbiased += other.H_distance_unbiased;
    H_texture_unbiased += other.H_texture_unbiased;
    correlation_ab += other.correlation_ab;
    correlation_aa += other.correlation_aa;
    correlation_bb += other.correlation_bb;
    return *this;
}

namespace {

struct Problem {
    const JointMaps &a, &b;
    const Camera& camera;
    Eigen::Matrix3d R;
    Eigen::Vector3d t, about;
    JointOptions o;
    Image<float> distances, differences;

    void pixel(int v, int u, JointSums& sums, Matrix62& tile) const;
    void add_texture(int v, int u, const Eigen::Vector2d& at, const Cell& cell, const Eigen::Vector3d& x,
                     JointSums& sums, Matrix62& tile) const;
};

void Problem::pixel(int v, int u, JointSums& sums, Matrix62& tile) const {
    Meeting m;
    if (!meet(a, b, camera, R, t, o, v, u, m)) return;
    const auto& [x, in_camera, at, cell, normal_a, normal_b, distance] = m;
    const Vector6 J = jacobian(x - about, (normal_a + normal_b).normalized());
    const Influence influence = tukey(distance, o.scale_distance);
    const double w = o.weight_distance * influence.weight;
    sums.distance.weights += influence.weight;
    sums.distance.slopes += influence.slope;
    sums.distance.H.noalias() += w * J * J.transpose();
    const Vector6 J_a = jacobian(x - about, normal_a), J_b = jacobian(x - about, normal_b);
    sums.H_distance_unbiased.noalias() += 0.5 * w * (J_a * J_b.transpose() + J_b * J_a.transpose());
    const Vector6 g = w * distance * J;
    sums.distance.g += g;
    tile.col(0) += g;
    sums.distance.cost += w * distance * distance;
    ++sums.distance.count;
    if (!distances.empty()) *distances.at(v, u) = static_cast<float>(distance);
    add_texture(v, u, at, cell, x, sums, tile);
}

void Problem::add_texture(int v, int u, const Eigen::Vector2d& at, const Cell& cell, const Eigen::Vector3d& x,
                          JointSums& sums, Matrix62& tile) const {
    const double value_b = *b.texture.at(v, u);
    const double value_a = cubic(a.texture, at.x(), at.y());
    const Eigen::Vector3d gradient_a = cell.vector(a.gradient);
    const float* gb = b.gradient.at(v, u);
    const Eigen::Vector3d gradient_b = R * Eigen::Vector3d(gb[0], gb[1], gb[2]);
    const double sigma_a = cell.scalar(a.sigma), sigma_b = *b.sigma.at(v, u);
    const double sigma = std::sqrt(sigma_a * sigma_a + sigma_b * sigma_b);
    if (std::isnan(value_a + value_b + gradient_a.sum() + gradient_b.sum() + sigma)) return;
    const double r = (value_a - value_b) / sigma;
    const Vector6 J_a = jacobian(x - about, gradient_a / sigma), J_b = jacobian(x - about, gradient_b / sigma);
    const Vector6 J = 0.5 * (J_a + J_b);
    const Influence influence = tukey(r, o.scale_texture);
    const double w = o.weight_texture * influence.weight;
    sums.texture.weights += influence.weight;
    sums.texture.slopes += influence.slope;
    sums.texture.H.noalias() += w * J * J.transpose();
    sums.H_texture_unbiased.noalias() += 0.5 * w * (J_a * J_b.transpose() + J_b * J_a.transpose());
    const Vector6 g = w * r * J;
    sums.texture.g += g;
    tile.col(1) += g;
    sums.texture.cost += w * r * r;
    ++sums.texture.count;
    if (w > 0) {
        sums.correlation_ab += value_a * value_b;
        sums.correlation_aa += value_a * value_a;
        sums.correlation_bb += value_b * value_b;
    }
    if (!differences.empty()) *differences.at(v, u) = static_cast<float>(r);
}

}  // namespace

JointResult joint_normal_equations(const JointMaps& a, const Camera& camera_a, const JointMaps& b,
                                   const Eigen::Matrix3d& R_a_b, const Eigen::Vector3d& t_a_b,
                                   const Eigen::Vector3d& about, const JointOptions& options, int threads,
                                   const Image<float>& distances, const Image<float>& differences) {
    constexpr float nan = std::numeric_limits<float>::quiet_NaN();
    for (const auto& out : {distances, differences})
        if (!out.empty()) std::fill_n(out.data, out.pixels(), nan);
    const Problem problem{a, b, camera_a, R_a_b, t_a_b, about, options, distances, differences};
    const int width = b.points.width, height = b.points.height;
    JointResult result;
    result.tile_rows = (height + options.tile - 1) / options.tile;
    result.tile_columns = (width + options.tile - 1) / options.tile;
    result.tile_gradients.assign(static_cast<std::size_t>(result.tile_rows) * result.tile_columns, Matrix62::Zero());
    // One block = one row of tiles: its tile sums belong to it alone, and the order of additions is fixed.
    result.sums = parallel_sum<JointSums>(result.tile_rows, 1, threads, [&](std::size_t row, std::size_t) {
        JointSums sums;
        const int top = static_cast<int>(row) * options.tile;
        for (int v = top; v < std::min(height, top + options.tile); v += options.stride)
            for (int u = 0; u < width; u += options.stride)
                problem.pixel(v, u, sums, result.tile_gradients[row * result.tile_columns + u / options.tile]);
        return sums;
    });
    return result;
}

}  // namespace planish
