#include "core/render.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <numbers>

#include "core/counter_noise.hpp"
#include "core/parallel.hpp"
#include "core/tracer.hpp"

namespace planish {

namespace {

float bilinear(const Image<const float>& map, double u, double v) {
    if (!(u > -1 && v > -1 && u < map.width && v < map.height)) return 0;
    const double fu = std::floor(u), fv = std::floor(v);
    const int iu = static_cast<int>(fu), iv = static_cast<int>(fv);
    const auto a = static_cast<float>(u - fu), b = static_cast<float>(v - fv);
    const auto at = [&](int row, int column) {
        return row < 0 || column < 0 || row >= map.height || column >= map.width ? 0.f : *map.at(row, column);
    };
    return (1 - b) * ((1 - a) * at(iv, iu) + a * at(iv, iu + 1)) +
           b * ((1 - a) * at(iv + 1, iu) + a * at(iv + 1, iu + 1));
}

/// cos(2 pi x) by linear interpolation (error 5e-6): the pixel grid asks for it twice per sample.
class CosineTable {
  public:
    CosineTable() {
        for (int i = 0; i <= kSize; ++i) value_[i] = static_cast<float>(std::cos(2 * std::numbers::pi * i / kSize));
    }
    [[nodiscard]] float operator()(double turns) const {
        const auto x = static_cast<float>((turns - std::floor(turns)) * kSize);
        const int i = std::min(static_cast<int>(x), kSize - 1);
        return value_[i] + (x - static_cast<float>(i)) * (value_[i + 1] - value_[i]);
    }

  private:
    static constexpr int kSize = 1024;
    float value_[kSize + 1];
};

/// Light of the samples of one pixel row: pattern * projected + constant. A row of samples is stored as `scale` planes
/// (one per sample column of a pixel), so that filters run over contiguous memory.
struct SampleRows {
    int scale, width;  ///< samples per pixel and axis; width [px] with the padding
    std::vector<float> projected, constant, u, v;

    SampleRows(int padded_width, int supersampling) : scale(supersampling), width(padded_width) {
        for (auto* layer : {&projected, &constant, &u, &v}) layer->resize(row(scale));
    }
    void clear() {
        for (auto* layer : {&projected, &constant, &u, &v}) std::fill(layer->begin(), layer->end(), 0.f);
    }
    [[nodiscard]] std::size_t row(int sample_row) const { return static_cast<std::size_t>(sample_row) * scale * width; }
};

/// Gives the samples of one pixel row after the other, from rays at the pixel centres and their neighbours.
class RowShader {
  public:
    RowShader(const RenderScene& scene, const ProjectedPatterns& patterns, int image_width, int pad, int supersampling)
        : rows(image_width + 2 * pad, supersampling), scene_(scene), patterns_(patterns), tracer_(scene), pad_(pad) {
        for (auto& line : lines_) line.resize(static_cast<std::size_t>(rows.width) + 2);
    }

    /// Starts before pixel row `first` (counted without padding).
    void start(int first) {
        next_ = first;
        trace_line(first - 1);
        trace_line(first);
    }

    /// Fills `rows` with the samples of the next pixel row.
    void advance() {
        trace_line(next_ + 1);
        rows.clear();
        for (int column = 0; column < rows.width; ++column) {
            const Sample* here = &line(next_)[column + 1];
            const Expansion around(&line(next_ - 1)[column + 1], here, &line(next_ + 1)[column + 1]);
            if (!(around.smooth() && here->patch < 0)) shade(around, column);
        }
        reflect(away_from_edges_, [this](std::size_t at, const Contribution& value) { put(at, value); });
        ++next_;
    }

    SampleRows rows;

  private:
    std::vector<Sample>& line(int row) { return lines_[(row + 3 * pad_ + 3) % 3]; }

    void trace_line(int row) {
        RowHint hint;
        std::vector<Sample>& out = line(row);
        for (int i = 0; i < rows.width + 2; ++i) out[i] = tracer_.sample(Eigen::Vector2d(i - pad_ - 1, row), hint);
    }

    /// What one sample contributes: pattern(u, v) * projected + constant.
    struct Contribution {
        float projected = 0, constant = 0, u = 0, v = 0;
    };

    /// A sample that still lacks the reflectance of its place.
    struct Pending {
        std::size_t at;  ///< index in `rows`
        double print;    ///< factor on the reflectance
        float diffuse, specular, ambient_diffuse, ambient_specular, u, v;
    };
    /// Samples on one texture, whose reflectance is asked for at once.
    struct Batch {
        std::vector<double> s, t;
        std::vector<Pending> samples;
        std::vector<double> albedo;
    };
    struct Batches {
        Batch on_part, on_background;
    };

    void shade(const Expansion& around, int column) {
        const int n = rows.scale;
        const SurfacePrint::Footprint footprint = around.footprint(n);
        for (int j = 0; j < n; ++j) {
            RowHint hint;
            for (int i = 0; i < n; ++i) {
                const double dx = (i + 0.5) / n - 0.5, dy = (j + 0.5) / n - 0.5;
                const Eigen::Vector2d pixel(column - pad_ + dx, next_ + dy);
                const std::size_t at = rows.row(j) + static_cast<std::size_t>(i) * rows.width + column;
                if (around.edge()) {
                    put(at, edge_contribution(pixel));
                } else {
                    defer(away_from_edges_, at, around.smooth() ? around.at(dx, dy) : tracer_.sample(pixel, hint),
                          footprint);
                }
            }
        }
    }

