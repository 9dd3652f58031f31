#include "core/refinement/joint_samples.hpp"

#include <algorithm>
#include <cmath>

#include "core/common/parallel.hpp"
#include "core/refinement/joint_lookup.hpp"

namespace planish {
namespace {

struct Problem : JointPair {
    using JointPair::JointPair;

    void add_tile(int top, int left, std::array<double, 4>& sizes, std::vector<TextureSample>& textures) const;
    void add(Meeting& m, std::array<double, 4>& sizes, std::vector<TextureSample>& textures) const;
};

void Problem::add_tile(int top, int left, std::array<double, 4>& sizes, std::vector<TextureSample>& textures) const {
    each_meeting(top, left, [&](Meeting& m) { add(m, sizes, textures); });
}

void Problem::add(Meeting& m, std::array<double, 4>& sizes, std::vector<TextureSample>& textures) const {
    if (!compare(m)) return;
    const float* of_b = b.values.at(m.v, m.u);
    sizes[0] += 1;
    sizes[1] += std::fabs(m.distance) / std::sqrt(m.variance + of_b[joint::variance_distance]);
    const float texture_a = cubic(a.texture, m.cell), texture_b = *b.texture.at(m.v, m.u);
    const float variance = m.normal[3] + of_b[joint::variance_texture];
    float all = texture_a + texture_b + variance;
    for (int i = 0; i < 3; ++i) all += m.gradient[i] + of_b[joint::gradient + i];
    if (!(all == all)) return;
    const float over_sigma = 1.0F / std::sqrt(variance);
    sizes[2] += 1;
    sizes[3] += std::fabs(texture_a - texture_b) * over_sigma;
    textures.push_back({texture_a, texture_b, over_sigma});
}

}  // namespace

JointSamples joint_samples(const JointMaps& a, const Camera& camera_a, const JointMaps& b, const Eigen::Matrix3d& R_a_b,
                           const Eigen::Vector3d& t_a_b, const JointOptions& options, int threads) {
    const Problem problem(a, camera_a, b, R_a_b, t_a_b, Eigen::Vector3d::Zero(), options);
    JointSamples out;
    out.tile_rows = tile_grid(b, options.tile)[0];
    out.tile_columns = tile_grid(b, options.tile)[1];
    const auto rows = static_cast<std::size_t>(out.tile_rows), columns = static_cast<std::size_t>(out.tile_columns);
    out.tile_sizes.assign(rows * columns, {});
    out.counts.assign(rows * columns, 0);
    std::vector<std::vector<TextureSample>> of_rows(rows);
    parallel_tasks(rows, threads, [&](std::size_t row) {
        auto& textures = of_rows[row];
        for (std::size_t column = 0; column < columns; ++column) {
            const std::size_t k = row * columns + column, before = textures.size();
            problem.add_tile(static_cast<int>(row) * options.tile, static_cast<int>(column) * options.tile,
                             out.tile_sizes[k], textures);
            out.counts[k] = static_cast<std::int64_t>(textures.size() - before);
        }
    });
    for (const auto& textures : of_rows) out.textures.insert(out.textures.end(), textures.begin(), textures.end());
    return out;
}

}  // namespace planish
