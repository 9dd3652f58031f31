#include "core/correspond.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <vector>

#include "core/parallel.hpp"

namespace planish {
namespace {

constexpr float kNaN = std::numeric_limits<float>::quiet_NaN();
constexpr int kBlock = 16;
/// Steps of the warm start before the whole curve is searched.
constexpr int kMaxWarmSteps = 8;
/// A prediction is a continuation of the row only over so many pixels of `own`.
constexpr int kMaxGap = 8;
/// Fixed-point steps for the curve's row: each gains a factor of about the distortion's gradient (0.05 at most).
constexpr int kWarmIterations = 2, kColdIterations = 6;

/// Smallest and largest position of each block, its last row and column shared with the next block.
class BlockRange {
public:
    BlockRange(Image<const float> position, int threads)
        : rows_((position.height + kBlock - 1) / kBlock), columns_((position.width + kBlock - 1) / kBlock),
          low_(static_cast<std::size_t>(rows_) * columns_), high_(low_.size()) {
        parallel_for(static_cast<std::size_t>(rows_), threads, [&](std::size_t begin, std::size_t end) {
            for (std::size_t i = begin; i < end; ++i)
                for (int j = 0; j < columns_; ++j) measure(position, static_cast<int>(i), j);
        });
    }

    [[nodiscard]] int rows() const { return rows_; }
    [[nodiscard]] int columns() const { return columns_; }
    [[nodiscard]] bool holds(int row, int column, float value) const {
        const std::size_t i = static_cast<std::size_t>(row) * columns_ + column;
        return low_[i] <= value && value <= high_[i];
    }

private:
    void measure(Image<const float> position, int row, int column) {
        float low = std::numeric_limits<float>::infinity(), high = -low;
        const int bottom = std::min((row + 1) * kBlock, position.height - 1);
        const int right = std::min((column + 1) * kBlock, position.width - 1);
        for (int v = row * kBlock; v <= bottom; ++v) {
            const float* p = position.row(v);
            for (int u = column * kBlock; u <= right; ++u) {
                low = p[u] < low ? p[u] : low;
                high = p[u] > high ? p[u] : high;
            }
        }
        low_[static_cast<std::size_t>(row) * columns_ + column] = low;
        high_[static_cast<std::size_t>(row) * columns_ + column] = high;
    }

    int rows_, columns_;
    std::vector<float> low_, high_;
};

/// The epipolar curve of one pixel in the other camera: row v as a function of column u.
class Curve {
public:
    Curve(const PhaseView& view, const Eigen::Vector3d& line)
        : view_(view), slope_(-line.x() / line.y()), offset_(-line.z() / line.y()) {}

    [[nodiscard]] double row(int u, double guess, int iterations) const {
        if (view_.shift_px.empty()) return slope_ * u + offset_;
        double v = guess;
        const int last = view_.shift_px.height - 2;
        for (int i = 0; i < iterations; ++i) {
            const int top = std::clamp(static_cast<int>(v), 0, last);
            const double f = std::clamp(v - top, 0.0, 1.0);
            const float* a = view_.shift_px.at(top, u);
            const float* b = view_.shift_px.at(top + 1, u);
            v = slope_ * (u + (1 - f) * a[0] + f * b[0]) + offset_ - ((1 - f) * a[1] + f * b[1]);
        }
        return v;
    }
    [[nodiscard]] double slope() const { return slope_; }
    [[nodiscard]] double undistorted_row(int u) const { return slope_ * u + offset_; }

    /// Position at column u and row v, linear between the two rows; NaN outside and where either row has none.
    [[nodiscard]] float position(int u, double v) const {
        if (!(v >= 0) || !(v < view_.position_px.height - 1)) return kNaN;
        const int top = static_cast<int>(v);
        const auto f = static_cast<float>(v - top);
        const float a = *view_.position_px.at(top, u), b = *view_.position_px.at(top + 1, u);
        return a + f * (b - a);
    }

private:
    const PhaseView& view_;
    double slope_, offset_;
};

struct Crossing {
    int u = -1;  ///< between columns u and u + 1
    float p0 = 0, p1 = 0;
    double v0 = 0, v1 = 0;

    [[nodiscard]] bool found() const { return u >= 0; }
    [[nodiscard]] float fraction(float target) const { return (target - p0) / (p1 - p0); }
};

bool encloses(float p0, float p1, float target) {
    return (p0 <= target && target < p1) || (p1 < target && target <= p0);
}

class Search {
public:
    Search(const PhaseView& view, const BlockRange& blocks) : view_(view), blocks_(blocks) {}

    /// Walks from the predicted place along the curve, as far as the slope suggests.
    [[nodiscard]] Crossing near(const Curve& curve, float target, double predicted_u, double guess_v) const {
        const int last = view_.position_px.width - 2;
        int u = static_cast<int>(std::floor(predicted_u));
        double v = guess_v;
        for (int i = 0; i < kMaxWarmSteps; ++i) {
            if (u < 0 || u > last) return {};
            const double v0 = curve.row(u, v, kWarmIterations), v1 = curve.row(u + 1, v0 + curve.slope(), kWarmIterations);
            const float p0 = curve.position(u, v0), p1 = curve.position(u + 1, v1);
            if (encloses(p0, p1, target)) return {u, p0, p1, v0, v1};
            const float steps = std::floor((target - p0) / (p1 - p0));
            if (!(std::fabs(steps) < kMaxWarmSteps) || steps == 0) return {};
            u += static_cast<int>(steps);
            v = v0 + curve.slope() * steps;
        }
        return {};
    }

