#pragma once

#include <cstdint>

namespace planish {

/// Bits of a pixel without a point, in the order of planish.measurement.REJECTIONS.
enum Rejection : std::uint16_t {
    kMasked = 1,
    kDark = 2,
    kSaturated = 4,
    kSlip = 8,
    kInterreflection = 16,
    kMixed = 32,
    kUnmatched = 64,
    kMismatch = 128,
    kEdge = 256,
    kIsolated = 512,
    kAmbiguous = 1024,
};

}  // namespace planish
