#include "core/joint.hpp"

#include <algorithm>
#include <cmath>
#include <limits>

#include "core/joint_lookup.hpp"
#include "core/parallel.hpp"

namespace planish {

JointSums& JointSums::operator+=(const JointSums& other) {
    for (auto [mine, theirs] : {std::pair{&distance, &other.distance}, std::pair{&texture, &other.texture}}) {
        mine->H += theirs->H;
        mine->g += theirs->g;
        mine->blur += theirs->blur;
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

/// Pixels that are added up together, as many lanes as one instruction takes, and pairs (i <= j) of six.
constexpr int kBatch = 64, kLanes = 8, kPairs = 21;
/// Pixels whose places are found before they are compared: so long does memory take to answer.
constexpr int kAhead = 16;

using Lanes = Eigen::Array<float, kLanes, 1>;
using Column = Eigen::Array<float, kBatch, 1>;

/// Residuals of one kind of up to `kBatch` pixels, in units of their noise, with both sides' derivatives.
struct Batch {
    int count = 0;
    /// x, y, z of the lever; of a's, b's and the mean derivative by a displacement; the residual; its change by the
    /// blur; of textures what gain and offset would take from it.
    std::array<Column, 16> columns;

    Batch() { columns.fill(Column::Zero()); }
    void add(float residual, const Eigen::Vector3f& lever, const Eigen::Vector3f& a, const Eigen::Vector3f& b,
             const Eigen::Vector3f& mean, float blur, float gain = 0, float offset = 0) {
        for (int i = 0; i < 3; ++i) {
            columns[i][count] = lever[i];
            columns[3 + i][count] = a[i];
            columns[6 + i][count] = b[i];
            columns[9 + i][count] = mean[i];
        }
        columns[12][count] = residual;
        columns[13][count] = blur;
        columns[14][count] = gain;
        columns[15][count] = offset;
        ++count;
    }
    [[nodiscard]] Lanes lanes(int column, int first) const { return columns[column].segment<kLanes>(first); }
    /// Derivatives of eight residuals by xi, from those by a displacement in three columns.
    [[nodiscard]] std::array<Lanes, 6> jacobian(int column, int first) const {
        const Lanes x = lanes(0, first), y = lanes(1, first), z = lanes(2, first);
        const Lanes p = lanes(column, first), q = lanes(column + 1, first), s = lanes(column + 2, first);
        return {y * s - z * q, z * p - x * s, x * q - y * p, p, q, s};
    }
};

/// Sums over batches, lane by lane.
struct LaneSums {
    std::array<Lanes, kPairs> H, unbiased;
    std::array<Lanes, 6> g, blur;
    Lanes cost = Lanes::Zero(), weights = Lanes::Zero(), slopes = Lanes::Zero(), absolute = Lanes::Zero();
    int count = 0;

    LaneSums() {
        H.fill(Lanes::Zero());
        unbiased.fill(Lanes::Zero());
        g.fill(Lanes::Zero());
        blur.fill(Lanes::Zero());
    }
    void add(const Batch& batch, const TileWeight& weight);
    void add_to(Normal& sums, Matrix6& unbiased_sums, Matrix62& tile, int column, double* sizes) const;
};

void LaneSums::add(const Batch& batch, const TileWeight& weight) {
    const float over_scale = 1.0F / (kTukey * weight.scale);
    const Lanes number = Lanes::LinSpaced(kLanes, 0, kLanes - 1);
    for (int first = 0; first < batch.count; first += kLanes) {
        const auto A = batch.jacobian(3, first), B = batch.jacobian(6, first), J = batch.jacobian(9, first);
        // 1 for pixels, 0 for what an older batch left behind them.
        const Lanes there = (static_cast<float>(batch.count - first) - number).max(0.0F).min(1.0F);
        const Lanes r = batch.lanes(12, first), xx = (r * over_scale).square(), y = (1.0F - xx).max(0.0F) * there;
        const Lanes w = weight.weight * y.square(), wr = w * r, wb = w * batch.lanes(13, first);
        weights += y.square();
        slopes += y * (1.0F - 5.0F * xx);
        cost += wr * r;
        absolute += r.abs() * there;
        for (int i = 0, pair = 0; i < 6; ++i) {
            g[i] += wr * J[i];
            blur[i] += wb * J[i];
            const Lanes wJ = w * J[i], wA = w * A[i], wB = w * B[i];
            for (int j = i; j < 6; ++j, ++pair) {
                H[pair] += wJ * J[j];
                unbiased[pair] += wA * B[j] + wB * A[j];
            }
        }
    }
    count += batch.count;
}

double total(const Lanes& lanes) { return lanes.cast<double>().sum(); }

void LaneSums::add_to(Normal& sums, Matrix6& unbiased_sums, Matrix62& tile, int column, double* sizes) const {
    for (int i = 0, pair = 0; i < 6; ++i) {
        const double gradient = total(g[i]);
        sums.g[i] += gradient;
        sums.blur[i] += total(blur[i]);
        tile(i, column) += gradient;
        for (int j = i; j < 6; ++j, ++pair) {
            const double plain = total(H[pair]), cross = 0.5 * total(unbiased[pair]);
            sums.H(i, j) += plain;
            unbiased_sums(i, j) += cross;
            if (i != j) {
                sums.H(j, i) += plain;
                unbiased_sums(j, i) += cross;
            }
        }
    }
    sums.cost += total(cost);
    sums.weights += total(weights);
    sums.slopes += total(slopes);
    sums.count += count;
    sizes[0] += count;
    sizes[1] += total(absolute);
}

/// Sums for `Shading`, lane by lane.
struct ShadingSums {
    std::array<Lanes, 6> by_gain, by_offset;
    Lanes gains = Lanes::Zero(), both = Lanes::Zero(), offsets = Lanes::Zero();
    Lanes gain_residual = Lanes::Zero(), offset_residual = Lanes::Zero();

    ShadingSums() {
        by_gain.fill(Lanes::Zero());
        by_offset.fill(Lanes::Zero());
    }
    void add(const Batch& batch, const TileWeight& weight);
    void add_to(Shading& sums) const;
};

void ShadingSums::add(const Batch& batch, const TileWeight& weight) {
    const float over_scale = 1.0F / (kTukey * weight.scale);
    const Lanes number = Lanes::LinSpaced(kLanes, 0, kLanes - 1);
    for (int first = 0; first < batch.count; first += kLanes) {
        const auto J = batch.jacobian(9, first);
        const Lanes there = (static_cast<float>(batch.count - first) - number).max(0.0F).min(1.0F);
        const Lanes r = batch.lanes(12, first), m = batch.lanes(14, first), q = batch.lanes(15, first);
        const Lanes w = weight.weight * ((1.0F - (r * over_scale).square()).max(0.0F) * there).square();
        const Lanes wm = w * m, wq = w * q;
        gains += wm * m;
        both += wm * q;
        offsets += wq * q;
        gain_residual += wm * r;
        offset_residual += wq * r;
        for (int i = 0; i < 6; ++i) {
            by_gain[i] += wm * J[i];
            by_offset[i] += wq * J[i];
        }
    }
}

void ShadingSums::add_to(Shading& sums) const {
    for (int i = 0; i < 6; ++i) {
        sums.change(i, 0) = total(by_gain[i]);
        sums.change(i, 1) = total(by_offset[i]);
    }
    sums.square << total(gains), total(both), total(both), total(offsets);
    sums.residual << total(gain_residual), total(offset_residual);
}

struct Problem : JointPair {
    using JointPair::JointPair;
    Image<float> distances, differences;

    void add_tile(int top, int left, const TileWeight* weights, JointSums& sums, Matrix62& gradients,
                  std::array<double, 4>& sizes, Shading& shading) const;
    void add_texture(const Meeting& m, const TileWeight& weight, Batch& batch, JointSums& sums) const;
};

/// All pixels of a tile: they lie close together in a, too, whichever way it is turned.
void Problem::add_tile(int top, int left, const TileWeight* weights, JointSums& sums, Matrix62& gradients,
                       std::array<double, 4>& sizes, Shading& shading) const {
    LaneSums distance, texture;
    ShadingSums shaded;
    Batch of_distance, of_texture;
    const auto flush = [&] {
        distance.add(of_distance, weights[0]);
        texture.add(of_texture, weights[1]);
        shaded.add(of_texture, weights[1]);
        of_distance.count = of_texture.count = 0;
    };
    const int bottom = std::min(b.values.height, top + o.tile), right = std::min(b.values.width, left + o.tile);
    std::array<Meeting, kAhead> found;
    int ahead = 0;
    const auto compare_found = [&] {
        for (int i = 0; i < ahead; ++i) {
            Meeting& m = found[i];
            if (!compare(m)) continue;
            const float over_sigma = 1.0F / m.sigma, r = m.distance * over_sigma;
            of_distance.add(r, (m.x - about).cast<float>(), m.normal_a * over_sigma, m.normal_b * over_sigma,
                            (m.normal_a + m.normal_b).normalized() * over_sigma,
                            (b.values.at(m.v, m.u)[joint::blur] - m.blur_a) * over_sigma);
            if (!distances.empty()) *distances.at(m.v, m.u) = r;
            add_texture(m, weights[1], of_texture, sums);
            if (of_distance.count == kBatch) flush();
        }
        ahead = 0;
    };
    for (int v = top; v < bottom; v += o.stride)
        for (int u = left; u < right; u += o.stride) {
            if (!find(v, u, found[ahead])) continue;
            prepare(found[ahead]);
            if (++ahead == kAhead) compare_found();
        }
    compare_found();
    flush();
    if (distance.count > 0) distance.add_to(sums.distance, sums.H_distance_unbiased, gradients, 0, &sizes[0]);
    if (texture.count > 0) texture.add_to(sums.texture, sums.H_texture_unbiased, gradients, 1, &sizes[2]);
    if (texture.count > 0) shaded.add_to(shading);
}

void Problem::add_texture(const Meeting& m, const TileWeight& weight, Batch& batch, JointSums& sums) const {
    const float* pb = b.values.at(m.v, m.u);
    const float value_b = *b.texture.at(m.v, m.u), value_a = cubic(a.texture, m.at.x(), m.at.y());
    const float variance = m.variance_texture + pb[joint::variance_texture];
    if (std::isnan(value_a + value_b + variance + m.gradient_a[0] + pb[joint::gradient])) return;
    const float over_sigma = 1.0F / std::sqrt(variance), mean = 0.5F * (value_a + value_b) * over_sigma;
    const float r = (value_a - value_b - weight.offset) * over_sigma - weight.gain * mean;
    const Eigen::Vector3f of_a = m.gradient_a * ((1.0F - 0.5F * weight.gain) * over_sigma);
    const Eigen::Vector3f of_b =
        R_float * Eigen::Vector3f(pb[joint::gradient], pb[joint::gradient + 1], pb[joint::gradient + 2]) *
        ((1.0F + 0.5F * weight.gain) * over_sigma);
    batch.add(r, (m.x - about).cast<float>(), of_a, of_b, 0.5F * (of_a + of_b), 0.0F, mean, over_sigma);
    sums.correlation_ab += value_a * value_b;
    sums.correlation_aa += value_a * value_a;
    sums.correlation_bb += value_b * value_b;
    if (!differences.empty()) *differences.at(m.v, m.u) = r;
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
    JointResult result;
    const int rows = tile_grid(b, options.tile)[0], columns = tile_grid(b, options.tile)[1];
    const auto tiles = static_cast<std::size_t>(rows) * columns;
    result.tile_rows = rows;
    result.tile_columns = columns;
    result.tile_gradients.assign(tiles, Matrix62::Zero());
    result.tile_sizes.assign(tiles, {});
    result.tile_shading.assign(tiles, {});
    // One block = one row of tiles: its tile sums belong to it alone, and the order of additions is fixed.
    result.sums = parallel_sum<JointSums>(result.tile_rows, 1, threads, [&](std::size_t row, std::size_t) {
        JointSums sums;
        const int top = static_cast<int>(row) * options.tile;
        for (int column = 0; column < columns; ++column) {
            const std::size_t k = row * columns + column;
            problem.add_tile(top, column * options.tile, &weights[2 * k], sums, result.tile_gradients[k],
                             result.tile_sizes[k], result.tile_shading[k]);
        }
        return sums;
    });
    return result;
}

}  // namespace planish
