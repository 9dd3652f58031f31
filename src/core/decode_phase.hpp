#pragma once

#include <cstdint>
#include <vector>

#include "core/image.hpp"
#include "core/phase_steps.hpp"
#include "core/rejection.hpp"

namespace planish {

/// One step of the ladder from coarse to fine: the phase sum a_i phi_i of the periods, which repeats every `period_px`
/// = 1 / sum(a_i / P_i). A single period has one coefficient 1; the beat of two has 1 and -1.
struct Level {
    std::vector<int> coefficients;
    float period_px = 0;
};

constexpr int kPhaseBins = 32;

/// How far the positions of a level and the one before it disagree without any inter-reflection: the mean as a function
/// of `fold` times the coarser level's phase (harmonics of N steps repeat N times a period), which is taken from the
/// coarser position, and the variance about it.
struct Disagreement {
    std::vector<float> mean_px;  ///< kPhaseBins values; the first bin begins at half a turn
    int fold = 1;
    float variance_px2 = 0;
};

struct DecodeSettings {
    GreyNoise noise;
    float max_phase_sigma_rad = 0.2F;               ///< pixels whose finest phase is worse are dark
    float coarse_offset_px = 0;                     ///< to be taken from `coarse`
    float coarse_limit_px = 0;                      ///< largest difference of `coarse` and the first level's phase
    float range_start_px = 0, range_length_px = 0;  ///< length > 0: positions are moved by it into this range
    std::vector<Level> levels;                      ///< from the coarsest to the finest, which is a single period
    std::vector<int> averaged;                      ///< periods whose weighted mean is the position; else the last level
    std::vector<Disagreement> expected;             ///< per level from the second on, as far as it is known
    float reflection_sigmas = 0;                    ///< what disagrees by more is suspected of inter-reflection
};

struct PhaseResult {
    Image<float> position_px, sigma_px, mean, modulation;
    Image<std::uint16_t> rejected;
};

/// Absolute projector position of every pixel: N-step phases, unwrapped from level to level.
///
/// `coarse` is the position by Gray code (NaN where none), or empty: then the first level is absolute. Pixels that are
/// rejected as slips or for inter-reflection alone keep position and sigma.
template <class T>
void decode_phase(const std::vector<PhaseSteps<T>>& steps, Image<const float> coarse, const DecodeSettings& settings,
                  int threads, const PhaseResult& out);

/// What a level and the one before it say about each other in some rows; maps (rows, width).
struct DisagreementSample {
    Image<float> difference_px;  ///< coarser position minus this level's; NaN where unusable
    Image<float> sigma_px;       ///< of it by noise alone
    Image<float> cycles;         ///< the coarser level's phase / (2 pi)
};

/// Disagreement, in the given rows of the images, of the first level of which none is expected yet.
template <class T>
void sample_disagreement(const std::vector<PhaseSteps<T>>& steps, Image<const float> coarse,
                         const DecodeSettings& settings, const std::vector<int>& rows, int width, int threads,
                         const DisagreementSample& out);

}  // namespace planish
