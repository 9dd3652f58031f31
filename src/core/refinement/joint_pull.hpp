#pragma once

#include <vector>

#include "core/refinement/joint.hpp"

namespace planish {

using Matrix63 = Eigen::Matrix<double, 6, 3>;

/// What a displacement of the points does to the gradient of the joint cost, tile by tile of b.
struct JointPull {
    std::vector<Matrix63> tiles;  ///< change of J'Wr by a displacement [mm] in frame a of all points of b in the tile
    std::vector<std::int64_t> pixel;  ///< flat index of the tile's pixel nearest to its middle that counts; -1 = none
    int tile_rows = 0, tile_columns = 0;
};

/// The derivative of `tile_gradients` of joint_normal_equations by displacements: of b's points, and with the opposite
/// sign of a's, which take their texture along. Robust weights and both look-ups change with the displacement, levers
/// and normals do not.
JointPull joint_pull(const JointMaps& a, const Camera& camera_a, const JointMaps& b, const Eigen::Matrix3d& R_a_b,
                     const Eigen::Vector3d& t_a_b, const Eigen::Vector3d& about, const JointOptions& options,
                     const std::vector<TileWeight>& weights, int threads);

}  // namespace planish
