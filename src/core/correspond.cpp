#include "core/correspond.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <vector>

#include "core/block_index.hpp"
#include "core/lens.hpp"
#include "core/parallel.hpp"

namespace planish {
namespace {

constexpr float kNaN = std::numeric_limits<float>::quiet_NaN();
/// Steps from the continuation before the whole curve is searched.
constexpr int kMaxWarmSteps = 8;
/// A neighbour says where a pixel continues only over so many pixels of `own`.
constexpr int kMaxGap = 8;
/// Rows that follow each other's solutions; fixed, so that the result does not depend on the number of threads.
constexpr int kRowsOfBlock = 64;
/// A step of the column on the curve [px] after which the next would be below rounding: it is squared times the
/// curvature of the distortion, 1e-3 per pixel at most.
constexpr float kLastStep = 0.25F;
/// The curve is straight over so many columns: 2^2 / 2 times 1e-4 (1e-3 at most) of a pixel off.
constexpr float kStraight = 2.0F;

/// An epipolar line in ideal pixels relative to the lens's centre: y = m x + k.
struct Line {
    float m = 0, k = 0;
};

/// A place on an epipolar curve: row v at column u, slope m = dv / du there, and the ideal column less u.
struct Spot {
    float u = 0, v = 0, m = 0, shift = 0;
};

struct Crossing {
    int u = -1;  ///< between columns u and u + 1
    float p0 = 0, p1 = 0;
    Spot spot;  ///< on the curve, at or near column u

    [[nodiscard]] bool found() const { return u >= 0; }
    [[nodiscard]] float row() const { return spot.v + (static_cast<float>(u) - spot.u) * spot.m; }
    [[nodiscard]] float fraction(float target) const { return (target - p0) / (p1 - p0); }
};

bool encloses(float p0, float p1, float target) {
    return (p0 <= target && target < p1) || (p1 < target && target <= p0);
}

/// Position at column u and row v, linear between the two rows; NaN outside and where either row has none.
inline float position_at(Image<const float> position, int u, float v) {
    if (!(v >= 0) || !(v < static_cast<float>(position.height - 1))) return kNaN;
    const int top = static_cast<int>(v);
    const float* p = position.row(top) + u;
    return p[0] + (v - static_cast<float>(top)) * (p[position.width] - p[0]);
}

class Search {
  public:
    Search(const OtherView& view, int threads)
        : position_(view.position_px), blocks_(view.position_px, threads), lens_(view.camera, view.transposed) {
        constexpr int size = BlockIndex::kBlock;
        shifts_.resize(static_cast<std::size_t>(blocks_.rows()) * blocks_.columns());
        parallel_for(static_cast<std::size_t>(blocks_.rows()), threads, [&](std::size_t begin, std::size_t end) {
            for (std::size_t row = begin; row < end; ++row)
                for (int column = 0; column < blocks_.columns(); ++column) {
                    Eigen::Vector2d pixel((column + 0.5) * size, (static_cast<double>(row) + 0.5) * size);
                    if (view.transposed) std::swap(pixel.x(), pixel.y());
                    const Camera& c = view.camera;
                    Eigen::Vector2d shift = c.to_pixel(c.undistort(c.from_pixel(pixel))) - pixel;
                    if (view.transposed) std::swap(shift.x(), shift.y());
                    shifts_[row * blocks_.columns() + column] = shift.cast<float>();
                }
        });
        for (const auto& shift : shifts_)
            if (shift.y() == shift.y()) largest_ = std::max(largest_, std::fabs(shift.y()));
    }

    [[nodiscard]] const Lens& lens() const { return lens_; }

    /// The curve at column u; `shift` is near the one there.
    [[nodiscard]] Spot locate(const Line& line, float u, float shift) const {
        for (int i = 0;; ++i) {
            const float x = u - lens_.cu + shift;
            const Lens::Place at = lens_.along(x, line.m * x + line.k, line.m);
            const float step = (u - lens_.cu - at.u) / at.du;
            shift += step;
            if (std::fabs(step) < kLastStep || i == kMaxNewton)
                return {u, at.v + lens_.cv + at.dv * step, at.dv / at.du, shift};
        }
    }

