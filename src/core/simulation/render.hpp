#pragma once

#include <cstdint>
#include <span>

#include "core/common/image.hpp"
#include "core/simulation/tracer.hpp"

namespace planish {

/// What the projector shows: per image a profile along one axis, sampled `samples_per_px` times per projector pixel
/// from coordinate `first` on, times a map that all images share (window, dust, vignetting).
struct ProjectedPatterns {
    Image<const float> profiles;   ///< (images, samples)
    std::span<const int> along_v;  ///< per image: 0 = profile over u, 1 = over v
    double first, samples_per_px;
    Image<const float> gain;  ///< (projector height, width)
    double grid_depth;        ///< modulation of the pixel grid's first harmonic
};

/// From radiance to grey levels (of an 8-bit image; finer quantisation keeps their meaning).
struct SensorResponse {
    double psf_px;      ///< standard deviation of the lens blur
    int supersampling;  ///< samples per pixel and axis
    double levels_per_radiance;
    double electrons_per_level, read_noise, noise_factor;
    double black_level, saturation, gamma;
    double quantum;               ///< grey levels per step of the output: 1 for 8 bit, 255/65535 for 16 bit
    Image<const float> response;  ///< (height, width): what is fixed to the sensor, about 1
    std::uint64_t seed, stream;   ///< of the noise; image k uses stream + k
};

/// Renders all images of one camera into out[k] (each the size of `response`).
template <class Pixel>
void render_images(const RenderScene& scene, const ProjectedPatterns& patterns, const SensorResponse& sensor,
                   std::span<const Image<Pixel>> out, int threads);

}  // namespace planish
