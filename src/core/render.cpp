#include "core/render.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <numbers>

#include "core/counter_noise.hpp"
#include "core/parallel.hpp"

namespace planish {

namespace {

constexpr int kBackgroundPatch = 1000;
/// Where second differences between neighbouring pixels exceed this, rays are traced per sample instead of expanded:
/// the third-order remainder is then far below 1e-3 of a projector pixel (u, v) or a micrometre (s, t).
constexpr double kSmoothPx = 0.01, kSmoothMm = 0.01, kSmoothRadiance = 0.01;

/// What the camera meets along one ray.
struct Sample {
    double s = 0, t = 0, u = 0, v = 0;  ///< surface coordinates [mm], projector coordinates [px]
    float diffuse = 0, specular = 0, ambient_diffuse = 0, ambient_specular = 0;
    short patch = -1;
    bool lit = false;
};

class Tracer {
  public:
    explicit Tracer(const RenderScene& scene)
        : scene_(scene), eye_(scene.camera.center_sensor()), source_(scene.projector.center_sensor()) {}

    [[nodiscard]] Hit hit(const Eigen::Vector2d& pixel, double& hint) const {
        const Ray ray{eye_, scene_.camera.ray_sensor(pixel)};
        Hit hit = scene_.surface.intersect(ray, hint);
        if (hit.patch >= 0) {
            hint = hit.distance;
        } else if (scene_.background) {
            const auto& plane = *scene_.background;
            const double distance = plane.normal.dot(plane.origin - ray.origin) / plane.normal.dot(ray.direction);
            const Eigen::Vector3d offset = ray.at(distance) - plane.origin;
            if (distance > 0) {
                hit = {
                    distance,        ray.at(distance), plane.normal, offset.dot(plane.axis_x), offset.dot(plane.axis_y),
                    kBackgroundPatch};
            }
        }
        return hit;
    }

    [[nodiscard]] Sample sample(const Eigen::Vector2d& pixel, double& hint) const {
        Sample out;
        const Hit found = hit(pixel, hint);
        if (found.patch < 0) return out;
        const bool on_part = found.patch != kBackgroundPatch;
        Radiance r = illuminate(scene_.surface, on_part, found, eye_, source_, scene_.light);
        if (!on_part && r.lit) {
            // The part throws its shadow on the background.
            const Ray ray{source_, found.point - source_};
            const Hit blocker = scene_.surface.intersect(ray, 1.0);
            if (blocker.patch >= 0 && blocker.distance < 1) r.lit = false, r.diffuse = r.specular = 0;
        }
        const Eigen::Vector3d in_projector = scene_.projector.to_camera(found.point);
        Eigen::Vector2d at(-1e6, -1e6);
        if (in_projector.z() > 0) at = scene_.projector.project(found.point);
        return {found.s,
                found.t,
                at.x(),
                at.y(),
                static_cast<float>(r.diffuse),
                static_cast<float>(r.specular),
                static_cast<float>(r.ambient_diffuse),
                static_cast<float>(r.ambient_specular),
                static_cast<short>(found.patch),
                r.lit};
    }

    [[nodiscard]] const Eigen::Vector3d& source() const { return source_; }

  private:
    const RenderScene& scene_;
    Eigen::Vector3d eye_, source_;
};

/// Second-order expansion of the samples around one pixel; empty where the neighbourhood is not smooth.
class Expansion {
  public:
    Expansion(const Sample* above, const Sample* here, const Sample* below) : here_(here) {
        smooth_ = true;
        for (const Sample* row : {above, here, below})
            for (int i = -1; i <= 1; ++i) smooth_ &= row[i].patch == here->patch && row[i].lit == here->lit;
        if (!smooth_ || here->patch < 0) return;
        const auto fit = [&](int slot, auto member, double tolerance) {
            const auto at = [&](const Sample* row, int i) { return static_cast<double>(row[i].*member); };
            double* c = coefficient_[slot];
            c[0] = at(here, 0);
            c[1] = 0.5 * (at(here, 1) - at(here, -1));
            c[2] = 0.5 * (at(below, 0) - at(above, 0));
            c[3] = at(here, 1) - 2 * c[0] + at(here, -1);
            c[4] = at(below, 0) - 2 * c[0] + at(above, 0);
            c[5] = 0.25 * (at(below, 1) - at(below, -1) - at(above, 1) + at(above, -1));
            smooth_ &= std::abs(c[3]) < tolerance && std::abs(c[4]) < tolerance && std::abs(c[5]) < tolerance;
        };
        fit(0, &Sample::s, kSmoothMm);
        fit(1, &Sample::t, kSmoothMm);
        fit(2, &Sample::u, kSmoothPx);
        fit(3, &Sample::v, kSmoothPx);
        fit(4, &Sample::diffuse, kSmoothRadiance);
        fit(5, &Sample::specular, kSmoothRadiance);
        fit(6, &Sample::ambient_diffuse, kSmoothRadiance);
        fit(7, &Sample::ambient_specular, kSmoothRadiance);
    }