    /// Walks from the predicted place along the curve, as far as the slope suggests.
    [[nodiscard]] Crossing near(const Line& line, float target, Spot spot) const {
        if (!(spot.u >= 0)) return {};
        const int last = position_.width - 2;
        int u = static_cast<int>(std::min(spot.u, static_cast<float>(last + 1)));
        for (int i = 0; i < kMaxWarmSteps; ++i) {
            if (u < 0 || u > last) return {};
            const auto column = static_cast<float>(u);
            if (std::fabs(column - spot.u) > kStraight) spot = locate(line, column, spot.shift);
            const float v = spot.v + (column - spot.u) * spot.m;
            const float p0 = position_at(position_, u, v), p1 = position_at(position_, u + 1, v + spot.m);
            if (encloses(p0, p1, target)) return {u, p0, p1, spot};
            const float steps = std::floor((target - p0) / (p1 - p0));
            if (!(std::fabs(steps) < kMaxWarmSteps) || steps == 0) return {};
            u += static_cast<int>(steps);
        }
        return {};
    }

    /// Every crossing of the whole curve is looked at; the one nearest to `predicted_u`, or the only one.
    [[nodiscard]] Crossing anywhere(const Line& line, float target, float predicted_u) const {
        constexpr int size = BlockIndex::kBlock;
        const float left = line.m * -lens_.cu + line.k + lens_.cv;
        const float right = left + line.m * static_cast<float>(position_.width - 1);
        const int first = std::max(0, block_row(std::min(left, right) - largest_ - kMargin));
        const int last = std::min(blocks_.rows() - 1, block_row(std::max(left, right) + largest_ + kMargin));
        Crossing best;
        bool several = false;
        for (int row = first; row <= last; ++row)
            for (const int column : blocks_.candidates(row, target)) {
                const Eigen::Vector2f& shift = shifts_[static_cast<std::size_t>(row) * blocks_.columns() + column];
                const int begin = column * size, end = std::min(begin + size, position_.width - 1);
                const auto top = static_cast<float>(row * size);
                // The straight line, with the block's own shift: where the curve passes the block, within the margin.
                const float v = left + line.m * (static_cast<float>(begin) + shift.x()) - shift.y();
                const float leave = v + line.m * size;
                if (!(std::max(v, leave) > top - kMargin && std::min(v, leave) < top + size + kMargin)) continue;
                if (!blocks_.holds(row, column, target)) continue;
                scan(line, target, begin, end, shift.x(), [&](const Crossing& c) {
                    several = several || (best.found() && best.u != c.u);
                    if (!best.found() || distance(c, predicted_u) < distance(best, predicted_u)) best = c;
                });
            }
        return several && !(predicted_u == predicted_u) ? Crossing{} : best;
    }

  private:
    static constexpr int kMaxNewton = 4;
    /// Of the rows of blocks that a curve passes [px]: the shift changes by less within a block.
    static constexpr float kMargin = 3.0F;

    static int block_row(float v) { return static_cast<int>(std::floor(v / BlockIndex::kBlock)); }
    static float distance(const Crossing& c, float u) { return std::fabs(static_cast<float>(c.u) + 0.5F - u); }

    template <class Action>
    void scan(const Line& line, float target, int begin, int end, float shift, const Action& action) const {
        const Spot a = locate(line, static_cast<float>(begin), shift), b = locate(line, static_cast<float>(end), shift);
        const float m = (b.v - a.v) / (b.u - a.u);
        float p = position_at(position_, begin, a.v);
        for (int u = begin; u < end; ++u) {
            const float next = position_at(position_, u + 1, a.v + static_cast<float>(u + 1 - begin) * m);
            if (encloses(p, next, target)) action(exact({u, p, next, a}, line));
            p = next;
        }
    }

    /// Between the ends of a block the curve was taken as straight: the crossing on the curve itself.
    [[nodiscard]] Crossing exact(Crossing c, const Line& line) const {
        c.spot = locate(line, static_cast<float>(c.u), c.spot.shift);
        const float p0 = position_at(position_, c.u, c.spot.v);
        const float p1 = position_at(position_, c.u + 1, c.spot.v + c.spot.m);
        // Where it differs by so much that it no longer encloses, the place is at a pixel and either will do.
        if ((p1 - p0) * (c.p1 - c.p0) > 0) c.p0 = p0, c.p1 = p1;
        return c;
    }

