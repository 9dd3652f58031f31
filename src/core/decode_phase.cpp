#include "core/decode_phase.hpp"

#include <Eigen/Dense>
#include <algorithm>
#include <array>
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
    const float large = ax > ay ? ax : ay, small = ax > ay ? ay : ax;
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
    // What the whole hierarchy of periods knows so far.
    std::vector<float> known_variance;
    std::vector<std::int32_t> rejected;

    explicit Row(std::size_t width)
        : sum(width),
          c(width),
          s(width),
          brightest(width),
          phase(width),
          amplitude(width),
          variance(width),
          known_variance(width),
          rejected(width) {}
};

/// Adds `Count` images to the sums of a row in one pass: the sums, not the images, are what memory has to move.
template <int Count, class T>
void add_images(const PhaseSteps<T>& steps, std::size_t first, std::size_t offset, std::size_t width, Row& row) {
    float* __restrict sum = row.sum.data();
    float* __restrict c = row.c.data();
    float* __restrict s = row.s.data();
    float* __restrict brightest = row.brightest.data();
    std::array<const T*, Count> image;
    std::array<float, Count> wc, ws;
    for (int k = 0; k < Count; ++k) {
        image[k] = steps.images[first + k] + offset;
        wc[k] = steps.cos_angle[first + k];
        ws[k] = steps.sin_angle[first + k];
    }
    for (std::size_t u = 0; u < width; ++u) {
        float total = sum[u], x = c[u], y = s[u], largest = brightest[u];
        for (int k = 0; k < Count; ++k) {
            const float grey = static_cast<float>(image[k][u]);
            total += grey;
            x += wc[k] * grey;
            y += ws[k] * grey;
            largest = grey > largest ? grey : largest;
        }
        sum[u] = total;
        c[u] = x;
        s[u] = y;
        brightest[u] = largest;
    }
}

template <class T>
void accumulate(const PhaseSteps<T>& steps, std::size_t offset, std::size_t width, Row& row) {
    for (auto* values : {&row.sum, &row.c, &row.s, &row.brightest}) std::fill(values->begin(), values->end(), 0.0F);
    std::size_t k = 0;
    for (; k + 4 <= steps.images.size(); k += 4) add_images<4>(steps, k, offset, width, row);
    for (; k < steps.images.size(); ++k) add_images<1>(steps, k, offset, width, row);
}

/// Whether any pixel of the row reached saturation.
bool any_saturated(const Row& row, float saturation) {
    int any = 0;
    for (const float grey : row.brightest) any |= grey >= saturation ? 1 : 0;
    return any != 0;
}

/// N-step phase (Srinivasan et al. 1984): C = 2/N sum I cos = B cos(phi), S = 2/N sum I sin = B sin(phi);
/// var(phi) = 2/N var(I) / B^2, exact for a variance linear in I and N > 3.
void solve_equal_steps(float scale, float offset, float slope, std::size_t width, const float* __restrict sum,
                       const float* __restrict c, const float* __restrict s, float* __restrict phase,
                       float* __restrict amplitude, float* __restrict variance) {
    for (std::size_t u = 0; u < width; ++u) {
        const float x = scale * c[u], y = scale * s[u], power = x * x + y * y;
        const float noise = offset + slope * sum[u];
        phase[u] = fast_atan2(y, x);
        amplitude[u] = std::sqrt(power);
        variance[u] = scale * (noise > 1e-12F ? noise : 1e-12F) / (power + 1e-12F);
    }
}

