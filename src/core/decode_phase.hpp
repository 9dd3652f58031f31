#pragma once

#include <cstdint>
#include <vector>

#include "core/image.hpp"
#include "core/rejection.hpp"

namespace planish {

/// The images of one fringe period; step k shows I_k = A + B cos(phi - angle_k).
template <class T>
struct PhaseSteps {
    std::vector<const T*> images;
    std::vector<float> cos_angle, sin_angle;
    float period_px = 0;
};

struct DecodeSettings {
    float saturation = 255;                         ///< grey level at and above which a step is not used
    float noise_offset = 1, noise_slope = 0;        ///< variance of a grey value I: offset + slope I
    float max_phase_sigma_rad = 0.2F;               ///< pixels whose finest phase is worse are dark
    float coarse_limit_px = 0;                      ///< largest difference of `coarse` and the first period's phase
    float range_start_px = 0, range_length_px = 0;  ///< length > 0: positions are moved by it into this range
};

struct PhaseResult {
    Image<float> position_px, sigma_px, mean, modulation;
    Image<std::uint16_t> rejected;
};

/// Absolute projector position of every pixel: N-step phases, unwrapped from the longest period down.
///
/// `steps` stands from the longest period to the shortest. `coarse` is the position by Gray code (NaN where none), or
/// empty: then the first period is absolute. Pixels that are rejected for their code alone keep position and sigma.
template <class T>
void decode_phase(const std::vector<PhaseSteps<T>>& steps, Image<const float> coarse, const DecodeSettings& settings,
                  int threads, const PhaseResult& out);

extern template void decode_phase(const std::vector<PhaseSteps<std::uint8_t>>&, Image<const float>,
                                  const DecodeSettings&, int, const PhaseResult&);
extern template void decode_phase(const std::vector<PhaseSteps<std::uint16_t>>&, Image<const float>,
                                  const DecodeSettings&, int, const PhaseResult&);

}  // namespace planish
