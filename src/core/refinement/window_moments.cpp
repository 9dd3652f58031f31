#include "core/refinement/window_moments.hpp"

#include <Eigen/Core>
#include <algorithm>
#include <cstddef>

#include "core/common/parallel.hpp"

namespace planish {
namespace {

/// Sums that stay in registers while a window is gone through.
constexpr int kTogether = 32;
using Together = Eigen::Array<float, kTogether, 1>;

/// One row of windows: first the sums over columns, then those over rows.
class WindowRow {
  public:
    WindowRow(const Image<const float>& image, const MomentWindow& window)
        : image_(image),
          window_(window),
          reach_(static_cast<int>(window.taps[0].size()) / 2),
          line_(image.width + 2 * reach_ + window.step),
          part_((line_.size() + window.step - 1) / window.step + kTogether),
          parts_(part_ * window.step) {}

    void compute(int i, const Image<float>& out) {
        for (int q = 0; q < static_cast<int>(window_.taps.size()); ++q) {
            const auto wanted = [q](const std::array<int, 2>& pair) { return pair[1] == q; };
            if (std::none_of(window_.pairs.begin(), window_.pairs.end(), wanted)) continue;
            sum_columns(i * window_.step - reach_, window_.taps[q]);
            take_apart();
            for (std::size_t k = 0; k < window_.pairs.size(); ++k)
                if (wanted(window_.pairs[k]))
                    sum_rows(window_.taps[window_.pairs[k][0]], out.at(static_cast<int>(k), i), out.channels);
        }
    }

  private:
    void sum_columns(int top, const std::vector<float>& taps) {
        const int first = std::max(0, -top), end = std::min(static_cast<int>(taps.size()), image_.height - top);
        float* out = line_.data() + reach_;
        int u = 0;
        for (; u + kTogether <= image_.width; u += kTogether) {
            Together sum = Together::Zero();
            for (int k = first; k < end; ++k) sum += taps[k] * Eigen::Map<const Together>(image_.at(top + k, u));
            Eigen::Map<Together>(out + u) = sum;
        }
        for (; u < image_.width; ++u) {
            float sum = 0;
            for (int k = first; k < end; ++k) sum += taps[k] * *image_.at(top + k, u);
            out[u] = sum;
        }
    }

    /// Columns that are a multiple of the step apart lie together.
    void take_apart() {
        const auto step = static_cast<std::size_t>(window_.step);
        for (std::size_t s = 0; s < step; ++s) {
            float* to = parts_.data() + s * part_;
            for (std::size_t j = 0; s + j * step < line_.size(); ++j) to[j] = line_[s + j * step];
        }
    }

    void sum_rows(const std::vector<float>& taps, float* out, int count) const {
        for (int j = 0; j < count; j += kTogether) {
            Together sum = Together::Zero();
            for (int k = 0; k < static_cast<int>(taps.size()); ++k)
                sum += taps[k] *
                       Eigen::Map<const Together>(parts_.data() + k % window_.step * part_ + k / window_.step + j);
            std::copy_n(sum.data(), std::min(kTogether, count - j), out + j);
        }
    }

    Image<const float> image_;
    const MomentWindow& window_;
    int reach_;
    std::vector<float> line_;
    std::size_t part_;
    std::vector<float> parts_;
};

}  // namespace

void window_moments(const Image<const float>& image, const MomentWindow& window, int threads, const Image<float>& out) {
    parallel_for(out.width, threads, [&](std::size_t first, std::size_t last) {
        WindowRow row(image, window);
        for (auto i = static_cast<int>(first); i < static_cast<int>(last); ++i) row.compute(i, out);
    });
}

}  // namespace planish
