#include "core/refinement/joint.hpp"

#include <algorithm>
#include <cmath>
#include <limits>

#include "core/common/parallel.hpp"
#include "core/refinement/joint_lookup.hpp"

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

using Lanes = Eigen::Array<float, kLanes, 1>;
using Lanes3 = std::array<Lanes, 3>;
/// Keeps opposite normals, which do not count, from a division by zero.
constexpr float kLeastSquare = 1e-6F;

/// Columns of a `Batch`; vectors take three.
enum Column {
    lever = 0,
    normal_a = 3,
    normal_b = 6,
    gradient_a = 9,
    gradient_b = 12,
    distance = 15,
    variance,
    blur,
    value_a,
    value_b,
    variance_texture,
    textured,
    columns
};

/// What up to `kBatch` pixels and their places in a hold, all of it finite; normals and gradients of b in its own
/// frame.
struct Batch {
    int count = 0;
    std::array<std::array<float, kBatch>, columns> values{};
    std::array<std::array<int, 2>, kBatch> pixels{};

    Batch() {
        values[variance].fill(1.0F);
        values[variance_texture].fill(1.0F);
    }
    void add(const Meeting& m, const float* b, float texture_a, float texture_b) {
        for (int i = 0; i < 3; ++i) {
            values[lever + i][count] = m.lever[i];
            values[normal_a + i][count] = m.normal[i];
            values[gradient_a + i][count] = m.gradient[i];
            values[normal_b + i][count] = b[joint::normal + i];
            values[gradient_b + i][count] = b[joint::gradient + i];
        }
        values[Column::distance][count] = m.distance;
        values[variance][count] = m.variance + b[joint::variance_distance];
        values[Column::blur][count] = b[joint::blur] - m.gradient[3];
        values[value_a][count] = texture_a;
        values[value_b][count] = texture_b;
        values[variance_texture][count] = m.normal[3] + b[joint::variance_texture];
        pixels[count] = {m.v, m.u};
        ++count;
    }
    /// Marks where both textures are known, and puts zeros where they are not.
    void mark_textured() {
        const auto& v = values;
        auto& known = values[textured];
        for (int i = 0; i < kBatch; ++i) {
            const float all =
                v[value_a][i] + v[value_b][i] + v[variance_texture][i] + v[gradient_a][i] + v[gradient_b][i];
            known[i] = all == all ? 1.0F : 0.0F;
        }
        for (const int column : {gradient_a + 0, gradient_a + 1, gradient_a + 2, gradient_b + 0, gradient_b + 1,
                                 gradient_b + 2, value_a + 0, value_b + 0})
            for (int i = 0; i < kBatch; ++i) values[column][i] = known[i] > 0 ? values[column][i] : 0.0F;
        for (int i = 0; i < kBatch; ++i)
            values[variance_texture][i] = known[i] > 0 ? values[variance_texture][i] : 1.0F;
    }
    [[nodiscard]] Lanes lanes(int column, int first) const { return Lanes::Map(&values[column][first]); }
    [[nodiscard]] Lanes3 vectors(int column, int first) const {
        return {lanes(column, first), lanes(column + 1, first), lanes(column + 2, first)};
    }
};

/// Eight residuals in units of their noise, both sides' and the mean derivative by a displacement, the residuals'
/// change by the blur; of textures what gain and offset would take from them; `there` is 1, or 0 where nothing of it
/// counts.
struct Residuals {
    Lanes there, residual, blur, gain, offset;
    Lanes3 a, b, mean;
};

Lanes dot(const Lanes3& p, const Lanes3& q) { return p[0] * q[0] + p[1] * q[1] + p[2] * q[2]; }

Lanes3 turned(const Eigen::Matrix3f& R, const Lanes3& x) {
    Lanes3 out;
    for (int i = 0; i < 3; ++i) out[i] = R(i, 0) * x[0] + R(i, 1) * x[1] + R(i, 2) * x[2];
    return out;
}

/// Derivatives of eight residuals by xi, from those by a displacement.
std::array<Lanes, 6> jacobians(const Lanes3& lever, const Lanes3& direction) {
    const auto& [x, y, z] = lever;
    const auto& [p, q, s] = direction;
    return {y * s - z * q, z * p - x * s, x * q - y * p, p, q, s};
}

