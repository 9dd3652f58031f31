#include "core/texture/fixed_pattern.hpp"

#include <algorithm>
#include <vector>

#include "core/common/parallel.hpp"
#include "core/texture/blocks.hpp"

namespace planish {

void add_to_pattern(const Image<const float>& value, const Image<const float>& weight, int factor, int threads,
                    const Image<float>& sum, const Image<float>& weights) {
    parallel_for(value.height, threads, [&](std::size_t first, std::size_t last) {
        std::vector<float> spread(value.width);
        const float* __restrict w = spread.data();
        for (auto v = static_cast<int>(first); v < static_cast<int>(last); ++v) {
            spread_blocks(weight.row(v / factor), factor, value.width, spread.data());
            const float* __restrict line = value.row(v);
            float* __restrict sums = sum.row(v);
            float* __restrict totals = weights.row(v);
            for (int u = 0; u < value.width; ++u) {
                const bool known = line[u] == line[u];
                sums[u] += known ? w[u] * line[u] : 0.0F;
                totals[u] += known ? w[u] : 0.0F;
            }
        }
    });
}

void remove_pattern(const Image<const float>& band, const Image<const float>& own, const PatternKnowledge& known,
                    float share, int threads, const Image<float>& rest, const Image<float>& uncertain) {
    const int width = band.width;
    parallel_for(band.height, threads, [&](std::size_t first, std::size_t last) {
        BlockLerp prior_map(known.prior, known.factor, width), still_map(known.still, known.factor, width),
            gain_map(known.gain, known.factor, width);
        std::vector<float> prior_row(width), still_row(width), gain_row(width), own_row(width, 0.0F);
        for (auto v = static_cast<int>(first); v < static_cast<int>(last); ++v) {
            prior_map.row(v, prior_row.data());
            still_map.row(v, still_row.data());
            gain_map.row(v, gain_row.data());
            if (!own.empty()) spread_blocks(own.row(v / known.factor), known.factor, width, own_row.data());
            const float* __restrict prior = prior_row.data();
            const float* __restrict still = still_row.data();
            const float* __restrict gain = gain_row.data();
            const float* __restrict mine = own_row.data();
            const float* __restrict contrast = band.row(v);
            const float* __restrict sums = known.sum.row(v);
            const float* __restrict weights = known.weight.row(v);
            float* __restrict corrected = rest.row(v);
            float* __restrict variance = uncertain.row(v);
            for (int u = 0; u < width; ++u) {
                // A pixel that the sums left out has no more weight in them than its own.
                const bool counted = weights[u] >= mine[u];
                const float left = weights[u] - (counted ? mine[u] : 0.0F), w = left > 0 ? left : 0.0F;
                const float s = sums[u] - ((counted & (mine[u] > 0)) ? mine[u] * contrast[u] : 0.0F);
                // Best linear estimate, per * s, from the mean s / w, whose errors are 1 / (gain w) and `still`.
                const float per = gain[u] * prior[u] / (1 + gain[u] * w * (prior[u] + still[u]));
                const bool usable = (w > 1e-3F * weights[u]) & (w > 0);
                corrected[u] -= usable ? per * s : 0.0F;
                variance[u] += share * prior[u] * (1 - (usable ? per * w : 0.0F));
            }
        }
    });
}

}  // namespace planish
