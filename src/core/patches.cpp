#include "core/patches.hpp"

#include <Eigen/Core>
#include <algorithm>
#include <cmath>
#include <cstring>

#include "core/parallel.hpp"

namespace planish {
namespace {

/// Values that one instruction takes; rows are padded to whole vectors, so that the inner loops need no rest.
constexpr int lane = 8;
using Lanes = Eigen::Array<float, lane, 1>;
/// Offsets along x that are computed in one go: each value is loaded once for all of them.
constexpr int block = 5;

constexpr int padded(int n) { return (n + lane - 1) / lane * lane; }

/// A square of side 2 * half + 1 around a place. Beyond each row lie zeros, which the inner loops may read.
struct Square {
    int half, side, stride;
    std::vector<float> value;

    explicit Square(int half_) : half(half_), side(2 * half + 1), stride(padded(side) + padded(block) + lane) {
        value.assign(static_cast<std::size_t>(side + 1) * stride, 0.0F);
    }
    [[nodiscard]] float* row(int y) { return value.data() + static_cast<std::size_t>(y) * stride; }
    [[nodiscard]] const float* row(int y) const { return value.data() + static_cast<std::size_t>(y) * stride; }
};

/// The columns [begin, end) of each row of a disc.
struct Disc {
    std::vector<int> begin, end;

    explicit Disc(int half) {
        for (int dy = -half; dy <= half; ++dy) {
            const int reach = static_cast<int>(std::sqrt(static_cast<double>(half * half - dy * dy)));
            begin.push_back(half - reach);
            end.push_back(half + reach + 1);
        }
    }
};

/// Values of a line of the chart by linear interpolation: from (u, v) in steps (du, dv); zero outside the chart.
///
/// In passes over a few pixels each: all but the reading is vector arithmetic, which reading in between would break up.
void sample_line(const Image<const float>& chart, float u0, float v0, float du, float dv, int count,
                 float* __restrict out) {
    constexpr int ahead = 4 * lane;
    const float u_max = static_cast<float>(chart.width) - 1.001F, v_max = static_cast<float>(chart.height) - 1.001F;
    const int width = chart.width;
    std::array<float, ahead> inside, fu, fv;
    std::array<float, 2 * ahead> above, below;
    std::array<std::int32_t, ahead> at;
    for (int first = 0; first < count; first += ahead) {
        const int rest = std::min(count - first, ahead);
        for (int x = 0; x < rest; ++x) {
            const float u = u0 + static_cast<float>(first + x) * du, v = v0 + static_cast<float>(first + x) * dv;
            // Clamped, so that every read is inside; what was outside is multiplied by zero.
            const float uc = std::min(std::max(u, 0.0F), u_max), vc = std::min(std::max(v, 0.0F), v_max);
            inside[x] = (uc == u ? 1.0F : 0.0F) * (vc == v ? 1.0F : 0.0F);
            const int iu = static_cast<int>(uc), iv = static_cast<int>(vc);
            fu[x] = uc - static_cast<float>(iu);
            fv[x] = vc - static_cast<float>(iv);
            at[x] = iv * width + iu;
        }
        for (int x = 0; x < rest; ++x) {
            const float* here = chart.data + at[x];
            std::memcpy(&above[2 * x], here, 2 * sizeof(float));
            std::memcpy(&below[2 * x], here + width, 2 * sizeof(float));
        }
        for (int x = 0; x < rest; ++x) {
            const float top = above[2 * x] + fu[x] * (above[2 * x + 1] - above[2 * x]);
            const float bottom = below[2 * x] + fu[x] * (below[2 * x + 1] - below[2 * x]);
            out[first + x] = inside[x] * (top + fv[x] * (bottom - top));
        }
    }
}

/// The surroundings of a place, turned by `turn`; of a disc where one is given, which is zero outside.
void sample(const Image<const float>& chart, const PatchPlace& place, double turn, const Disc* disc, Square& out) {
    const double c = std::cos(turn), s = std::sin(turn);
    const auto& m = place.axes;
    const double ux = m[0] * c + m[1] * s, uy = m[1] * c - m[0] * s;
    const double vx = m[2] * c + m[3] * s, vy = m[3] * c - m[2] * s;
    for (int y = 0; y < out.side; ++y) {
        const int begin = disc ? disc->begin[y] : 0, end = disc ? disc->end[y] : out.side;
        const double dx = begin - out.half, dy = y - out.half;
        sample_line(chart, static_cast<float>(place.u + dx * ux + dy * uy),
                    static_cast<float>(place.v + dx * vx + dy * vy), static_cast<float>(ux), static_cast<float>(vx),
                    end - begin, out.row(y) + begin);
    }
}

/// Sums of a * b over the disc of a at the whole offsets (x, y) ... (x + block - 1, y) in b.
std::array<float, block> products(const Square& a, const Disc& disc, const Square& b, int x, int y) {
    const int shift = b.half - a.half;
    std::array<Lanes, block> sums;
    sums.fill(Lanes::Zero());
    for (int r = 0; r < a.side; ++r) {
        const float* p = a.row(r);
        const float* q = b.row(r + shift + y) + shift + x;
        for (int k = disc.begin[r] / lane * lane; k < disc.end[r]; k += lane) {
            const Lanes value = Eigen::Map<const Lanes>(p + k);
            for (int i = 0; i < block; ++i) sums[i] += value * Eigen::Map<const Lanes>(q + k + i);
        }
    }
    std::array<float, block> out;
    for (int i = 0; i < block; ++i) out[i] = sums[i].sum();
    return out;
}

/// A patch with its squares and where it has texture, as the normalisation needs them.
struct Known {
    Square value, squared, known;
    bool there = true, whole = false;  ///< whole: with texture at every pixel of what is compared

