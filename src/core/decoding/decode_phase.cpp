#include "core/decoding/decode_phase.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <memory>
#include <numbers>

#include "core/common/parallel.hpp"

namespace planish {
namespace {

constexpr float kNaN = std::numeric_limits<float>::quiet_NaN();
constexpr float kPerTurn = static_cast<float>(0.5 * std::numbers::inv_pi);
/// A slip by one period needs half a period of error: kept at 3.5 standard deviations. One pixel in 2000 that is as
/// dark as that slips; its neighbours correct it, which they cannot where all of them are rejected.
constexpr float kMaxUnwrapSigma = 0.5F / 3.5F;
/// Largest difference of two neighbouring levels' positions, in periods: half of the way to a slip.
constexpr float kMaxUnwrapDifference = 0.25F;
/// The position of these is known; only the named criteria contradict.
constexpr std::int32_t kDoubtful = kSlip | kInterreflection;

/// Nearest whole number for |x| < 2^22; unlike std::round it vectorises on every processor.
inline float fast_round(float x) {
    constexpr float kShift = 12582912.0F;
    return (x + kShift) - kShift;
}

/// A term of a sum over the periods.
struct Term {
    std::size_t period = 0;
    float weight = 0;
};

/// A level with what its step from the level before needs.
struct Step {
    float period_px = 0, limit_px = 0;
    std::vector<Term> phase;       ///< cycles of the level from the cycles of the periods
    std::vector<Term> difference;  ///< variance [px^2] of the difference to the coarser position, from their variances
};

std::vector<Step> make_steps(const DecodeSettings& settings, bool gray) {
    std::vector<Step> made;
    for (std::size_t j = 0; j < settings.levels.size(); ++j) {
        const Level& level = settings.levels[j];
        Step step{level.period_px, kMaxUnwrapDifference * level.period_px, {}, {}};
        if (j == 0) step.limit_px = gray ? settings.coarse_limit_px : level.period_px;
        for (std::size_t i = 0; i < level.coefficients.size(); ++i) {
            const auto a = static_cast<float>(level.coefficients[i]);
            if (a != 0) step.phase.push_back({i, a});
            if (j == 0) continue;
            // The two positions share phases: coarser - finer = sum (P_c c_i - P a_i) phi_i / (2 pi).
            const Level& coarser = settings.levels[j - 1];
            const float c = coarser.period_px * static_cast<float>(coarser.coefficients[i]) - level.period_px * a;
            if (c != 0) step.difference.push_back({i, c * c});
        }
        made.push_back(step);
    }
    return made;
}

struct Block {
    std::vector<PeriodBlock> periods;
    LightBlock light;
    alignas(64) BlockOf<float> position, difference, variance, weight;
    alignas(64) std::array<BlockOf<float>, 2> beat;  ///< cycles of a level that is no single period, and of the next
    const float* cycles = nullptr;                   ///< of the level
    const float* coarser_cycles = nullptr;           ///< of the level before
};

/// Weighted sum over the periods of one of their values, in `out`; or that value itself where nothing is to be summed.
const float* sum_terms(const std::vector<Term>& terms, const std::vector<PeriodBlock>& periods,
                       BlockOf<float> PeriodBlock::* values, std::size_t count, float* __restrict out) {
    if (terms.empty()) std::fill_n(out, count, 0.0F);
    for (std::size_t i = 0; i < terms.size(); ++i) {
        const float* __restrict value = (periods[terms[i].period].*values).data();
        const float weight = terms[i].weight;
        if (terms.size() == 1 && weight == 1) return value;
        if (i == 0)
            for (std::size_t u = 0; u < count; ++u) out[u] = weight * value[u];
        else
            for (std::size_t u = 0; u < count; ++u) out[u] += weight * value[u];
    }
    return out;
}

/// The first level, absolute: its positions lie within half a period of `middle`.
void place(float period, float middle, std::size_t count, const float* __restrict cycles, float* __restrict position) {
    const float center = middle / period;
    for (std::size_t u = 0; u < count; ++u) position[u] = period * (cycles[u] + fast_round(center - cycles[u]));
}

/// Position of a level with the whole periods from the position known so far, and by how much the two differ.
void unwrap(float period, float limit, std::size_t count, const float* __restrict cycles,
            const float* __restrict variance, float* __restrict position, float* __restrict difference,
            std::int32_t* __restrict rejected) {
    const float per_period = 1 / period, max_variance = (kMaxUnwrapSigma * period) * (kMaxUnwrapSigma * period);
    for (std::size_t u = 0; u < count; ++u) {
        const float guess = position[u], found = period * (cycles[u] + fast_round(guess * per_period - cycles[u]));
        const float apart = guess - found;
        const std::int32_t near = std::fabs(apart) <= limit ? 0 : kSlip;
        const std::int32_t sure = variance[u] <= max_variance ? 0 : kSlip;
        rejected[u] |= near | sure;
        position[u] = found;
        difference[u] = apart;
    }
}

/// Takes from positions what the harmonics of a level, whose phase is `cycles`, shift them by.
void correct(const PhaseFunction& shift, std::size_t count, const float* __restrict cycles,
             float* __restrict position) {
    if (shift.values_px.empty()) return;
    const auto fold = static_cast<float>(shift.fold);
    const float* __restrict values = shift.values_px.data();
    for (std::size_t u = 0; u < count; ++u) {
        const float folded = fold * cycles[u];
        // Linear between the middles of the bins; one turn more, so that nothing is negative.
        const float place = (folded - fast_round(folded) + 0.5F) * kPhaseBins + (kPhaseBins - 0.5F);
        const auto bin = static_cast<std::int32_t>(place);
        const float share = place - static_cast<float>(bin);
        const float low = values[bin & (kPhaseBins - 1)], high = values[(bin + 1) & (kPhaseBins - 1)];
        position[u] -= low + share * (high - low);
    }
}

/// Suspects pixels whose levels disagree by more than noise and harmonics explain.
void suspect(float excess_variance, float sigmas, std::size_t count, const float* __restrict variance,
             const float* __restrict difference, std::int32_t* __restrict rejected) {
    const float limit = sigmas * sigmas;
    for (std::size_t u = 0; u < count; ++u)
        rejected[u] |= difference[u] * difference[u] > limit * (variance[u] + excess_variance) ? kInterreflection : 0;
}

/// Weighted mean of the positions by several periods, whose whole periods the finest position tells.
void average(const std::vector<int>& averaged, const std::vector<Step>& singles, std::size_t count, Block& block) {
    float* __restrict sum = block.difference.data();
    float* __restrict weights = block.weight.data();
    std::fill_n(sum, count, 0.0F);
    std::fill_n(weights, count, 0.0F);
    const float* __restrict position = block.position.data();
    for (const int i : averaged) {
        const float period = singles[i].period_px, per_period = 1 / period, square = period * period;
        const float* __restrict cycles = block.periods[i].cycles.data();
        const float* __restrict variance = block.periods[i].variance.data();
        for (std::size_t u = 0; u < count; ++u) {
            const float found = period * (cycles[u] + fast_round(position[u] * per_period - cycles[u]));
            const float weight = 1 / (square * variance[u]);
            // Differences to the finest position are small: single precision keeps them.
            sum[u] += weight * (found - position[u]);
            weights[u] += weight;
        }
    }
    float* __restrict mean = block.position.data();
    float* __restrict variance = block.variance.data();
    for (std::size_t u = 0; u < count; ++u) {
        variance[u] = 1 / weights[u];
        mean[u] += sum[u] / weights[u];
    }
}

struct RowsOut {
    float *position, *sigma, *mean, *modulation;
    std::uint16_t* rejected;
};

/// Adds darkness to the reasons; what is rejected for another is not suspected of inter-reflection.
void judge(float dark, std::size_t count, const float* __restrict finest_variance, std::int32_t* __restrict rejected) {
    for (std::size_t u = 0; u < count; ++u) {
        const std::int32_t reason = rejected[u] | (finest_variance[u] <= dark ? 0 : kDark);
        const std::int32_t other = reason & ~kInterreflection;
        rejected[u] = other != 0 ? other : reason;
    }
}

/// Positions moved into the range and their sigma; NaN where rejected, doubtful pixels aside.
void write_positions(const DecodeSettings& settings, std::size_t count, const float* __restrict position,
                     const float* __restrict variance, const std::int32_t* __restrict rejected,
                     float* __restrict out_position, float* __restrict out_sigma) {
    constexpr float kFar = std::numeric_limits<float>::infinity();
    const float length = settings.range_length_px, low = length > 0 ? settings.range_start_px : -kFar;
    const float end = length > 0 ? low + length : kFar;
    for (std::size_t u = 0; u < count; ++u) {
        const float gap = (rejected[u] & ~kDoubtful) != 0 ? kNaN : 0.0F;
        const float x = position[u], up = x < low ? length : 0.0F, down = x >= end ? length : 0.0F;
        out_position[u] = x + (up - down) + gap;
        out_sigma[u] = std::sqrt(variance[u]) + gap;
    }
}

void write_light(float images, std::size_t count, const float* __restrict sum, const float* __restrict amplitudes,
                 const std::int32_t* __restrict rejected, float* __restrict mean, float* __restrict modulation,
                 std::uint16_t* __restrict out_rejected) {
    const float weight = 1 / images;
    for (std::size_t u = 0; u < count; ++u) mean[u] = weight * sum[u];
    for (std::size_t u = 0; u < count; ++u) modulation[u] = weight * amplitudes[u];
    for (std::size_t u = 0; u < count; ++u) out_rejected[u] = static_cast<std::uint16_t>(rejected[u]);
}

/// Decodes blocks of pixels; one per thread.
template <class T>
class Decoder {
  public:
    Decoder(const std::vector<PhaseSteps<T>>& steps, Image<const float> coarse, const DecodeSettings& settings)
        : coarse_(coarse), settings_(settings), steps_(make_steps(settings, !coarse.empty())) {
        for (const auto& period : steps) {
            solvers_.push_back(std::make_unique<PeriodSolver<T>>(period, settings.noise));
            images_ += static_cast<float>(period.images.size());
            singles_.push_back({period.period_px, 0, {}, {}});
        }
        block_.periods.resize(steps.size());
    }