    [[nodiscard]] bool smooth() const { return smooth_; }

    [[nodiscard]] Sample at(double x, double y) const {
        const auto value = [&](int slot) {
            const double* c = coefficient_[slot];
            return c[0] + c[1] * x + c[2] * y + 0.5 * (c[3] * x * x + c[4] * y * y) + c[5] * x * y;
        };
        const auto light = [&](int slot) { return static_cast<float>(std::max(0.0, value(slot))); };
        return {value(0), value(1), value(2), value(3),     light(4),
                light(5), light(6), light(7), here_->patch, here_->lit};
    }

  private:
    const Sample* here_;
    bool smooth_;
    double coefficient_[8][6];
};

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

/// Light of the sub-pixel samples on the padded image: pattern * projected + constant. A row of samples is stored as
/// `supersampling` planes (one per sample column of a pixel), so that filters run over contiguous memory.
struct Layers {
    int pad, scale, width, height;  ///< width and height [px] with the padding
    std::vector<float> projected, constant, u, v;

    Layers(int image_width, int image_height, int padding, int supersampling)
        : pad(padding), scale(supersampling), width(image_width + 2 * padding), height(image_height + 2 * padding) {
        const std::size_t count = static_cast<std::size_t>(width) * height * scale * scale;
        for (auto* layer : {&projected, &constant, &u, &v}) layer->resize(count);
    }
    [[nodiscard]] std::size_t row(int sample_row) const { return static_cast<std::size_t>(sample_row) * scale * width; }
};

float grid_factor(double u, double v, double depth) {
    // First harmonic of the dark lines between projector pixels; the lens passes no more.
    constexpr double k = 2 * std::numbers::pi;
    return static_cast<float>(1 + depth * 0.5 * (std::cos(k * u) + std::cos(k * v)));
}

void shade_pixel(const RenderScene& scene, const Tracer& tracer, const ProjectedPatterns& patterns,
                 const Expansion& around, const Eigen::Vector2d& pixel, int row, int column, double hint,
                 Layers& layers) {
    const int n = layers.scale;
    for (int j = 0; j < n; ++j) {
        for (int i = 0; i < n; ++i) {
            const double dx = (i + 0.5) / n - 0.5, dy = (j + 0.5) / n - 0.5;
            const Sample s = around.smooth() ? around.at(dx, dy) : tracer.sample(pixel + Eigen::Vector2d(dx, dy), hint);
            if (s.patch < 0) continue;
            const SurfaceTexture& texture = s.patch == kBackgroundPatch ? scene.background->texture : scene.texture;
            const auto albedo = static_cast<float>(texture.albedo(s.s, s.t));
            const std::size_t k = layers.row(row * n + j) + static_cast<std::size_t>(i) * layers.width + column;
            float gain = bilinear(patterns.gain, s.u, s.v);
            if (patterns.grid_depth > 0) gain *= grid_factor(s.u, s.v, patterns.grid_depth);
            layers.projected[k] = (albedo * s.diffuse + s.specular) * gain;
            layers.constant[k] = albedo * s.ambient_diffuse + s.ambient_specular;
            layers.u[k] = static_cast<float>(s.u);
            layers.v[k] = static_cast<float>(s.v);
        }
    }
}

Layers render_layers(const RenderScene& scene, const ProjectedPatterns& patterns, int width, int height, int pad,
                     int supersampling, int threads) {
    const Tracer tracer(scene);
    Layers layers(width, height, pad, supersampling);
    // One pixel more on every side, for the neighbours of the expansion.
    const int grid_width = layers.width + 2, grid_height = layers.height + 2;
    std::vector<Sample> grid(static_cast<std::size_t>(grid_width) * grid_height);
    parallel_for(grid_height, threads, [&](std::size_t first, std::size_t last) {
        for (std::size_t row = first; row < last; ++row) {
            double hint = -1;  // restarted in every row, so that nothing depends on the blocks of the threads
            for (int column = 0; column < grid_width; ++column) {
                const Eigen::Vector2d pixel(column - pad - 1, static_cast<double>(row) - pad - 1);
                grid[row * grid_width + column] = tracer.sample(pixel, hint);
            }
        }
    });
    parallel_for(layers.height, threads, [&](std::size_t first, std::size_t last) {
        for (std::size_t row = first; row < last; ++row) {
            for (int column = 0; column < layers.width; ++column) {
                const Sample* here = &grid[(row + 1) * grid_width + column + 1];
                const Expansion around(here - grid_width, here, here + grid_width);
                if (around.smooth() && here->patch < 0) continue;
                const Eigen::Vector2d pixel(column - pad, static_cast<double>(row) - pad);
                shade_pixel(scene, tracer, patterns, around, pixel, static_cast<int>(row), column, -1, layers);
            }
        }
    });
    return layers;
}

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

}  // namespace

template <class Pixel>
void render_images(const RenderScene& scene, const ProjectedPatterns& patterns, const SensorResponse& sensor,
                   std::span<const Image<Pixel>> out, int threads) {
    const int width = sensor.response.width, height = sensor.response.height, n = sensor.supersampling;
    const int pad = static_cast<int>(std::ceil(3.5 * sensor.psf_px + 0.5));
    const Layers layers = render_layers(scene, patterns, width, height, pad, n, threads);
    const std::vector<float> kernel = pixel_kernel(sensor.psf_px, pad, n);
    const int taps = static_cast<int>(kernel.size()), images = static_cast<int>(out.size());
    const std::size_t row_samples = static_cast<std::size_t>(n) * layers.width;
    const auto noise_width = static_cast<std::uint32_t>((width + 3) / 4 * 4);
    const bool any_v = std::find(patterns.along_v.begin(), patterns.along_v.end(), 1) != patterns.along_v.end();

    parallel_for(height, threads, [&](std::size_t first, std::size_t last) {
        // Rows of samples, filtered along u, in a ring as long as the filter along v.
        std::vector<float> ring(static_cast<std::size_t>(images) * taps * width), line(row_samples), sum(width);
        std::vector<float> normal(noise_width);
        ProfileLookup along_u, along_v;
        const auto ring_row = [&](int image, int sample_row) {
            return ring.data() + (static_cast<std::size_t>(image) * taps + sample_row % taps) * width;
        };
        const auto filter_row = [&](int sample_row) {
            const std::size_t at = layers.row(sample_row);
            along_u.locate(&layers.u[at], row_samples, patterns);
            if (any_v) along_v.locate(&layers.v[at], row_samples, patterns);
            const float *projected = &layers.projected[at], *constant = &layers.constant[at];
            for (int k = 0; k < images; ++k) {
                const ProfileLookup& lookup = patterns.along_v[k] ? along_v : along_u;
                const float* profile = patterns.profiles.row(k);
                const int* cell = lookup.cell.data();
                const float* fraction = lookup.fraction.data();
                for (std::size_t i = 0; i < row_samples; ++i) {
                    const float low = profile[cell[i]], high = profile[cell[i] + 1];
                    line[i] = projected[i] * (low + fraction[i] * (high - low)) + constant[i];
                }
                float* target = ring_row(k, sample_row);
                std::fill_n(target, width, 0.f);
                for (int j = 0; j < taps; ++j) {
                    const float w = kernel[j];
                    const float* source = &line[static_cast<std::size_t>(j % n) * layers.width + j / n];
                    for (int u = 0; u < width; ++u) target[u] += w * source[u];
                }
            }
        };
        int next = static_cast<int>(first) * n;
        for (int v = static_cast<int>(first); v < static_cast<int>(last); ++v) {
            for (; next < v * n + taps; ++next) filter_row(next);
            for (int k = 0; k < images; ++k) {
                std::fill(sum.begin(), sum.end(), 0.f);
                for (int j = 0; j < taps; ++j) {
                    const float w = kernel[j];
                    const float* source = ring_row(k, v * n + j);
                    for (int u = 0; u < width; ++u) sum[u] += w * source[u];
                }
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

void trace_image(const RenderScene& scene, const std::optional<Eigen::Vector3d>& other_center, Image<double> points,
                 Image<std::uint8_t> lit, int threads) {
    const Tracer tracer(scene);
    parallel_for(points.height, threads, [&](std::size_t first, std::size_t last) {
        for (int v = static_cast<int>(first); v < static_cast<int>(last); ++v) {
            double hint = -1;
            for (int u = 0; u < points.width; ++u) {
                const Hit hit = tracer.hit({u, v}, hint);
                const bool on_part = hit.patch >= 0 && hit.patch != kBackgroundPatch;
                double* point = points.at(v, u);
                for (int i = 0; i < 3; ++i) {
                    point[i] = on_part ? hit.point[i] : std::numeric_limits<double>::quiet_NaN();
                }
                *lit.at(v, u) = on_part && !scene.surface.occluded(hit, tracer.source()) &&
                                (!other_center || !scene.surface.occluded(hit, *other_center));
            }
        }
    });
}

}  // namespace planish