/// Sums over batches, lane by lane.
struct LaneSums {
    std::array<Lanes, kPairs> H, unbiased;
    std::array<Lanes, 6> g, blur;
    Lanes cost = Lanes::Zero(), weights = Lanes::Zero(), slopes = Lanes::Zero(), absolute = Lanes::Zero(),
          count = Lanes::Zero();

    LaneSums() {
        H.fill(Lanes::Zero());
        unbiased.fill(Lanes::Zero());
        g.fill(Lanes::Zero());
        blur.fill(Lanes::Zero());
    }
    void add(const Residuals& found, const Lanes3& lever, const TileWeight& weight);
    void add_to(Normal& sums, Matrix6& unbiased_sums, Matrix62& tile, int column, double* sizes) const;
};

void LaneSums::add(const Residuals& found, const Lanes3& lever, const TileWeight& weight) {
    const float over_scale = 1.0F / (kTukey * weight.scale);
    const auto A = jacobians(lever, found.a), B = jacobians(lever, found.b), J = jacobians(lever, found.mean);
    const Lanes &r = found.residual, xx = (r * over_scale).square(), y = (1.0F - xx).max(0.0F) * found.there;
    const Lanes w = weight.weight * y.square(), wr = w * r, wb = w * found.blur;
    weights += y.square();
    slopes += y * (1.0F - 5.0F * xx);
    cost += wr * r;
    absolute += r.abs() * found.there;
    count += found.there;
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
    const double number = total(count);
    sums.count += static_cast<std::int64_t>(number);
    sizes[0] += number;
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
    void add(const Residuals& found, const Lanes3& lever, const TileWeight& weight);
    void add_to(Shading& sums) const;
};

