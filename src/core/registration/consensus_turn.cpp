#include "core/registration/consensus_turn.hpp"

#include <algorithm>
#include <cmath>
#include <numbers>

namespace planish {

TurnVoting::TurnVoting(std::span<const FramedMatch> matches, std::span<const int> cells, int cell_count,
                       const ConsensusOptions& options)
    : matches_(matches), cells_(cells), o_(options), in_cell_(static_cast<std::size_t>(cell_count), 0) {}

void TurnVoting::collect(std::size_t i) {
    intervals_.clear();
    const FramedMatch& seed = matches_[i];
    const Eigen::Matrix3d to_a = seed.frame_a.transpose(), to_b = seed.frame_b.transpose();
    // Both matches err in position, and both in the tilt of their normals.
    const double both = 2.0 * o_.tolerance, tilt = o_.normal_angle, min_normal = std::cos(2.0 * tilt);
    for (std::size_t j = 0; j < matches_.size(); ++j) {
        const FramedMatch& other = matches_[j];
        const Eigen::Vector3d a = other.point_a - seed.point_a, b = other.point_b - seed.point_b;
        const double squared_a = a.squaredNorm(), squared_b = b.squaredNorm();
        // | |a| - |b| | <= both, without roots: (|a|^2 + |b|^2 - both^2)^2 <= 4 |a|^2 |b|^2.
        const double sum = squared_a + squared_b - both * both;
        if (sum > 0 && sum * sum > 4 * squared_a * squared_b) continue;
        const Eigen::Vector3d in_a = to_a * a, in_b = to_b * b;
        const double radius_a = std::hypot(in_a.x(), in_a.y()), radius_b = std::hypot(in_b.x(), in_b.y());
        const double radius = std::max(radius_a, radius_b), height = std::max(std::fabs(in_a.z()), std::fabs(in_b.z()));
        if (std::fabs(in_a.z() - in_b.z()) > both + tilt * radius) continue;
        // A tilt shortens the way along the surface by its square, and moves what lies high.
        const double slack = both + tilt * height + 0.5 * tilt * tilt * radius;
        if (std::fabs(radius_a - radius_b) > slack) continue;
        const double place =
            std::atan2(in_b.x() * in_a.y() - in_b.y() * in_a.x(), in_b.x() * in_a.x() + in_b.y() * in_a.y());
        const double half = slack < 2 * radius ? 2 * std::asin(slack / (2 * radius)) : std::numbers::pi;
        double low = std::max(place - half, -o_.frame_angle), high = std::min(place + half, o_.frame_angle);
        if (low > high) continue;
        // How the other match's own rotation differs from that of this one, in its frame.
        const Eigen::Matrix3d turned = (to_a * other.frame_a) * (to_b * other.frame_b).transpose();
        if (turned(2, 2) < min_normal) continue;
        const double own = std::atan2(turned(1, 0) - turned(0, 1), turned(0, 0) + turned(1, 1));
        low = std::max(low, own - o_.frame_angle);
        high = std::min(high, own + o_.frame_angle);
        if (low <= high) intervals_.push_back({j, low, high});
    }
}

TurnVote TurnVoting::vote(std::size_t i) {
    collect(i);
    ends_.clear();
    for (const auto& interval : intervals_) {
        ends_.push_back({interval.low, false, cells_[interval.match]});
        ends_.push_back({interval.high, true, cells_[interval.match]});
    }
    // At one place intervals open before others close: their ends belong to them.
    std::ranges::sort(ends_, [](const End& x, const End& y) {
        return x.at != y.at ? x.at < y.at : (x.closes != y.closes ? y.closes : x.cell < y.cell);
    });
    TurnVote best;
    int places = 0;
    for (std::size_t k = 0; k < ends_.size(); ++k) {
        int& inside = in_cell_[static_cast<std::size_t>(ends_[k].cell)];
        if (ends_[k].closes) {
            places -= --inside == 0 ? 1 : 0;
            continue;
        }
        places += inside++ == 0 ? 1 : 0;
        // Between this end and the next all of them agree; the last end closes.
        if (places > best.places) best = {0.5 * (ends_[k].at + ends_[k + 1].at), places};
    }
    return best;
}

std::vector<std::size_t> TurnVoting::voters(std::size_t i, double turn) {
    collect(i);
    std::vector<std::size_t> out;
    for (const auto& interval : intervals_)
        if (interval.low <= turn && turn <= interval.high) out.push_back(interval.match);
    return out;
}

}  // namespace planish
