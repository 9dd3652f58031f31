#include "core/registration/patches.hpp"

#include <Eigen/Core>
#include <algorithm>
#include <cmath>
#include <cstring>

#include "core/common/packets.hpp"
#include "core/common/parallel.hpp"

namespace planish {
namespace {

/// Rows are padded to so many values, whole vectors, so that the inner loops need no rest.
constexpr int lane = 8;
static_assert(lane % Packet::size == 0);
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

/// A line of places in a chart: from (u, v) in steps (du, dv).
struct Line {
    float u, v, du, dv;
};

/// Places that are gone through together: what is known of them stays in registers and in the first cache.
constexpr int together = 32;
static_assert(together % lane == 0);

/// Where places of a line lie in the chart, and the values beside each: that and its right neighbour in turn, above and
/// below it.
struct Beside {
    std::array<int, together> at;
    std::array<float, together> fu, fv, inside;
    std::array<float, 2 * static_cast<std::size_t>(together)> top, bottom;
};

/// Values along a line of the chart by linear interpolation; zero outside the chart, which it does not leave where it
/// is `whole`. What follows to the next whole vector becomes zero.
template <bool whole>
void sample_line(const Image<const float>& chart, const Line& line, int count, float* __restrict out) {
    const float u_max = static_cast<float>(chart.width) - 1.001F, v_max = static_cast<float>(chart.height) - 1.001F;
    const int width = chart.width, filled = padded(count);
    const auto last = static_cast<float>(count);
    // Copies, which nothing that is written can change.
    const float u0 = line.u, v0 = line.v, du = line.du, dv = line.dv;
    const float* __restrict data = chart.data;
    Beside beside;
    for (int first = 0; first < filled; first += together) {
        const int end = std::min(together, filled - first);
        // Loops over whole vectors, which need no rest.
        for (int begin = 0; begin < end; begin += lane)
            for (int x = begin; x < begin + lane; ++x) {
                const float step = static_cast<float>(first + x), u = u0 + step * du, v = v0 + step * dv;
                // Clamped, so that every read is inside; what was outside is multiplied by zero.
                const float uc = whole ? u : std::min(std::max(u, 0.0F), u_max),
                            vc = whole ? v : std::min(std::max(v, 0.0F), v_max);
                float inside = step < last ? 1.0F : 0.0F;
                if constexpr (!whole) inside *= (uc == u ? 1.0F : 0.0F) * (vc == v ? 1.0F : 0.0F);
                const int iu = static_cast<int>(uc), iv = static_cast<int>(vc);
                beside.inside[x] = inside;
                beside.fu[x] = uc - static_cast<float>(iu);
                beside.fv[x] = vc - static_cast<float>(iv);
                beside.at[x] = iv * width + iu;
            }
        // Two neighbours in one: half as many reads as values.
        for (int x = 0; x < end; ++x) {
            const float* from = data + beside.at[x];
            std::memcpy(&beside.top[2 * x], from, 2 * sizeof(float));
            std::memcpy(&beside.bottom[2 * x], from + width, 2 * sizeof(float));
        }
        for (int begin = 0; begin < end; begin += lane)
            for (int x = begin; x < begin + lane; ++x) {
                const float a = beside.top[2 * x], b = beside.top[2 * x + 1];
                const float c = beside.bottom[2 * x], d = beside.bottom[2 * x + 1];
                const float top = a + beside.fu[x] * (b - a), bottom = c + beside.fu[x] * (d - c);
                out[first + x] = beside.inside[x] * (top + beside.fv[x] * (bottom - top));
            }
    }
}

/// The surroundings of a place, turned by `turn`; of a disc where one is given, which is zero outside.
void sample(const Image<const float>& chart, const PatchPlace& place, double turn, const Disc* disc, Square& out) {
    const double c = std::cos(turn), s = std::sin(turn);
    const auto& m = place.axes;
    const double ux = m[0] * c + m[1] * s, uy = m[1] * c - m[0] * s;
    const double vx = m[2] * c + m[3] * s, vy = m[3] * c - m[2] * s;
    // Behind each row stands up to a vector less one.
    const double reach = out.half + lane, u_reach = reach * (std::abs(ux) + std::abs(uy)),
                 v_reach = reach * (std::abs(vx) + std::abs(vy));
    const bool whole = place.u - u_reach > 0 && place.v - v_reach > 0 && place.u + u_reach < chart.width - 2 &&
                       place.v + v_reach < chart.height - 2;
    for (int y = 0; y < out.side; ++y) {
        const int begin = disc ? disc->begin[y] : 0, end = disc ? disc->end[y] : out.side;
        const double dx = begin - out.half, dy = y - out.half;
        const Line line{static_cast<float>(place.u + dx * ux + dy * uy),
                        static_cast<float>(place.v + dx * vx + dy * vy), static_cast<float>(ux),
                        static_cast<float>(vx)};
        if (whole)
            sample_line<true>(chart, line, end - begin, out.row(y) + begin);
        else
            sample_line<false>(chart, line, end - begin, out.row(y) + begin);
    }
}

/// Sums of a * b over the disc of a at the whole offsets (x, y) ... (x + columns - 1, y + rows - 1) in b, row by row.
template <int rows, int columns>
std::array<float, static_cast<std::size_t>(rows) * columns> products(const Square& a, const Disc& disc, const Square& b,
                                                                     int x, int y) {
    const int shift = b.half - a.half, down = b.stride;
    std::array<Packet, static_cast<std::size_t>(rows) * columns> sums;
    for (int r = 0; r < a.side; ++r) {
        const float* p = a.row(r);
        const float* q = b.row(r + shift + y) + shift + x;
        for (int k = disc.begin[r] / lane * lane; k < disc.end[r]; k += Packet::size) {
            const Packet value(p + k);
            for (int j = 0; j < rows; ++j)
                for (int i = 0; i < columns; ++i)
                    sums[j * columns + i].add_product(value, Packet(q + j * down + k + i));
        }
    }
    std::array<float, static_cast<std::size_t>(rows) * columns> out;
    for (std::size_t i = 0; i < out.size(); ++i) out[i] = sums[i].sum();
    return out;
}

/// A patch with its squares and where it has texture, as the normalisation of patches with gaps needs them.
struct Known {
    Square value, squared, known;
    bool whole = false;      ///< with texture at every pixel of what is compared
    bool completed = false;  ///< whether `squared` and `known` are those of `value`

