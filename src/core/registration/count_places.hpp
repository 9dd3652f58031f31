#pragma once

#include <Eigen/Core>
#include <span>

namespace planish {

/// How many of some points are at least `distinct` apart, chosen greedily in their order.
int count_places(std::span<const Eigen::Vector3d> points, double distinct);

}  // namespace planish
