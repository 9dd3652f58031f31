#include "core/joint.hpp"

#include <Eigen/Geometry>
#include <array>
#include <cmath>
#include <limits>

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
    conflicts += other.conflicts;
    return *this;
}

namespace {

struct Influence {
    double weight;  ///< psi(r) / r
    double slope;   ///< psi'(r)
};

/// Tukey's biweight: 1 at 0, 0 from 4.685 scales on (95 % efficiency under normal noise, Holland and Welsch 1977).
Influence tukey(double residual, double scale) {
    const double x = residual / (4.685 * scale), xx = x * x;
    const double y = 1.0 - xx;
    return y > 0 ? Influence{y * y, y * (1.0 - 5.0 * xx)} : Influence{0, 0};
}

struct Cell {
    int u, v;
    std::array<float, 4> w;

    Cell(double x, double y) : u(static_cast<int>(std::floor(x))), v(static_cast<int>(std::floor(y))) {
        const auto fx = static_cast<float>(x - u), fy = static_cast<float>(y - v);
        w = {(1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy};
    }
    [[nodiscard]] Eigen::Vector3d vector(const Image<const float>& map) const {
        const float *p = map.at(v, u), *q = map.at(v + 1, u);
        Eigen::Vector3d out;
        for (int i = 0; i < 3; ++i) out[i] = w[0] * p[i] + w[1] * p[i + 3] + w[2] * q[i] + w[3] * q[i + 3];
        return out;
    }
    [[nodiscard]] double scalar(const Image<const float>& map) const {
        const float *p = map.at(v, u), *q = map.at(v + 1, u);
        return w[0] * p[0] + w[1] * p[1] + w[2] * q[0] + w[3] * q[1];
    }
};

/// Cubic convolution (Keys 1981, a = -1/2); NaN where one of the 16 values is.
double cubic(const Image<const float>& map, double x, double y) {
    const int u = static_cast<int>(std::floor(x)), v = static_cast<int>(std::floor(y));
    const auto weights = [](float f) -> std::array<float, 4> {
        const float f2 = f * f, f3 = f2 * f;
        return {-0.5F * f3 + f2 - 0.5F * f, 1.5F * f3 - 2.5F * f2 + 1.0F, -1.5F * f3 + 2.0F * f2 + 0.5F * f,
                0.5F * f3 - 0.5F * f2};
    };
    const auto wx = weights(static_cast<float>(x - u)), wy = weights(static_cast<float>(y - v));
    float sum = 0;
    for (int j = 0; j < 4; ++j) {
        const float* p = map.at(v - 1 + j, u - 1);
        sum += wy[j] * (wx[0] * p[0] + wx[1] * p[1] + wx[2] * p[2] + wx[3] * p[3]);
    }
    return sum;
}

struct Problem {
    const JointMaps &a, &b;
    const Camera& camera;
    Eigen::Matrix3d R;
    Eigen::Vector3d t, about;
    JointOptions o;
    Image<float> distances, differences;

    void pixel(int v, int u, JointSums& sums, Vector6& tile) const;
    void add_texture(int v, int u, const Eigen::Vector2d& at, const Cell& cell, const Eigen::Vector3d& x,
                     JointSums& sums, Vector6& tile) const;
};

Vector6 jacobian(const Eigen::Vector3d& lever, const Eigen::Vector3d& direction) {
    const Eigen::Vector3d moment = lever.cross(direction);
    Vector6 J;
    for (int i = 0; i < 3; ++i) {
        J[i] = moment[i];
        J[i + 3] = direction[i];
    }
    return J;
}

void Problem::pixel(int v, int u, JointSums& sums, Vector6& tile) const {
    const float* p = b.points.at(v, u);
    if (std::isnan(p[2]) || *b.use.at(v, u) == 0) return;
    const Eigen::Vector3d x = R * Eigen::Vector3d(p[0], p[1], p[2]) + t;
    const Eigen::Vector3d in_camera = camera.to_camera(x);
    if (!(in_camera.z() > 0)) return;
    const Eigen::Vector2d at =
        camera.to_pixel(camera.distort({in_camera.x() / in_camera.z(), in_camera.y() / in_camera.z()}));
    if (!(at.x() >= 1 && at.y() >= 1 && at.x() < a.points.width - 2 && at.y() < a.points.height - 2)) return;
    const Cell cell(at.x(), at.y());
    if (*a.use.at(cell.v, cell.u) == 0) return;
    const Eigen::Vector3d q = cell.vector(a.points);
    const Eigen::Vector3d normal_a = cell.vector(a.normals);
    if (std::isnan(q.z()) || std::isnan(normal_a.z())) return;
    const float* n = b.normals.at(v, u);
    const Eigen::Vector3d normal_b = R * Eigen::Vector3d(n[0], n[1], n[2]);
    const double distance = normal_a.dot(x - q);
    if (std::fabs(distance) > o.max_distance || normal_a.dot(normal_b) < o.min_cosine) {
        ++sums.conflicts;
        return;
    }
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
    tile += g;
    sums.distance.cost += w * distance * distance;
    ++sums.distance.count;
    if (!distances.empty()) *distances.at(v, u) = static_cast<float>(distance);
    add_texture(v, u, at, cell, x, sums, tile);
}

void Problem::add_texture(int v, int u, const Eigen::Vector2d& at, const Cell& cell, const Eigen::Vector3d& x,
                          JointSums& sums, Vector6& tile) const {
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
    tile += g;
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
    result.tile_gradients.assign(static_cast<std::size_t>(result.tile_rows) * result.tile_columns, Vector6::Zero());
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
