#include "core/consensus.hpp"

#include <Eigen/Geometry>
#include <Eigen/SVD>
#include <algorithm>
#include <cmath>
#include <numeric>

#include "core/parallel.hpp"

namespace planish {

bool agrees(const FramedMatch& match, const Eigen::Matrix3d& R, const Eigen::Vector3d& t, double tolerance,
            double min_normal_cosine) {
    return (match.point_a - R * match.point_b - t).squaredNorm() <= tolerance * tolerance &&
           match.frame_a.col(2).dot(R * match.frame_b.col(2)) >= min_normal_cosine;
}

namespace {

int count_support(std::span<const FramedMatch> matches, const Hypothesis& h, double tolerance, double min_cosine) {
    int count = 0;
    for (const auto& m : matches) count += agrees(m, h.R_a_b, h.t_a_b, tolerance, min_cosine) ? 1 : 0;
    return count;
}

/// Frame from the connection of two points (x) and their mean normal (z).
Eigen::Matrix3d pair_frame(const Eigen::Vector3d& p, const Eigen::Vector3d& q, const Eigen::Vector3d& normals) {
    const Eigen::Vector3d x = (q - p).normalized();
    const Eigen::Vector3d z = (normals - normals.dot(x) * x).normalized();
    Eigen::Matrix3d frame;
    frame << x, z.cross(x), z;
    return frame;
}

Hypothesis from_pair(const FramedMatch& i, const FramedMatch& j) {
    const Eigen::Matrix3d A = pair_frame(i.point_a, j.point_a, i.frame_a.col(2) + j.frame_a.col(2));
    const Eigen::Matrix3d B = pair_frame(i.point_b, j.point_b, i.frame_b.col(2) + j.frame_b.col(2));
    Hypothesis h;
    h.R_a_b = A * B.transpose();
    h.t_a_b = 0.5 * (i.point_a + j.point_a) - h.R_a_b * (0.5 * (i.point_b + j.point_b));
    return h;
}

/// Rigid fit to the agreeing matches (Kabsch 1976), repeated until their number no longer grows.
Hypothesis refine(std::span<const FramedMatch> matches, Hypothesis best, double tolerance, double min_cosine) {
    // A normal counts like a place five tolerances away.
    const double normal_weight = 25.0 * tolerance * tolerance;
    for (int round = 0; round < 10; ++round) {
        Eigen::Vector3d mean_a = Eigen::Vector3d::Zero(), mean_b = Eigen::Vector3d::Zero();
        int n = 0;
        for (const auto& m : matches)
            if (agrees(m, best.R_a_b, best.t_a_b, tolerance, min_cosine)) {
                mean_a += m.point_a;
                mean_b += m.point_b;
                ++n;
            }
        if (n < 3) return best;
        mean_a /= n;
        mean_b /= n;
        Eigen::Matrix3d H = Eigen::Matrix3d::Zero();
        for (const auto& m : matches)
            if (agrees(m, best.R_a_b, best.t_a_b, tolerance, min_cosine)) {
                // The normals steady the fit where all agreeing places lie on one line.
                H += (m.point_a - mean_a) * (m.point_b - mean_b).transpose() +
                     normal_weight * m.frame_a.col(2) * m.frame_b.col(2).transpose();
            }
        const Eigen::JacobiSVD<Eigen::Matrix3d> svd(H, Eigen::ComputeFullU | Eigen::ComputeFullV);
        Eigen::Matrix3d S = Eigen::Matrix3d::Identity();
        S(2, 2) = (svd.matrixU() * svd.matrixV().transpose()).determinant() < 0 ? -1.0 : 1.0;
        Hypothesis next;
        next.R_a_b = svd.matrixU() * S * svd.matrixV().transpose();
        next.t_a_b = mean_a - next.R_a_b * mean_b;
        next.support = count_support(matches, next, tolerance, min_cosine);
        if (next.support <= best.support && round > 0) return best;
        if (next.support < best.support) return best;
        best = next;
    }
    return best;
}

bool alike(const Hypothesis& g, const Hypothesis& h, const Eigen::Vector3d& centre_b, double tolerance) {
    const double angle = Eigen::AngleAxisd(g.R_a_b.transpose() * h.R_a_b).angle();
    const double shift = ((g.R_a_b - h.R_a_b) * centre_b + g.t_a_b - h.t_a_b).norm();
    return angle < 0.05 && shift < 5.0 * tolerance;
}

/// For match i: which others keep distance, direction, rotation and normal under i's own transform.
void compatible(std::span<const FramedMatch> matches, std::size_t i, const ConsensusOptions& o,
                std::vector<std::size_t>& out) {
    out.clear();
    const FramedMatch& m = matches[i];
    const Eigen::Matrix3d R = m.frame_a * m.frame_b.transpose();
    const double min_normal = std::cos(o.normal_angle);
    const double min_trace = 1.0 + 2.0 * std::cos(2.0 * o.frame_angle);
    for (std::size_t j = 0; j < matches.size(); ++j) {
        const FramedMatch& n = matches[j];
        const Eigen::Vector3d a = n.point_a - m.point_a, b = n.point_b - m.point_b;
        const double length = a.norm();
        if (std::fabs(length - b.norm()) > o.tolerance) continue;
        if ((a - R * b).norm() > o.tolerance + o.frame_angle * length) continue;
        // The normal is turned by R, whose tilt errs like a normal, and must agree itself.
        if (n.frame_a.col(2).dot(R * n.frame_b.col(2)) < min_normal) continue;
        if ((R.transpose() * (n.frame_a * n.frame_b.transpose())).trace() < min_trace) continue;
        out.push_back(j);
    }
}

}  // namespace

std::vector<Hypothesis> find_consensus(std::span<const FramedMatch> matches, const ConsensusOptions& o, int keep,
                                       int threads) {
    const std::size_t count = matches.size();
    const double min_cosine = std::cos(o.normal_angle);
    std::vector<int> support(count);
    parallel_for(count, threads, [&](std::size_t first, std::size_t last) {
        std::vector<std::size_t> others;
        for (std::size_t i = first; i < last; ++i) {
            compatible(matches, i, o, others);
            support[i] = static_cast<int>(others.size());
        }
    });
    std::vector<std::size_t> order(count);
    std::iota(order.begin(), order.end(), std::size_t{0});
    std::ranges::stable_sort(order, [&](std::size_t i, std::size_t j) { return support[i] > support[j]; });
    const std::size_t seeds = std::min<std::size_t>(o.seeds, count);
    std::vector<Hypothesis> best(seeds);
    parallel_for(seeds, threads, [&](std::size_t first, std::size_t last) {
        std::vector<std::size_t> others;
        for (std::size_t s = first; s < last; ++s) {
            const std::size_t i = order[s];
            compatible(matches, i, o, others);
            std::erase_if(others, [&](std::size_t j) {
                return (matches[i].point_a - matches[j].point_a).norm() < o.min_baseline;
            });
            std::ranges::stable_sort(others, [&](std::size_t j, std::size_t k) { return support[j] > support[k]; });
            if (others.size() > static_cast<std::size_t>(o.partners)) others.resize(o.partners);
            for (const std::size_t j : others) {
                Hypothesis h = from_pair(matches[i], matches[j]);
                h.support = count_support(matches, h, o.tolerance, min_cosine);
                if (h.support > best[s].support) best[s] = h;
            }
            if (best[s].support >= 3) best[s] = refine(matches, best[s], o.tolerance, min_cosine);
        }
    });
    std::ranges::stable_sort(best, [](const Hypothesis& g, const Hypothesis& h) { return g.support > h.support; });
    Eigen::Vector3d centre = Eigen::Vector3d::Zero();
    for (const auto& m : matches) centre += m.point_b / static_cast<double>(count);
    std::vector<Hypothesis> distinct;
    for (const auto& h : best) {
        if (h.support < 3 || static_cast<int>(distinct.size()) == keep) break;
        if (std::ranges::none_of(distinct, [&](const Hypothesis& g) { return alike(g, h, centre, o.tolerance); }))
            distinct.push_back(h);
    }
    return distinct;
}

}  // namespace planish
