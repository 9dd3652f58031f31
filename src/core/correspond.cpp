#include "core/correspond.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <span>
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
/// From the column beside it the guess is good to 0.01 px, one step makes that 0.0005.
constexpr int kWarmIterations = 2, kColdIterations = 6;

/// Which blocks may hold a position: per row of blocks and bin of position, a list of columns of blocks.
class BlockIndex {
  public:
    explicit BlockIndex(Image<const float> position)
        : position_(position),
          rows_((position.height + kBlock - 1) / kBlock),
          columns_((position.width + kBlock - 1) / kBlock) {
        for (std::size_t i = 0; i < position.pixels(); ++i) {
            const float p = position.data[i];
            low_ = p < low_ ? p : low_;
            high_ = p > high_ ? p : high_;
        }
        // Two passes: count the entries of each list, then write them.
        start_.assign(static_cast<std::size_t>(rows_) * kBins + 1, 0);
        visit([&](std::size_t list, int) { ++start_[list + 1]; });
        for (std::size_t i = 1; i < start_.size(); ++i) start_[i] += start_[i - 1];
        entries_.resize(start_.back());
        std::vector<std::uint32_t> next(start_.begin(), start_.end() - 1);
        visit([&](std::size_t list, int column) { entries_[next[list]++] = static_cast<std::uint16_t>(column); });
    }

    [[nodiscard]] int rows() const { return rows_; }
    [[nodiscard]] std::span<const std::uint16_t> columns(int row, float target) const {
        if (!(target >= low_ && target <= high_)) return {};
        const std::size_t list = static_cast<std::size_t>(row) * kBins + bin(target);
        return {entries_.data() + start_[list], entries_.data() + start_[list + 1]};
    }

  private:
    static constexpr int kBins = 1024;

    [[nodiscard]] std::size_t bin(float p) const {
        return std::min<std::size_t>(static_cast<std::size_t>((p - low_) / (high_ - low_ + 1e-6F) * kBins), kBins - 1);
    }

    template <class Action>
    void visit(const Action& action) const {
        for (int row = 0; row < rows_; ++row)
            for (int column = 0; column < columns_; ++column) {
                float low = std::numeric_limits<float>::infinity(), high = -low;
                // The last row and column are shared with the next block: a crossing lies between pixels.
                const int bottom = std::min((row + 1) * kBlock, position_.height - 1);
                const int right = std::min((column + 1) * kBlock, position_.width - 1);
                for (int v = row * kBlock; v <= bottom; ++v) {
                    const float* p = position_.row(v);
                    for (int u = column * kBlock; u <= right; ++u) {
                        low = p[u] < low ? p[u] : low;
                        high = p[u] > high ? p[u] : high;
                    }
                }
                if (low > high) continue;
                const std::size_t first = static_cast<std::size_t>(row) * kBins;
                for (std::size_t i = bin(low); i <= bin(high); ++i) action(first + i, column);
            }
    }

    Image<const float> position_;
    int rows_, columns_;
    float low_ = std::numeric_limits<float>::infinity(), high_ = -std::numeric_limits<float>::infinity();
    std::vector<std::uint32_t> start_;
    std::vector<std::uint16_t> entries_;
};

/// Largest shift of a pixel's row by the distortion.
double largest_row_shift(Image<const float> shift) {
    float largest = 0;
    for (std::size_t i = 0; i < 2 * shift.pixels() && !shift.empty(); i += 2)
        largest = std::max(largest, std::fabs(shift.data[i + 1]));
    return largest;
}

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
    Search(const PhaseView& view, const BlockIndex& blocks)
        : view_(view), blocks_(blocks), row_shift_(largest_row_shift(view.shift_px)) {}

    /// Walks from the predicted place along the curve, as far as the slope suggests.
    [[nodiscard]] Crossing near(const Curve& curve, float target, double predicted_u, double guess_v) const {
        const int last = view_.position_px.width - 2;
        int u = static_cast<int>(std::floor(predicted_u));
        double v = guess_v;
        for (int i = 0; i < kMaxWarmSteps; ++i) {
            if (u < 0 || u > last) return {};
            const double v0 = curve.row(u, v, kWarmIterations), v1 = curve.row(u + 1, v0 + curve.slope(), 1);
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
        const int width = view_.position_px.width;
        const double a = curve.undistorted_row(0), b = curve.undistorted_row(width - 1);
        const int first = std::max(0, block_row(std::min(a, b) - row_shift_ - 1));
        const int last = std::min(blocks_.rows() - 1, block_row(std::max(a, b) + row_shift_ + 1));
        Crossing best;
        bool several = false;
        for (int row = first; row <= last; ++row)
            for (const int column : blocks_.columns(row, target)) {
                const int begin = column * kBlock, end = std::min(begin + kBlock, width - 1);
                const double v = curve.row(begin, curve.undistorted_row(begin), kColdIterations);
                const double leave = v + curve.slope() * (end - begin);
                // One pixel of margin: the curve bends by far less than that within a block.
                if (block_row(std::max(v, leave) + 1) < row || block_row(std::min(v, leave) - 1) > row) continue;
                scan(curve, target, begin, end, v, [&](const Crossing& c) {
                    several = several || (best.found() && best.u != c.u);
                    if (!best.found() || std::fabs(c.u + 0.5 - predicted_u) < std::fabs(best.u + 0.5 - predicted_u))
                        best = c;
                });
            }
        return several && !(predicted_u == predicted_u) ? Crossing{} : best;
    }

  private:
    static int block_row(double v) { return static_cast<int>(std::floor(v / kBlock)); }

    template <class Action>
    void scan(const Curve& curve, float target, int begin, int end, double v, const Action& action) const {
        float p = curve.position(begin, v);
        for (int u = begin; u < end; ++u) {
            const double v_next = curve.row(u + 1, v + curve.slope(), kWarmIterations);
            const float p_next = curve.position(u + 1, v_next);
            if (encloses(p, p_next, target)) action({u, p, p_next, v, v_next});
            v = v_next;
            p = p_next;
        }
    }

    const PhaseView& view_;
    const BlockIndex& blocks_;
    double row_shift_;
};

