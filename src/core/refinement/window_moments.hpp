#pragma once

#include <array>
#include <vector>

#include "core/common/image.hpp"

namespace planish {

/// Weights along one axis, all of one odd length, and which of them are taken along u and along v for each sum.
struct MomentWindow {
    std::vector<std::vector<float>> taps;
    std::vector<std::array<int, 2>> pairs;
    int step;  ///< every n-th pixel has a window, from the first one on
};

/// Sums over windows of an image, weighted by taps[pair[0]] along u times taps[pair[1]] along v (pairs, h, w); 0 lies
/// outside the image, and the last windows may be centred beyond it, by less than a step. What lies between the
/// windows' centres is not computed.
void window_moments(const Image<const float>& image, const MomentWindow& window, int threads, const Image<float>& out);

}  // namespace planish