    explicit Known(int half) : value(half), squared(half), known(half) {}
    /// `pixels` is how many are compared.
    void complete(float pixels) {
        const auto size = static_cast<int>(value.value.size());
        const float* __restrict v = value.value.data();
        float* __restrict square = squared.value.data();
        float* __restrict there_is = known.value.data();
        for (int i = 0; i < size; ++i) {
            square[i] = v[i] * v[i];
            there_is[i] = v[i] != 0.0F ? 1.0F : 0.0F;
        }
        whole = Eigen::Map<const Eigen::ArrayXf>(there_is, size).sum() == pixels;
    }
};

struct Correlation {
    double value = -1.0;
    int pixels = 0;
};

/// Place of the vertex of the parabola through (-1, low), (0, middle), (1, high), within half a step.
double vertex(double low, double middle, double high) {
    const double bend = low - 2 * middle + high;
    return bend < 0 ? std::clamp(0.5 * (low - high) / bend, -0.5, 0.5) : 0.0;
}

struct Best {
    int turn = 0, x = 0, y = 0;
    double value = 0.0;
};

/// Aligns one pair after the other; the turned patches of a are kept while a stays the same.
class Aligner {
  public:
    explicit Aligner(const PatchOptions& options)
        : o(options),
          disc(options.radius),
          turned(2 * options.turns + 1, Square(options.radius)),
          energy(turned.size()),
          fan(5, Known(options.radius)),
          wide(options.radius + options.reach + 1),
          under_disc(2 * options.reach + 3) {
        for (std::size_t y = 0; y < disc.begin.size(); ++y)
            disc_pixels += static_cast<float>(disc.end[y] - disc.begin[y]);
    }

    PatchAlignment align(const Image<const float>& chart_a, const PatchPlace& a, const Image<const float>& chart_b,
                         const PatchPlace& b) {
        if (&a != of_a) turn_all(chart_a, a);
        of_a = &a;
        sample(chart_b, b, 0.0, nullptr, wide.value);
        const Best coarse = search();
        if (coarse.value <= 0.0) return {};
        wide.complete(static_cast<float>(wide.value.side * wide.value.side));
        const double middle = (coarse.turn - o.turns) * o.turn_step;
        for (int t = -2; t <= 2; ++t) {
            Known& one = fan[t + 2];
            const int whole = coarse.turn + t / 2;
            one.there = t % 2 != 0 || (whole >= 0 && whole < static_cast<int>(turned.size()));
            if (!one.there) continue;
            if (t % 2 == 0)
                one.value = turned[whole];
            else
                sample(chart_a, a, -(middle + t * 0.5 * o.turn_step), &disc, one.value);
            one.complete(disc_pixels);
            if (one.whole && wide.whole) fan_energy[t + 2] = products(one.squared, disc, wide.known, 0, 0)[0];
        }
        return fine(coarse, middle);
    }

  private:
    void turn_all(const Image<const float>& chart, const PatchPlace& place) {
        for (int t = 0; t < static_cast<int>(turned.size()); ++t) {
            // The offsets are those of b's patch, so that a is the one that is read along turned axes.
            sample(chart, place, -(t - o.turns) * o.turn_step, &disc, turned[t]);
            energy[t] = products(turned[t], disc, turned[t], 0, 0)[0];
        }
    }

    /// The greatest product over all rotations and whole offsets, relative to the energy of the turned patch.
    [[nodiscard]] Best search() const {
        Best best;
        for (int t = 0; t < static_cast<int>(turned.size()); ++t) {
            if (energy[t] <= 0) continue;
            const double scale = 1.0 / std::sqrt(energy[t]);
            for (int y = -o.reach; y <= o.reach; ++y)
                for (int x = -o.reach; x <= o.reach; x += block) {
                    const auto sums = products(turned[t], disc, wide.value, x, y);
                    for (int i = 0; i < block && x + i <= o.reach; ++i)
                        if (scale * sums[i] > best.value) best = {t, x + i, y, scale * sums[i]};
                }
        }
        return best;
    }

