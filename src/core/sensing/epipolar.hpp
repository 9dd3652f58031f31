#pragma once

#include <Eigen/Core>
#include <Eigen/Geometry>
#include <algorithm>
#include <cmath>

#include "core/common/image.hpp"

namespace planish {

/// Pixel (u, v, 1) at its place without lens distortion; `shift_px` (two channels) may be empty.
inline Eigen::Vector3d undistorted_pixel(Image<const float> shift_px, int u, int v) {
    if (shift_px.empty()) return {static_cast<double>(u), static_cast<double>(v), 1.0};
    const float* shift = shift_px.at(v, u);
    return {static_cast<double>(u) + shift[0], static_cast<double>(v) + shift[1], 1.0};
}

/// The epipolar curve of one pixel in the other camera: row v as a function of column u. Its line in undistorted pixels
/// must be nearer to a row than to a column; `shift_px` holds each pixel's shift to its undistorted place, or nothing.
class EpipolarCurve {
  public:
    EpipolarCurve(Image<const float> shift_px, const Eigen::Vector3d& line)
        : shift_px_(shift_px), slope_(-line.x() / line.y()), offset_(-line.z() / line.y()) {}

    /// Row at column u by fixed-point steps: each gains a factor of about the distortion's gradient (0.05 at most).
    [[nodiscard]] double row(int u, double guess, int iterations) const {
        if (shift_px_.empty()) return undistorted_row(u);
        double v = guess;
        const int last = shift_px_.height - 2;
        for (int i = 0; i < iterations; ++i) {
            const int top = std::clamp(static_cast<int>(v), 0, last);
            const double f = std::clamp(v - top, 0.0, 1.0);
            const float* a = shift_px_.at(top, u);
            const float* b = shift_px_.at(top + 1, u);
            v = slope_ * (u + (1 - f) * a[0] + f * b[0]) + offset_ - ((1 - f) * a[1] + f * b[1]);
        }
        return v;
    }
    [[nodiscard]] double slope() const { return slope_; }
    [[nodiscard]] double undistorted_row(double u) const { return slope_ * u + offset_; }

  private:
    Image<const float> shift_px_;
    double slope_, offset_;
};

}  // namespace planish
