#include "core/sensing/temporal_fit.hpp"

#include <Eigen/Core>
#include <algorithm>
#include <cmath>

namespace planish {
namespace {

using Group = Eigen::Array<float, kStepGroup, 1>;
using Steps = Eigen::Map<const Eigen::ArrayXf>;

constexpr int kMaxIterations = 12;
/// Instead of a number of columns: the spline.
constexpr int kSpline = 0;
/// After a step so short the next one is the last [px]: each leaves about a tenth of its square.
constexpr double kNearlyThere = 0.1;
/// Longest single step and longest way from the start [px].
constexpr double kMaxStep = 0.75, kMaxWay = 6;
/// A slope most of which is noise tells no place.
constexpr float kMinSlopeShare = 0.15F;

/// Weights of the cubic B-spline for nodes at -1, 0, 1, 2 and a place f in [0, 1].
std::array<float, 4> spline(float f) {
    const float g = 1 - f;
    return {g * g * g / 6, (4 - 6 * f * f + 3 * f * f * f) / 6, (4 - 6 * g * g + 3 * g * g * g) / 6, f * f * f / 6};
}

std::array<float, 4> spline_slope(float f) {
    const float g = 1 - f;
    return {-g * g / 2, (3 * f * f - 4 * f) / 2, (4 * g - 3 * g * g) / 2, f * f / 2};
}

/// Sums of squares and products of the weights that the pixels themselves have in value and slope.
struct Moments {
    float value = 0, slope = 0, cross = 0;

    void add(float w, float d) {
        value += w * w;
        slope += d * d;
        cross += w * d;
    }
};

Moments spline_moments(const std::array<float, 4>& w, const std::array<float, 4>& d) {
    // Each coefficient is made of five pixels: eight of them take part.
    std::array<float, 8> value{}, slope{};
    for (int i = 0; i < 4; ++i)
        for (int j = 0; j < 5; ++j) {
            value[i + j] += w[i] * kQuasiInterpolant[j];
            slope[i + j] += d[i] * kQuasiInterpolant[j];
        }
    Moments m;
    for (int i = 0; i < 8; ++i) m.add(value[i], slope[i]);
    return m;
}

/// Weights of pixels at -1, 0, 1, 2 for value and slope at f in [0, 1]: cubic convolution (Keys 1981), or linear.
struct PixelWeights {
    std::array<float, 4> value{}, slope{};
    Moments moments;