    Image<const float> position_;
    BlockIndex blocks_;
    Lens lens_;
    std::vector<Eigen::Vector2f> shifts_;  ///< of each block's centre to its ideal place
    float largest_ = 0;
};

/// What the other camera's positions say at a place between pixels.
struct Sample {
    float position = 0, slope = 0;  ///< slope along the curve per column
    float weight = 0;               ///< sum of the squared weights: variance of `position` over that of one pixel
};

using Four = Eigen::Array4f;

/// Weights of the cubic B-spline for four nodes at -1, 0, 1, 2 and a place f in [0, 1].
inline Four spline(float f) {
    const Four one(1.0F / 6, 4.0F / 6, 1.0F / 6, 0), first(-0.5F, 0, 0.5F, 0), second(0.5F, -1, 0.5F, 0),
        third(-1.0F / 6, 0.5F, -0.5F, 1.0F / 6);
    return one + f * (first + f * (second + f * third));
}

/// Cubic B-spline of the 4 x 4 pixels around: exact for linear positions, of nearly the same noise wherever the place
/// lies between the pixels (0.23 of a pixel's variance; bilinear: 0.25 ... 1). False where one of them is missing.
inline bool spline_sample(Image<const float> position, int u, float v, float f, float curve_slope, Sample& out) {
    const int top = static_cast<int>(v);
    if (u < 1 || u + 2 >= position.width || top < 1 || top + 2 >= position.height) return false;
    const Four wu = spline(f), wv = spline(v - static_cast<float>(top));
    const float* corner = position.row(top - 1) + u - 1;
    const auto row = [&](int j) { return Eigen::Map<const Four>(corner + static_cast<std::ptrdiff_t>(j) * position.width); };
    const Four columns = (wv[0] * row(0) + wv[1] * row(1)) + (wv[2] * row(2) + wv[3] * row(3));
    out.position = (wu * columns).sum();
    out.slope = (columns[3] - columns[0] + curve_slope * (wu * (row(3) - row(0))).sum()) / 3;
    out.weight = wu.square().sum() * wv.square().sum();
    return out.position == out.position;
}

/// The same from the two columns and rows of the crossing alone, beside edges and gaps.
Sample linear_sample(const Crossing& c, float target, float f) {
    const auto rows = [](float v) {
        const float g = v - std::floor(v);
        return (1 - g) * (1 - g) + g * g;
    };
    const float v = c.row();
    return {target, c.p1 - c.p0, (1 - f) * (1 - f) * rows(v) + f * f * rows(v + c.spot.m)};
}

/// The place on the curve, its standard deviation, and the slope of the position.
struct Match {
    float u = 0, v = 0, sigma = 0, slope = 0;
};

inline Match refine(const OtherView& view, const Crossing& c, float target, float target_sigma) {
    const float f = c.fraction(target), v = c.row() + f * c.spot.m;
    Sample sample;
    float shift = 0;
    bool smooth = spline_sample(view.position_px, c.u, v, f, c.spot.m, sample) && sample.slope * (c.p1 - c.p0) > 0;
    if (smooth) {
        shift = (target - sample.position) / sample.slope;
        // The two differ by noise; more than a pixel means that the slope is none.
        smooth = std::fabs(shift) < 1;
    }
    if (!smooth) {
        sample = linear_sample(c, target, f);
        shift = 0;
    }
    const int nearest_v = std::min(static_cast<int>(v + 0.5F), view.sigma_px.height - 1);
    const float sigma = view.sigma_px.row(nearest_v)[f < 0.5F ? c.u : c.u + 1];
    return {static_cast<float>(c.u) + (f + shift), v + shift * c.spot.m,
            std::sqrt(target_sigma * target_sigma + sample.weight * sigma * sigma) / std::fabs(sample.slope),
            sample.slope};
}

/// Solves rows one after the other, each from the one above.
class Rows {
  public:
    Rows(const OwnView& own, const OtherView& other, const Eigen::Matrix3d& F, const Search& search,
         const CorrespondResult& out)
        : own_(own), other_(other), F_(F), search_(search), out_(out), width_(own.position_px.width) {
        for (auto* v : {&trail_u_, &trail_target_, &trail_slope_, &trail_shift_, &line_m_, &line_k_, &spot_v_, &spot_m_,
                        &spot_shift_, &spot_u_, &shift_u_, &shift_v_})
            v->assign(static_cast<std::size_t>(width_), 0.0F);
        std::fill(trail_u_.begin(), trail_u_.end(), kNaN);
        trail_row_.assign(static_cast<std::size_t>(width_), -kMaxGap - 1);
    }