    /// All levels of pixels [offset, offset + count). `after_step(level, block)` sees each but the first.
    template <class AfterStep>
    void unwrap_all(std::size_t offset, std::size_t count, AfterStep&& after_step) {
        std::fill_n(block_.light.sum.begin(), count, 0.0F);
        std::fill_n(block_.light.modulation.begin(), count, 0.0F);
        std::fill_n(block_.light.rejected.begin(), count, 0);
        for (std::size_t i = 0; i < solvers_.size(); ++i)
            solvers_[i]->solve(offset, count, block_.periods[i], block_.light);
        for (std::size_t j = 0; j < steps_.size(); ++j) {
            block_.coarser_cycles = block_.cycles;
            block_.cycles =
                sum_terms(steps_[j].phase, block_.periods, &PeriodBlock::cycles, count, block_.beat[j % 2].data());
            if (j == 0 && coarse_.empty()) {
                place(steps_[0].period_px, settings_.range_start_px + 0.5F * steps_[0].period_px, count, block_.cycles,
                      block_.position.data());
                continue;
            }
            if (j == 0) take_coarse(offset, count);
            const Disagreement* expected =
                j > 0 && j <= settings_.expected.size() ? &settings_.expected[j - 1] : nullptr;
            if (expected != nullptr) correct(expected->coarser, count, block_.coarser_cycles, block_.position.data());
            sum_terms(steps_[j].difference, block_.periods, &PeriodBlock::variance, count, block_.variance.data());
            unwrap(steps_[j].period_px, steps_[j].limit_px, count, block_.cycles, block_.variance.data(),
                   block_.position.data(), block_.difference.data(), block_.light.rejected.data());
            if (expected != nullptr) {
                correct(expected->finer, count, block_.cycles, block_.difference.data());
                suspect(expected->variance_px2, settings_.reflection_sigmas, count, block_.variance.data(),
                        block_.difference.data(), block_.light.rejected.data());
            }
            if (j > 0) after_step(j, block_);
        }
    }

