#pragma once

#include <vector>

#include "core/common/image.hpp"

namespace planish {

/// A window over blocks, and how far a plane within it is trusted.
struct PlaneWindow {
    std::vector<float> bell;  ///< weights along one axis, an odd number, their sum 1
    float least_weight;       ///< weight in the window from which on there is a value
    float thin;               ///< added to the variance of what is known along both axes [blocks^2]
    float steepest;           ///< largest change from the mean to the plane's value, as a share of the mean
};

/// Per block the value of the plane through total / weight around it (h, w), fitted under a separable window; NaN where
/// there is too little weight. Beyond the image the weight is 0.
///
/// The plane of least squares (local linear regression: Fan and Gijbels 1996, section 3.2) needs the window's moments
/// of the weight up to the second order and of the total up to the first: all in one pass.
void local_planes(const Image<const float>& total, const Image<const float>& weight, const PlaneWindow& window,
                  int threads, const Image<float>& out);

}  // namespace planish