void solve_equal_steps(std::size_t steps, const DecodeSettings& settings, Row& row) {
    const float n = static_cast<float>(steps);
    solve_equal_steps(2 / n, settings.noise_offset, settings.noise_slope / n, row.sum.size(), row.sum.data(),
                      row.c.data(), row.s.data(), row.phase.data(), row.amplitude.data(), row.variance.data());
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

void unwrap(const Level& level, const DecodeSettings& settings, std::size_t width, float* __restrict position,
            Row& row) {
    const float P = level.period_px, per_period = 1 / P, scale = P / (2 * kPi);
    const float max_variance = (kMaxUnwrapSigma * P) * (kMaxUnwrapSigma * P);
    const float dark = level.last ? settings.max_phase_sigma_rad * settings.max_phase_sigma_rad
                                  : std::numeric_limits<float>::infinity();
    const float middle = settings.range_start_px + 0.5F * P, limit = level.absolute ? P : level.limit_px;
    const bool absolute = level.absolute;
    const float* __restrict phase = row.phase.data();
    const float* __restrict phase_variance = row.variance.data();
    float* __restrict variance = row.known_variance.data();
    std::int32_t* __restrict rejected = row.rejected.data();
    for (std::size_t u = 0; u < width; ++u) {
        const float x = phase[u] * scale, own = phase_variance[u] * scale * scale;
        const float guess = absolute ? middle : position[u];
        const float joint = absolute ? 0.0F : variance[u] + own;
        const float unwrapped = x + P * fast_round((guess - x) * per_period);
        rejected[u] |= std::fabs(guess - unwrapped) <= limit ? 0 : kSlip;
        rejected[u] |= joint > max_variance ? kSlip : 0;
        rejected[u] |= phase_variance[u] > dark ? kDark : 0;
        position[u] = unwrapped;
        variance[u] = own;
    }
}

/// Writes the row: NaN where rejected (but for the code alone: the phase is still good), moved into the range.
void finish(const DecodeSettings& settings, std::size_t width, const Row& row, float* __restrict position,
            float* __restrict sigma, std::uint16_t* __restrict out) {
    const float start = settings.range_start_px, length = settings.range_length_px, end = start + length;
    const std::int32_t* __restrict rejected = row.rejected.data();
    const float* __restrict variance = row.known_variance.data();
    for (std::size_t u = 0; u < width; ++u) {
        const float x = position[u];
        const float moved = x < start ? x + length : (x >= end ? x - length : x);
        position[u] = (rejected[u] & ~kSlip) != 0 ? kNaN : (length > 0 ? moved : x);
        sigma[u] = (rejected[u] & ~kSlip) != 0 ? kNaN : std::sqrt(variance[u]);
    }
    for (std::size_t u = 0; u < width; ++u) out[u] = static_cast<std::uint16_t>(rejected[u]);
}

}  // namespace

template <class T>
void decode_phase(const std::vector<PhaseSteps<T>>& steps, Image<const float> coarse, const DecodeSettings& settings,
                  int threads, const PhaseResult& out) {
    const int height = out.position_px.height;
    const auto width = static_cast<std::size_t>(out.position_px.width);
    float images = 0;
    for (const auto& period : steps) images += static_cast<float>(period.images.size());

    const auto decode_row = [&](int v, Row& row) {
        float* __restrict position = out.position_px.row(v);
        float* __restrict mean = out.mean.row(v);
        float* __restrict modulation = out.modulation.row(v);
        const std::size_t offset = static_cast<std::size_t>(v) * width;
        std::fill(row.rejected.begin(), row.rejected.end(), 0);
        std::fill_n(mean, width, 0.0F);
        std::fill_n(modulation, width, 0.0F);
        // The Gray code is a cell, not a measured value: its bounds are in the limit, not in a variance.
        std::fill(row.known_variance.begin(), row.known_variance.end(), 0.0F);
        if (!coarse.empty()) std::copy_n(coarse.row(v), width, position);
        for (std::size_t i = 0; i < steps.size(); ++i) {
            const std::size_t n = steps[i].images.size();
            accumulate(steps[i], offset, width, row);
            solve_equal_steps(n, settings, row);
            if (any_saturated(row, settings.saturation))
                for (std::size_t u = 0; u < width; ++u)
                    if (row.brightest[u] >= settings.saturation &&
                        !solve_unsaturated(steps[i], offset + u, u, settings, row))
                        row.rejected[u] |= kSaturated;
            const float share = static_cast<float>(n) / images, weight = 1 / images;
            const float* __restrict sum = row.sum.data();
            const float* __restrict amplitude = row.amplitude.data();
            for (std::size_t u = 0; u < width; ++u) {
                mean[u] += weight * sum[u];
                modulation[u] += share * amplitude[u];
            }
            const bool first = i == 0;
            const Level level{steps[i].period_px,
                              first ? settings.coarse_limit_px : kMaxUnwrapDifference * steps[i].period_px,
                              first && coarse.empty(), i + 1 == steps.size()};
            unwrap(level, settings, width, position, row);
        }
        finish(settings, width, row, position, out.sigma_px.row(v), out.rejected.row(v));
    };
    parallel_for(static_cast<std::size_t>(height), threads, [&](std::size_t begin, std::size_t end) {
        Row row(width);
        for (std::size_t v = begin; v < end; ++v) decode_row(static_cast<int>(v), row);
    });
}

template void decode_phase(const std::vector<PhaseSteps<std::uint8_t>>&, Image<const float>, const DecodeSettings&, int,
                           const PhaseResult&);
template void decode_phase(const std::vector<PhaseSteps<std::uint16_t>>&, Image<const float>, const DecodeSettings&,
                           int, const PhaseResult&);

}  // namespace planish