    /// Every crossing of the whole curve is looked at; the one nearest to `predicted_u`, or the only one.
    [[nodiscard]] Crossing anywhere(const Curve& curve, float target, double predicted_u) const {
        Crossing best;
        double best_distance = std::numeric_limits<double>::infinity();
        const int width = view_.position_px.width;
        double v0 = curve.row(0, curve.undistorted_row(0), kColdIterations);
        for (int column = 0; column < blocks_.columns(); ++column) {
            const int begin = column * kBlock, end = std::min(begin + kBlock, width - 1);
            const double v1 = curve.row(end, v0 + curve.slope() * (end - begin), kWarmIterations + 1);
            if (may_hold(column, std::min(v0, v1), std::max(v0, v1), target)) {
                double va = v0;
                float pa = curve.position(begin, va);
                for (int u = begin; u < end; ++u) {
                    const double vb = curve.row(u + 1, va + curve.slope(), kWarmIterations);
                    const float pb = curve.position(u + 1, vb);
                    if (encloses(pa, pb, target)) {
                        const double distance = std::fabs(u + 0.5 - predicted_u);
                        if (best.found() && !(predicted_u == predicted_u)) return {};
                        if (!best.found() || distance < best_distance) best = {u, pa, pb, va, vb};
                        best_distance = std::min(best_distance, distance);
                    }
                    va = vb;
                    pa = pb;
                }
            }
            v0 = v1;
        }
        return best;
    }

private:
    [[nodiscard]] bool may_hold(int column, double v_low, double v_high, float target) const {
        // One pixel of margin: the curve bends by far less than that within a block.
        const int first = std::max(0, static_cast<int>(std::floor((v_low - 1) / kBlock)));
        const int last = std::min(blocks_.rows() - 1, static_cast<int>(std::floor((v_high + 1) / kBlock)));
        for (int row = first; row <= last; ++row)
            if (blocks_.holds(row, column, target)) return true;
        return false;
    }

    const PhaseView& view_;
    const BlockRange& blocks_;
};

/// Slope of the position along the curve over up to three columns: less noise than over one.
float wide_slope(const Curve& curve, const Crossing& c, int width) {
    const double dv = c.v1 - c.v0;
    const float before = c.u > 0 ? curve.position(c.u - 1, c.v0 - dv) : kNaN;
    const float after = c.u + 2 < width ? curve.position(c.u + 2, c.v1 + dv) : kNaN;
    const bool has_before = before == before, has_after = after == after;
    const float columns = 1.0F + (has_before ? 1.0F : 0.0F) + (has_after ? 1.0F : 0.0F);
    return ((has_after ? after : c.p1) - (has_before ? before : c.p0)) / columns;
}

/// Variance of the interpolated position: the squares of the four weights times the variance of one pixel.
float interpolated_variance(const PhaseView& view, const Crossing& c, float f) {
    const auto rows = [](double v) {
        const auto g = static_cast<float>(v - std::floor(v));
        return (1 - g) * (1 - g) + g * g;
    };
    const int v = static_cast<int>(f < 0.5F ? c.v0 + 0.5 : c.v1 + 0.5);
    const float sigma = *view.sigma_px.at(std::min(v, view.sigma_px.height - 1), f < 0.5F ? c.u : c.u + 1);
    return ((1 - f) * (1 - f) * rows(c.v0) + f * f * rows(c.v1)) * sigma * sigma;
}

/// What the next pixel of the row starts from.
struct Trail {
    int at = -1;
    double u = 0, v = 0;
    float target = 0, slope = 0;

    [[nodiscard]] double predict(int pixel, float next) const {
        return at >= 0 && pixel - at <= kMaxGap ? u + (next - target) / slope : std::nan("");
    }
};

}  // namespace

void correspond(const PhaseView& own, const PhaseView& other, const Eigen::Matrix3d& F, int threads,
                const CorrespondResult& out) {
    const BlockRange blocks(other.position_px, threads);
    const Search search(other, blocks);
    const int width = own.position_px.width;

    const auto correspond_row = [&](int v) {
        const float* position = own.position_px.row(v);
        const float* sigma = own.sigma_px.row(v);
        float* pixel = out.pixel_px.row(v);
        float* pixel_sigma = out.sigma_px.row(v);
        Trail trail;
        for (int u = 0; u < width; ++u) {
            pixel[2 * u] = pixel[2 * u + 1] = pixel_sigma[u] = kNaN;
            const float target = position[u];
            if (!(target == target)) continue;
            Eigen::Vector3d x(u, v, 1.0);
            if (!own.shift_px.empty()) {
                const float* shift = own.shift_px.at(v, u);
                x.x() += shift[0];
                x.y() += shift[1];
            }
            const Curve curve(other, F * x);
            const double predicted = trail.predict(u, target);
            Crossing c;
            if (predicted == predicted)
                c = search.near(curve, target, predicted, trail.v + curve.slope() * (predicted - trail.u));
            if (!c.found()) c = search.anywhere(curve, target, predicted);
            if (!c.found()) continue;
            const float f = c.fraction(target), slope = wide_slope(curve, c, other.position_px.width);
            if (!(slope * (c.p1 - c.p0) > 0)) continue;
            pixel[2 * u] = static_cast<float>(c.u + static_cast<double>(f));
            pixel[2 * u + 1] = static_cast<float>(c.v0 + static_cast<double>(f) * (c.v1 - c.v0));
            pixel_sigma[u] =
                std::sqrt(sigma[u] * sigma[u] + interpolated_variance(other, c, f)) / std::fabs(slope);
            trail = {u, pixel[2 * u], pixel[2 * u + 1], target, slope};
        }
    };
    parallel_for(static_cast<std::size_t>(own.position_px.height), threads, [&](std::size_t begin, std::size_t end) {
        for (std::size_t v = begin; v < end; ++v) correspond_row(static_cast<int>(v));
    });
}

}  // namespace planish
