#include "core/texture/sample_chart.hpp"

#include <Eigen/Core>
#include <algorithm>
#include <cmath>
#include <vector>

#include "core/common/between_pixels.hpp"
#include "core/common/cubic.hpp"
#include "core/common/parallel.hpp"

namespace planish {
namespace {

/// Chart pixels larger than so many map pixels are sampled as if they were of this size.
constexpr float kMaxStretch = 4.0F;
constexpr int kMaxTaps = 2 * static_cast<int>(2 * kMaxStretch) + 2;
/// Kernels of so many taps are the rule; loops over a fixed number vectorise.
constexpr int kFewTaps = 8;
/// Kernels are made for so many places per pixel, and for widths in such parts of a pixel.
constexpr int kPlaces = 256, kWidths = 8;
/// Share of the kernel's weight that may lack.
constexpr float kMinWeight = 0.75F;

/// Correlation of white noise at 1, 2, 3 pixels after cubic convolution, over all places between pixels:
/// autocorrelation of the kernel.
constexpr float kCorrelation[] = {0.1557F, -0.0439F, 0.0022F};

/// The kernel for a place between two pixels.
struct Taps {
    int first = 0, count = 0;     ///< relative to the pixel before the place
    float weight[kMaxTaps] = {};  ///< 0 beyond `count`
    float gain = 1;               ///< of the variance, where the noise was read between pixels before

    Taps() = default;
    Taps(float place, float stretch) {
        first = static_cast<int>(std::ceil(place - 2 * stretch));
        count = std::min(kMaxTaps, static_cast<int>(std::floor(place + 2 * stretch)) - first + 1);
        float sum = 0, squares = 0, products = 0;
        for (int k = 0; k < count; ++k)
            sum += weight[k] = cubic_weight((static_cast<float>(first + k) - place) / stretch);
        for (int k = 0; k < count; ++k) weight[k] /= sum;
        for (int k = 0; k < count; ++k) {
            squares += weight[k] * weight[k];
            for (int lag = 1; lag <= 3 && k + lag < count; ++lag)
                products += 2 * kCorrelation[lag - 1] * weight[k] * weight[k + lag];
        }
        gain = 1 + products / squares;
    }
};

/// The kernels of all places and widths.
class Kernels {
  public:
    Kernels() : taps_(static_cast<std::size_t>(kPlaces) * kStretches) {
        for (int s = 0; s < kStretches; ++s)
            for (int f = 0; f < kPlaces; ++f)
                taps_[static_cast<std::size_t>(s) * kPlaces + f] =
                    Taps(static_cast<float>(f) / kPlaces, 1.0F + static_cast<float>(s) / kWidths);
    }

    /// The kernel, and the pixel that it is relative to.
    [[nodiscard]] const Taps& at(float place, float stretch, int& pixel) const {
        const int fine = static_cast<int>(place * kPlaces + 0.5F),
                  wide = static_cast<int>((stretch - 1) * kWidths + 0.5F);
        pixel = fine / kPlaces;
        return taps_[static_cast<std::size_t>(wide) * kPlaces + (fine - pixel * kPlaces)];
    }

