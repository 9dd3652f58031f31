#pragma once

#include <array>
#include <cstdint>
#include <vector>

#include "core/refinement/joint.hpp"

namespace planish {

/// Where two textures are compared: what the residual at any weights follows from.
struct TextureSample {
    float a, b;        ///< both textures
    float over_sigma;  ///< 1 / standard deviation of their difference by noise
};

struct JointSamples {
    /// Number and sum of absolute values of the residuals over their noise per tile: distance, texture; unweighted.
    std::vector<std::array<double, 4>> tile_sizes;
    std::vector<TextureSample> textures;  ///< tile by tile
    std::vector<std::int64_t> counts;     ///< of samples per tile
    int tile_rows = 0, tile_columns = 0;
};

/// The residuals of `joint_normal_equations` at weights that are all alike, without their derivatives.
JointSamples joint_samples(const JointMaps& a, const Camera& camera_a, const JointMaps& b, const Eigen::Matrix3d& R_a_b,
                           const Eigen::Vector3d& t_a_b, const JointOptions& options, int threads);

}  // namespace planish
