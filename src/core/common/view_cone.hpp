#pragma once

#include <Eigen/Core>
#include <algorithm>
#include <array>
#include <cmath>
#include <limits>

#include "core/common/image.hpp"
#include "core/common/moved_camera.hpp"

namespace planish {

/// Smallest box with edges along the axes that holds some points.
struct Box {
    Eigen::Vector3d middle, half;
    bool empty;
};

/// Box of the points (H, W, 3) of a window; those with NaN do not count.
inline Box box_of(const Image<const float>& points, int top, int left, int bottom, int right) {
    // Eight points at a time, which fill whole vectors.
    constexpr int kFloats = 24;
    std::array<float, kFloats> low, high;
    low.fill(std::numeric_limits<float>::infinity());
    high.fill(-std::numeric_limits<float>::infinity());
    const int size = 3 * (right - left);
    for (int v = top; v < bottom; ++v) {
        const float* p = points.at(v, left);
        int first = 0;
        for (; first + kFloats <= size; first += kFloats)
            for (int i = 0; i < kFloats; ++i) {
                const float x = p[first + i];
                low[i] = x < low[i] ? x : low[i];
                high[i] = x > high[i] ? x : high[i];
            }
        for (int i = 0; first + i < size; ++i) {
            const float x = p[first + i];
            low[i] = x < low[i] ? x : low[i];
            high[i] = x > high[i] ? x : high[i];
        }
    }
    Box box{};
    for (int c = 0; c < 3; ++c) {
        double least = low[c], most = high[c];
        for (int i = c + 3; i < kFloats; i += 3) {
            least = std::min<double>(least, low[i]);
            most = std::max<double>(most, high[i]);
        }
        box.middle[c] = 0.5 * (least + most);
        box.half[c] = 0.5 * (most - least);
        box.empty = box.empty || !(least <= most);
    }
    return box;
}

/// The four planes that hold all rays of a camera's image, in another frame, from which that of the camera moves.
///
/// The rays of an image's rim bound all others, as distortion is one to one in the image; they are taken every few
/// pixels of a rim that lies outside the image by more than what a rim may bend between two of them.
class ViewCone {
  public:
    ViewCone(const MovedCamera& moved, int width, int height) {
        double left = kFar, right = -kFar, top = kFar, bottom = -kFar;
        const auto reach = [&](double u, double v) {
            const Eigen::Vector2d n = moved.camera.undistort(moved.camera.from_pixel({u, v}));
            bounded_ = bounded_ && std::isfinite(n.x()) && std::isfinite(n.y());
            left = std::min(left, n.x());
            right = std::max(right, n.x());
            top = std::min(top, n.y());
            bottom = std::max(bottom, n.y());
        };
        const double last_u = width - 1 + kOutside, last_v = height - 1 + kOutside;
        for (double u = -kOutside; u < last_u + kStep; u += kStep)
            for (const double v : {-kOutside, last_v}) reach(std::min(u, last_u), v);
        for (double v = -kOutside; v < last_v + kStep; v += kStep)
            for (const double u : {-kOutside, last_u}) reach(u, std::min(v, last_v));
        const Eigen::Matrix3d& R = moved.R;
        const Eigen::Vector3d& t = moved.t;
        planes_.row(0) = R.row(0) - left * R.row(2);
        planes_.row(1) = right * R.row(2) - R.row(0);
        planes_.row(2) = R.row(1) - top * R.row(2);
        planes_.row(3) = bottom * R.row(2) - R.row(1);
        planes_.row(4) = R.row(2);
        offsets_ << t[0] - left * t[2], right * t[2] - t[0], t[1] - top * t[2], bottom * t[2] - t[1], t[2];
    }

    /// False only where no point of the box lies in the image.
    [[nodiscard]] bool may_see(const Box& box) const {
        if (box.empty) return false;
        if (!bounded_) return true;
        const Eigen::Matrix<double, 5, 1> farthest = planes_ * box.middle + planes_.cwiseAbs() * box.half + offsets_;
        return farthest.minCoeff() > 0;
    }

  private:
    static constexpr double kFar = std::numeric_limits<double>::infinity();
    /// Between two rays of the rim, and from the image to the rim [px].
    static constexpr double kStep = 8, kOutside = 2;

    Eigen::Matrix<double, 5, 3> planes_;
    Eigen::Matrix<double, 5, 1> offsets_;
    bool bounded_ = true;
};

}  // namespace planish
