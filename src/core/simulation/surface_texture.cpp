#include "core/simulation/surface_texture.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <utility>

namespace planish {

namespace {

constexpr double kBin = 4.0;  // [mm]
/// A scratch ends this many standard deviations from its middle line.
constexpr double kScratchReach = 3.5;
/// Specks and smudges are ragged: their radius varies by this share.
constexpr double kRagged = 0.25;
/// Reflectance never falls below this share of the mean: dirt is not a black hole.
constexpr double kDarkest = 0.02;

/// Integer hash with low bias (C. Wellons, Prospecting for hash functions, "lowbias32").
inline std::uint32_t mix(std::uint32_t x) {
    x ^= x >> 16;
    x *= 0x7feb352du;
    x ^= x >> 15;
    x *= 0x846ca68bu;
    return x ^ (x >> 16);
}

/// Places whose noise is computed side by side: every loop over them runs in vector registers.
constexpr int kLanes = 16;

template <int lanes>
using Floats = std::array<float, lanes>;
template <int lanes>
using Keys = std::array<std::uint32_t, lanes>;

/// Weights of the uniform cubic B-spline at the fractions f of cells.
template <int lanes>
std::array<Floats<lanes>, 4> spline_weights(const Floats<lanes>& f) {
    constexpr float sixth = 1.f / 6.f;
    std::array<Floats<lanes>, 4> w;
    for (int l = 0; l < lanes; ++l) {
        const float g = 1 - f[l], f2 = f[l] * f[l], g2 = g * g;
        w[0][l] = g2 * g * sixth;
        w[1][l] = (4 - 6 * f2 + 3 * f2 * f[l]) * sixth;
        w[2][l] = (4 - 6 * g2 + 3 * g2 * g) * sixth;
        w[3][l] = f2 * f[l] * sixth;
    }
    return w;
}

/// Cell and fraction of lattice coordinates.
template <int lanes>
void split(const std::array<double, lanes>& x, Keys<lanes>& cell, Floats<lanes>& fraction) {
    for (int l = 0; l < lanes; ++l) {
        const double whole = std::floor(x[l]);
        cell[l] = static_cast<std::uint32_t>(static_cast<std::int32_t>(whole));
        fraction[l] = static_cast<float>(x[l] - whole);
    }
}

/// Adds amplitude * noise of unit rms at the lattice coordinates (x, y) to `sum`.
template <int lanes>
void add_noise(const std::array<double, lanes>& x, const std::array<double, lanes>& y, std::uint32_t seed,
               float amplitude, Floats<lanes>& sum) {
    Keys<lanes> column, row, line;
    Floats<lanes> fx, fy, values;
    split<lanes>(x, column, fx);
    split<lanes>(y, row, fy);
    const auto wx = spline_weights<lanes>(fx), wy = spline_weights<lanes>(fy);
    // Uniform numbers in [-1, 1) have variance 1/3; the squared weights of the spline add up to 151/315 per axis.
    const auto unit = static_cast<float>(0x1p-31 * 1.7320508075688772 * 315.0 / 151.0) * amplitude;
    for (std::uint32_t j = 0; j < 4; ++j) {
        for (int l = 0; l < lanes; ++l) line[l] = mix((row[l] + j) ^ seed), values[l] = 0;
        for (std::uint32_t i = 0; i < 4; ++i) {
            for (int l = 0; l < lanes; ++l) {
                const std::uint32_t key = mix(line[l] + (column[l] + i) * 0x9E3779B9u);
                values[l] += wx[i][l] * static_cast<float>(static_cast<std::int32_t>(key));
            }
        }
        for (int l = 0; l < lanes; ++l) sum[l] += unit * wy[j][l] * values[l];
    }
}

double smooth_edge(double x) {
    x = std::clamp(x, 0.0, 1.0);
    return x * x * (3 - 2 * x);
}

}  // namespace

double lattice_noise(double x, double y, std::uint32_t seed) {
    Floats<1> sum{0};
    add_noise<1>({x}, {y}, seed, 1, sum);
    return sum[0];
}

SurfaceTexture::SurfaceTexture(double albedo, std::vector<GrainScale> grain, std::vector<Mark> marks, double half_s,
                               double half_t)
    : albedo_(albedo), grain_(std::move(grain)), marks_(std::move(marks)) {
    for (const auto& scale : grain_) {
        const double c = std::cos(scale.angle), s = std::sin(scale.angle);
        frames_.push_back({c / scale.along_mm, s / scale.along_mm, -s / scale.across_mm, c / scale.across_mm});
    }
    for (const auto& mark : marks_) mark_axes_.emplace_back(std::cos(mark.angle), std::sin(mark.angle));
    index_marks(half_s, half_t);
}

void SurfaceTexture::index_marks(double half_s, double half_t) {
    if (marks_.empty()) return;
    origin_s_ = -half_s;
    origin_t_ = -half_t;
    bins_s_ = static_cast<int>(2 * half_s / kBin) + 1;
    bins_t_ = static_cast<int>(2 * half_t / kBin) + 1;
    std::vector<std::pair<int, int>> entries;
    const auto add_disc = [&](double s, double t, double radius, int mark) {
        const auto cell = [](double x, double origin, int bins) {
            return std::clamp(static_cast<int>(std::floor((x - origin) / kBin)), -1, bins);
        };
        const int s0 = cell(s - radius, origin_s_, bins_s_), s1 = cell(s + radius, origin_s_, bins_s_);
        const int t0 = cell(t - radius, origin_t_, bins_t_), t1 = cell(t + radius, origin_t_, bins_t_);
        for (int j = std::max(t0, 0); j <= std::min(t1, bins_t_ - 1); ++j)
            for (int i = std::max(s0, 0); i <= std::min(s1, bins_s_ - 1); ++i)
                entries.emplace_back(j * bins_s_ + i, mark);
    };
    for (int m = 0; m < static_cast<int>(marks_.size()); ++m) {
        const Mark& mark = marks_[m];
        if (mark.kind != Mark::Kind::scratch) {
            add_disc(mark.s, mark.t, std::max(mark.half_length, mark.half_width) / (1 - 4 * kRagged / 2), m);
            continue;
        }
        // Discs along the bow, so that a long scratch does not fill a square of bins.
        const double c = std::cos(mark.angle), s = std::sin(mark.angle);
        for (double x = -mark.half_length; x <= mark.half_length + kBin / 2; x += kBin / 2) {
            const double y = mark.curvature * x * x;
            add_disc(mark.s + c * x - s * y, mark.t + s * x + c * y, kBin / 2 + kScratchReach * mark.half_width, m);
        }
    }
    std::sort(entries.begin(), entries.end());
    entries.erase(std::unique(entries.begin(), entries.end()), entries.end());
    bin_begin_.assign(static_cast<std::size_t>(bins_s_) * bins_t_ + 1, 0);
    for (const auto& [bin, mark] : entries) {
        ++bin_begin_[bin + 1];
        bin_marks_.push_back(mark);
    }
    for (std::size_t i = 1; i < bin_begin_.size(); ++i) bin_begin_[i] += bin_begin_[i - 1];
}

double SurfaceTexture::profile(int index, double s, double t) const {
    const Mark& mark = marks_[index];
    const double c = mark_axes_[index].x(), d = mark_axes_[index].y(), ds = s - mark.s, dt = t - mark.t;
    const double x = c * ds + d * dt, y = -d * ds + c * dt;
    if (mark.kind == Mark::Kind::scratch) {
        const double e = x / mark.half_length, q = (y - mark.curvature * x * x) / mark.half_width;
        if (e * e >= 1 || std::abs(q) > kScratchReach) return 0;
        return std::exp(-0.5 * q * q) * (1 - e * e * e * e);
    }
    const double ex = x / mark.half_length, ey = y / mark.half_width, r = std::sqrt(ex * ex + ey * ey);
    if (r > 1 / (1 - 4 * kRagged / 2)) return 0;
    const auto seed = static_cast<std::uint32_t>(static_cast<std::int64_t>(1000 * (mark.s + 7 * mark.t)));
    const double wobble = std::clamp(kRagged * lattice_noise(2 * ex, 2 * ey, seed), -2 * kRagged, 2 * kRagged);
    if (mark.kind == Mark::Kind::speck) return smooth_edge((1 - r * (1 + wobble)) / 0.4);
    // A wiped smudge: no edge, streaks inside.
    const double streaks = 0.75 + 0.25 * lattice_noise(1.5 * ex, 9 * ey, seed + 1);
    return smooth_edge(1 - r * (1 + wobble)) * streaks;
}

void SurfaceTexture::add_grain(const GrainScale& scale, const Frame& f, std::span<const double> s,
                               std::span<const double> t, std::span<double> out) const {
    const auto amplitude = static_cast<float>(scale.amplitude);
    for (std::size_t first = 0; first < out.size(); first += kLanes) {
        const std::size_t count = std::min<std::size_t>(kLanes, out.size() - first);
        std::array<double, kLanes> x{}, y{};
        Floats<kLanes> sum{};
        for (std::size_t l = 0; l < count; ++l) {
            x[l] = f.along_s * s[first + l] + f.along_t * t[first + l];
            y[l] = f.across_s * s[first + l] + f.across_t * t[first + l];
        }
        add_noise<kLanes>(x, y, scale.seed, amplitude, sum);
        for (std::size_t l = 0; l < count; ++l) out[first + l] += sum[l];
    }
}

double SurfaceTexture::marks(double s, double t) const {
    const int i = static_cast<int>(std::floor((s - origin_s_) / kBin));
    const int j = static_cast<int>(std::floor((t - origin_t_) / kBin));
    double factor = 1;
    if (i >= 0 && i < bins_s_ && j >= 0 && j < bins_t_) {
        const std::size_t bin = static_cast<std::size_t>(j) * bins_s_ + i;
        for (int k = bin_begin_[bin]; k < bin_begin_[bin + 1]; ++k) {
            factor *= 1 + marks_[bin_marks_[k]].contrast * profile(bin_marks_[k], s, t);
        }
    }
    return factor;
}

void SurfaceTexture::albedo(std::span<const double> s, std::span<const double> t, std::span<double> out) const {
    std::fill(out.begin(), out.end(), 1.0);
    for (std::size_t i = 0; i < grain_.size(); ++i) add_grain(grain_[i], frames_[i], s, t, out);
    for (std::size_t k = 0; k < out.size(); ++k) {
        const double factor = marks_.empty() ? out[k] : out[k] * marks(s[k], t[k]);
        out[k] = albedo_ * std::max(factor, kDarkest);
    }
}

}  // namespace planish