    explicit Known(int half) : value(half), squared(half), known(half) {}

    void complete() {
        if (completed) return;
        const auto size = static_cast<int>(value.value.size());
        const float* __restrict v = value.value.data();
        float* __restrict square = squared.value.data();
        float* __restrict there_is = known.value.data();
        for (int i = 0; i < size; ++i) {
            square[i] = v[i] * v[i];
            there_is[i] = v[i] != 0.0F ? 1.0F : 0.0F;
        }
        completed = true;
    }
};

/// How many values of a square are not zero.
int count_known(const Square& square) {
    int count = 0;
    for (const float value : square.value) count += value != 0.0F ? 1 : 0;
    return count;
}

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
          turned(2 * options.turns + 1, Known(options.radius)),
          energy(turned.size()),
          between(2, Known(options.radius)),
          all(options.radius),
          wide(options.radius + options.reach + 1) {
        for (int y = 0; y < all.side; ++y) {
            std::fill(all.row(y) + disc.begin[y], all.row(y) + disc.end[y], 1.0F);
            disc_pixels += disc.end[y] - disc.begin[y];
        }
    }

    PatchAlignment align(const Image<const float>& chart_a, const PatchPlace& a, const Image<const float>& chart_b,
                         const PatchPlace& b) {
        if (&a != of_a) turn_all(chart_a, a);
        of_a = &a;
        sample(chart_b, b, 0.0, nullptr, wide.value);
        wide.completed = squares_known = false;
        const Best coarse = search();
        if (coarse.value <= 0.0) return {};
        wide.whole = count_known(wide.value) == wide.value.side * wide.value.side;
        const double middle = (coarse.turn - o.turns) * o.turn_step;
        for (int side = 0; side < 2; ++side) {
            sample(chart_a, a, -(middle + (side - 0.5) * o.turn_step), &disc, between[side].value);
            finish(between[side]);
            between_energy[side] = energy_of(between[side]);
        }
        return fine(coarse, middle);
    }

  private:
    using Nine = std::array<Correlation, 9>;

    void turn_all(const Image<const float>& chart, const PatchPlace& place) {
        for (int t = 0; t < static_cast<int>(turned.size()); ++t) {
            // The offsets are those of b's patch, so that a is the one that is read along turned axes.
            sample(chart, place, -(t - o.turns) * o.turn_step, &disc, turned[t].value);
            finish(turned[t]);
            energy[t] = energy_of(turned[t]);
        }
    }
    void finish(Known& patch) const {
        patch.completed = false;
        patch.whole = count_known(patch.value) == disc_pixels;
    }
    [[nodiscard]] float energy_of(const Known& patch) const {
        return products<1, 1>(patch.value, disc, patch.value, 0, 0)[0];
    }

    /// The greatest product over all rotations and whole offsets, relative to the energy of the turned patch.
    [[nodiscard]] Best search() const {
        Best best;
        for (int t = 0; t < static_cast<int>(turned.size()); ++t) {
            if (energy[t] <= 0) continue;
            const double scale = 1.0 / std::sqrt(energy[t]);
            // Two rows at a time, and the one that is left.
            for (int y = -o.reach; y < o.reach; y += 2)
                for (int x = -o.reach; x <= o.reach; x += block)
                    keep_best(products<2, block>(turned[t].value, disc, wide.value, x, y), t, x, y, scale, best);
            for (int x = -o.reach; x <= o.reach; x += block)
                keep_best(products<1, block>(turned[t].value, disc, wide.value, x, o.reach), t, x, o.reach, scale,
                          best);
        }
        return best;
    }
    template <std::size_t count>
    void keep_best(const std::array<float, count>& sums, int turn, int x, int y, double scale, Best& best) const {
        for (int j = 0; j < static_cast<int>(count) / block; ++j)
            for (int i = 0; i < block && x + i <= o.reach; ++i)
                if (const double value = scale * sums[j * block + i]; value > best.value)
                    best = {turn, x + i, y + j, value};
    }