    void put(std::size_t at, const Contribution& value) {
        rows.projected[at] = value.projected;
        rows.constant[at] = value.constant;
        rows.u[at] = value.u;
        rows.v[at] = value.v;
    }

    void defer(Batches& batches, std::size_t at, const Sample& sample, const SurfacePrint::Footprint& footprint) {
        if (sample.patch < 0) return;
        Batch& batch = sample.patch == kBackgroundPatch ? batches.on_background : batches.on_part;
        batch.s.push_back(sample.value[Sample::s]);
        batch.t.push_back(sample.value[Sample::t]);
        batch.samples.push_back(pending(at, sample, footprint));
    }

    Pending pending(std::size_t at, const Sample& sample, const SurfacePrint::Footprint& footprint) {
        const auto value = [&](Sample::Slot slot) { return static_cast<float>(sample.value[slot]); };
        const bool printed = sample.patch != kBackgroundPatch && scene_.print;
        const double print =
            printed ? scene_.print->factor(sample.value[Sample::s], sample.value[Sample::t], footprint, on_print_) : 1;
        return {at,
                print,
                value(Sample::diffuse),
                value(Sample::specular),
                value(Sample::ambient_diffuse),
                value(Sample::ambient_specular),
                value(Sample::u),
                value(Sample::v)};
    }

    /// Completes all samples, gives them to put(at, contribution) and empties the batches.
    template <class Put>
    void reflect(Batches& batches, const Put& put) {
        reflect(scene_.texture, batches.on_part, put);
        if (scene_.background) reflect(scene_.background->texture, batches.on_background, put);
    }

    template <class Put>
    void reflect(const SurfaceTexture& texture, Batch& batch, const Put& put) const {
        batch.albedo.resize(batch.samples.size());
        texture.albedo(batch.s, batch.t, batch.albedo);
        for (std::size_t k = 0; k < batch.samples.size(); ++k) {
            put(batch.samples[k].at, lit(batch.samples[k], batch.albedo[k]));
        }
        batch.s.clear(), batch.t.clear(), batch.samples.clear();
    }

    [[nodiscard]] Contribution lit(const Pending& sample, double reflectance) const {
        const auto albedo = static_cast<float>(reflectance * sample.print);
        float gain = bilinear(patterns_.gain, sample.u, sample.v);
        // First harmonic of the dark lines between projector pixels; the lens passes no more.
        const auto depth = static_cast<float>(0.5 * patterns_.grid_depth);
        if (depth > 0) gain *= 1 + depth * (cosine_(sample.u) + cosine_(sample.v));
        return {(albedo * sample.diffuse + sample.specular) * gain,
                albedo * sample.ambient_diffuse + sample.ambient_specular, sample.u, sample.v};
    }

    /// At an edge one ray per sample would break thin walls and shadows into dashes: the mean of several. Its projector
    /// coordinate is that of the strongest ray with those near to it.
    Contribution edge_contribution(const Eigen::Vector2d& pixel) {
        constexpr int kRays = 4;
        constexpr float share = 1.f / (kRays * kRays);
        constexpr float kNear = 1;  // [projector px]
        std::array<Contribution, kRays * kRays> rays{};
        RowHint hint;
        for (int k = 0; k < kRays * kRays; ++k) {
            if (k % kRays == 0) hint = {};
            const int row = k / kRays, column = k % kRays;
            const Eigen::Vector2d offset((column + 0.5) / kRays - 0.5, (row + 0.5) / kRays - 0.5);
            defer(around_edge_, k, tracer_.sample(pixel + offset / rows.scale, hint), {});
        }
        reflect(around_edge_, [&](std::size_t k, const Contribution& value) { rays[k] = value; });
        const auto weaker = [](const Contribution& a, const Contribution& b) { return a.projected < b.projected; };
        const Contribution& strongest = *std::max_element(rays.begin(), rays.end(), weaker);
        Contribution sum;
        float weight = 0;
        for (const Contribution& ray : rays) {
            sum.projected += share * ray.projected;
            sum.constant += share * ray.constant;
            if (std::abs(ray.u - strongest.u) > kNear || std::abs(ray.v - strongest.v) > kNear) continue;
            weight += ray.projected;
            sum.u += ray.projected * (ray.u - strongest.u);
            sum.v += ray.projected * (ray.v - strongest.v);
        }
        sum.u = strongest.u + (weight > 0 ? sum.u / weight : 0);
        sum.v = strongest.v + (weight > 0 ? sum.v / weight : 0);
        return sum;
    }

    const RenderScene& scene_;
    const ProjectedPatterns& patterns_;
    Tracer tracer_;
    CosineTable cosine_;
    Batches away_from_edges_, around_edge_;
    SurfacePrint::Cursor on_print_;
    int pad_, next_ = 0;
    std::vector<Sample> lines_[3];
};

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
