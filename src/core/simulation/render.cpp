#include "core/simulation/render.hpp"

#include <algorithm>
#include <cmath>
#include <numbers>

#include "core/common/parallel.hpp"
#include "core/simulation/counter_noise.hpp"
#include "core/simulation/row_shader.hpp"

namespace planish {

namespace {

/// Pixel area convolved with the Gaussian of the lens, at the sample positions of pixels -pad .. pad; sum 1.
std::vector<float> pixel_kernel(double psf_px, int pad, int supersampling) {
    std::vector<double> w;
    double sum = 0;
    for (int i = 0; i < (2 * pad + 1) * supersampling; ++i) {
        const double x = (i + 0.5) / supersampling - 0.5 - pad;
        const double q = psf_px * std::numbers::sqrt2;
        w.push_back(psf_px > 0 ? std::erf((x + 0.5) / q) - std::erf((x - 0.5) / q) : (std::abs(x) < 0.5 ? 1.0 : 0.0));
        sum += w.back();
    }
    std::vector<float> out;
    for (const double value : w) out.push_back(static_cast<float>(value / sum));
    return out;
}

/// Profile values at one row of samples: cell and fraction are found once and serve all images.
struct ProfileLookup {
    std::vector<int> cell;
    std::vector<float> fraction;

    void locate(const float* coordinate, std::size_t count, const ProjectedPatterns& patterns) {
        cell.resize(count);
        fraction.resize(count);
        const auto scale = static_cast<float>(patterns.samples_per_px), first = static_cast<float>(patterns.first);
        const auto last = static_cast<float>(patterns.profiles.width - 1) - 0.5f;
        for (std::size_t i = 0; i < count; ++i) {
            const float x = std::min(std::max((coordinate[i] - first) * scale, 0.f), last);
            cell[i] = static_cast<int>(x);
            fraction[i] = x - static_cast<float>(cell[i]);
        }
    }
};

/// One camera row of one image: noise, gamma, black level, quantisation.
template <class Pixel>
void digitise(const float* radiance, const float* response, const float* normal, int width, const SensorResponse& p,
              Pixel* out) {
    const auto gain = static_cast<float>(p.levels_per_radiance), shot = static_cast<float>(1 / p.electrons_per_level);
    const auto read = static_cast<float>(p.read_noise * p.read_noise), factor = static_cast<float>(p.noise_factor);
    const auto black = static_cast<float>(p.black_level), top = static_cast<float>(p.saturation);
    const auto steps = static_cast<float>(1 / p.quantum), exponent = static_cast<float>(1 / p.gamma);
    for (int u = 0; u < width; ++u) {
        const float signal = gain * radiance[u] * response[u];
        // Photon transfer (EMVA 1288): variance = read^2 + signal / (electrons per level); Gaussian for Poisson.
        float level = signal + factor * std::sqrt(read + shot * signal) * normal[u];
        if (exponent != 1.f) level = 255.f * std::pow(std::max(level, 0.f) / 255.f, exponent);
        level = std::min(std::max(level + black, 0.f), top);
        out[u] = static_cast<Pixel>(level * steps + 0.5f);
    }
}

/// Projects the patterns onto the samples and filters them to pixels: along u at once, along v when all rows are there.
class ImageFilter {
  public:
    ImageFilter(const ProjectedPatterns& patterns, std::vector<float> kernel, int images, int width)
        : patterns_(patterns), kernel_(std::move(kernel)), taps_(static_cast<int>(kernel_.size())), width_(width) {
        ring_.resize(static_cast<std::size_t>(images) * taps_ * width);
        any_v_ = std::find(patterns.along_v.begin(), patterns.along_v.end(), 1) != patterns.along_v.end();
    }

    /// Takes row j of `rows` as sample row number `sample_row` of the image.
    void add(const SampleRows& rows, int j, int sample_row) {
        const std::size_t at = rows.row(j), count = static_cast<std::size_t>(rows.scale) * rows.width;
        line_.resize(count);
        along_u_.locate(&rows.u[at], count, patterns_);
        if (any_v_) along_v_.locate(&rows.v[at], count, patterns_);
        for (int k = 0; k < patterns_.profiles.height; ++k) {
            project(patterns_.along_v[k] ? along_v_ : along_u_, patterns_.profiles.row(k), &rows.projected[at],
                    &rows.constant[at], count);
            const auto source = [&](int tap) {
                return &line_[static_cast<std::size_t>(tap % rows.scale) * rows.width + tap / rows.scale];
            };
            weighted_sum(source, ring_row(k, sample_row));
        }
    }