    /// The energies of b under the disc at the offsets (x - 1 ... x + 3, y); they serve all turns of whole patches.
    const std::array<float, block>& energy_of_b(const Known& a, int x, int y) {
        auto& kept = under_disc[y + o.reach + 1];
        if (!kept.known || kept.x != x) kept = {true, x, products(a.known, disc, wide.squared, x - 1, y)};
        return kept.energy;
    }

    /// Normalised over the pixels where both have texture, at the offsets (x - 1, y), (x, y), (x + 1, y).
    std::array<Correlation, 3> correlate(int turn, int x, int y) {
        const Known& a = fan[turn];
        const auto ab = products(a.value, disc, wide.value, x - 1, y);
        std::array<float, block> aa, bb, n;
        if (a.whole && wide.whole) {
            // What does not depend on the offset, or not on the turn, is the same sum of the same values.
            aa.fill(fan_energy[turn]);
            n.fill(disc_pixels);
            bb = energy_of_b(a, x, y);
        } else {
            aa = products(a.squared, disc, wide.known, x - 1, y);
            bb = products(a.known, disc, wide.squared, x - 1, y);
            n = products(a.known, disc, wide.known, x - 1, y);
        }
        std::array<Correlation, 3> out;
        for (int i = 0; i < 3; ++i) {
            const double norm = std::sqrt(static_cast<double>(aa[i]) * bb[i]);
            if (norm > 0) out[i] = {ab[i] / norm, static_cast<int>(n[i])};
        }
        return out;
    }

    /// The greatest correlation around the coarse one, with fractions of steps.
    [[nodiscard]] PatchAlignment fine(const Best& coarse, double middle) {
        for (auto& kept : under_disc) kept.known = false;
        Best best;
        Correlation at_best;
        for (int t = 1; t <= 3; ++t)
            for (int y = std::max(coarse.y - 1, -o.reach); y <= std::min(coarse.y + 1, o.reach); ++y) {
                const auto row = correlate(t, coarse.x, y);
                for (int i = 0; i < 3; ++i) {
                    const int x = coarse.x + i - 1;
                    if (std::abs(x) > o.reach || row[i].value <= at_best.value) continue;
                    at_best = row[i];
                    best = {t, x, y, row[i].value};
                }
            }
        if (at_best.pixels == 0) return {};
        const auto at = [&](int t, int y) { return correlate(t, best.x, y); };
        const auto row = at(best.turn, best.y);
        const double half_step = 0.5 * o.turn_step;
        const double x = best.x + vertex(row[0].value, best.value, row[2].value);
        const double y =
            best.y + vertex(at(best.turn, best.y - 1)[1].value, best.value, at(best.turn, best.y + 1)[1].value);
        double turn = middle + (best.turn - 2) * half_step;
        if (fan[best.turn - 1].there && fan[best.turn + 1].there)
            turn +=
                half_step * vertex(at(best.turn - 1, best.y)[1].value, best.value, at(best.turn + 1, best.y)[1].value);
        return {at_best.value, x, y, turn, at_best.pixels};
    }

    PatchOptions o;
    Disc disc;
    std::vector<Square> turned;
    std::vector<double> energy;
    std::vector<Known> fan;  ///< of a: half steps around the best rotation, from a whole step back to one on
    std::array<float, 5> fan_energy{};
    Known wide;  ///< of b
    /// Energies of b under the disc, by the offset along y.
    struct UnderDisc {
        bool known = false;
        int x = 0;
        std::array<float, block> energy{};
    };
    std::vector<UnderDisc> under_disc;
    float disc_pixels = 0;
    const PatchPlace* of_a = nullptr;
};

}  // namespace

std::vector<PatchAlignment> align_patches(std::span<const Image<const float>> charts_a,
                                          std::span<const Image<const float>> charts_b,
                                          std::span<const PatchPlace> places_a, std::span<const PatchPlace> places_b,
                                          std::span<const PatchPair> pairs, const PatchOptions& options, int threads) {
    std::vector<PatchAlignment> out(pairs.size());
    parallel_for(pairs.size(), threads, [&](std::size_t first, std::size_t last) {
        Aligner aligner(options);
        for (std::size_t i = first; i < last; ++i) {
            const auto [a, b] = pairs[i];
            const PatchPlace &at_a = places_a[a], &at_b = places_b[b];
            out[i] = aligner.align(charts_a[at_a.chart], at_a, charts_b[at_b.chart], at_b);
        }
    });
    return out;
}

}  // namespace planish
