#include "core/sensing/correspond.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <vector>

#include "core/common/lens.hpp"
#include "core/common/parallel.hpp"
#include "core/sensing/curve_search.hpp"

namespace planish {
namespace {

constexpr float kNaN = std::numeric_limits<float>::quiet_NaN();
/// A neighbour says where a pixel continues only over so many pixels of `own`.
constexpr int kMaxGap = 8;
/// Rows that follow each other's solutions; fixed, so that the result does not depend on the number of threads.
constexpr int kRowsOfBlock = 64;

using Four = Eigen::Array4f;

/// Weights of the cubic B-spline for four nodes at -1, 0, 1, 2 and a place f in [0, 1].
inline Four spline(float f) {
    const Four one(1.0F / 6, 4.0F / 6, 1.0F / 6, 0), first(-0.5F, 0, 0.5F, 0), second(0.5F, -1, 0.5F, 0),
        third(-1.0F / 6, 0.5F, -0.5F, 1.0F / 6);
    return one + f * (first + f * (second + f * third));
}

/// Sums of the squares of the weights: variance of an interpolated position over that of one pixel.
inline float spline_weight(float f) {
    const float g = 1 - f, f2 = f * f, g2 = g * g, a = g * g2, b = 4 - 6 * f2 + 3 * f * f2, c = 4 - 6 * g2 + 3 * g * g2,
                d = f * f2;
    return (a * a + b * b + c * c + d * d) / 36;
}
inline float linear_weight(float f) { return (1 - f) * (1 - f) + f * f; }

constexpr int kChunk = 256;
using Floats = std::array<float, kChunk>;
using Ints = std::array<std::int32_t, kChunk>;

/// Successive pixels of a row, one array per quantity: all steps are loops without branches, of vector arithmetic or of
/// loads from the other camera's maps.
struct Chunk {
    Floats line_m, line_k;                        ///< epipolar lines
    Floats spot_u, spot_v, spot_m, spot_shift;    ///< where the row above continues; NaN where it does not
    Ints u;                                       ///< crossings: columns, -1 where none,
    Floats p0, p1, row, m, shift;                 ///< positions, row of the curve at u, its slope, shift
    Ints index0, index1;                          ///< places of loads
    Floats g0, g1, f, v;                          ///< shares between pixels, row of the curve at u + f
    std::array<Floats, 4> weight;                 ///< of the four rows of the spline
    std::array<float, 4 * kChunk> along, across;  ///< products of the spline, to be summed by fours
    Floats rise, other_sigma;
    Floats at_u, at_v, sigma, slope;  ///< the result