    void decode(std::size_t offset, std::size_t count, const RowsOut& out) {
        unwrap_all(offset, count, [](std::size_t, const Block&) {});
        const Term finest = steps_.back().phase.front();
        if (settings_.averaged.size() > 1)
            average(settings_.averaged, singles_, count, block_);
        else
            sum_terms({{finest.period, steps_.back().period_px * steps_.back().period_px}}, block_.periods,
                      &PeriodBlock::variance, count, block_.variance.data());
        const float dark = settings_.max_phase_sigma_rad * kPerTurn;
        std::int32_t* rejected = block_.light.rejected.data();
        judge(dark * dark, count, block_.periods[finest.period].variance.data(), rejected);
        write_positions(settings_, count, block_.position.data(), block_.variance.data(), rejected, out.position,
                        out.sigma);
        write_light(images_, count, block_.light.sum.data(), block_.light.modulation.data(), rejected, out.mean,
                    out.modulation, out.rejected);
    }

  private:
    void take_coarse(std::size_t offset, std::size_t count) {
        const float* coarse = coarse_.data + offset;
        for (std::size_t u = 0; u < count; ++u) block_.position[u] = coarse[u] - settings_.coarse_offset_px;
    }

    Image<const float> coarse_;
    const DecodeSettings& settings_;
    std::vector<Step> steps_, singles_;
    std::vector<std::unique_ptr<PeriodSolver<T>>> solvers_;
    float images_ = 0;
    Block block_;
};

}  // namespace

template <class T>
void decode_phase(const std::vector<PhaseSteps<T>>& steps, Image<const float> coarse, const DecodeSettings& settings,
                  int threads, const PhaseResult& out) {
    const std::size_t pixels = out.position_px.pixels();
    parallel_for((pixels + kBlock - 1) / kBlock, threads, [&](std::size_t begin, std::size_t end) {
        const auto decoder = std::make_unique<Decoder<T>>(steps, coarse, settings);
        for (std::size_t i = begin; i < end; ++i) {
            const std::size_t at = i * kBlock;
            decoder->decode(at, std::min(kBlock, pixels - at),
                            {out.position_px.data + at, out.sigma_px.data + at, out.mean.data + at,
                             out.modulation.data + at, out.rejected.data + at});
        }
    });
}

template <class T>
void sample_disagreement(const std::vector<PhaseSteps<T>>& steps, Image<const float> coarse,
                         const DecodeSettings& settings, const std::vector<int>& rows, int width, int threads,
                         const DisagreementSample& out) {
    const auto columns = static_cast<std::size_t>(width);
    parallel_for(rows.size(), threads, [&](std::size_t begin, std::size_t end) {
        const auto decoder = std::make_unique<Decoder<T>>(steps, coarse, settings);
        for (std::size_t r = begin; r < end; ++r)
            for (std::size_t u0 = 0; u0 < columns; u0 += kBlock) {
                const std::size_t count = std::min(kBlock, columns - u0);
                decoder->unwrap_all(rows[r] * columns + u0, count, [&](std::size_t level, const Block& block) {
                    if (level != settings.expected.size() + 1) return;
                    const float worst = kMaxUnwrapSigma * settings.levels[level].period_px;
                    const std::size_t at = r * columns + u0;
                    for (std::size_t u = 0; u < count; ++u) {
                        const bool usable =
                            (block.light.rejected[u] & ~kDoubtful) == 0 && block.variance[u] <= worst * worst;
                        out.difference_px.data[at + u] = usable ? block.difference[u] : kNaN;
                        out.sigma_px.data[at + u] = std::sqrt(block.variance[u]);
                        out.coarser_cycles.data[at + u] = block.coarser_cycles[u];
                        out.finer_cycles.data[at + u] = block.cycles[u];
                    }
                });
            }
    });
}

template void decode_phase(const std::vector<PhaseSteps<std::uint8_t>>&, Image<const float>, const DecodeSettings&, int,
                           const PhaseResult&);
template void decode_phase(const std::vector<PhaseSteps<std::uint16_t>>&, Image<const float>, const DecodeSettings&,
                           int, const PhaseResult&);
template void sample_disagreement(const std::vector<PhaseSteps<std::uint8_t>>&, Image<const float>,
                                  const DecodeSettings&, const std::vector<int>&, int, int, const DisagreementSample&);
template void sample_disagreement(const std::vector<PhaseSteps<std::uint16_t>>&, Image<const float>,
                                  const DecodeSettings&, const std::vector<int>&, int, int, const DisagreementSample&);

}  // namespace planish
