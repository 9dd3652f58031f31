#include "core/temporal_fit.hpp"

#include <Eigen/Core>
#include <algorithm>
#include <cmath>

namespace planish {
namespace {

using Group = Eigen::Array<float, kStepGroup, 1>;
using Steps = Eigen::Map<const Eigen::ArrayXf>;

constexpr int kMaxIterations = 8;
/// After a step so short the next one is the last [px]: each leaves about a tenth of its square.
constexpr double kNearlyThere = 0.1;
/// Longest single step and longest way from the start [px].
constexpr double kMaxStep = 0.75, kMaxWay = 6;
/// A slope most of which is noise tells no place.
constexpr float kMinSlopeShare = 0.2F;

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
};

Moments spline_moments(const std::array<float, 4>& w, const std::array<float, 4>& d) {
    // The coefficients are -1/6, 8/6, -1/6 of the pixels: six of them take part.
    const auto pixels = [](const std::array<float, 4>& c, std::array<float, 6>& out) {
        for (int i = 0; i < 4; ++i) {
            out[i] -= c[i] / 6;
            out[i + 1] += 8 * c[i] / 6;
            out[i + 2] -= c[i] / 6;
        }
    };
    std::array<float, 6> value{}, slope{};
    pixels(w, value);
    pixels(d, slope);
    Moments m;
    for (int i = 0; i < 6; ++i) {
        m.value += value[i] * value[i];
        m.slope += slope[i] * slope[i];
        m.cross += value[i] * slope[i];
    }
    return m;
}

Moments linear_moments(float f) { return {(1 - f) * (1 - f) + f * f, 2, 2 * f - 1}; }

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
    for (auto& tap : taps_) tap.resize(n);
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

bool TemporalFitter::sample_linear(const OwnVector& own, const CurvePiece& curve, double u) {
    const double v = curve.at(u);
    if (!(u >= 0 && v >= 0 && u < field_.width() - 1 && v < field_.height() - 1)) return false;
    const int left = static_cast<int>(u), top = static_cast<int>(v);
    const auto fu = static_cast<float>(u - left), fv = static_cast<float>(v - top);
    const auto s = static_cast<float>(curve.slope);
    sample_.weight = own.weight;
    for (int i = 0; i < 4; ++i) {
        if (*other_.usable.at(top + i / 2, left + i % 2) == 0) return false;
        if (*other_.statistics.saturated.at(top + i / 2, left + i % 2) == 0) continue;
        const std::uint16_t* grey = other_.stack.at(top + i / 2, left + i % 2);
        for (int k = 0; k < other_.stack.steps; ++k)
            if (static_cast<float>(grey[k]) >= other_.noise.saturation) sample_.weight[k] = 0;
    }
    const Steps weight(sample_.weight.data(), field_.padded());
    sample_.steps = static_cast<int>(weight.sum());
    if (sample_.steps < min_steps_) return false;
    const std::array<float, 4> value = {(1 - fu) * (1 - fv), fu * (1 - fv), (1 - fu) * fv, fu * fv};
    const std::array<float, 4> slope = {-(1 - fv) - s * (1 - fu), (1 - fv) - s * fu, -fv + s * (1 - fu), fv + s * fu};
    Eigen::Map<Eigen::ArrayXf> sum(sample_.value.data(), field_.padded()), change(sample_.slope.data(), sum.size());
    sum.setZero();
    change.setZero();
    float noise_offset = 0, noise_slope = 0;
    for (int i = 0; i < 4; ++i) {
        const std::uint16_t* grey = other_.stack.at(top + i / 2, left + i % 2);
        for (int k = 0; k < field_.padded(); ++k) taps_[i][k] = static_cast<float>(grey[k]);
        const Eigen::Map<Eigen::ArrayXf> x(taps_[i].data(), sum.size());
        const float mean = (x * weight).sum() / static_cast<float>(sample_.steps);
        centre(taps_[i], sample_.weight, sample_.steps);
        const float norm = std::sqrt(x.square().sum());
        if (!(norm > 0)) return false;
        sum += (value[i] / norm) * x;
        change += (slope[i] / norm) * x;
        noise_offset += value[i] * (other_.noise.offset + other_.noise.slope * mean) / (norm * norm);
        noise_slope += value[i] * other_.noise.slope / norm;
    }
    sample_.noise_offset = noise_offset;
    sample_.noise_slope = noise_slope;
    combine(linear_moments(fu), linear_moments(fv), s, sample_);
    return true;
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
    if (!(information > kMinSlopeShare * raw)) return false;
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
    // var u = sum g_k^2 (var a_k + gain^2 w var b_k) / (gain^2 (g.g)^2), g across 1 and b. The first sum holds g with its
    // own noise: that is right, for its product with the noise of the residual is part of the error.
    out.sigma = std::sqrt((across.square() * total).sum() * static_cast<float>(1 + curve.slope * curve.slope)) /
                (gain * information);
    out.misfit = (residual.square() / total).sum();
    out.loss = residual.square().sum() / aa;
    out.expected_loss = (weight * total).sum() / aa;
    out.steps = sample_.steps;
    return true;
}

TemporalFit TemporalFitter::fit(const OwnVector& own, const CurvePiece& curve, double start, bool linear) {
    TemporalFit out;
    double u = start, step = 0;
    bool spline = !linear;
    for (int i = 0; i < kMaxIterations; ++i) {
        spline = spline && sample_spline(own, curve, u);
        if (!spline && !sample_linear(own, curve, u)) return out;
        if (!solve(own, curve, false, step, out)) return out;
        u += std::clamp(step, -kMaxStep, kMaxStep);
        if (!(std::fabs(u - start) <= kMaxWay)) return out;
        if (std::fabs(step) < kNearlyThere) break;
    }
    if (!(spline ? sample_spline(own, curve, u) : sample_linear(own, curve, u))) return out;
    if (!solve(own, curve, true, step, out)) return out;
    out.found = std::fabs(step) < kNearlyThere;
    out.u = u + step;
    return out;
}

}  // namespace planish