    void set(int i, const Crossing& c) {
        u[i] = c.u;
        p0[i] = c.p0;
        p1[i] = c.p1;
        row[i] = c.row();
        m[i] = c.spot.m;
        shift[i] = c.spot.shift;
    }
};

inline float clamped(float x, float low, float high) {
    const float y = x > low ? x : low;
    return y < high ? y : high;
}
inline int clamped(int x, int low, int high) {
    const int y = x > low ? x : low;
    return y < high ? y : high;
}

/// The crossings at the spots themselves; where there is none, u is -1.
void cross(const OtherView& view, const float* target, int n, Chunk& c) {
    const int width = view.position_px.width, height = view.position_px.height;
    const auto right = static_cast<float>(width - 1), bottom = static_cast<float>(height - 1);
    for (int i = 0; i < n; ++i) {
        // Loads stay within the image whatever the spots are; NaN becomes 0.
        const float spot_u = clamped(c.spot_u[i], 0.0F, right - 1);
        const int u = static_cast<int>(spot_u);
        const float v0 = c.spot_v[i] + (static_cast<float>(u) - c.spot_u[i]) * c.spot_m[i], v1 = v0 + c.spot_m[i];
        const int top0 = static_cast<int>(clamped(v0, 0.0F, bottom - 1)),
                  top1 = static_cast<int>(clamped(v1, 0.0F, bottom - 1));
        const bool ok =
            (c.spot_u[i] >= 0) & (c.spot_u[i] < right) & (v0 >= 0) & (v0 < bottom) & (v1 >= 0) & (v1 < bottom);
        c.u[i] = ok ? u : -1;
        c.row[i] = v0;
        c.g0[i] = v0 - static_cast<float>(top0);
        c.g1[i] = v1 - static_cast<float>(top1);
        c.index0[i] = top0 * width + u;
        c.index1[i] = top1 * width + u + 1;
        c.m[i] = c.spot_m[i];
        c.shift[i] = c.spot_shift[i];
    }
    const float* p = view.position_px.data;
    for (int i = 0; i < n; ++i) {
        const float *a = p + c.index0[i], *b = p + c.index1[i];
        c.p0[i] = a[0] + c.g0[i] * (a[width] - a[0]);
        c.p1[i] = b[0] + c.g1[i] * (b[width] - b[0]);
    }
    for (int i = 0; i < n; ++i) {
        const float p0 = c.p0[i], p1 = c.p1[i], t = target[i];
        const bool hit = ((p0 <= t) & (t < p1)) | ((p1 < t) & (t <= p0));
        c.u[i] = hit ? c.u[i] : -1;
    }
}

/// Cubic B-spline of the 4 x 4 pixels around crossing [begin, end): exact for linear positions, of nearly the same
/// noise wherever the place lies between the pixels (0.23 of a pixel's variance; bilinear: 0.25 ... 1).
void sample(const OtherView& view, const float* target, int begin, int end, Chunk& c) {
    const int width = view.position_px.width, height = view.position_px.height;
    const auto last_row = static_cast<float>(height - 1);
    for (int i = begin; i < end; ++i) {
        const float f = (target[i] - c.p0[i]) / (c.p1[i] - c.p0[i]), v = c.row[i] + f * c.m[i];
        // Any pixels will do where the 4 x 4 are not inside: what they give is not used.
        const int row = static_cast<int>(clamped(v, 0.0F, last_row)), u = c.u[i];
        const int left = clamped(u, 1, width - 3), top = clamped(row, 1, height - 3);
        const int near_u = clamped(f < 0.5F ? u : u + 1, 0, width - 1);
        c.index0[i] = (top - 1) * width + left - 1;
        c.index1[i] = static_cast<int>(clamped(v + 0.5F, 0.0F, last_row)) * width + near_u;
        c.f[i] = f;
        c.v[i] = v;
        const float g = v - static_cast<float>(top), h = 1 - g, g2 = g * g, h2 = h * h;
        c.g0[i] = g;
        c.weight[0][i] = h * h2 / 6;
        c.weight[1][i] = (4 - 6 * g2 + 3 * g * g2) / 6;
        c.weight[2][i] = (4 - 6 * h2 + 3 * h * h2) / 6;
        c.weight[3][i] = (left == u) & (top == row) ? g * g2 / 6 : kNaN;
    }
    for (int i = begin; i < end; ++i) {
        const float* corner = view.position_px.data + c.index0[i];
        const auto line = [&](int j) {
            return Eigen::Map<const Four>(corner + static_cast<std::ptrdiff_t>(j) * width);
        };
        const Four first = line(0), last = line(3), f = spline(c.f[i]);
        const Four columns =
            (c.weight[0][i] * first + c.weight[1][i] * line(1)) + (c.weight[2][i] * line(2) + c.weight[3][i] * last);
        Eigen::Map<Four>(c.along.data() + 4 * i) = f * columns;
        Eigen::Map<Four>(c.across.data() + 4 * i) = f * (last - first);
        c.rise[i] = columns[3] - columns[0];
    }
    for (int i = begin; i < end; ++i) c.other_sigma[i] = view.sigma_px.data[c.index1[i]];
}

/// Where between the pixels of crossing [begin, end) the position is the one looked for, and how well that is known.
void refine(const OtherView& view, const float* target, const float* target_sigma, int begin, int end, Chunk& c) {
    sample(view, target, begin, end, c);
    const float *along = c.along.data(), *across = c.across.data();
    for (int i = begin; i < end; ++i) {
        const float position = (along[4 * i] + along[4 * i + 1]) + (along[4 * i + 2] + along[4 * i + 3]);
        const float fall = (across[4 * i] + across[4 * i + 1]) + (across[4 * i + 2] + across[4 * i + 3]);
        const float linear = c.p1[i] - c.p0[i], slope = (c.rise[i] + c.m[i] * fall) / 3;
        const float step = (target[i] - position) / slope;
        // Spline and crossing differ by noise; more than a pixel means that the slope is none. Beside edges and gaps
        // the two columns and rows of the crossing count alone.
        const bool smooth = (slope * linear > 0) & (std::fabs(step) < 1);
        const float f = c.f[i], row0 = c.row[i], row1 = row0 + c.m[i];
        const float bilinear =
            (1 - f) * (1 - f) * linear_weight(row0 - std::floor(row0)) + f * f * linear_weight(row1 - std::floor(row1));
        const float weight = smooth ? spline_weight(f) * spline_weight(c.g0[i]) : bilinear;
        const float move = smooth ? step : 0.0F, own = target_sigma[i], other = c.other_sigma[i];
        c.slope[i] = smooth ? slope : linear;
        c.at_u[i] = static_cast<float>(c.u[i]) + (f + move);
        c.at_v[i] = c.v[i] + move * c.m[i];
        c.sigma[i] = std::sqrt(own * own + weight * other * other) / std::fabs(c.slope[i]);
    }
}

/// Solves rows one after the other, each from the one above.
class Rows {
  public:
    Rows(const OwnView& own, const OtherView& other, const Eigen::Matrix3d& F, const CurveSearch& search,
         const CorrespondResult& out)
        : own_(own),
          other_(other),
          F_(F),
          search_(search),
          out_(out),
          trail_u_(static_cast<std::size_t>(own.position_px.width), kNaN),
          trail_target_(trail_u_.size()),
          trail_slope_(trail_u_.size()),
          trail_shift_(trail_u_.size()),
          trail_row_(trail_u_.size(), -kMaxGap - 1),
          no_shift_(2 * trail_u_.size()) {}

