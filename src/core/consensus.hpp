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
    double frame_angle;   ///< error of a single keypoint's orientation [rad]
    double normal_angle;  ///< error of a normal [rad]
    double min_baseline;  ///< shortest distance of two matches that make a hypothesis [mm]
    int seeds;            ///< matches with the most support that are tried as first of a pair
    int partners;         ///< and as second
};

struct Hypothesis {
    Eigen::Matrix3d R_a_b;
    Eigen::Vector3d t_a_b;
    int support = 0;  ///< matches within the tolerance
};

/// Transforms that many matches agree on, best first, no two of them alike.
///
/// Concept: every match alone fixes a transform through its frames, exact in position and good to `frame_angle` in
/// rotation. (1) Support: for every match count the others that keep their distance, direction and normals under its
/// transform. (2) Hypotheses: two supporting matches and their normals fix the transform to the accuracy of their
/// distance. (3) Refinement: rigid fit to all matches within the tolerance, until they no longer change. Exhaustive up
/// to `seeds` and `partners`; no random numbers.
std::vector<Hypothesis> find_consensus(std::span<const FramedMatch> matches, const ConsensusOptions& options, int keep,
                                       int threads);

/// Whether a match agrees with a transform in position and normal.
bool agrees(const FramedMatch& match, const Eigen::Matrix3d& R, const Eigen::Vector3d& t, double tolerance,
            double min_normal_cosine);

}  // namespace planish
