#include "core/texture/local_plane.hpp"

#include <Eigen/Core>
#include <algorithm>
#include <array>
#include <cmath>
#include <limits>

#include "core/common/parallel.hpp"

namespace planish {
namespace {

constexpr int kLane = 8;
using Lanes = Eigen::Array<float, kLane, 1>;
using Kernel = std::vector<float>;

/// The window's weights times the powers 0, 1, 2 of the distance along an axis.
struct Powers {
    std::array<Kernel, 3> of;
    int reach;

    explicit Powers(const Kernel& bell) : reach(static_cast<int>(bell.size() / 2)) {
        for (std::size_t k = 0; k < bell.size(); ++k) {
            const float at = static_cast<float>(k) - static_cast<float>(reach);
            of[0].push_back(bell[k]);
            of[1].push_back(bell[k] * at);
            of[2].push_back(bell[k] * at * at);
        }
    }
};

/// Moments of one row of blocks: first along columns, then along rows.
class Moments {
  public:
    /// Of weight 1, x, y, xx, xy, yy and of total 1, x, y.
    static constexpr int kCount = 9;

    Moments(const Powers& powers, int width)
        : powers_(powers), width_((width + kLane - 1) / kLane * kLane), stride_(width_ + 2 * powers.reach) {
        down_.fill(std::vector<float>(stride_));
        for (auto& row : moment) row.resize(width_);
    }

    void compute(const Image<const float>& total, const Image<const float>& weight, int y) {
        sum_down<3>(weight, y, 0);
        sum_down<2>(total, y, 3);
        const int taps = 2 * powers_.reach + 1;
        for (int x = 0; x < width_; x += kLane) {
            std::array<Lanes, kCount> sums;
            sums.fill(Lanes::Zero());
            for (int k = 0; k < taps; ++k) {
                const float one = powers_.of[0][k], first = powers_.of[1][k], second = powers_.of[2][k];
                const auto at = [&](int i) { return Eigen::Map<const Lanes>(down_[i].data() + x + k); };
                sums[0] += one * at(0);
                sums[1] += first * at(0);
                sums[2] += one * at(1);
                sums[3] += second * at(0);
                sums[4] += first * at(1);
                sums[5] += one * at(2);
                sums[6] += one * at(3);
                sums[7] += first * at(3);
                sums[8] += one * at(4);
            }
            for (int i = 0; i < kCount; ++i) Eigen::Map<Lanes>(moment[i].data() + x) = sums[i];
        }
    }

    std::array<std::vector<float>, kCount> moment;

  private:
    /// Sums along columns with the powers 0 to `count` - 1, into the rows from `first` on.
    template <int count>
    void sum_down(const Image<const float>& image, int y, int first) {
        const int top = std::max(0, y - powers_.reach), end = std::min(image.height, y + powers_.reach + 1);
        const int whole = image.width / kLane * kLane, tap = powers_.reach - y;
        for (int x = 0; x < whole; x += kLane) {
            std::array<Lanes, count> sums;
            sums.fill(Lanes::Zero());
            for (int v = top; v < end; ++v) {
                const Lanes values = Eigen::Map<const Lanes>(image.row(v) + x);
                for (int i = 0; i < count; ++i) sums[i] += powers_.of[i][v + tap] * values;
            }
            for (int i = 0; i < count; ++i) Eigen::Map<Lanes>(down_[first + i].data() + powers_.reach + x) = sums[i];
        }
        for (int x = whole; x < image.width; ++x)
            for (int i = 0; i < count; ++i) {
                float sum = 0;
                for (int v = top; v < end; ++v) sum += powers_.of[i][v + tap] * image.row(v)[x];
                down_[first + i][powers_.reach + x] = sum;
            }
    }

    const Powers& powers_;
    int width_, stride_;
    std::array<std::vector<float>, 5> down_;  ///< weight times 1, y, y^2; total times 1, y; zeros beside the image
};

void solve(const Moments& moments, const PlaneWindow& window, int width, float* __restrict out) {
    const auto& m = moments.moment;
    const float *density = m[0].data(), *first_x = m[1].data(), *first_y = m[2].data(), *second_xx = m[3].data(),
                *second_xy = m[4].data(), *second_yy = m[5].data(), *value = m[6].data(), *value_x = m[7].data(),
                *value_y = m[8].data();
    constexpr float nan = std::numeric_limits<float>::quiet_NaN();
    for (int i = 0; i < width; ++i) {
        const float per = 1 / density[i];
        const float mean = value[i] * per, x = first_x[i] * per, y = first_y[i] * per;
        const float xx = second_xx[i] * per - x * x + window.thin, yy = second_yy[i] * per - y * y + window.thin,
                    xy = second_xy[i] * per - x * y;
        const float slope_x = value_x[i] * per - x * mean, slope_y = value_y[i] * per - y * mean;
        // The plane at the block itself, (x, y) from the middle of what is known.
        const float solved =
            (x * (yy * slope_x - xy * slope_y) + y * (xx * slope_y - xy * slope_x)) / (xx * yy - xy * xy);
        const float limit = window.steepest * std::fabs(mean);
        const float less = solved < -limit ? -limit : solved, held = less > limit ? limit : less;
        out[i] = density[i] > window.least_weight ? mean - held : nan;
    }
}

}  // namespace

void local_planes(const Image<const float>& total, const Image<const float>& weight, const PlaneWindow& window,
                  int threads, const Image<float>& out) {
    const Powers powers(window.bell);
    parallel_for(out.height, threads, [&](std::size_t first, std::size_t last) {
        Moments moments(powers, out.width);
        for (auto y = static_cast<int>(first); y < static_cast<int>(last); ++y) {
            moments.compute(total, weight, y);
            solve(moments, window, out.width, out.row(y));
        }
    });
}

}  // namespace planish