    void solve(int v) {
        const int width = own_.position_px.width;
        left_ = -kMaxGap - 1;
        for (int begin = 0; begin < width; begin += kChunk) solve(v, begin, std::min(kChunk, width - begin));
    }

  private:
    void solve(int v, int begin, int n) {
        const float* position = own_.position_px.row(v) + begin;
        const float* sigma = own_.sigma_px.row(v) + begin;
        Chunk& c = chunk_;
        find_lines(v, begin, n);
        predict(v, begin, n);
        cross(other_, position, n, c);
        for (int i = 0; i < n; ++i)
            if (c.u[i] < 0 && c.spot_u[i] == c.spot_u[i])
                c.set(i, search_.near({c.line_m[i], c.line_k[i]}, position[i],
                                      {c.spot_u[i], c.spot_v[i], c.spot_m[i], c.spot_shift[i]}));
        refine(other_, position, sigma, 0, n, c);
        keep(v, begin, 0, n);
        // The rest one by one, for each starts from the one before.
        for (int i = 0; i < n; ++i) {
            if (c.u[i] < 0 && position[i] == position[i]) {
                c.set(i, find(begin + i, i, position[i]));
                if (c.u[i] >= 0) {
                    refine(other_, position, sigma, i, i + 1, c);
                    keep(v, begin, i, i + 1);
                }
            }
            left_ = c.u[i] >= 0 ? begin + i : left_;
        }
    }

    /// The epipolar lines of the pixels.
    void find_lines(int v, int begin, int n) {
        const float* shift = own_.shift_px.empty() ? no_shift_.data() : own_.shift_px.row(v) + 2 * begin;
        const Eigen::Matrix3d F = F_;
        const double cu = search_.lens().cu, cv = search_.lens().cv;
        for (int i = 0; i < n; ++i) {
            const double x = static_cast<double>(begin + i) + shift[2 * i],
                         y = static_cast<double>(v) + shift[2 * i + 1];
            const double below = -1 / (F(1, 0) * x + F(1, 1) * y + F(1, 2)),
                         m = (F(0, 0) * x + F(0, 1) * y + F(0, 2)) * below;
            chunk_.line_m[i] = static_cast<float>(m);
            chunk_.line_k[i] = static_cast<float>((F(2, 0) * x + F(2, 1) * y + F(2, 2)) * below + m * cu - cv);
        }
    }

