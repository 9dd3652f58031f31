#include "core/decoding/noise_samples.hpp"

#include <algorithm>
#include <array>
#include <cmath>

namespace planish {
namespace {

const float kUnitGain = 1 / std::sqrt(6.0F);
constexpr double kOneSigma = 0.6827;

/// One row of the contrast, of its grey level, and of the brightest image.
struct Row {
    std::vector<float> contrast, level, brightest;

    explicit Row(std::size_t width) : contrast(width), level(width), brightest(width) {}
};

template <class T>
void add_image(const T* __restrict image, float weight, std::size_t width, float* __restrict contrast,
               float* __restrict level, float* __restrict brightest) {
    const float square = weight * weight;
    for (std::size_t u = 0; u < width; ++u) {
        const float grey = static_cast<float>(image[u]);
        contrast[u] += weight * grey;
        level[u] += square * grey;
        brightest[u] = grey > brightest[u] ? grey : brightest[u];
    }
}

template <class T>
void read_row(const NoiseContrast<T>& from, std::size_t offset, std::size_t width, Row& row) {
    for (auto* values : {&row.contrast, &row.level, &row.brightest}) std::fill(values->begin(), values->end(), 0.0F);
    for (std::size_t k = 0; k < from.images.size(); ++k)
        add_image(from.images[k] + offset, from.weights[k], width, row.contrast.data(), row.level.data(),
                  row.brightest.data());
}

struct Place {
    const Row* row;
    std::size_t u;
};

/// Mean level beside a pixel of a row.
float level_beside(const Place& place) {
    const auto& level = place.row->level;
    const std::size_t last = level.size() - 1;
    return 0.5F * (level[place.u > 0 ? place.u - 1 : last] + level[place.u < last ? place.u + 1 : 0]);
}

void add_sample(const std::array<Place, 3>& at, float saturation, bool beside, NoiseSamples& samples) {
    float residual = 0, level = 0;
    constexpr std::array<float, 3> kSecondDifference = {1, -2, 1};
    for (int i = 0; i < 3; ++i) {
        const auto& [row, u] = at[i];
        if (row->brightest[u] >= saturation) return;
        const float share = kSecondDifference[i];
        residual += share * row->contrast[u];
        // The grey level that the variance of the residual belongs to: each pixel by its share of it.
        level += share * share / 6 * (beside ? level_beside(at[i]) : row->level[u]);
    }
    samples.residual.push_back(kUnitGain * residual);
    samples.level.push_back(level);
}

double clipped_variance(std::vector<float>& residual, float clip_sigmas, float min_sigma) {
    // The quantile as NumPy defines it, linear between two samples.
    const double at = kOneSigma * static_cast<double>(residual.size() - 1);
    const auto below = static_cast<std::ptrdiff_t>(at);
    const auto smaller = [](float a, float b) { return std::fabs(a) < std::fabs(b); };
    std::nth_element(residual.begin(), residual.begin() + below, residual.end(), smaller);
    double sigma = std::fabs(residual[below]);
    if (below + 1 < static_cast<std::ptrdiff_t>(residual.size())) {
        const float above = std::fabs(*std::min_element(residual.begin() + below + 1, residual.end(), smaller));
        sigma += (at - static_cast<double>(below)) * (above - sigma);
    }
    for (int pass = 0; pass < 3; ++pass) {
        const auto limit = static_cast<float>(clip_sigmas * std::max<double>(sigma, min_sigma));
        double sum = 0;
        std::int64_t count = 0;
        for (const float r : residual) {
            const bool kept = std::fabs(r) <= limit;
            sum += kept ? static_cast<double>(r) * r : 0.0;
            count += kept ? 1 : 0;
        }
        sigma = count > 0 ? std::sqrt(sum / static_cast<double>(count)) : 0.0;
    }
    return sigma * sigma;
}

}  // namespace

template <class T>
NoiseSamples sample_noise(const NoiseContrast<T>& contrast, int height, int width) {
    const auto columns = static_cast<std::size_t>(width);
    std::array<Row, 3> rows = {Row(columns), Row(columns), Row(columns)};
    NoiseSamples samples;
    samples.level.reserve(contrast.rows.size() * columns);
    samples.residual.reserve(contrast.rows.size() * columns);
    for (const int first : contrast.rows) {
        for (int i = 0; i < 3; ++i)
            read_row(contrast, static_cast<std::size_t>(std::min(first + i, height - 1)) * columns, columns, rows[i]);
        if (contrast.along_rows) {
            for (const Row& row : rows)
                for (std::size_t u = 0; u + 2 < columns; u += 3)
                    add_sample({Place{&row, u}, Place{&row, u + 1}, Place{&row, u + 2}}, contrast.saturation,
                               contrast.level_beside, samples);
        } else {
            for (std::size_t u = 0; u < columns; ++u)
                add_sample({Place{&rows[0], u}, Place{&rows[1], u}, Place{&rows[2], u}}, contrast.saturation,
                           contrast.level_beside, samples);
        }
    }
    return samples;
}

NoiseBins bin_noise(const std::vector<float>& level, const std::vector<float>& residual, int bins, float clip_sigmas,
                    float min_sigma) {
    NoiseBins found;
    if (level.empty()) return found;
    const auto [low, high] = std::minmax_element(level.begin(), level.end());
    const float start = *low, per_step = static_cast<float>(bins) / std::max(*high - *low, 1e-6F);
    std::vector<std::vector<float>> members(bins);
    std::vector<double> sums(bins, 0.0);
    for (auto& bin : members) bin.reserve(2 * level.size() / static_cast<std::size_t>(bins));
    for (std::size_t i = 0; i < level.size(); ++i) {
        const int bin = std::min(static_cast<int>((level[i] - start) * per_step), bins - 1);
        members[bin].push_back(residual[i]);
        sums[bin] += level[i];
    }
    for (int bin = 0; bin < bins; ++bin) {
        const auto count = static_cast<std::int64_t>(members[bin].size());
        found.count.push_back(count);
        found.level.push_back(count > 0 ? sums[bin] / static_cast<double>(count) : 0.0);
        found.variance.push_back(count > 0 ? clipped_variance(members[bin], clip_sigmas, min_sigma) : 0.0);
    }
    return found;
}

template NoiseSamples sample_noise(const NoiseContrast<std::uint8_t>&, int, int);
template NoiseSamples sample_noise(const NoiseContrast<std::uint16_t>&, int, int);

}  // namespace planish
