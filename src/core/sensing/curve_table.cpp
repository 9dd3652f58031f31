#include "core/sensing/curve_table.hpp"

#include <Eigen/Geometry>
#include <algorithm>
#include <cmath>
#include <vector>

#include "core/common/parallel.hpp"

namespace planish {
namespace {

/// Fixed-point steps for a curve's row, from far away and from the column before.
constexpr int kColdIterations = 6, kWarmIterations = 2;
/// Every so many rows are looked at for the mean correlation.
constexpr int kSampledRow = 16;

/// Adds weight times the unit vector of a pixel.
void add_unit(const TemporalView& view, int v, int u, float weight, std::vector<float>& sum) {
    const std::uint16_t* grey = view.stack.at(v, u);
    const float mean = *view.statistics.mean.at(v, u), scale = weight / *view.statistics.norm.at(v, u);
    for (int k = 0; k < view.stack.steps; ++k) sum[k] += (static_cast<float>(grey[k]) - mean) * scale;
}

}  // namespace

Eigen::Vector3d epipole_of(const Eigen::Matrix3d& F) {
    Eigen::Vector3d best = Eigen::Vector3d::Zero();
    for (int i = 0; i < 3; ++i) {
        const Eigen::Vector3d meet = F.col(i).cross(F.col((i + 1) % 3));
        if (meet.squaredNorm() > best.squaredNorm()) best = meet;
    }
    return best.normalized();
}

std::vector<double> column_correlation(const TemporalView& view, int lags) {
    std::vector<double> total(lags), count(lags);
    double noise = 0;
    std::vector<float> a(view.stack.steps), b(view.stack.steps);
    for (int v = kSampledRow / 2; v < view.stack.height; v += kSampledRow)
        for (int u = 0; u + lags <= view.stack.width; u += lags) {
            if (*view.usable.at(v, u) == 0) continue;
            std::fill(a.begin(), a.end(), 0.0F);
            add_unit(view, v, u, 1, a);
            const float norm = *view.statistics.norm.at(v, u), mean = *view.statistics.mean.at(v, u);
            noise += static_cast<float>(view.stack.steps - 1) * (view.noise.offset + view.noise.slope * mean) /
                     (norm * norm);
            for (int lag = 0; lag < lags; ++lag) {
                if (*view.usable.at(v, u + lag) == 0) continue;
                std::fill(b.begin(), b.end(), 0.0F);
                add_unit(view, v, u + lag, 1, b);
                for (int k = 0; k < view.stack.steps; ++k) total[lag] += a[k] * b[k];
                ++count[lag];
            }
        }
    const double clean = std::max(1 - noise / std::max(count[0], 1.0), 0.1);
    for (int lag = 1; lag < lags; ++lag) total[lag] = std::min(total[lag] / std::max(count[lag], 1.0) / clean, 1.0);
    total[0] = 1;
    return total;
}

CurveTable::CurveTable(const TemporalView& view, Image<const float> shift_px, const Eigen::Vector3d& epipole,
                       int stride, Eigen::Vector2d lines, int threads)
    : steps_(view.stack.steps),
      stride_(stride),
      columns_((view.stack.width - 1) / stride + 1),
      blocks_((columns_ + kColumnBlock - 1) / kColumnBlock),
      curves_(std::max(static_cast<int>(std::ceil(lines[1]) - std::floor(lines[0])) + 1, 0)),
      middle_(0.5 * view.stack.width),
      first_(std::floor(lines[0])) {
    const std::size_t size = static_cast<std::size_t>(blocks_) * steps_ * kColumnBlock;
    values_ = std::make_unique_for_overwrite<float[]>(size * curves_);
    parallel_for(static_cast<std::size_t>(curves_), threads, [&](std::size_t begin, std::size_t end) {
        for (std::size_t i = begin; i < end; ++i) {
            const Eigen::Vector3d through(middle_, first_ + static_cast<double>(i), 1);
            fill(view, EpipolarCurve(shift_px, epipole.cross(through)), values_.get() + i * size);
        }
    });
}

void CurveTable::fill(const TemporalView& view, const EpipolarCurve& curve, float* out) const {
    std::vector<float> unit(steps_);
    std::fill(out, out + static_cast<std::size_t>(blocks_) * steps_ * kColumnBlock, 0.0F);
    double v = curve.row(0, curve.undistorted_row(0), kColdIterations);
    for (int j = 0; j < columns_; ++j) {
        const int u = j * stride_;
        if (j > 0) v = curve.row(u, v + stride_ * curve.slope(), kWarmIterations);
        if (!(v >= 0 && v < view.stack.height - 1)) continue;
        const int top = static_cast<int>(v);
        const auto f = static_cast<float>(v - top);
        const int usable[2] = {*view.usable.at(top, u), *view.usable.at(top + 1, u)};
        if (usable[0] + usable[1] == 0) continue;
        std::fill(unit.begin(), unit.end(), 0.0F);
        for (int i = 0; i < 2; ++i)
            if (usable[i] != 0) add_unit(view, top + i, u, usable[1 - i] == 0 ? 1.0F : (i == 0 ? 1 - f : f), unit);
        float squares = 0;
        for (const float x : unit) squares += x * x;
        const float scale = squares > 0 ? 1 / std::sqrt(squares) : 0;
        float* column = out + static_cast<std::size_t>(j / kColumnBlock) * steps_ * kColumnBlock + j % kColumnBlock;
        for (int k = 0; k < steps_; ++k) column[k * kColumnBlock] = unit[k] * scale;
    }
}

}  // namespace planish
