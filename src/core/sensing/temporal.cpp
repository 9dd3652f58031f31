#include "core/sensing/temporal.hpp"

#include <Eigen/Core>
#include <algorithm>
#include <cmath>
#include <limits>
#include <vector>

#include "core/common/parallel.hpp"

namespace planish {

template <class T>
TemporalStack interleave(std::span<const T* const> images, int height, int width, int threads) {
    const int steps = static_cast<int>(images.size()), padded = (steps + kStepGroup - 1) / kStepGroup * kStepGroup;
    TemporalStack stack{steps, padded, height, width, nullptr};
    stack.grey = std::make_unique_for_overwrite<std::uint16_t[]>(static_cast<std::size_t>(height) * width * padded);
    parallel_for(static_cast<std::size_t>(height), threads, [&](std::size_t begin, std::size_t end) {
        const std::size_t first = begin * width, last = end * width;
        std::fill(stack.grey.get() + first * padded, stack.grey.get() + last * padded, std::uint16_t{0});
        constexpr std::size_t kRun = 256;  // stays in the first cache with all its steps
        for (std::size_t i = first; i < last; i += kRun)
            for (int k = 0; k < steps; ++k) {
                std::uint16_t* out = stack.grey.get() + i * padded + k;
                for (std::size_t j = i; j < std::min(i + kRun, last); ++j, out += padded) *out = images[k][j];
            }
    });
    return stack;
}

template TemporalStack interleave(std::span<const std::uint8_t* const>, int, int, int);
template TemporalStack interleave(std::span<const std::uint16_t* const>, int, int, int);

void temporal_statistics(const TemporalStack& stack, float saturation, int threads, const TemporalStatistics& out) {
    const auto limit = static_cast<std::uint32_t>(std::clamp(std::ceil(saturation), 0.0F, 65536.0F));
    parallel_for(static_cast<std::size_t>(stack.height), threads, [&](std::size_t begin, std::size_t end) {
        for (int v = static_cast<int>(begin); v < static_cast<int>(end); ++v)
            for (int u = 0; u < stack.width; ++u) {
                const std::uint16_t* grey = stack.at(v, u);
                std::uint64_t sum = 0, squares = 0;
                int saturated = 0;
                for (int k = 0; k < stack.steps; ++k) {
                    const std::uint32_t g = grey[k];
                    sum += g;
                    squares += std::uint64_t{g} * g;
                    saturated += g >= limit ? 1 : 0;
                }
                // Whole numbers: the difference of the two large sums is exact.
                const double n = stack.steps, spread = static_cast<double>(stack.steps * squares - sum * sum) / n;
                *out.mean.at(v, u) = static_cast<float>(static_cast<double>(sum) / n);
                *out.norm.at(v, u) = static_cast<float>(std::sqrt(spread));
                *out.saturated.at(v, u) = static_cast<std::uint8_t>(std::min(saturated, 255));
            }
    });
}

UnitVectorField::UnitVectorField(const TemporalStack& stack, const TemporalStatistics& statistics,
                                 Image<const std::uint8_t> usable, int threads)
    : height_(stack.height),
      width_(stack.width),
      padded_(stack.padded),
      coefficients_(std::make_unique_for_overwrite<float[]>(static_cast<std::size_t>(height_) * width_ * padded_)) {
    using Vector = Eigen::Map<Eigen::ArrayXf>;
    const auto length = static_cast<Eigen::Index>(width_) * padded_;
    const auto fill_row = [&](int v, std::vector<float>& unit) {
        for (int u = 0; u < width_; ++u) {
            const std::uint16_t* grey = stack.at(v, u);
            const float mean = *statistics.mean.at(v, u), scale = 1 / *statistics.norm.at(v, u);
            float* out = &unit[static_cast<std::size_t>(u) * padded_];
            for (int k = 0; k < padded_; ++k) out[k] = (static_cast<float>(grey[k]) - mean) * scale;
            for (int k = stack.steps; k < padded_; ++k) out[k] = 0;
            if (*usable.at(v, u) == 0 || *statistics.saturated.at(v, u) != 0)
                out[0] = std::numeric_limits<float>::quiet_NaN();
        }
    };
    parallel_for(static_cast<std::size_t>(height_), threads, [&](std::size_t begin, std::size_t end) {
        const int first = static_cast<int>(begin), last = static_cast<int>(end);
        // Row v stands in rows[(v + 5) % 5]; those beyond the image are missing.
        std::vector<float> rows[5], column(length);
        const std::vector<float> missing(length, std::numeric_limits<float>::quiet_NaN());
        const auto load = [&](int v) {
            auto& row = rows[(v + 5) % 5];
            row = missing;
            if (v >= 0 && v < height_) fill_row(v, row);
        };
        for (int v = first - 2; v < first + 2; ++v) load(v);
        for (int v = first; v < last; ++v) {
            load(v + 2);
            Vector middle(column.data(), length);
            middle.setZero();
            for (int i = 0; i < 5; ++i) middle += kQuasiInterpolant[i] * Vector(rows[(v + 3 + i) % 5].data(), length);
            Vector out(coefficients_.get() + v * length, length);
            out = Vector(rows[v % 5].data(), length);
            const Eigen::Index side = 2 * padded_, inner = length - 2 * side;
            for (const Eigen::Index border : {Eigen::Index{0}, length - side})
                for (int u = 0; u < 2; ++u) out[border + u * padded_] = std::numeric_limits<float>::quiet_NaN();
            if (inner <= 0) continue;
            out.segment(side, inner).setZero();
            for (int i = 0; i < 5; ++i)
                out.segment(side, inner) += kQuasiInterpolant[i] * middle.segment(i * padded_, inner);
        }
    });
}

}  // namespace planish
