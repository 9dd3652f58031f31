#pragma once

#include <cstdint>
#include <vector>

#include "core/common/image.hpp"
#include "core/common/rejection.hpp"
#include "core/decoding/phase_steps.hpp"

namespace planish {

/// One step of the ladder from coarse to fine: the phase sum a_i phi_i of the periods, which repeats every `period_px`
/// = 1 / sum(a_i / P_i). A single period has one coefficient 1; the beat of two has 1 and -1.
struct Level {
    std::vector<int> coefficients;
    float period_px = 0;
};

constexpr int kPhaseBins = 32;

/// A shift of positions as a function of `fold` times a phase: harmonics of N steps repeat N times a period.
struct PhaseFunction {
    std::vector<float> values_px;  ///< kPhaseBins values, the first bin beginning at half a turn; empty: no shift
    int fold = 1;
};

/// How far the positions of a level and the one before it disagree without any inter-reflection: functions of the two
/// phases, and the variance about them that noise does not explain.
struct Disagreement {
    PhaseFunction coarser, finer;
    float variance_px2 = 0;
};

struct DecodeSettings {
    GreyNoise noise;
    float max_phase_sigma_rad = 0.2F;               ///< pixels whose finest phase is worse are dark
    float coarse_offset_px = 0;                     ///< to be taken from `coarse`
    float coarse_limit_px = 0;                      ///< largest difference of `coarse` and the first level's phase
    float range_start_px = 0, range_length_px = 0;  ///< length > 0: positions are moved by it into this range
    std::vector<Level> levels;                      ///< from the coarsest to the finest, which is a single period
    std::vector<int> averaged;           ///< periods whose weighted mean is the position; else the last level
    std::vector<Disagreement> expected;  ///< per level from the second on, as far as it is known
    float reflection_sigmas = 0;         ///< what disagrees by more is suspected of inter-reflection
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
    Image<float> difference_px;                 ///< coarser position minus this level's; NaN where unusable
    Image<float> sigma_px;                      ///< of it by noise alone
    Image<float> coarser_cycles, finer_cycles;  ///< the levels' phases / (2 pi)
};

/// Disagreement, in the given rows of the images, of the first level of which none is expected yet.
template <class T>
void sample_disagreement(const std::vector<PhaseSteps<T>>& steps, Image<const float> coarse,
                         const DecodeSettings& settings, const std::vector<int>& rows, int width, int threads,
                         const DisagreementSample& out);

}  // namespace planish