    /// Adds up the filtered rows from `sample_row` on into one pixel row of image k.
    void column_sum(int k, int sample_row, std::vector<float>& sum) {
        weighted_sum([&](int tap) { return ring_row(k, sample_row + tap); }, sum.data());
    }

    [[nodiscard]] int taps() const { return taps_; }

  private:
    void project(const ProfileLookup& lookup, const float* profile, const float* projected, const float* constant,
                 std::size_t count) {
        const int* cell = lookup.cell.data();
        const float* fraction = lookup.fraction.data();
        float* out = line_.data();
        for (std::size_t i = 0; i < count; ++i) {
            const float low = profile[cell[i]], high = profile[cell[i] + 1];
            out[i] = projected[i] * (low + fraction[i] * (high - low)) + constant[i];
        }
    }

    /// target[u] = sum over taps of weight * source(tap)[u], in blocks that stay in registers.
    template <class Source>
    void weighted_sum(const Source& source, float* target) const {
        constexpr int kBlock = 32;
        int u = 0;
        for (; u + kBlock <= width_; u += kBlock) {
            Eigen::Array<float, kBlock, 1> sum = Eigen::Array<float, kBlock, 1>::Zero();
            for (int tap = 0; tap < taps_; ++tap) {
                sum += kernel_[tap] * Eigen::Array<float, kBlock, 1>::Map(source(tap) + u);
            }
            Eigen::Array<float, kBlock, 1>::Map(target + u) = sum;
        }
        for (; u < width_; ++u) {
            float sum = 0;
            for (int tap = 0; tap < taps_; ++tap) sum += kernel_[tap] * source(tap)[u];
            target[u] = sum;
        }
    }

    float* ring_row(int image, int sample_row) {
        return ring_.data() + (static_cast<std::size_t>(image) * taps_ + sample_row % taps_) * width_;
    }

    const ProjectedPatterns& patterns_;
    std::vector<float> kernel_, ring_, line_;
    ProfileLookup along_u_, along_v_;
    int taps_, width_;
    bool any_v_;
};

}  // namespace

template <class Pixel>
void render_images(const RenderScene& scene, const ProjectedPatterns& patterns, const SensorResponse& sensor,
                   std::span<const Image<Pixel>> out, int threads) {
    const int width = sensor.response.width, height = sensor.response.height, n = sensor.supersampling;
    const int pad = static_cast<int>(std::ceil(3.5 * sensor.psf_px + 0.5));
    const std::vector<float> kernel = pixel_kernel(sensor.psf_px, pad, n);
    const int images = static_cast<int>(out.size());
    // Blocks of four normal numbers start at the begin of a row.
    const auto noise_width = static_cast<std::uint32_t>((width + 3) / 4 * 4);

    parallel_for(height, threads, [&](std::size_t first, std::size_t last) {
        RowShader shader(scene, patterns, width, pad, n);
        ImageFilter filter(patterns, kernel, images, width);
        std::vector<float> sum(width), normal(noise_width);
        const int begin = static_cast<int>(first), end = static_cast<int>(last);
        shader.start(begin - pad);
        for (int row = begin - pad; row < end + pad; ++row) {
            shader.advance();
            for (int j = 0; j < n; ++j) filter.add(shader.rows, j, (row + pad) * n + j);
            const int v = row - pad;
            if (v < begin) continue;
            for (int k = 0; k < images; ++k) {
                filter.column_sum(k, v * n, sum);
                normal_numbers(sensor.seed, sensor.stream + k, static_cast<std::uint32_t>(v) * noise_width, normal);
                digitise(sum.data(), sensor.response.row(v), normal.data(), width, sensor, out[k].row(v));
            }
        }
    });
}

template void render_images<std::uint8_t>(const RenderScene&, const ProjectedPatterns&, const SensorResponse&,
                                          std::span<const Image<std::uint8_t>>, int);
template void render_images<std::uint16_t>(const RenderScene&, const ProjectedPatterns&, const SensorResponse&,
                                           std::span<const Image<std::uint16_t>>, int);

}  // namespace planish
