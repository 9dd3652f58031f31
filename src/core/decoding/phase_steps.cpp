#include "core/decoding/phase_steps.hpp"

#include <Eigen/Dense>
#include <algorithm>
#include <cmath>
#include <numbers>

#include "core/common/rejection.hpp"

namespace planish {
namespace {

constexpr int kMinSteps = 3;
/// Of more steps, no subset is solved: what saturates in one of them is rejected.
constexpr std::size_t kMaxSubset = 64;
/// Solutions by least squares that are kept, found by a hash of the subset.
constexpr std::size_t kKnown = 256;
constexpr float kPerTurn = static_cast<float>(0.5 * std::numbers::inv_pi);
constexpr float kMinVariance = 1e-12F;

/// Angle of (x, y) in turns, -0.5 ... 0.5, |error| < 3e-8 turns: minimax polynomial of atan(t) / (2 pi) in t^2 over
/// 0 ... 1. The octants are put back without choices between two values, which are slow where vectorised.
inline float turns(float y, float x) {
    const float ax = std::fabs(x), ay = std::fabs(y);
    const float large = ax > ay ? ax : ay, small = ax > ay ? ay : ax;
    const float t = small / (large + 1e-30F), z = t * t;
    float a = -6.453036331e-4F;
    a = a * z + 3.479595063e-3F;
    a = a * z - 8.898719214e-3F;
    a = a * z + 1.534603070e-2F;
    a = a * z - 2.213627100e-2F;
    a = a * z + 3.174594417e-2F;
    a = a * z - 5.304612219e-2F;
    a = (a * z + 1.591548324e-1F) * t;
    a = std::fabs((ay > ax ? 0.25F : 0.0F) - a);
    a = std::fabs((x < 0 ? 0.5F : 0.0F) - a);
    return std::copysign(a, y);
}

/// Adds the grey values of `Count` images, or of `Count` pairs of opposite images, to the sums of a block.
template <int Count, bool Paired, bool First, class T>
void add_images(const T* const* images, std::size_t opposite, std::size_t offset, const float* weight_cos,
                const float* weight_sin, std::size_t count, float* __restrict sum, float* __restrict cosine,
                float* __restrict sine) {
    std::array<const T*, Count> near, far;
    std::array<float, Count> wc, ws;
    for (int k = 0; k < Count; ++k) {
        near[k] = images[k] + offset;
        far[k] = Paired ? images[k + opposite] + offset : nullptr;
        wc[k] = weight_cos[k];
        ws[k] = weight_sin[k];
    }
    for (std::size_t u = 0; u < count; ++u) {
        std::int32_t total = 0;
        float x = First ? 0.0F : cosine[u], y = First ? 0.0F : sine[u];
        for (int k = 0; k < Count; ++k) {
            const std::int32_t a = near[k][u], b = Paired ? far[k][u] : 0;
            // cos and sin of opposite steps differ in sign only.
            const float difference = static_cast<float>(a - b);
            total += a + b;
            x += wc[k] * difference;
            y += ws[k] * difference;
        }
        sum[u] = static_cast<float>(total) + (First ? 0.0F : sum[u]);
        cosine[u] = x;
        sine[u] = y;
    }
}

template <bool Paired, bool First, class T>
void add_up_to_four(std::size_t images_left, const T* const* images, std::size_t opposite, std::size_t offset,
                    const float* wc, const float* ws, std::size_t count, float* sum, float* cosine, float* sine) {
    switch (images_left) {
        case 1:
            return add_images<1, Paired, First>(images, opposite, offset, wc, ws, count, sum, cosine, sine);
        case 2:
            return add_images<2, Paired, First>(images, opposite, offset, wc, ws, count, sum, cosine, sine);
        case 3:
            return add_images<3, Paired, First>(images, opposite, offset, wc, ws, count, sum, cosine, sine);
        default:
            return add_images<4, Paired, First>(images, opposite, offset, wc, ws, count, sum, cosine, sine);
    }
}

template <bool Paired, class T>
void add_all(const PhaseSteps<T>& steps, std::size_t offset, std::size_t count, float* sum, float* cosine,
             float* sine) {
    const std::size_t opposite = steps.images.size() / 2, images = Paired ? opposite : steps.images.size();
    const float* wc = steps.cos_angle.data();
    const float* ws = steps.sin_angle.data();
    add_up_to_four<Paired, true>(images, steps.images.data(), opposite, offset, wc, ws, count, sum, cosine, sine);
    for (std::size_t k = 4; k < images; k += 4)
        add_up_to_four<Paired, false>(images - k, steps.images.data() + k, opposite, offset, wc + k, ws + k, count, sum,
                                      cosine, sine);
}

template <class T>
void keep_brighter(const T* __restrict image, std::size_t count, T* __restrict brightest) {
    for (std::size_t u = 0; u < count; ++u) brightest[u] = image[u] > brightest[u] ? image[u] : brightest[u];
}

template <class T>
T find_brightest(const PhaseSteps<T>& steps, std::size_t offset, std::size_t count, T* __restrict brightest) {
    std::copy_n(steps.images[0] + offset, count, brightest);
    for (std::size_t k = 1; k < steps.images.size(); ++k) keep_brighter(steps.images[k] + offset, count, brightest);
    T all = 0;
    for (std::size_t u = 0; u < count; ++u) all = brightest[u] > all ? brightest[u] : all;
    return all;
}

/// N-step phase (Srinivasan et al. 1984): C = 2/N sum I cos = B cos(phi), S = 2/N sum I sin = B sin(phi).
/// var(phi) = 4 / (N^2 B^2) sum sin^2(phi - angle_k) (offset + slope I_k) = 2/N (offset + slope A) / B^2; with N = 3
/// the slope's third harmonic stays: A becomes A - B cos(3 phi) / 2.
template <bool ThreeSteps>
void solve_equal_steps(float n, const GreyNoise& settings, std::size_t count, const float* __restrict sum,
                       const float* __restrict cosine, const float* __restrict sine, float* __restrict cycles,
                       float* __restrict variance, float* __restrict all, float* __restrict modulation) {
    const float scale = 2 / n, offset = settings.offset, slope = settings.slope, per_step = slope / n;
    const float turns_squared = scale * kPerTurn * kPerTurn;
    for (std::size_t u = 0; u < count; ++u) {
        const float x = scale * cosine[u], y = scale * sine[u], power = x * x + y * y;
        float noise = offset + per_step * sum[u];
        // B cos(3 phi) = x (x^2 - 3 y^2) / B^2
        if constexpr (ThreeSteps) noise -= 0.5F * slope * x * (x * x - 3 * y * y) / (power + kMinVariance);
        noise = noise > kMinVariance ? noise : kMinVariance;
        cycles[u] = turns(y, x);
        variance[u] = turns_squared * noise / (power + kMinVariance);
        all[u] += sum[u];
        modulation[u] += n * std::sqrt(power);
    }
}

}  // namespace

template <class T>
PeriodSolver<T>::PeriodSolver(const PhaseSteps<T>& steps, const GreyNoise& noise)
    : steps_(steps), noise_(noise), paired_(steps.images.size() % 2 == 0) {}

template <class T>
void PeriodSolver<T>::solve(std::size_t offset, std::size_t count, PeriodBlock& out, LightBlock& light) {
    const auto n = static_cast<float>(steps_.images.size());
    const auto add = paired_ ? add_all<true, T> : add_all<false, T>;
    add(steps_, offset, count, sum_.data(), cosine_.data(), sine_.data());
    const auto solve_steps = steps_.images.size() == 3 ? solve_equal_steps<true> : solve_equal_steps<false>;
    solve_steps(n, noise_, count, sum_.data(), cosine_.data(), sine_.data(), out.cycles.data(), out.variance.data(),
                light.sum.data(), light.modulation.data());
    if (static_cast<float>(find_brightest(steps_, offset, count, brightest_.data())) >= noise_.saturation)
        solve_saturated(offset, count, out, light);
}

/// The same by least squares over the steps below saturation; rejected where too few are left.
template <class T>
void PeriodSolver<T>::solve_saturated(std::size_t offset, std::size_t count, PeriodBlock& out, LightBlock& light) {
    const std::size_t n = steps_.images.size();
    for (std::size_t u = 0; u < count; ++u) {
        if (static_cast<float>(brightest_[u]) < noise_.saturation) continue;
        std::uint64_t subset = 0;
        for (std::size_t k = 0; k < n && n <= kMaxSubset; ++k)
            if (static_cast<float>(steps_.images[k][offset + u]) < noise_.saturation) subset |= std::uint64_t{1} << k;
        const SubsetSolution& known = solution(subset);
        if (!known.solvable) {
            light.rejected[u] |= kSaturated;
            continue;
        }
        double mean = 0, x = 0, y = 0;
        for (std::size_t k = 0; k < n; ++k) {
            const double grey = static_cast<double>(steps_.images[k][offset + u]);
            mean += known.mean[k] * grey;
            x += known.cosine[k] * grey;
            y += known.sine[k] * grey;
        }
        const double power = std::max(x * x + y * y, 1e-12);
        // d phi / d I_k = (x sine_k - y cosine_k) / B^2; the noise of the steps is independent.
        double variance = 0;
        for (std::size_t k = 0; k < n; ++k) {
            const double gain = x * known.sine[k] - y * known.cosine[k];
            const double grey = static_cast<double>(steps_.images[k][offset + u]);
            variance += gain * gain * std::max<double>(noise_.offset + noise_.slope * grey, kMinVariance);
        }
        out.cycles[u] = turns(static_cast<float>(y), static_cast<float>(x));
        out.variance[u] = static_cast<float>(variance / (power * power)) * kPerTurn * kPerTurn;
        // In place of what all steps gave.
        const auto steps = static_cast<double>(n);
        light.sum[u] += static_cast<float>(steps * mean) - sum_[u];
        light.modulation[u] += static_cast<float>(steps * std::sqrt(power)) - 2 * std::hypot(cosine_[u], sine_[u]);
    }
}

template <class T>
const SubsetSolution& PeriodSolver<T>::solution(std::uint64_t subset) {
    if (known_.empty()) known_.resize(kKnown);
    SubsetSolution& slot = known_[(subset * 0x9E3779B97F4A7C15U) >> 56U];
    if (!slot.mean.empty() && slot.subset == subset) return slot;
    const std::size_t n = steps_.images.size();
    slot.subset = subset;
    for (auto* weights : {&slot.mean, &slot.cosine, &slot.sine}) weights->assign(n, 0.0);
    Eigen::Matrix3d normal = Eigen::Matrix3d::Zero();
    int used = 0;
    const auto row = [&](std::size_t k) { return Eigen::Vector3d(1.0, steps_.cos_angle[k], steps_.sin_angle[k]); };
    for (std::size_t k = 0; k < n; ++k)
        if ((subset >> k & 1U) != 0) {
            normal += row(k) * row(k).transpose();
            ++used;
        }
    slot.solvable = used >= kMinSteps;
    if (!slot.solvable) return slot;
    const Eigen::Matrix3d inverse = normal.inverse();
    for (std::size_t k = 0; k < n; ++k)
        if ((subset >> k & 1U) != 0) {
            const Eigen::Vector3d weights = inverse * row(k);
            slot.mean[k] = weights[0];
            slot.cosine[k] = weights[1];
            slot.sine[k] = weights[2];
        }
    return slot;
}

template class PeriodSolver<std::uint8_t>;
template class PeriodSolver<std::uint16_t>;

}  // namespace planish
