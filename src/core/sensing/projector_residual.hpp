#pragma once

#include <Eigen/Core>

#include "core/common/camera.hpp"
#include "core/common/image.hpp"
#include "core/common/lens.hpp"

namespace planish {

/// A projector as a third ray: where it sees the points of the organising camera's rays.
class ProjectorRay {
  public:
    /// `axis`: 0 for the projector's columns u, 1 for its rows v.
    ProjectorRay(const Camera& projector, int axis, const Eigen::Vector3d& center_own);

    /// Projector position of n points (x, y, z interleaved, [mm]) less the decoded one, and its standard deviation, of
    /// the points along their rays and of the decoding together. Single precision: 1e-4 px.
    void residual(const float* points, const float* sigma_mm, const float* position, const float* position_sigma, int n,
                  float* residual, float* residual_sigma) const;

  private:
    Lens lens_;
    Eigen::Matrix3f R_;  ///< rows: along the axis, across it, depth
    Eigen::Vector3f t_, center_;
    float focal_, focal_across_, skew_, skew_across_;
};

void projector_residual(const ProjectorRay& projector, Image<const float> points_sensor, Image<const float> sigma_mm,
                        Image<const float> position_px, Image<const float> position_sigma_px, int threads,
                        Image<float> residual_px, Image<float> residual_sigma_px);

}  // namespace planish