    PixelWeights(float f, int taps) {
        if (taps == 4) {
            value = {((2 - f) * f - 1) * f / 2, (f * f * (3 * f - 5) + 2) / 2, f * (4 * f - 3 * f * f + 1) / 2,
                     f * f * (f - 1) / 2};
            slope = {(4 * f - 3 * f * f - 1) / 2, (9 * f * f - 10 * f) / 2, (8 * f - 9 * f * f + 1) / 2,
                     (3 * f * f - 2 * f) / 2};
        } else {
            value = {0, 1 - f, f, 0};
            slope = {0, -1, 1, 0};
        }
        for (int i = 0; i < 4; ++i) moments.add(value[i], slope[i]);
    }
};

void combine(const Moments& u, const Moments& v, float s, VectorSample& out) {
    out.value_weight = u.value * v.value;
    out.cross_weight = u.cross * v.value + s * u.value * v.cross;
    out.slope_weight = u.slope * v.value + 2 * s * u.cross * v.cross + s * s * u.value * v.slope;
}

/// Takes the mean of the steps that count away and sets the others to zero.
void centre(std::vector<float>& values, const std::vector<float>& weight, int steps) {
    Eigen::Map<Eigen::ArrayXf> x(values.data(), static_cast<Eigen::Index>(values.size()));
    const Steps w(weight.data(), x.size());
    x *= w;
    x -= w * (x.sum() / static_cast<float>(steps));
}

}  // namespace

TemporalFitter::TemporalFitter(const TemporalView& other, const UnitVectorField& field, int min_steps)
    : other_(other), field_(field), min_steps_(min_steps) {
    const auto n = static_cast<std::size_t>(field.padded());
    for (auto* values : {&sample_.value, &sample_.slope, &sample_.weight}) values->resize(n);
    pixel_.resize(n);
}

void TemporalFitter::set_noise(int u, int v) {
    const float norm = *other_.statistics.norm.at(v, u), mean = *other_.statistics.mean.at(v, u);
    sample_.noise_offset = (other_.noise.offset + other_.noise.slope * mean) / (norm * norm);
    sample_.noise_slope = other_.noise.slope / norm;
}

bool TemporalFitter::sample_spline(const OwnVector& own, const CurvePiece& curve, double u) {
    const double v = curve.at(u);
    if (!(u >= 1 && v >= 1 && u < field_.width() - 2 && v < field_.height() - 2)) return false;
    const int left = static_cast<int>(u), top = static_cast<int>(v);
    const auto fu = static_cast<float>(u - left), fv = static_cast<float>(v - top);
    const auto s = static_cast<float>(curve.slope);
    const auto wu = spline(fu), wv = spline(fv), du = spline_slope(fu), dv = spline_slope(fv);
    for (int first = 0; first < field_.padded(); first += kStepGroup) {
        Group value = Group::Zero(), slope = Group::Zero();
        for (int j = 0; j < 4; ++j) {
            const float* c = field_.at(top - 1 + j, left - 1) + first;
            for (int i = 0; i < 4; ++i, c += field_.padded()) {
                const Eigen::Map<const Group> coefficient(c);
                value += wu[i] * wv[j] * coefficient;
                slope += (du[i] * wv[j] + s * wu[i] * dv[j]) * coefficient;
            }
        }
        Eigen::Map<Group>(sample_.value.data() + first) = value;
        Eigen::Map<Group>(sample_.slope.data() + first) = slope;
    }
    if (!(sample_.value[0] == sample_.value[0])) return false;
    combine(spline_moments(wu, du), spline_moments(wv, dv), s, sample_);
    set_noise(fu < 0.5F ? left : left + 1, fv < 0.5F ? top : top + 1);
    sample_.weight = own.weight;
    sample_.steps = own.steps;
    if (own.steps < other_.stack.steps)
        for (auto* values : {&sample_.value, &sample_.slope}) centre(*values, sample_.weight, sample_.steps);
    return true;
}

/// Leaves out steps at which one of the pixels is saturated; false where a pixel is not usable or too few are left.
bool TemporalFitter::weigh_steps(const OwnVector& own, int first_u, int last_u, int top) {
    sample_.weight = own.weight;
    for (int v = top; v <= top + 1; ++v)
        for (int u = first_u; u <= last_u; ++u) {
            if (*other_.usable.at(v, u) == 0) return false;
            if (*other_.statistics.saturated.at(v, u) == 0) continue;
            const std::uint16_t* grey = other_.stack.at(v, u);
            for (int k = 0; k < other_.stack.steps; ++k)
                if (static_cast<float>(grey[k]) >= other_.noise.saturation) sample_.weight[k] = 0;
        }
    sample_.steps = static_cast<int>(Steps(sample_.weight.data(), field_.padded()).sum());
    return sample_.steps >= min_steps_;
}

bool TemporalFitter::sample_pixels(const OwnVector& own, const CurvePiece& curve, double u, int taps) {
    const double v = curve.at(u);
    const int margin = taps / 2 - 1;
    if (!(u >= margin && v >= 0 && u < field_.width() - 1 - margin && v < field_.height() - 1)) return false;
    const int left = static_cast<int>(u), top = static_cast<int>(v);
    if (!weigh_steps(own, left - margin, left + 1 + margin, top)) return false;
    const auto s = static_cast<float>(curve.slope);
    const PixelWeights wu(static_cast<float>(u - left), taps), wv(static_cast<float>(v - top), 2);
    const Steps weight(sample_.weight.data(), field_.padded());
    Eigen::Map<Eigen::ArrayXf> sum(sample_.value.data(), field_.padded()), change(sample_.slope.data(), sum.size());
    Eigen::Map<Eigen::ArrayXf> x(pixel_.data(), sum.size());
    sum.setZero();
    change.setZero();
    sample_.noise_offset = sample_.noise_slope = 0;
    for (int j = 1; j <= 2; ++j)
        for (int i = 1 - margin; i <= 2 + margin; ++i) {
            const std::uint16_t* grey = other_.stack.at(top - 1 + j, left - 1 + i);
            for (int k = 0; k < field_.padded(); ++k) pixel_[k] = static_cast<float>(grey[k]);
            // Texture is taken out by the mean: over few steps the length of the vector changes too much from pixel to
            // pixel to be interpolated away.
            const float mean = (x * weight).sum() / static_cast<float>(sample_.steps);
            if (!(mean > 0)) return false;
            x = weight * (x - mean);
            const float share = wu.value[i] * wv.value[j];
            sum += (share / mean) * x;
            change += ((wu.slope[i] * wv.value[j] + s * wu.value[i] * wv.slope[j]) / mean) * x;
            sample_.noise_offset += share * (other_.noise.offset + other_.noise.slope * mean) / (mean * mean);
            sample_.noise_slope += share * other_.noise.slope / mean;
        }
    combine(wu.moments, wv.moments, s, sample_);
    return sample_.noise_offset > 0;
}

/// One Gauss-Newton step of min |a - gain b(u) - offset|^2, gain and offset eliminated.
///
/// b and its slope g carry noise themselves, whose products do not average out; their expectations, known from the
/// noise model and the weights of the pixels, are taken away (corrected score: Nakamura, Biometrika 77, 1990). Else the
/// result would lean towards places between pixels, where interpolation makes the noise of b least.
bool TemporalFitter::solve(const OwnVector& own, const CurvePiece& curve, bool last, double& step, TemporalFit& out) {
    const auto n = static_cast<Eigen::Index>(sample_.value.size());
    const Steps a(own.centred.data(), n), b(sample_.value.data(), n), g(sample_.slope.data(), n);
    const Steps weight(sample_.weight.data(), n), variance(own.variance.data(), n);
    // Unit length and mean zero leave each pixel's noise steps - 2 dimensions.
    const float noise = static_cast<float>(sample_.steps - 2) * sample_.noise_offset;
    const float ab = (a * b).sum(), ag = (a * g).sum();
    const float bb = b.square().sum() - noise * sample_.value_weight;
    const float bg = (b * g).sum() - noise * sample_.cross_weight;
    const float raw = g.square().sum(), gg = raw - noise * sample_.slope_weight;
    if (!(bb > 0) || !(ab > 0)) return false;
    const float gain = ab / bb, information = gg - bg * bg / bb;
    out.vague = !(information > kMinSlopeShare * raw);
    if (out.vague) return false;
    step = (ag - gain * bg) / (gain * information);
    if (!last) return true;
    // Offsets: where the steps that count are fewer than those of own.centred, its mean over them differs.
    const float offset = (a * weight).sum() / static_cast<float>(sample_.steps);
    const auto other_variance =
        (gain * gain * sample_.value_weight) * (sample_.noise_offset + sample_.noise_slope * b).max(0.0F);
    const Eigen::ArrayXf total = variance + other_variance;
    const Eigen::ArrayXf residual = weight * (a - offset - gain * b);
    const Eigen::ArrayXf across = g - (bg / bb) * b;
    const float aa = (weight * (a - offset).square()).sum();
    // var u = sum g_k^2 (var a_k + gain^2 w var b_k) / (gain^2 (g.g)^2), g across 1 and b. The first sum holds g with
    // its own noise: that is right, for its product with the noise of the residual is part of the error.
    out.sigma = std::sqrt((across.square() * total).sum() * static_cast<float>(1 + curve.slope * curve.slope)) /
                (gain * information);
    out.misfit = (residual.square() / total).sum();
    out.loss = residual.square().sum() / aa;
    out.expected_loss = (weight * total).sum() / aa;
    out.steps = sample_.steps;
    return true;
}

bool TemporalFitter::sample(const OwnVector& own, const CurvePiece& curve, double u, int& taps) {
    // Once the spline or the four columns do not reach, they are not tried again: the place must not jump back and
    // forth.
    if (taps == kSpline && !sample_spline(own, curve, u)) taps = 4;
    if (taps == kSpline) return true;
    if (taps == 4 && sample_pixels(own, curve, u, taps)) return true;
    taps = 2;
    return sample_pixels(own, curve, u, taps);
}

TemporalFit TemporalFitter::fit(const OwnVector& own, const CurvePiece& curve, double start, bool linear) {
    TemporalFit out;
    double u = start, step = 0;
    int taps = linear ? 2 : kSpline;
    // The maximum lies right of `low` and left of `high`. Much noise makes the correlation bend elsewhere than
    // expected, and steps overshoot: then the middle is taken.
    double low = start - kMaxWay, high = start + kMaxWay;
    for (int i = 0; i < kMaxIterations; ++i) {
        if (!sample(own, curve, u, taps) || !solve(own, curve, false, step, out)) return out;
        (step > 0 ? low : high) = u;
        u += std::clamp(step, -kMaxStep, kMaxStep);
        if (u <= low || u >= high) u = 0.5 * (low + high);
        if (std::fabs(step) < kNearlyThere) break;
    }
    if (!sample(own, curve, u, taps) || !solve(own, curve, true, step, out)) return out;
    out.found = std::fabs(step) < kNearlyThere;
    out.u = u + step;
    return out;
}

}  // namespace planish
