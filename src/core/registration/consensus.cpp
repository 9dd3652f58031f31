#include "core/registration/consensus.hpp"

#include <Eigen/Geometry>
#include <Eigen/SVD>
#include <algorithm>
#include <array>
#include <cmath>
#include <map>
#include <numeric>

#include "core/common/parallel.hpp"
#include "core/registration/consensus_turn.hpp"

namespace planish {
namespace {

/// Matches asked first, one after the other: where much agrees, they find it and spare most of the others.
constexpr std::size_t asked_first = 16;
/// Most promising matches that are refined; in practice few are left after those that belong to what is found.
constexpr int most_refined = 1000;

/// Per match the number of its cell in a; returns how many cells there are.
int number_cells(std::span<const FramedMatch> matches, double size, std::vector<int>& cells) {
    std::map<std::array<long, 3>, int> known;
    for (const auto& m : matches) {
        std::array<long, 3> key{};
        for (int k = 0; k < 3; ++k) key[k] = std::lround(std::floor(m.point_a[k] / size));
        cells.push_back(known.try_emplace(key, static_cast<int>(known.size())).first->second);
    }
    return static_cast<int>(known.size());
}

class Refinement {
  public:
    Refinement(std::span<const FramedMatch> matches, std::span<const int> cells, int cell_count,
               const ConsensusOptions& options)
        : matches_(matches),
          cells_(cells),
          o_(options),
          squared_tolerance_(options.tolerance * options.tolerance),
          min_normal_(std::cos(options.normal_angle)),
          min_orientation_(std::cos(options.frame_angle)),
          taken_(static_cast<std::size_t>(cell_count), 0) {}

    [[nodiscard]] bool agrees(const FramedMatch& m, const Hypothesis& h) const {
        return (m.point_a - h.R_a_b * m.point_b - h.t_a_b).squaredNorm() <= squared_tolerance_ &&
               m.frame_a.col(2).dot(h.R_a_b * m.frame_b.col(2)) >= min_normal_ &&
               m.frame_a.col(0).dot(h.R_a_b * m.frame_b.col(0)) >= min_orientation_;
    }

    /// From those that voted for a turn: a robust fit to them, then fits to all that agree, as long as they grow.
    Hypothesis refine(const std::vector<std::size_t>& voters, Hypothesis h) {
        // Graduated non-convexity (Blake and Zisserman 1987): the scale of Geman and McClure's weight shrinks.
        for (const double scale : {8.0, 4.0, 2.0, 1.0}) {
            weights_.clear();
            const double squared = scale * scale * squared_tolerance_;
            for (const std::size_t j : voters) {
                const FramedMatch& m = matches_[j];
                const double r = (m.point_a - h.R_a_b * m.point_b - h.t_a_b).squaredNorm();
                weights_.push_back(squared * squared / ((squared + r) * (squared + r)));
            }
            h = fit(voters, weights_);
        }
        count(h);
        for (int round = 0; round < 10 && h.support >= 3; ++round) {
            weights_.assign(members_.size(), 1.0);
            Hypothesis next = fit(members_, weights_);
            count(next);
            if (next.places < h.places || (next.places == h.places && next.support <= h.support)) break;
            h = next;
        }
        return h;
    }

  private:
    /// Counts the agreeing matches and their places; leaves them in `members_`.
    void count(Hypothesis& h) {
        members_.clear();
        ++stamp_;
        h.places = 0;
        for (std::size_t j = 0; j < matches_.size(); ++j) {
            if (!agrees(matches_[j], h)) continue;
            members_.push_back(j);
            int& taken = taken_[static_cast<std::size_t>(cells_[j])];
            h.places += taken != stamp_ ? 1 : 0;
            taken = stamp_;
        }
        h.support = static_cast<int>(members_.size());
    }

    /// Weighted rigid fit of points and frames (Kabsch 1976): an axis counts like a place at the distance at which its
    /// angle's error is worth the tolerance. Frames hold the rotation where all places lie on one line.
    [[nodiscard]] Hypothesis fit(const std::vector<std::size_t>& which, const std::vector<double>& weights) const {
        Eigen::Vector3d mean_a = Eigen::Vector3d::Zero(), mean_b = Eigen::Vector3d::Zero();
        double total = 0;
        for (std::size_t k = 0; k < which.size(); ++k) {
            mean_a += weights[k] * matches_[which[k]].point_a;
            mean_b += weights[k] * matches_[which[k]].point_b;
            total += weights[k];
        }
        mean_a /= total;
        mean_b /= total;
        const double orientation = squared_tolerance_ / (o_.frame_angle * o_.frame_angle);
        const double normal = squared_tolerance_ / (o_.normal_angle * o_.normal_angle);
        Eigen::Matrix3d H = Eigen::Matrix3d::Zero();
        for (std::size_t k = 0; k < which.size(); ++k) {
            const FramedMatch& m = matches_[which[k]];
            H += weights[k] * ((m.point_a - mean_a) * (m.point_b - mean_b).transpose() +
                               orientation * m.frame_a.col(0) * m.frame_b.col(0).transpose() +
                               normal * m.frame_a.col(2) * m.frame_b.col(2).transpose());
        }
        const Eigen::JacobiSVD<Eigen::Matrix3d> svd(H, Eigen::ComputeFullU | Eigen::ComputeFullV);
        Eigen::Matrix3d S = Eigen::Matrix3d::Identity();
        S(2, 2) = (svd.matrixU() * svd.matrixV().transpose()).determinant() < 0 ? -1.0 : 1.0;
        Hypothesis h;
        h.R_a_b = svd.matrixU() * S * svd.matrixV().transpose();
        h.t_a_b = mean_a - h.R_a_b * mean_b;
        return h;
    }