    void solve(int v) {
        predict(v);
        const float* position = own_.position_px.row(v);
        const float* sigma = own_.sigma_px.row(v);
        float* pixel = out_.pixel_px.row(v);
        float* pixel_sigma = out_.sigma_px.row(v);
        int left = -kMaxGap - 1;  // the last pixel of this row that was solved
        for (int u = 0; u < width_; ++u) {
            const float target = position[u];
            Crossing c;
            if (target == target) c = find(u, v, target, left);
            if (!c.found()) {
                pixel[2 * u] = pixel[2 * u + 1] = pixel_sigma[u] = kNaN;
                continue;
            }
            const Match match = refine(other_, c, target, sigma[u]);
            pixel[2 * u] = match.u;
            pixel[2 * u + 1] = match.v;
            pixel_sigma[u] = match.sigma;
            trail_u_[u] = match.u;
            trail_target_[u] = target;
            trail_slope_[u] = 1 / match.slope;
            trail_shift_[u] = c.spot.shift;
            trail_row_[u] = v;
            left = u;
        }
    }

  private:
    /// The epipolar line of every pixel of the row, and the place on its curve where the row above continues.
    void predict(int v) {
        const Lens lens = search_.lens();
        const float* position = own_.position_px.row(v);
        if (!own_.shift_px.empty()) {
            const float* shift = own_.shift_px.row(v);
            for (int u = 0; u < width_; ++u) {
                shift_u_[u] = shift[2 * u];
                shift_v_[u] = shift[2 * u + 1];
            }
        }
        const float *su = shift_u_.data(), *sv = shift_v_.data(), *tu = trail_u_.data(), *tt = trail_target_.data(),
                    *ts = trail_slope_.data(), *th = trail_shift_.data();
        const int* tr = trail_row_.data();
        float *lm = line_m_.data(), *lk = line_k_.data(), *pu = spot_u_.data(), *pv = spot_v_.data(),
              *pm = spot_m_.data(), *ph = spot_shift_.data();
        const double f00 = F_(0, 0), f01 = F_(0, 1), f02 = F_(0, 2), f10 = F_(1, 0), f11 = F_(1, 1), f12 = F_(1, 2),
                     f20 = F_(2, 0), f21 = F_(2, 1), f22 = F_(2, 2);
        const double cu = lens.cu, cv = lens.cv, row = v;
#pragma GCC ivdep
        for (int u = 0; u < width_; ++u) {
            const double x = static_cast<double>(u) + su[u], y = row + sv[u];
            const double a = f00 * x + f01 * y + f02, b = f10 * x + f11 * y + f12, c = f20 * x + f21 * y + f22;
            const double below = -1 / b;
            lm[u] = static_cast<float>(a * below);
            lk[u] = static_cast<float>((c + a * cu) * below - cv);
        }
#pragma GCC ivdep
        for (int u = 0; u < width_; ++u) {
            const float at_u = tu[u] + (position[u] - tt[u]) * ts[u], relative = at_u - lens.cu;
            const float at_x = relative + th[u], m = lm[u];
            const Lens::Place at = lens.along(at_x, m * at_x + lk[u], m);
            const float step = (relative - at.u) / at.du;
            const bool good = std::fabs(step) < kLastStep && tr[u] >= v - kMaxGap;
            pu[u] = good ? at_u : kNaN;
            pv[u] = at.v + lens.cv + at.dv * step;
            pm[u] = at.dv / at.du;
            ph[u] = th[u] + step;
        }
    }

    [[nodiscard]] Crossing find(int u, int v, float target, int left) const {
        const Line line{line_m_[u], line_k_[u]};
        const Spot above{spot_u_[u], spot_v_[u], spot_m_[u], spot_shift_[u]};
        float predicted = above.u;
        Crossing c = search_.near(line, target, above);
        if (c.found()) return c;
        if (u - left <= kMaxGap) {
            const float beside = trail_u_[left] + (target - trail_target_[left]) * trail_slope_[left];
            if (!(predicted == predicted)) predicted = beside;
            c = search_.near(line, target, search_.locate(line, beside, trail_shift_[left]));
            if (c.found()) return c;
        }
        (void)v;
        return search_.anywhere(line, target, predicted);
    }

    const OwnView& own_;
    const OtherView& other_;
    const Eigen::Matrix3d& F_;
    const Search& search_;
    const CorrespondResult& out_;
    int width_;
    /// Per column, the last solution: place, position, 1 / slope, shift to the ideal column, and its row.
    std::vector<float> trail_u_, trail_target_, trail_slope_, trail_shift_;
    std::vector<int> trail_row_;
    std::vector<float> line_m_, line_k_, spot_u_, spot_v_, spot_m_, spot_shift_, shift_u_, shift_v_;
};

}  // namespace

void correspond(const OwnView& own, const OtherView& other, const Eigen::Matrix3d& F, int threads,
                const CorrespondResult& out) {
    const Search search(other, threads);
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