void ShadingSums::add(const Residuals& found, const Lanes3& lever, const TileWeight& weight) {
    const float over_scale = 1.0F / (kTukey * weight.scale);
    const auto J = jacobians(lever, found.mean);
    const Lanes &r = found.residual, &m = found.gain, &q = found.offset;
    const Lanes w = weight.weight * ((1.0F - (r * over_scale).square()).max(0.0F) * found.there).square();
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

void ShadingSums::add_to(Shading& sums) const {
    for (int i = 0; i < 6; ++i) {
        sums.change(i, 0) = total(by_gain[i]);
        sums.change(i, 1) = total(by_offset[i]);
    }
    sums.square << total(gains), total(both), total(both), total(offsets);
    sums.residual << total(gain_residual), total(offset_residual);
}

/// Sums of one tile.
struct TileSums {
    LaneSums distance, texture;
    ShadingSums shading;
    Lanes correlation_ab = Lanes::Zero(), correlation_aa = Lanes::Zero(), correlation_bb = Lanes::Zero();
};

struct Problem : JointPair {
    using JointPair::JointPair;
    Image<float> distances, differences;

    void add_tile(int top, int left, const TileWeight* weights, JointSums& sums, Matrix62& gradients,
                  std::array<double, 4>& sizes, Shading& shading, Batch& batch) const;
    void add(Batch& batch, const TileWeight* weights, TileSums& sums) const;
    [[nodiscard]] Residuals compare_points(const Batch& batch, int first) const;
    [[nodiscard]] Residuals compare_textures(const Batch& batch, int first, const Lanes& there,
                                             const TileWeight& weight) const;
    void keep(const Batch& batch, int first, const Residuals& found, const Image<float>& map) const;
};

/// All pixels of a tile.
void Problem::add_tile(int top, int left, const TileWeight* weights, JointSums& sums, Matrix62& gradients,
                       std::array<double, 4>& sizes, Shading& shading, Batch& batch) const {
    if (weights[0].weight == 0 && weights[1].weight == 0) return;
    TileSums tile;
    batch.count = 0;
    bool met = false;
    each_meeting(top, left, [&](Meeting& m) {
        look_up(m);
        if (!(std::fabs(m.distance) <= o.max_distance)) return;
        batch.add(m, b.values.at(m.v, m.u), cubic(a.texture, m.cell), *b.texture.at(m.v, m.u));
        met = true;
        if (batch.count < kBatch) return;
        add(batch, weights, tile);
        batch.count = 0;
    });
    if (!met) return;
    add(batch, weights, tile);
    tile.distance.add_to(sums.distance, sums.H_distance_unbiased, gradients, 0, &sizes[0]);
    tile.texture.add_to(sums.texture, sums.H_texture_unbiased, gradients, 1, &sizes[2]);
    tile.shading.add_to(shading);
    sums.correlation_ab += total(tile.correlation_ab);
    sums.correlation_aa += total(tile.correlation_aa);
    sums.correlation_bb += total(tile.correlation_bb);
}

void Problem::add(Batch& batch, const TileWeight* weights, TileSums& sums) const {
    batch.mark_textured();
    for (int first = 0; first < batch.count; first += kLanes) {
        const Lanes3 from = batch.vectors(lever, first);
        const Residuals distance = compare_points(batch, first);
        const Residuals texture = compare_textures(batch, first, distance.there, weights[1]);
        sums.distance.add(distance, from, weights[0]);
        sums.texture.add(texture, from, weights[1]);
        sums.shading.add(texture, from, weights[1]);
        const Lanes of_a = batch.lanes(value_a, first), of_b = batch.lanes(value_b, first);
        sums.correlation_ab += of_a * of_b * texture.there;
        sums.correlation_aa += of_a.square() * texture.there;
        sums.correlation_bb += of_b.square() * texture.there;
        if (!distances.empty()) keep(batch, first, distance, distances);
        if (!differences.empty()) keep(batch, first, texture, differences);
    }
}

Residuals Problem::compare_points(const Batch& batch, int first) const {
    const Lanes3 of_a = batch.vectors(normal_a, first), of_b = turned(R_float, batch.vectors(normal_b, first));
    const Lanes over_sigma = 1.0F / batch.lanes(variance, first).sqrt(), cosine = dot(of_a, of_b);
    const Lanes3 sum{of_a[0] + of_b[0], of_a[1] + of_b[1], of_a[2] + of_b[2]};
    const Lanes over_length = over_sigma / dot(sum, sum).max(kLeastSquare).sqrt();
    const auto least = static_cast<float>(o.min_cosine);
    Residuals out;
    // Behind the last pixel stands what an older batch left.
    for (int i = 0; i < kLanes; ++i) out.there[i] = first + i < batch.count && cosine[i] >= least ? 1.0F : 0.0F;
    out.residual = batch.lanes(Column::distance, first) * over_sigma;
    out.blur = batch.lanes(Column::blur, first) * over_sigma;
    for (int i = 0; i < 3; ++i) {
        out.a[i] = of_a[i] * over_sigma;
        out.b[i] = of_b[i] * over_sigma;
        out.mean[i] = sum[i] * over_length;
    }
    return out;
}

Residuals Problem::compare_textures(const Batch& batch, int first, const Lanes& there, const TileWeight& weight) const {
    const Lanes3 of_a = batch.vectors(gradient_a, first), of_b = turned(R_float, batch.vectors(gradient_b, first));
    const Lanes over_sigma = 1.0F / batch.lanes(variance_texture, first).sqrt();
    Residuals out;
    out.there = there * batch.lanes(textured, first);
    const Lanes texture_a = batch.lanes(value_a, first), texture_b = batch.lanes(value_b, first);
    out.gain = 0.5F * (texture_a + texture_b) * over_sigma;
    out.offset = over_sigma;
    out.residual = (texture_a - texture_b - weight.offset) * over_sigma - weight.gain * out.gain;
    out.blur = Lanes::Zero();
    const Lanes share_a = (1.0F - 0.5F * weight.gain) * over_sigma, share_b = (1.0F + 0.5F * weight.gain) * over_sigma;
    for (int i = 0; i < 3; ++i) {
        out.a[i] = of_a[i] * share_a;
        out.b[i] = of_b[i] * share_b;
        out.mean[i] = 0.5F * (out.a[i] + out.b[i]);
    }
    return out;
}

/// Writes residuals to where their pixels stand.
void Problem::keep(const Batch& batch, int first, const Residuals& found, const Image<float>& map) const {
    for (int i = 0; i < std::min(kLanes, batch.count - first); ++i)
        if (found.there[i] > 0) *map.at(batch.pixels[first + i][0], batch.pixels[first + i][1]) = found.residual[i];
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
        Batch batch;
        const int top = static_cast<int>(row) * options.tile;
        for (int column = 0; column < columns; ++column) {
            const std::size_t k = row * columns + column;
            problem.add_tile(top, column * options.tile, &weights[2 * k], sums, result.tile_gradients[k],
                             result.tile_sizes[k], result.tile_shading[k], batch);
        }
        return sums;
    });
    return result;
}

}  // namespace planish
