#pragma once

namespace planish {

/// Variance of a grey value I: offset + slope I; steps at and above `saturation` say nothing.
struct GreyNoise {
    float offset = 1, slope = 0, saturation = 255;
};

}  // namespace planish
