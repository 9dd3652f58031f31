#include "core/refinement/spectrum_cells.hpp"

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <numbers>
#include <vector>

#include "core/common/parallel.hpp"

namespace planish {
namespace {

float product(const float* a, const float* b) { return a[0] * b[0] + a[1] * b[1]; }

/// The products of one row of frequencies, continued to both sides by those of opposite frequencies, which are alike.
void multiply(const Image<const float>& first, const Image<const float>& second, int y, int around, float* out) {
    const int opposite = (first.height - y) % first.height, width = first.width;
    const float* __restrict a = first.row(y);
    const float* __restrict b = second.row(y);
    float* __restrict to = out + around;
    for (int x = 0; x < width; ++x) to[x] = a[2 * x] * b[2 * x] + a[2 * x + 1] * b[2 * x + 1];
    for (int d = 1; d <= around; ++d) {
        to[-d] = product(first.at(opposite, d), second.at(opposite, d));
        to[width - 1 + d] = product(first.at(opposite, width - 1 - d), second.at(opposite, width - 1 - d));
    }
}

/// Weights of a triangle of 2 n - 1 values, their sum 1.
std::vector<float> triangle(int n) {
    std::vector<float> weights;
    for (int d = 1 - n; d < n; ++d)
        weights.push_back((1 - static_cast<float>(std::abs(d)) / static_cast<float>(n)) / static_cast<float>(n));
    return weights;
}

/// exp(-(2 pi s f)^2 / 2) at the frequencies k / size, those above a half being negative.
std::vector<float> bell(int count, int size, double s) {
    std::vector<float> out(count);
    for (int k = 0; k < count; ++k) {
        const double at = 2 * std::numbers::pi * s * (k <= size / 2 ? k : k - size) / size;
        out[k] = static_cast<float>(std::exp(-0.5 * at * at));
    }
    return out;
}

}  // namespace

void spectrum_products(const Image<const float>& first, const Image<const float>& second, int step, int threads,
                       const Image<float>& cells) {
    const std::vector<float> weights = triangle(step);
    const int reach = step - 1;
    parallel_for(cells.height, threads, [&](std::size_t begin, std::size_t end) {
        std::vector<float> line(first.width + 2 * reach), sum(line.size());
        for (auto i = static_cast<int>(begin); i < static_cast<int>(end); ++i) {
            std::fill(sum.begin(), sum.end(), 0.0F);
            for (int k = 0; k < 2 * step - 1; ++k) {
                multiply(first, second, (i * step + k - reach + first.height) % first.height, reach, line.data());
                for (std::size_t x = 0; x < sum.size(); ++x) sum[x] += weights[k] * line[x];
            }
            float* out = cells.row(i);
            for (int j = 0; j < cells.width; ++j) {
                out[j] = 0;
                for (int k = 0; k < 2 * step - 1; ++k) out[j] += weights[k] * sum[j * step + k];
            }
        }
    });
}

void weigh_spectrum(const Image<float>& spectrum, const Image<const float>& cells, int step, double shading,
                    int threads) {
    const std::vector<float> down = bell(spectrum.height, spectrum.height, shading);
    const std::vector<float> across = bell(spectrum.width, 2 * (spectrum.width - 1), shading);
    parallel_for(spectrum.height, threads, [&](std::size_t begin, std::size_t end) {
        std::vector<float> between(cells.width + 1), weight(static_cast<std::size_t>(cells.width) * step);
        for (auto y = static_cast<int>(begin); y < static_cast<int>(end); ++y) {
            const float *above = cells.row(y / step), *below = cells.row((y / step + 1) % cells.height);
            const float part = static_cast<float>(y % step) / static_cast<float>(step);
            for (int j = 0; j < cells.width; ++j) between[j] = above[j] + part * (below[j] - above[j]);
            between[cells.width] = between[cells.width - 1];
            for (int s = 0; s < step; ++s) {
                const float share = static_cast<float>(s) / static_cast<float>(step);
                for (int j = 0; j < cells.width; ++j)
                    weight[static_cast<std::size_t>(j) * step + s] = between[j] + share * (between[j + 1] - between[j]);
            }
            float* __restrict line = spectrum.row(y);
            for (int x = 0; x < spectrum.width; ++x) {
                const float by = weight[x] * (1 - down[y] * across[x]);
                line[2 * x] *= by;
                line[2 * x + 1] *= by;
            }
        }
    });
}

}  // namespace planish
