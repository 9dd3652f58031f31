#include "core/decode_phase.hpp"

#include <Eigen/Dense>
#include <algorithm>
#include <cmath>
#include <limits>

#include "core/parallel.hpp"

namespace planish {
namespace {

constexpr float kPi = 3.14159265358979F;
constexpr float kNaN = std::numeric_limits<float>::quiet_NaN();
/// A slip by one period needs half a period of error: kept at 4.5 standard deviations.
constexpr float kMaxUnwrapSigma = 0.5F / 4.5F;
/// Largest difference of two neighbouring periods' positions, in periods: half of the way to a slip.
constexpr float kMaxUnwrapDifference = 0.25F;
constexpr int kMinSteps = 3;

/// Polynomial of Cephes atanf (Moshier), |error| < 3e-7 rad, without branches so that loops over it vectorise.
inline float fast_atan2(float y, float x) {
    const float ax = std::fabs(x), ay = std::fabs(y);
    const float large = std::max(ax, ay), small = std::min(ax, ay);
    const bool reduce = small > 0.414213562F * large;
    const float t = (reduce ? small - large : small) / ((reduce ? small + large : large) + 1e-30F);
    const float z = t * t;
    const float poly = ((8.05374449538e-2F * z - 1.38776856032e-1F) * z + 1.99777106478e-1F) * z - 3.33329491539e-1F;
    float a = poly * z * t + t + (reduce ? 0.25F * kPi : 0.0F);
    a = ay > ax ? 0.5F * kPi - a : a;
    a = x < 0 ? kPi - a : a;
    return y < 0 ? -a : a;
}

/// Nearest whole number for |x| < 2^22; unlike std::round it vectorises on every processor.
inline float fast_round(float x) {
    constexpr float kShift = 12582912.0F;
    return (x + kShift) - kShift;
}

/// Sums of one row and, after them, the phase of one period.
struct Row {
    std::vector<float> sum, c, s, brightest, phase, amplitude, variance;