    /// The places on the curves where the rows above continue.
    void predict(int v, int begin, int n) {
        const Lens lens = search_.lens();
        const float* position = own_.position_px.row(v) + begin;
        const float *trail_u = trail_u_.data() + begin, *trail_target = trail_target_.data() + begin,
                    *trail_slope = trail_slope_.data() + begin, *trail_shift = trail_shift_.data() + begin;
        const std::int32_t* trail_row = trail_row_.data() + begin;
        Chunk& c = chunk_;
        for (int i = 0; i < n; ++i) {
            const float u = trail_u[i] + (position[i] - trail_target[i]) * trail_slope[i], relative = u - lens.cu;
            const float x = relative + trail_shift[i], m = c.line_m[i];
            const Lens::Place at = lens.along(x, m * x + c.line_k[i], 1, m);
            const float step = (relative - at.u) / at.du;
            const bool good = (std::fabs(step) < CurveSearch::kLastStep) & (trail_row[i] >= v - kMaxGap);
            c.spot_u[i] = good ? u : kNaN;
            c.spot_v[i] = at.v + lens.cv + at.dv * step;
            c.spot_m[i] = at.dv / at.du;
            c.spot_shift[i] = trail_shift[i] + step;
        }
    }

    /// Writes the results [first, last) and keeps them for the next row.
    void keep(int v, int begin, int first, int last) {
        const Chunk& c = chunk_;
        const float* position = own_.position_px.row(v) + begin;
        float* pixel = out_.pixel_px.row(v) + 2 * begin;
        float* sigma = out_.sigma_px.row(v) + begin;
        float *trail_u = trail_u_.data() + begin, *trail_target = trail_target_.data() + begin,
              *trail_slope = trail_slope_.data() + begin, *trail_shift = trail_shift_.data() + begin;
        std::int32_t* trail_row = trail_row_.data() + begin;
        for (int i = first; i < last; ++i) {
            const bool found = c.u[i] >= 0;
            pixel[2 * i] = found ? c.at_u[i] : kNaN;
            pixel[2 * i + 1] = found ? c.at_v[i] : kNaN;
            sigma[i] = found ? c.sigma[i] : kNaN;
        }
        for (int i = first; i < last; ++i) {
            const bool found = c.u[i] >= 0;
            trail_u[i] = found ? c.at_u[i] : trail_u[i];
            trail_target[i] = found ? position[i] : trail_target[i];
            trail_slope[i] = found ? 1 / c.slope[i] : trail_slope[i];
            trail_shift[i] = found ? c.shift[i] : trail_shift[i];
            trail_row[i] = found ? v : trail_row[i];
        }
    }

    /// The crossing of a pixel that does not continue the row above.
    [[nodiscard]] Crossing find(int u, int i, float target) const {
        const Line line{chunk_.line_m[i], chunk_.line_k[i]};
        float predicted = chunk_.spot_u[i];
        if (u - left_ <= kMaxGap) {
            const float beside = trail_u_[left_] + (target - trail_target_[left_]) * trail_slope_[left_];
            if (!(predicted == predicted)) predicted = beside;
            const Crossing c = search_.near(line, target, search_.locate(line, beside, trail_shift_[left_]));
            if (c.found()) return c;
        }
        return search_.anywhere(line, target, predicted);
    }

    const OwnView& own_;
    const OtherView& other_;
    const Eigen::Matrix3d& F_;
    const CurveSearch& search_;
    const CorrespondResult& out_;
    /// Per column, the last solution: place, position, 1 / slope, shift to the ideal column, and its row.
    std::vector<float> trail_u_, trail_target_, trail_slope_, trail_shift_;
    std::vector<std::int32_t> trail_row_;
    std::vector<float> no_shift_;
    int left_ = 0;  ///< the last pixel of this row that was solved
    Chunk chunk_;
};

}  // namespace

void correspond(const OwnView& own, const OtherView& other, const Eigen::Matrix3d& F, int threads,
                const CorrespondResult& out) {
    if (std::min(other.position_px.width, other.position_px.height) < 4) {
        // Less than the spline spans.
        std::fill_n(out.pixel_px.data, 2 * out.pixel_px.pixels(), kNaN);
        std::fill_n(out.sigma_px.data, out.sigma_px.pixels(), kNaN);
        return;
    }
    const CurveSearch search(other, threads);
    const int height = own.position_px.height, blocks = (height + kRowsOfBlock - 1) / kRowsOfBlock;
    parallel_for(static_cast<std::size_t>(blocks), threads, [&](std::size_t begin, std::size_t end) {
        for (std::size_t block = begin; block < end; ++block) {
            Rows rows(own, other, F, search, out);
            const int first = static_cast<int>(block) * kRowsOfBlock;
            for (int v = first; v < std::min(first + kRowsOfBlock, height); ++v) rows.solve(v);
        }
    });
}

}  // namespace planish