    /// Turned by half steps from a whole step before the best rotation (0) to one behind (4); null = not searched.
    [[nodiscard]] Known* of_turn(int t, int coarse_turn) {
        if (t % 2 != 0) return &between[t / 2];
        const int whole = coarse_turn + t / 2 - 1;
        return whole >= 0 && whole < static_cast<int>(turned.size()) ? &turned[whole] : nullptr;
    }
    [[nodiscard]] float energy_at(int t, int coarse_turn) const {
        return t % 2 != 0 ? between_energy[t / 2] : static_cast<float>(energy[coarse_turn + t / 2 - 1]);
    }

    /// Normalised over the pixels where both have texture, at the nine offsets around (x, y), row by row.
    Nine correlate(Known& a, float energy_a, int x, int y) {
        const auto ab = products<3, 3>(a.value, disc, wide.value, x - 1, y - 1);
        std::array<float, 9> aa, bb, n;
        if (a.whole && wide.whole) {
            // What does not depend on the offset, or not on the turn, is the same sum of the same values.
            aa.fill(energy_a);
            n.fill(static_cast<float>(disc_pixels));
            bb = energies_of_b(x, y);
        } else {
            a.complete();
            wide.complete();
            aa = products<3, 3>(a.squared, disc, wide.known, x - 1, y - 1);
            bb = products<3, 3>(a.known, disc, wide.squared, x - 1, y - 1);
            n = products<3, 3>(a.known, disc, wide.known, x - 1, y - 1);
        }
        Nine out;
        for (std::size_t i = 0; i < out.size(); ++i) {
            const double norm = std::sqrt(static_cast<double>(aa[i]) * bb[i]);
            if (norm > 0) out[i] = {ab[i] / norm, static_cast<int>(n[i])};
        }
        return out;
    }

    /// The energies of b under the disc at the nine offsets around (x, y); they serve all turns of whole patches.
    const std::array<float, 9>& energies_of_b(int x, int y) {
        if (!squares_known || squares_x != x || squares_y != y) {
            wide.complete();
            squares = products<3, 3>(all, disc, wide.squared, x - 1, y - 1);
            squares_known = true;
            squares_x = x;
            squares_y = y;
        }
        return squares;
    }

    /// The greatest correlation around the coarse one, with fractions of steps.
    [[nodiscard]] PatchAlignment fine(const Best& coarse, double middle) {
        Best best;
        Correlation at_best;
        std::array<Nine, 5> around;
        for (int t = 1; t <= 3; ++t) {
            around[t] = correlate(*of_turn(t, coarse.turn), energy_at(t, coarse.turn), coarse.x, coarse.y);
            for (int i = 0; i < 9; ++i) {
                const int x = coarse.x + i % 3 - 1, y = coarse.y + i / 3 - 1;
                if (std::max(std::abs(x), std::abs(y)) > o.reach || around[t][i].value <= at_best.value) continue;
                at_best = around[t][i];
                best = {t, x, y, at_best.value};
            }
        }
        if (at_best.pixels == 0) return {};
        const bool moved = best.x != coarse.x || best.y != coarse.y;
        for (int t = best.turn - 1; t <= best.turn + 1; ++t) {
            Known* turn = of_turn(t, coarse.turn);
            if (turn && (moved || t == 0 || t == 4))
                around[t] = correlate(*turn, energy_at(t, coarse.turn), best.x, best.y);
        }
        constexpr int above = 1, left = 3, here = 4, right = 5, below = 7;
        const Nine& at = around[best.turn];
        const double half_step = 0.5 * o.turn_step;
        const double x = best.x + vertex(at[left].value, best.value, at[right].value);
        const double y = best.y + vertex(at[above].value, best.value, at[below].value);
        double turn = middle + (best.turn - 2) * half_step;
        if (of_turn(best.turn - 1, coarse.turn) && of_turn(best.turn + 1, coarse.turn))
            turn +=
                half_step * vertex(around[best.turn - 1][here].value, best.value, around[best.turn + 1][here].value);
        return {at_best.value, x, y, turn, at_best.pixels};
    }

    PatchOptions o;
    Disc disc;
    std::vector<Known> turned;
    std::vector<double> energy;
    std::vector<Known> between;  ///< of a: half a step before and behind the best rotation
    std::array<float, 2> between_energy{};
    Square all;  ///< 1 on the disc
    Known wide;  ///< of b
    /// Energies of b under the disc at the nine offsets around a place.
    bool squares_known = false;
    int squares_x = 0, squares_y = 0;
    std::array<float, 9> squares{};
    int disc_pixels = 0;
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
