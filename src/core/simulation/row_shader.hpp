#pragma once

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <numbers>
#include <vector>

#include "core/simulation/render.hpp"
#include "core/simulation/tracer.hpp"

namespace planish {

inline float bilinear_or_dark(const Image<const float>& map, double u, double v) {
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
        float gain = bilinear_or_dark(patterns_.gain, sample.u, sample.v);
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

}  // namespace planish
