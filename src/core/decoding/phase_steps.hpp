#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <vector>

#include "core/common/grey_noise.hpp"

namespace planish {

/// The images of one fringe period in equal steps; step k shows I_k = A + B cos(phi - angle_k), angle_k = sign 2 pi
/// k/N.
template <class T>
struct PhaseSteps {
    std::vector<const T*> images;
    std::vector<float> cos_angle, sin_angle;
    float period_px = 0;
};

/// Pixels that are worked on together: their intermediate values fit into the fastest cache.
constexpr std::size_t kBlock = 512;

template <class V>
using BlockOf = std::array<V, kBlock>;

/// What one period says about the pixels of a block.
struct PeriodBlock {
    alignas(64) BlockOf<float> cycles;    ///< phase / (2 pi), -0.5 ... 0.5
    alignas(64) BlockOf<float> variance;  ///< of `cycles`
};

/// Sums over all periods, and what is wrong with each pixel.
struct LightBlock {
    alignas(64) BlockOf<float> sum;         ///< of all grey values
    alignas(64) BlockOf<float> modulation;  ///< sum over the periods of N times the amplitude
    alignas(64) BlockOf<std::int32_t> rejected;
};

/// Least squares over a subset of the steps: weights of the grey values for A, B cos(phi) and B sin(phi).
struct SubsetSolution {
    std::uint64_t subset = 0;
    bool solvable = false;
    std::vector<double> mean, cosine, sine;
};

/// Phase of one period for blocks of pixels, with the memory it needs; one per thread.
template <class T>
class PeriodSolver {
  public:
    PeriodSolver(const PhaseSteps<T>& steps, const GreyNoise& noise);

    /// Solves pixels [offset, offset + count), count <= kBlock; adds to `light`, which must be set before.
    void solve(std::size_t offset, std::size_t count, PeriodBlock& out, LightBlock& light);

  private:
    void solve_saturated(std::size_t offset, std::size_t count, PeriodBlock& out, LightBlock& light);
    const SubsetSolution& solution(std::uint64_t subset);

    const PhaseSteps<T>& steps_;
    GreyNoise noise_;
    bool paired_;  ///< steps k and k + N/2 are opposite
    alignas(64) BlockOf<float> sum_, cosine_, sine_;
    alignas(64) BlockOf<T> brightest_;
    std::vector<SubsetSolution> known_;
};

extern template class PeriodSolver<std::uint8_t>;
extern template class PeriodSolver<std::uint16_t>;

}  // namespace planish
