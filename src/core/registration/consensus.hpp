#pragma once

#include <Eigen/Core>
#include <span>
#include <vector>

namespace planish {

/// A match: the same place seen in a and b, each with a local frame (columns: orientation, normal x orientation,
/// normal).
struct FramedMatch {
    Eigen::Vector3d point_a, point_b;
    Eigen::Matrix3d frame_a, frame_b;
};

struct ConsensusOptions {
    double tolerance;     ///< distance within which a match agrees with a transform [mm]
    double frame_angle;   ///< largest error of the rotation that a match's orientations give [rad]
    double normal_angle;  ///< largest error of the rotation that its normals give [rad]
    double distinct;      ///< matches in one cell of this size are one place [mm]
};

struct Hypothesis {
    Eigen::Matrix3d R_a_b;
    Eigen::Vector3d t_a_b;
    int places = 0;   ///< cells of a that hold an agreeing match
    int support = 0;  ///< agreeing matches
};

/// Transforms that the most places agree on, best first, no two of them alike.
///
/// Concept: a match alone fixes the transform through its frames but for a small turn about its normal, which its
/// orientations leave open, and a small tilt. (1) Voting: every match is asked in turn. Each other match that keeps
/// distance, height and normal says within which turns it would agree; the turn that the most places share follows from
/// sorting the ends of these intervals: matches x matches, nothing is drawn at random. (2) Refinement, most promising
/// first: a robust rigid fit to those that voted for the turn, then to all that agree, until they no longer change. A
/// match that agrees with the best transform so far is passed over: a better one has members that do not.
std::vector<Hypothesis> find_consensus(std::span<const FramedMatch> matches, const ConsensusOptions& options, int keep,
                                       int threads);

}  // namespace planish