    explicit Row(std::size_t width)
        : sum(width), c(width), s(width), brightest(width), phase(width), amplitude(width), variance(width) {}
};

template <class T>
void accumulate(const PhaseSteps<T>& steps, std::size_t offset, std::size_t width, Row& row) {
    std::fill(row.sum.begin(), row.sum.end(), 0.0F);
    std::fill(row.c.begin(), row.c.end(), 0.0F);
    std::fill(row.s.begin(), row.s.end(), 0.0F);
    std::fill(row.brightest.begin(), row.brightest.end(), 0.0F);
    float* __restrict sum = row.sum.data();
    float* __restrict c = row.c.data();
    float* __restrict s = row.s.data();
    float* __restrict brightest = row.brightest.data();
    for (std::size_t k = 0; k < steps.images.size(); ++k) {
        const T* __restrict image = steps.images[k] + offset;
        const float wc = steps.cos_angle[k], ws = steps.sin_angle[k];
        for (std::size_t u = 0; u < width; ++u) {
            const float grey = static_cast<float>(image[u]);
            sum[u] += grey;
            c[u] += wc * grey;
            s[u] += ws * grey;
            brightest[u] = std::max(brightest[u], grey);
        }
    }
}

/// N-step phase (Srinivasan et al. 1984): C = 2/N sum I cos = B cos(phi), S = 2/N sum I sin = B sin(phi);
/// var(phi) = 2/N var(I) / B^2, exact for a variance linear in I and N > 3.
void solve_equal_steps(std::size_t steps, std::size_t width, const DecodeSettings& settings, Row& row) {
    const float n = static_cast<float>(steps), scale = 2.0F / n;
    const float* __restrict sum = row.sum.data();
    const float* __restrict c = row.c.data();
    const float* __restrict s = row.s.data();
    float* __restrict phase = row.phase.data();
    float* __restrict amplitude = row.amplitude.data();
    float* __restrict variance = row.variance.data();
    for (std::size_t u = 0; u < width; ++u) {
        const float x = scale * c[u], y = scale * s[u], power = x * x + y * y;
        phase[u] = fast_atan2(y, x);
        amplitude[u] = std::sqrt(power);
        const float noise = std::max(settings.noise_offset + settings.noise_slope * sum[u] / n, 1e-12F);
        variance[u] = scale * noise / (power + 1e-12F);
    }
}

/// The same by general least squares over the steps below saturation; false where too few are left.
template <class T>
bool solve_unsaturated(const PhaseSteps<T>& steps, std::size_t pixel, std::size_t u, const DecodeSettings& settings,
                       Row& row) {
    Eigen::Matrix3d normal = Eigen::Matrix3d::Zero();
    Eigen::Vector3d right = Eigen::Vector3d::Zero();
    int used = 0;
    for (std::size_t k = 0; k < steps.images.size(); ++k) {
        const double grey = static_cast<double>(steps.images[k][pixel]);
        if (grey >= settings.saturation) continue;
        const Eigen::Vector3d a(1.0, steps.cos_angle[k], steps.sin_angle[k]);
        normal += a * a.transpose();
        right += grey * a;
        ++used;
    }
    if (used < kMinSteps) return false;
    const Eigen::Matrix3d covariance = normal.inverse();
    const Eigen::Vector3d x = covariance * right;
    const double power = x[1] * x[1] + x[2] * x[2];
    if (!x.allFinite() || power <= 0) return false;
    const Eigen::Vector3d gradient(0.0, -x[2] / power, x[1] / power);
    const double noise = std::max(settings.noise_offset + settings.noise_slope * x[0], 1e-12);
    row.phase[u] = static_cast<float>(std::atan2(x[2], x[1]));
    row.amplitude[u] = static_cast<float>(std::sqrt(power));
    row.variance[u] = static_cast<float>(noise * gradient.dot(covariance * gradient));
    return true;
}

/// Position by this period, with the whole periods from the position known so far.
struct Level {
    float period_px, limit_px;
    bool absolute, last;
};

void unwrap(const Level& level, const DecodeSettings& settings, std::size_t width, const Row& row,
            float* __restrict position, float* __restrict variance, std::uint16_t* __restrict rejected) {
    const float P = level.period_px, scale = P / (2 * kPi),
                max_variance = (kMaxUnwrapSigma * P) * (kMaxUnwrapSigma * P);
    const float dark = settings.max_phase_sigma_rad * settings.max_phase_sigma_rad;
    const float start = settings.range_start_px;
    for (std::size_t u = 0; u < width; ++u) {
        const float x = row.phase[u] * scale, own = row.variance[u] * scale * scale;
        const float guess = level.absolute ? start + 0.5F * P : position[u];
        const float joint = level.absolute ? 0.0F : variance[u] + own;
        const float unwrapped = x + P * fast_round((guess - x) / P);
        const float limit = level.absolute ? P : level.limit_px;
        const bool contradiction = !(std::fabs(guess - unwrapped) <= limit) || joint > max_variance;
        rejected[u] = static_cast<std::uint16_t>(rejected[u] | (contradiction ? kCode : 0) |
                                                 (level.last && row.variance[u] > dark ? kDark : 0));
        position[u] = unwrapped;
        variance[u] = own;
    }
}

}  // namespace

template <class T>
void decode_phase(const std::vector<PhaseSteps<T>>& steps, Image<const float> coarse, const DecodeSettings& settings,
                  int threads, const PhaseResult& out) {
    const int height = out.position_px.height;
    const auto width = static_cast<std::size_t>(out.position_px.width);
    float images = 0;
    for (const auto& period : steps) images += static_cast<float>(period.images.size());

    const auto decode_row = [&](int v, Row& row, std::vector<float>& variance) {
        float* position = out.position_px.row(v);
        float* mean = out.mean.row(v);
        float* modulation = out.modulation.row(v);
        std::uint16_t* rejected = out.rejected.row(v);
        const std::size_t offset = static_cast<std::size_t>(v) * width;
        std::fill_n(rejected, width, std::uint16_t{0});
        std::fill_n(mean, width, 0.0F);
        std::fill_n(modulation, width, 0.0F);
        // The Gray code is a cell, not a measured value: its bounds are in the limit, not in a variance.
        std::fill(variance.begin(), variance.end(), 0.0F);
        if (!coarse.empty()) std::copy_n(coarse.row(v), width, position);
        for (std::size_t i = 0; i < steps.size(); ++i) {
            const std::size_t n = steps[i].images.size();
            accumulate(steps[i], offset, width, row);
            solve_equal_steps(n, width, settings, row);
            for (std::size_t u = 0; u < width; ++u) {
                if (row.brightest[u] < settings.saturation) continue;
                if (!solve_unsaturated(steps[i], offset + u, u, settings, row)) rejected[u] |= kSaturated;
            }
            const float share = static_cast<float>(n) / images;
            for (std::size_t u = 0; u < width; ++u) {
                mean[u] += row.sum[u] / images;
                modulation[u] += share * row.amplitude[u];
            }
            const bool first = i == 0;
            const Level level{steps[i].period_px,
                              first ? settings.coarse_limit_px : kMaxUnwrapDifference * steps[i].period_px,
                              first && coarse.empty(), i + 1 == steps.size()};
            unwrap(level, settings, width, row, position, variance.data(), rejected);
        }
        const float start = settings.range_start_px, length = settings.range_length_px;
        float* sigma = out.sigma_px.row(v);
        for (std::size_t u = 0; u < width; ++u) {
            float x = position[u];
            if (length > 0) x = x < start ? x + length : (x >= start + length ? x - length : x);
            position[u] = rejected[u] ? kNaN : x;
            sigma[u] = rejected[u] ? kNaN : std::sqrt(variance[u]);
        }
    };
    parallel_for(static_cast<std::size_t>(height), threads, [&](std::size_t begin, std::size_t end) {
        Row row(width);
        std::vector<float> variance(width);
        for (std::size_t v = begin; v < end; ++v) decode_row(static_cast<int>(v), row, variance);
    });
}

template void decode_phase(const std::vector<PhaseSteps<std::uint8_t>>&, Image<const float>, const DecodeSettings&, int,
                           const PhaseResult&);
template void decode_phase(const std::vector<PhaseSteps<std::uint16_t>>&, Image<const float>, const DecodeSettings&,
                           int, const PhaseResult&);

}  // namespace planish