  private:
    static constexpr int kStretches = static_cast<int>((kMaxStretch - 1) * kWidths) + 1;
    std::vector<Taps> taps_;
};

/// Map pixels per chart pixel along both axes of the map, at least 1, for the pixels of a row of the chart. Of both
/// neighbours the nearer one counts: the other may lie beyond a jump.
void stretches(const Image<const float>& source, int y, float* __restrict out) {
    const int size = 2 * source.width;
    const float* here = source.row(y);
    const float* above = y > 0 ? source.row(y - 1) : nullptr;
    const float* below = y + 1 < source.height ? source.row(y + 1) : nullptr;
    const auto nearer = [](float nearest, float a, float b) {
        const float d = std::fabs(a - b);
        return d < nearest ? d : nearest;  // false for NaN
    };
    const auto of = [&](int k, bool left, bool right) {
        float across = kMaxStretch, down = kMaxStretch;
        if (left) across = nearer(across, here[k - 2], here[k]);
        if (right) across = nearer(across, here[k + 2], here[k]);
        if (above) down = nearer(down, above[k], here[k]);
        if (below) down = nearer(down, below[k], here[k]);
        const float larger = across > down ? across : down;
        return larger > 1.0F ? larger : 1.0F;
    };
    for (int k = 0; k < std::min(2, size); ++k) out[k] = of(k, false, k + 2 < size);
    for (int k = 2; k < size - 2; ++k) out[k] = of(k, true, true);
    for (int k = std::max(2, size - 2); k < size; ++k) out[k] = of(k, true, false);
}

/// Sums over a kernel: weighted values, weights, squared weighted errors.
struct Sums {
    float value = 0, weight = 0, squares = 0;
};

/// The kernel's window: its first row and column, and its weights along both.
struct Window {
    int top, left;
    const Taps &down, &across;
};

/// Inside the map and without gaps; NaN where there is one.
Sums read_whole(const Image<const float>& value, const Image<const float>& sigma, const Window& w) {
    using Lanes = Eigen::Array<float, kFewTaps, 1>;
    Lanes values = Lanes::Zero(), squares = Lanes::Zero();
    for (int j = 0; j < w.down.count; ++j) {
        const float weight = w.down.weight[j];
        values += weight * Eigen::Map<const Lanes>(value.at(w.top + j, w.left));
        const Lanes error = weight * Eigen::Map<const Lanes>(sigma.at(w.top + j, w.left));
        squares += error * error;
    }
    const Eigen::Map<const Lanes> across(w.across.weight);
    return {(across * values).sum(), 1, (across * across * squares).sum()};
}

/// What is known of the kernel's window.
Sums read_known(const Image<const float>& value, const Image<const float>& sigma, const Window& w) {
    Sums sums;
    for (int j = std::max(0, -w.top); j < std::min(w.down.count, value.height - w.top); ++j)
        for (int i = std::max(0, -w.left); i < std::min(w.across.count, value.width - w.left); ++i) {
            const float grey = *value.at(w.top + j, w.left + i), error = *sigma.at(w.top + j, w.left + i);
            if (!(grey == grey && error == error)) continue;
            const float weight = w.down.weight[j] * w.across.weight[i];
            sums.value += weight * grey;
            sums.weight += weight;
            sums.squares += (weight * error) * (weight * error);
        }
    return sums;
}

Sums read(const Image<const float>& value, const Image<const float>& sigma, const Window& w) {
    if (w.across.count <= kFewTaps && w.left >= 0 && w.left + kFewTaps <= value.width && w.top >= 0 &&
        w.top + w.down.count <= value.height) {
        const Sums sums = read_whole(value, sigma, w);
        if (sums.value == sums.value && sums.squares == sums.squares) return sums;
    }
    return read_known(value, sigma, w);
}

/// Whether all four pixels around a place are known.
bool all_known(const Image<const std::uint8_t>& known, float u, float v) {
    const PixelShare across(u, known.width), down(v, known.height);
    const std::uint8_t* corner = known.at(down.index, across.index);
    const int right = across.index + 1 < known.width ? 1 : 0, below = down.index + 1 < known.height ? known.width : 0;
    return (corner[0] & corner[right] & corner[below] & corner[below + right]) != 0;
}

/// One row of a chart, in the steps that loops over whole rows vectorise.
struct ChartRow {
    std::vector<float> stretch, value, weight, squares;

    explicit ChartRow(int width) : stretch(2 * width), value(width), weight(width), squares(width) {}

    void finish(float* __restrict sampled, float* __restrict deviation, std::uint8_t* __restrict mask) const {
        for (int x = 0; x < static_cast<int>(value.size()); ++x) {
            const bool shown = weight[x] >= kMinWeight;
            const float whole = shown ? weight[x] : 1.0F;
            sampled[x] = (shown ? value[x] : 0.0F) / whole;
            deviation[x] = std::sqrt(shown ? squares[x] : 0.0F) / whole;
            mask[x] = shown ? 1 : 0;
        }
    }
};

}  // namespace

void sample_chart(const Image<const float>& value, const Image<const float>& sigma,
                  const Image<const std::uint8_t>& known, const Image<const float>& source, float interpolated,
                  int threads, const SampledChart& out) {
    const auto right = static_cast<float>(value.width - 1), bottom = static_cast<float>(value.height - 1);
    static const Kernels kernels;
    parallel_for(source.height, threads, [&](std::size_t first, std::size_t last) {
        ChartRow line(source.width);
        for (auto y = static_cast<int>(first); y < static_cast<int>(last); ++y) {
            const float* place = source.row(y);
            stretches(source, y, line.stretch.data());
            for (int x = 0; x < source.width; ++x) {
                const float u = place[2 * x], v = place[2 * x + 1];
                line.weight[x] = 0;
                if (!(u >= 0 && v >= 0 && u <= right && v <= bottom)) continue;  // NaN: no surface
                if (!all_known(known, u, v)) continue;
                int row = 0, column = 0;
                const Taps& across = kernels.at(u, line.stretch[2 * x], column);
                const Taps& down = kernels.at(v, line.stretch[2 * x + 1], row);
                const Sums sums = read(value, sigma, {row + down.first, column + across.first, down, across});
                line.value[x] = sums.value;
                line.weight[x] = sums.weight;
                line.squares[x] = sums.squares * (1 + interpolated * (across.gain * down.gain - 1));
            }
            line.finish(out.value.row(y), out.sigma.row(y), out.mask.row(y));
        }
    });
}

}  // namespace planish
