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

using Square6 = std::array<Row6, 6>;

inline void add_product(Square6& sum, float w, const Row6& left, const Row6& right) {
    for (int i = 0; i < 6; ++i) {
        const float factor = w * left[i];
        for (int j = 0; j < 8; ++j) sum[i][j] += factor * right[j];
    }
}

/// Sums over the pixels of one row of one tile: few enough for float32.
struct Run {
    struct Kind {
        Square6 H{}, unbiased{};
        Row6 g{};
        float cost = 0, weights = 0, slopes = 0, absolute = 0;
        int count = 0;
    };
    Kind distance, texture;
    float correlation_ab = 0, correlation_aa = 0, correlation_bb = 0;

    void add_to(JointSums& sums, Matrix62& tile, std::array<double, 4>& sizes) const {
        add(distance, sums.distance, sums.H_distance_unbiased, tile, 0);
        add(texture, sums.texture, sums.H_texture_unbiased, tile, 1);
        sums.correlation_ab += correlation_ab;
        sums.correlation_aa += correlation_aa;
        sums.correlation_bb += correlation_bb;
        sizes[0] += distance.count;
        sizes[1] += distance.absolute;
        sizes[2] += texture.count;
        sizes[3] += texture.absolute;
    }

  private:
    static void add(const Kind& kind, Normal& sums, Matrix6& unbiased, Matrix62& tile, int column) {
        if (kind.count == 0) return;
        for (int i = 0; i < 6; ++i) {
            sums.g[i] += kind.g[i];
            tile(i, column) += kind.g[i];
            for (int j = 0; j < 6; ++j) {
                sums.H(i, j) += kind.H[i][j];
                unbiased(i, j) += 0.5 * (kind.unbiased[i][j] + kind.unbiased[j][i]);
            }
        }
        sums.cost += kind.cost;
        sums.weights += kind.weights;
        sums.slopes += kind.slopes;
        sums.count += kind.count;
    }
};

struct Problem : JointPair {
    using JointPair::JointPair;
    Image<float> distances, differences;

    void pixel(int v, int u, const TileWeight* weights, Run& run) const;
    void add_texture(int v, int u, const Meeting& m, const Eigen::Vector3f& lever, const TileWeight& weight,
                     Run& run) const;
};

/// Adds one residual in units of its noise with its derivatives on both sides; J is their mean.
inline void add_residual(Run::Kind& sums, float r, const Row6& J, const Row6& J_a, const Row6& J_b,
                         const TileWeight& weight) {
    const Influence influence = tukey(r, weight.scale);
    const float w = weight.weight * influence.weight;
    sums.weights += influence.weight;
    sums.slopes += influence.slope;
    add_product(sums.H, w, J, J);
    add_product(sums.unbiased, w, J_a, J_b);
    for (int i = 0; i < 8; ++i) sums.g[i] += w * r * J[i];
    sums.cost += w * r * r;
    sums.absolute += std::fabs(r);
    ++sums.count;
}

void Problem::pixel(int v, int u, const TileWeight* weights, Run& run) const {
    Meeting m;
    if (!meet(v, u, m)) return;
    const Eigen::Vector3f lever = (m.x - about).cast<float>();
    const float over_sigma = 1.0F / m.sigma, r = m.distance * over_sigma;
    add_residual(run.distance, r, jacobian(lever, (m.normal_a + m.normal_b).normalized() * over_sigma),
                 jacobian(lever, m.normal_a * over_sigma), jacobian(lever, m.normal_b * over_sigma), weights[0]);
    if (!distances.empty()) *distances.at(v, u) = r;
    add_texture(v, u, m, lever, weights[1], run);
}

void Problem::add_texture(int v, int u, const Meeting& m, const Eigen::Vector3f& lever, const TileWeight& weight,
                          Run& run) const {
    const float* pb = b.values.at(v, u);
    const float value_b = *b.texture.at(v, u), value_a = cubic(a.texture, m.at.x(), m.at.y());
    const float variance = m.a[joint::variance_texture] + pb[joint::variance_texture];
    if (std::isnan(value_a + value_b + variance + m.a[joint::gradient] + pb[joint::gradient])) return;
    const float over_sigma = 1.0F / std::sqrt(variance), r = (value_a - value_b) * over_sigma;
    const Eigen::Vector3f gradient_a = vector_of(m.a.data(), joint::gradient).cast<float>();
    const Eigen::Vector3f gradient_b = R_float * vector_of(pb, joint::gradient).cast<float>();
    const Row6 J_a = jacobian(lever, gradient_a * over_sigma), J_b = jacobian(lever, gradient_b * over_sigma);
    Row6 J{};
    for (int i = 0; i < 8; ++i) J[i] = 0.5F * (J_a[i] + J_b[i]);
    add_residual(run.texture, r, J, J_a, J_b, weight);
    run.correlation_ab += value_a * value_b;
    run.correlation_aa += value_a * value_a;
    run.correlation_bb += value_b * value_b;
    if (!differences.empty()) *differences.at(v, u) = r;
}

}  // namespace

JointResult joint_normal_equations(const JointMaps& a, const Camera& camera_a, const JointMaps& b,
                                   const Eigen::Matrix3d& R_a_b, const Eigen::Vector3d& t_a_b,
                                   const Eigen::Vector3d& about, const JointOptions& options,
                                   const std::vector<TileWeight>& weights, int threads, const Image<float>& distances,
                                   const Image<float>& differences) {
    constexpr float nan = std::numeric_limits<float>::quiet_NaN();
    for (const auto& out : {distances, differences})
        if (!out.empty()) std::fill_n(out.data, out.pixels(), nan);
    Problem problem(a, camera_a, b, R_a_b, t_a_b, about, options);
    problem.distances = distances;
    problem.differences = differences;
    const int width = b.values.width, height = b.values.height;
    JointResult result;
    const auto [rows, columns] = tile_grid(b, options.tile);
    const auto tiles = static_cast<std::size_t>(rows) * columns;
    result.tile_rows = rows;
    result.tile_columns = columns;
    result.tile_gradients.assign(tiles, Matrix62::Zero());
    result.tile_sizes.assign(tiles, {});
    // One block = one row of tiles: its tile sums belong to it alone, and the order of additions is fixed.
    result.sums = parallel_sum<JointSums>(result.tile_rows, 1, threads, [&](std::size_t row, std::size_t) {
        JointSums sums;
        const int top = static_cast<int>(row) * options.tile;
        for (int v = top; v < std::min(height, top + options.tile); v += options.stride)
            for (int left = 0; left < width; left += options.tile) {
                const std::size_t k = row * result.tile_columns + left / options.tile;
                Run run;
                for (int u = left; u < std::min(width, left + options.tile); u += options.stride)
                    problem.pixel(v, u, &weights[2 * k], run);
                if (run.distance.count > 0) run.add_to(sums, result.tile_gradients[k], result.tile_sizes[k]);
            }
        return sums;
    });
    return result;
}

}  // namespace planish
