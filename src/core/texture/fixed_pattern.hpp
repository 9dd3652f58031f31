#pragma once

#include "core/common/image.hpp"

namespace planish {

/// What several captures say about the pattern of one camera, and what is known beforehand, at blocks of pixels (h, w).
struct PatternKnowledge {
    Image<const float> sum, weight;  ///< per pixel (H, W): sum of weight * contrast and of weights over captures
    Image<const float> prior;        ///< variance of the pattern
    Image<const float> still;        ///< variance of what else stands still
    Image<const float> gain;         ///< information per weight
    int factor = 1;
};

/// sum += weight * value, weights += weight, where the value is known; `weight` (h, w) is constant over blocks.
void add_to_pattern(const Image<const float>& value, const Image<const float>& weight, int factor, int threads,
                    const Image<float>& sum, const Image<float>& weights);

/// Takes the best linear estimate of the pattern in one band of a contrast from `rest`, and adds `share` of what stays
/// uncertain of it to `uncertain`, in place. `own` (h, w): the weights with which the band itself took part in the
/// sums, which is taken out; empty: it did not.
void remove_pattern(const Image<const float>& band, const Image<const float>& own, const PatternKnowledge& known,
                    float share, int threads, const Image<float>& rest, const Image<float>& uncertain);

}  // namespace planish
