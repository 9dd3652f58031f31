#pragma once

#include <Eigen/Core>
#include <memory>

#include "core/sensing/epipolar.hpp"
#include "core/sensing/temporal_fit.hpp"

namespace planish {

/// Columns of a curve are handled in blocks of so many.
constexpr int kColumnBlock = 16;

/// All epipolar curves of a camera, one pixel apart, with the unit vectors along them.
///
/// Epipolar lines form a pencil: each is told by the row at which it crosses the image's middle column, so that the
/// curves of all pixels of the organising camera are these, within half a pixel.
class CurveTable {
  public:
    /// `lines` (low, high): rows of the middle column between which there are curves; `stride`: of the columns.
    CurveTable(const TemporalView& view, Image<const float> shift_px, const Eigen::Vector3d& epipole, int stride,
               Eigen::Vector2d lines, int threads);
    [[nodiscard]] double crossing(const Eigen::Vector3d& line) const {
        return -(line.x() * middle_ + line.z()) / line.y();
    }
    /// Number of the curve nearest to a crossing; -1 where there is none.
    [[nodiscard]] int curve(double crossing) const {
        const double i = std::round(crossing - first_);
        return i >= 0 && i < curves_ ? static_cast<int>(i) : -1;
    }
    [[nodiscard]] int stride() const { return stride_; }
    [[nodiscard]] int columns() const { return columns_; }
    [[nodiscard]] int blocks() const { return blocks_; }
    /// Unit vectors of a block of columns: (steps, kColumnBlock); zero where there are none.
    [[nodiscard]] const float* block(int curve, int index) const {
        return values_.get() + (static_cast<std::size_t>(curve) * blocks_ + index) * steps_ * kColumnBlock;
    }

  private:
    void fill(const TemporalView& view, const EpipolarCurve& curve, float* out) const;

    int steps_, stride_, columns_, blocks_, curves_;
    double middle_, first_;
    std::unique_ptr<float[]> values_;
};

/// Point in which all epipolar lines F x meet, e' F = 0.
Eigen::Vector3d epipole_of(const Eigen::Matrix3d& F);

/// Mean correlation of the vectors of pixels `lag` = 0, 1, ..., lags - 1 columns apart, the share of noise taken away.
std::vector<double> column_correlation(const TemporalView& view, int lags);

}  // namespace planish
