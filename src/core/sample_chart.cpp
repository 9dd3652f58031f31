#include <algorithm>
#include <cmath>
#include <limits>

#include "core/chart.hpp"
#include "core/cubic.hpp"
#include "core/parallel.hpp"

namespace planish {
namespace {

/// Chart pixels larger than so many map pixels are sampled as if they were of this size.
constexpr float kMaxStretch = 4.0F;
constexpr int kMaxTaps = 2 * static_cast<int>(2 * kMaxStretch) + 2;
/// Share of the kernel's weight that may lack.
constexpr float kMinWeight = 0.75F;

struct Taps {
    int first = 0, count = 0;
    float weight[kMaxTaps];

    Taps(float place, float stretch) {
        first = static_cast<int>(std::ceil(place - 2 * stretch));
        count = std::min(kMaxTaps, static_cast<int>(std::floor(place + 2 * stretch)) - first + 1);
        float sum = 0;
        for (int k = 0; k < count; ++k) {
            weight[k] = cubic_weight((static_cast<float>(first + k) - place) / stretch);
            sum += weight[k];
        }
        for (int k = 0; k < count; ++k) weight[k] /= sum;
    }
};

/// Correlation of white noise at 1, 2, 3 pixels after cubic convolution, over all places between pixels:
/// autocorrelation of the kernel.
constexpr float kCorrelation[] = {0.1557F, -0.0439F, 0.0022F};

/// By how much the variance of the weighted sum is larger for such noise than for independent noise.
float correlation_gain(const Taps& taps) {
    float squares = 0, products = 0;
    for (int k = 0; k < taps.count; ++k) {
        squares += taps.weight[k] * taps.weight[k];
        for (int lag = 1; lag <= 3 && k + lag < taps.count; ++lag)
            products += 2 * kCorrelation[lag - 1] * taps.weight[k] * taps.weight[k + lag];
    }
    return 1 + products / squares;
}

/// Map pixels per chart pixel along one axis of the map, at least 1. Of both neighbours the nearer one counts: the
/// other may lie beyond a jump.
float stretch_at(const Image<const float>& source, int y, int x, int axis) {
    const auto step = [&](int dy, int dx) {
        float nearest = kMaxStretch;
        for (const int sign : {-1, 1}) {
            const int row = y + sign * dy, column = x + sign * dx;
            if (row < 0 || row >= source.height || column < 0 || column >= source.width) continue;
            const float d = std::fabs(source.at(row, column)[axis] - source.at(y, x)[axis]);
            if (d < nearest) nearest = d;  // false for NaN
        }
        return nearest;
    };
    return std::max({1.0F, step(0, 1), step(1, 0)});
}

}  // namespace

void sample_chart(const Image<const float>& value, const Image<const float>& sigma, const Image<const float>& source,
                  float interpolated, int threads, const Image<float>& out_value, const Image<float>& out_sigma) {
    constexpr float nan = std::numeric_limits<float>::quiet_NaN();
    parallel_for(source.height, threads, [&](std::size_t first, std::size_t last) {
        for (auto y = static_cast<int>(first); y < static_cast<int>(last); ++y)
            for (int x = 0; x < source.width; ++x) {
                float& sampled = *out_value.at(y, x);
                float& deviation = *out_sigma.at(y, x);
                sampled = deviation = nan;
                const float *place = source.at(y, x), u = place[0], v = place[1];
                if (!(u >= 0 && v >= 0 && u <= static_cast<float>(value.width - 1) &&
                      v <= static_cast<float>(value.height - 1)))
                    continue;
                const Taps across(u, stretch_at(source, y, x, 0)), down(v, stretch_at(source, y, x, 1));
                float sum = 0, weights = 0, squares = 0;
                for (int j = 0; j < down.count; ++j) {
                    const int row = down.first + j;
                    if (row < 0 || row >= value.height) continue;
                    const int begin = std::max(0, -across.first);
                    const int end = std::min(across.count, value.width - across.first);
                    const float* line = value.row(row) + across.first;
                    const float* errors = sigma.row(row) + across.first;
                    for (int i = begin; i < end; ++i) {
                        const bool known = line[i] == line[i] && errors[i] == errors[i];
                        const float w = known ? down.weight[j] * across.weight[i] : 0.0F;
                        const float error = known ? w * errors[i] : 0.0F;
                        sum += w * (known ? line[i] : 0.0F);
                        weights += w;
                        squares += error * error;
                    }
                }
                if (weights < kMinWeight) continue;
                sampled = sum / weights;
                const float gain = 1 + interpolated * (correlation_gain(across) * correlation_gain(down) - 1);
                deviation = std::sqrt(squares * gain) / weights;
            }
    });
}

}  // namespace planish