    std::span<const FramedMatch> matches_;
    std::span<const int> cells_;
    ConsensusOptions o_;
    double squared_tolerance_, min_normal_, min_orientation_;
    std::vector<int> taken_;
    int stamp_ = 0;
    std::vector<std::size_t> members_;
    std::vector<double> weights_;
};

Hypothesis turned(const FramedMatch& m, double turn) {
    const Eigen::Matrix3d about = Eigen::AngleAxisd(turn, Eigen::Vector3d::UnitZ()).toRotationMatrix();
    Hypothesis h;
    h.R_a_b = m.frame_a * about * m.frame_b.transpose();
    h.t_a_b = m.point_a - h.R_a_b * m.point_b;
    return h;
}

bool better(const Hypothesis& g, const Hypothesis& h) {
    return g.places != h.places ? g.places > h.places : g.support > h.support;
}

/// Alike: the places of b move by no more than a few tolerances.
bool alike(const Hypothesis& g, const Hypothesis& h, const Eigen::Vector3d& centre_b, double tolerance) {
    const double angle = Eigen::AngleAxisd(g.R_a_b.transpose() * h.R_a_b).angle();
    const double shift = ((g.R_a_b - h.R_a_b) * centre_b + g.t_a_b - h.t_a_b).norm();
    return angle < 0.05 && shift < 5.0 * tolerance;
}

}  // namespace

std::vector<Hypothesis> find_consensus(std::span<const FramedMatch> matches, const ConsensusOptions& o, int keep,
                                       int threads) {
    std::vector<int> cells;
    const int cell_count = number_cells(matches, o.distinct, cells);
    TurnVoting voting(matches, cells, cell_count, o);
    Refinement refinement(matches, cells, cell_count, o);
    std::vector<Hypothesis> found;
    Hypothesis best;
    const auto refine = [&](std::size_t i, const TurnVote& vote) {
        const Hypothesis h = refinement.refine(voting.voters(i, vote.turn), turned(matches[i], vote.turn));
        if (h.places < 3) return;
        found.push_back(h);
        if (better(h, best)) best = h;
    };
    // A better transform has a member that does not agree with the best so far: those that do need not be asked.
    const auto spared = [&](std::size_t i) { return best.places > 0 && refinement.agrees(matches[i], best); };
    for (std::size_t i = 0; i < std::min(asked_first, matches.size()); ++i) {
        if (spared(i)) continue;
        const TurnVote vote = voting.vote(i);
        if (vote.places >= 3) refine(i, vote);
    }
    std::vector<std::size_t> order;
    for (std::size_t i = 0; i < matches.size(); ++i)
        if (!spared(i)) order.push_back(i);
    std::vector<TurnVote> votes(matches.size());
    parallel_for(order.size(), threads, [&](std::size_t first, std::size_t last) {
        TurnVoting own(matches, cells, cell_count, o);
        for (std::size_t k = first; k < last; ++k) votes[order[k]] = own.vote(order[k]);
    });
    std::ranges::stable_sort(order, [&](std::size_t i, std::size_t j) { return votes[i].places > votes[j].places; });
    int refined = 0;
    for (const std::size_t i : order) {
        if (votes[i].places < 3 || refined == most_refined) break;
        if (spared(i) || std::ranges::any_of(found, [&](const Hypothesis& h) {
                return h.places >= votes[i].places && refinement.agrees(matches[i], h);
            }))
            continue;
        refine(i, votes[i]);
        ++refined;
    }
    std::ranges::stable_sort(found, better);
    Eigen::Vector3d centre = Eigen::Vector3d::Zero();
    for (const auto& m : matches) centre += m.point_b / static_cast<double>(matches.size());
    std::vector<Hypothesis> distinct;
    for (const auto& h : found) {
        if (static_cast<int>(distinct.size()) == keep) break;
        if (std::ranges::none_of(distinct, [&](const Hypothesis& g) { return alike(g, h, centre, o.tolerance); }))
            distinct.push_back(h);
    }
    return distinct;
}

}  // namespace planish