/// What the other camera's positions say at a place between pixels.
struct Sample {
    float position = 0, slope = 0;  ///< slope along the curve per column
    float weight = 0;               ///< sum of the squared weights: variance of `position` over that of one pixel
};

/// Weights of the cubic B-spline for four nodes at -1, 0, 1, 2 and a place f in [0, 1].
std::array<float, 4> spline(float f) {
    const float g = 1 - f;
    return {g * g * g / 6, (4 - 6 * f * f + 3 * f * f * f) / 6, (4 - 6 * g * g + 3 * g * g * g) / 6, f * f * f / 6};
}

float sum_of_squares(const std::array<float, 4>& w) { return w[0] * w[0] + w[1] * w[1] + w[2] * w[2] + w[3] * w[3]; }

/// Cubic B-spline of the 4 x 4 pixels around: exact for linear positions, of nearly the same noise wherever the place
/// lies between the pixels (0.23 of a pixel's variance; bilinear: 0.25 ... 1). False where one of them is missing.
bool spline_sample(Image<const float> position, int u, double v, float f, double curve_slope, Sample& out) {
    const int top = static_cast<int>(v);
    if (u < 1 || u + 2 >= position.width || top < 1 || top + 2 >= position.height) return false;
    const auto wu = spline(f), wv = spline(static_cast<float>(v - top));
    std::array<float, 4> columns{}, rows{};
    for (int j = 0; j < 4; ++j) {
        const float* p = position.at(top - 1 + j, u - 1);
        rows[j] = wu[0] * p[0] + wu[1] * p[1] + wu[2] * p[2] + wu[3] * p[3];
        for (int k = 0; k < 4; ++k) columns[k] += wv[j] * p[k];
    }
    out.position = wv[0] * rows[0] + wv[1] * rows[1] + wv[2] * rows[2] + wv[3] * rows[3];
    out.slope = (columns[3] - columns[0]) / 3 + static_cast<float>(curve_slope) * (rows[3] - rows[0]) / 3;
    out.weight = sum_of_squares(wu) * sum_of_squares(wv);
    return out.position == out.position;
}

/// The same from the two columns and rows of the crossing alone, beside edges and gaps.
Sample linear_sample(const Crossing& c, float target, float f) {
    const auto rows = [](double v) {
        const auto g = static_cast<float>(v - std::floor(v));
        return (1 - g) * (1 - g) + g * g;
    };
    return {target, c.p1 - c.p0, (1 - f) * (1 - f) * rows(c.v0) + f * f * rows(c.v1)};
}

/// The place on the curve, and its standard deviation.
struct Match {
    double u = 0, v = 0;
    float sigma = 0, slope = 0;
};

Match refine(const PhaseView& view, const Crossing& c, float target, float target_sigma) {
    const float f = c.fraction(target);
    const double curve_slope = c.v1 - c.v0, v = c.v0 + f * curve_slope;
    Sample sample = linear_sample(c, target, f);
    Sample spline;
    float shift = 0;
    if (spline_sample(view.position_px, c.u, v, f, curve_slope, spline) && spline.slope * sample.slope > 0) {
        shift = (target - spline.position) / spline.slope;
        // The two differ by noise; more than a pixel means that the slope is none.
        if (std::fabs(shift) < 1)
            sample = spline;
        else
            shift = 0;
    }
    const int nearest_v = std::min(static_cast<int>(v + 0.5), view.sigma_px.height - 1);
    const float sigma = *view.sigma_px.at(nearest_v, f < 0.5F ? c.u : c.u + 1);
    const double u = c.u + static_cast<double>(f) + shift;
    return {u, v + shift * curve_slope,
            std::sqrt(target_sigma * target_sigma + sample.weight * sigma * sigma) / std::fabs(sample.slope),
            sample.slope};
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
    const BlockIndex blocks(other.position_px);
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
            const Match match = refine(other, c, target, sigma[u]);
            pixel[2 * u] = static_cast<float>(match.u);
            pixel[2 * u + 1] = static_cast<float>(match.v);
            pixel_sigma[u] = match.sigma;
            trail = {u, match.u, match.v, target, match.slope};
        }
    };
    parallel_for(static_cast<std::size_t>(own.position_px.height), threads, [&](std::size_t begin, std::size_t end) {
        for (std::size_t v = begin; v < end; ++v) correspond_row(static_cast<int>(v));
    });
}

}  // namespace planish
