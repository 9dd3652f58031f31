#include "core/sensing/curve_search.hpp"

#include <algorithm>
#include <array>
#include <cstdlib>
#include <limits>
#include <utility>

#include "core/common/parallel.hpp"

namespace planish {
namespace {

constexpr float kNaN = std::numeric_limits<float>::quiet_NaN();
constexpr int kSize = BlockIndex::kBlock;
/// Steps from the continuation before the search is given up.
constexpr int kMaxWarmSteps = 8;
constexpr int kMaxNewton = 4;
/// The curve is straight over so many columns: 2^2 / 2 times 1e-4 (1e-3 at most) of a pixel off.
constexpr float kStraight = 2.0F;
/// Of the rows of blocks that a curve passes [px]: the shift changes by less within a block.
constexpr float kMargin = 3.0F;
/// Rows beyond are infinite [px].
constexpr float kFar = 1e6F;

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

int block_row(float v) { return static_cast<int>(std::floor(v / kSize)); }
/// Whether two blocks found one crossing: a position does not cross twice in succession in one direction.
bool same(const Crossing& a, const Crossing& b) {
    return a.u == b.u || (std::abs(a.u - b.u) == 1 && (a.p1 - a.p0) * (b.p1 - b.p0) > 0);
}
float distance(const Crossing& c, float u) { return std::fabs(static_cast<float>(c.u) + 0.5F - u); }

}  // namespace

CurveSearch::CurveSearch(const OtherView& view, int threads)
    : position_(view.position_px), blocks_(view.position_px, threads), lens_(view.camera, view.transposed) {
    const Camera& camera = view.camera;
    shifts_.resize(static_cast<std::size_t>(blocks_.rows()) * blocks_.columns());
    parallel_for(static_cast<std::size_t>(blocks_.rows()), threads, [&](std::size_t begin, std::size_t end) {
        for (std::size_t row = begin; row < end; ++row)
            for (int column = 0; column < blocks_.columns(); ++column) {
                Eigen::Vector2d pixel((column + 0.5) * kSize, (static_cast<double>(row) + 0.5) * kSize);
                if (view.transposed) std::swap(pixel.x(), pixel.y());
                Eigen::Vector2d shift = camera.to_pixel(camera.undistort(camera.from_pixel(pixel))) - pixel;
                if (view.transposed) std::swap(shift.x(), shift.y());
                shifts_[row * blocks_.columns() + column] = shift.cast<float>();
            }
    });
    for (const auto& shift : shifts_)
        if (shift.y() == shift.y()) largest_ = std::max(largest_, std::fabs(shift.y()));
}

Spot CurveSearch::locate(const Line& line, float u, float shift) const {
    for (int i = 0;; ++i) {
        const float x = u - lens_.cu + shift;
        const Lens::Place at = lens_.along(x, line.m * x + line.k, 1, line.m);
        const float step = (u - lens_.cu - at.u) / at.du;
        shift += step;
        if (std::fabs(step) < kLastStep || i == kMaxNewton)
            return {u, at.v + lens_.cv + at.dv * step, at.dv / at.du, shift};
    }
}

Crossing CurveSearch::near(const Line& line, float target, Spot spot) const {
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

Crossing CurveSearch::anywhere(const Line& line, float target, float predicted_u) const {
    const float left = line.m * -lens_.cu + line.k + lens_.cv;
    const float right = left + line.m * static_cast<float>(position_.width - 1);
    // Lines that are hardly inclined to columns, or none at all, pass no row of blocks in particular.
    if (!(std::fabs(left) < kFar && std::fabs(right) < kFar)) return {};
    const int first = std::max(0, block_row(std::min(left, right) - largest_ - kMargin));
    const int last = std::min(blocks_.rows() - 1, block_row(std::max(left, right) + largest_ + kMargin));
    Crossing best;
    bool several = false;
    for (int row = first; row <= last; ++row)
        for (const int column : blocks_.candidates(row, target)) {
            const Eigen::Vector2f& shift = shifts_[static_cast<std::size_t>(row) * blocks_.columns() + column];
            const int begin = column * kSize;
            const auto top = static_cast<float>(row * kSize);
            // The straight line, with the block's own shift: where the curve passes the block, within the margin.
            const float v = left + line.m * (static_cast<float>(begin) + shift.x()) - shift.y();
            const float leave = v + line.m * kSize;
            if (!(std::max(v, leave) > top - kMargin && std::min(v, leave) < top + kSize + kMargin)) continue;
            if (!blocks_.holds(row, column, target)) continue;
            scan(line, target, begin, shift.x(), [&](const Crossing& c) {
                several = several || (best.found() && !same(best, c));
                if (!best.found() || distance(c, predicted_u) < distance(best, predicted_u)) best = c;
            });
        }
    return several && !(predicted_u == predicted_u) ? Crossing{} : best;
}

/// Calls `action` with the crossings between the columns of a block and one more on either side: the curve is taken as
/// straight, and where blocks meet the two straights differ by some thousandths of a pixel.
template <class Action>
void CurveSearch::scan(const Line& line, float target, int begin, float shift, const Action& action) const {
    const int width = position_.width, first = std::max(begin - 1, 0), last = std::min(begin + kSize + 1, width - 1);
    const Spot spot = locate(line, static_cast<float>(begin) + 0.5F * kSize, shift);
    const auto bottom = static_cast<float>(position_.height - 1);
    std::array<float, kSize + 3> p;
    for (int u = first; u <= last; ++u) {
        const float v = spot.v + (static_cast<float>(u) - spot.u) * spot.m;
        const bool inside = v >= 0 && v < bottom;
        const int top = inside ? static_cast<int>(v) : 0;
        const float* at = position_.data + static_cast<std::ptrdiff_t>(top) * width + u;
        p[u - first] = inside ? at[0] + (v - static_cast<float>(top)) * (at[width] - at[0]) : kNaN;
    }
    for (int u = first; u < last; ++u)
        if (encloses(p[u - first], p[u + 1 - first], target)) {
            action(exact(line, {u, p[u - first], p[u + 1 - first], spot}));
        }
}

/// The crossing of a straight, on the curve itself.
Crossing CurveSearch::exact(const Line& line, Crossing c) const {
    c.spot = locate(line, static_cast<float>(c.u), c.spot.shift);
    const float p0 = position_at(position_, c.u, c.spot.v), p1 = position_at(position_, c.u + 1, c.spot.v + c.spot.m);
    // Where these do not enclose the position any more, the place is at a pixel, and that close to it either will do.
    if ((p1 - p0) * (c.p1 - c.p0) > 0) {
        c.p0 = p0;
        c.p1 = p1;
    }
    return c;
}

}  // namespace planish
