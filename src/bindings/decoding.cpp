// Bindings of the kernels from images to projector positions: noise, Gray code, phases.

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/vector.h>

#include <algorithm>
#include <cstdint>
#include <stdexcept>
#include <vector>

#include "bindings/arrays.hpp"
#include "bindings/bindings.hpp"
#include "bindings/maps.hpp"
#include "core/common/image.hpp"
#include "core/decoding/decode_gray.hpp"
#include "core/decoding/decode_phase.hpp"
#include "core/decoding/gray_edges.hpp"
#include "core/decoding/noise_samples.hpp"
#include "core/decoding/repair_periods.hpp"

namespace {

template <class T>
std::vector<planish::PhaseSteps<T>> make_steps(const std::vector<AnyImage>& images, const std::vector<int>& counts,
                                               const std::vector<float>& angles_cos,
                                               const std::vector<float>& angles_sin,
                                               const std::vector<float>& periods) {
    std::vector<planish::PhaseSteps<T>> steps(counts.size());
    std::size_t next = 0;
    for (std::size_t i = 0; i < counts.size(); ++i) {
        steps[i].period_px = periods[i];
        for (int k = 0; k < counts[i]; ++k, ++next) {
            steps[i].images.push_back(static_cast<const T*>(images[next].data()));
            steps[i].cos_angle.push_back(angles_cos[next]);
            steps[i].sin_angle.push_back(angles_sin[next]);
        }
    }
    return steps;
}

planish::DecodeSettings make_settings(const nb::dict& values) {
    const auto number = [&](const char* name) { return nb::cast<float>(values[name]); };
    planish::DecodeSettings settings;
    settings.noise = {number("noise_offset"), number("noise_slope"), number("saturation")};
    settings.max_phase_sigma_rad = number("max_phase_sigma_rad");
    settings.coarse_offset_px = number("coarse_offset_px");
    settings.coarse_limit_px = number("coarse_limit_px");
    settings.range_start_px = number("range_start_px");
    settings.range_length_px = number("range_length_px");
    settings.reflection_sigmas = number("reflection_sigmas");
    settings.averaged = nb::cast<std::vector<int>>(values["averaged"]);
    const auto coefficients = nb::cast<std::vector<std::vector<int>>>(values["level_coefficients"]);
    const auto periods = nb::cast<std::vector<float>>(values["level_periods_px"]);
    for (std::size_t i = 0; i < periods.size(); ++i) settings.levels.push_back({coefficients[i], periods[i]});
    for (const auto entry : nb::cast<nb::list>(values["expected"])) {
        const auto expected = nb::cast<nb::dict>(entry);
        const auto shift = [&](const char* name, const char* fold) {
            return planish::PhaseFunction{nb::cast<std::vector<float>>(expected[name]), nb::cast<int>(expected[fold])};
        };
        settings.expected.push_back({shift("coarser_px", "coarser_fold"), shift("finer_px", "finer_fold"),
                                     nb::cast<float>(expected["variance_px2"])});
    }
    return settings;
}

/// Calls `use` with the steps of all periods, for the type of the images.
template <class Use>
void with_steps(const std::vector<AnyImage>& images, const std::vector<int>& counts,
                const std::vector<float>& angles_cos, const std::vector<float>& angles_sin,
                const std::vector<float>& periods, Use&& use) {
    if (is_8_bit(images))
        use(make_steps<std::uint8_t>(images, counts, angles_cos, angles_sin, periods));
    else
        use(make_steps<std::uint16_t>(images, counts, angles_cos, angles_sin, periods));
}

nb::tuple decode_phase(const std::vector<AnyImage>& images, const std::vector<int>& counts,
                       const std::vector<float>& angles_cos, const std::vector<float>& angles_sin,
                       const std::vector<float>& periods, const AnyIn<float>& coarse, const nb::dict& settings,
                       int threads) {
    is_8_bit(images);
    const std::size_t h = images[0].shape(0), w = images[0].shape(1);
    auto position = make_array<float>({h, w}), sigma = make_array<float>({h, w}), mean = make_array<float>({h, w}),
         modulation = make_array<float>({h, w});
    auto rejected = make_array<std::uint16_t>({h, w});
    const planish::DecodeSettings used = make_settings(settings);
    const planish::PhaseResult out{view_of(position), view_of(sigma), view_of(mean), view_of(modulation),
                                   view_of(rejected)};
    const auto coarse_view = view_of(coarse);
    with_steps(images, counts, angles_cos, angles_sin, periods, [&](const auto& steps) {
        nb::gil_scoped_release release;
        planish::decode_phase(steps, coarse_view, used, threads, out);
    });
    return nb::make_tuple(position, sigma, mean, modulation, rejected);
}

nb::tuple sample_disagreement(const std::vector<AnyImage>& images, const std::vector<int>& counts,
                              const std::vector<float>& angles_cos, const std::vector<float>& angles_sin,
                              const std::vector<float>& periods, const AnyIn<float>& coarse, const nb::dict& settings,
                              const std::vector<int>& rows, int threads) {
    is_8_bit(images);
    const std::size_t w = images[0].shape(1);
    const planish::DecodeSettings used = make_settings(settings);
    auto difference = make_array<float>({rows.size(), w}), sigma = make_array<float>({rows.size(), w}),
         coarser = make_array<float>({rows.size(), w}), finer = make_array<float>({rows.size(), w});
    const planish::DisagreementSample out{view_of(difference), view_of(sigma), view_of(coarser), view_of(finer)};
    const auto coarse_view = view_of(coarse);
    with_steps(images, counts, angles_cos, angles_sin, periods, [&](const auto& steps) {
        nb::gil_scoped_release release;
        planish::sample_disagreement(steps, coarse_view, used, rows, static_cast<int>(w), threads, out);
    });
    return nb::make_tuple(difference, sigma, coarser, finer);
}

template <class T>
std::vector<planish::GrayBit<T>> make_bits(const std::vector<AnyImage>& images, const std::vector<int>& inverse) {
    std::vector<planish::GrayBit<T>> bits;
    for (std::size_t i = 0; i < inverse.size(); ++i)
        bits.push_back({static_cast<const T*>(images[i].data()),
                        inverse[i] < 0 ? nullptr : static_cast<const T*>(images[inverse[i]].data())});
    return bits;
}

AnyOut<float> decode_gray(const std::vector<AnyImage>& images, const std::vector<int>& inverse,
                          const AnyIn<float>& threshold, int threads) {
    const bool narrow = is_8_bit(images);
    auto cell = make_array<float>({images[0].shape(0), images[0].shape(1)});
    const auto out = view_of(cell);
    const auto limit = view_of(threshold);
    nb::gil_scoped_release release;
    if (narrow)
        planish::decode_gray(make_bits<std::uint8_t>(images, inverse), limit, threads, out);
    else
        planish::decode_gray(make_bits<std::uint16_t>(images, inverse), limit, threads, out);
    return cell;
}

void repair_periods(const Shared<float>& position, const Shared<float>& sigma, const Shared<std::uint16_t>& rejected,
                    float period_px, float tolerance_px, float sigmas, int reflection_pixels, int threads) {
    const auto p = view_of(position), s = view_of(sigma);
    const auto r = view_of(rejected);
    nb::gil_scoped_release release;
    planish::repair_periods(p, s, r, {period_px, tolerance_px, sigmas, reflection_pixels}, threads);
}

template <class V>
AnyOut<V> to_array(const std::vector<V>& values) {
    auto array = make_array<V>({values.size()});
    std::copy(values.begin(), values.end(), array.data());
    return array;
}

nb::tuple sample_noise(const std::vector<AnyImage>& images, const std::vector<float>& weights,
                       const std::vector<int>& rows, bool along_rows, bool level_beside, float saturation) {
    const int h = static_cast<int>(images.at(0).shape(0)), w = static_cast<int>(images.at(0).shape(1));
    const auto sample = [&]<class T>(T) {
        planish::NoiseContrast<T> contrast{{}, weights, rows, along_rows, level_beside, saturation};
        for (const auto& image : images) contrast.images.push_back(static_cast<const T*>(image.data()));
        return planish::sample_noise(contrast, h, w);
    };
    const bool narrow = is_8_bit(images);
    planish::NoiseSamples found;
    {
        nb::gil_scoped_release release;
        found = narrow ? sample(std::uint8_t{}) : sample(std::uint16_t{});
    }
    return nb::make_tuple(to_array(found.level), to_array(found.residual));
}

nb::tuple bin_noise(const AnyIn<float>& level, const AnyIn<float>& residual, int bins, float clip_sigmas,
                    float min_sigma) {
    planish::NoiseBins found;
    {
        nb::gil_scoped_release release;
        found = planish::bin_noise({level.data(), level.data() + level.size()},
                                   {residual.data(), residual.data() + residual.size()}, bins, clip_sigmas, min_sigma);
    }
    return nb::make_tuple(to_array(found.level), to_array(found.variance), to_array(found.count));
}

template <class T>
void gray_edges(const std::vector<AnyImage>& images, const std::vector<int>& inverse, int white, int black,
                const planish::GrayEdgeSettings& settings, int threads, const planish::GrayEdgeResult& out) {
    const auto single = [&](int index) { return index < 0 ? nullptr : static_cast<const T*>(images[index].data()); };
    planish::gray_edges(make_bits<T>(images, inverse), single(white), single(black), settings, threads, out);
}

nb::tuple gray_edges(const std::vector<AnyImage>& images, const std::vector<int>& inverse, int white, int black,
                     float cell_px, float saturation, float noise_offset, float noise_slope, float max_signal_sigma,
                     float edge_bias_px, int threads) {
    const bool narrow = is_8_bit(images);
    const std::size_t h = images[0].shape(0), w = images[0].shape(1);
    auto position = make_array<float>({h, w}), sigma = make_array<float>({h, w}), mean = make_array<float>({h, w}),
         modulation = make_array<float>({h, w});
    auto rejected = make_array<std::uint16_t>({h, w});
    const planish::GrayEdgeSettings settings{cell_px,     saturation,       noise_offset,
                                             noise_slope, max_signal_sigma, edge_bias_px};
    const planish::GrayEdgeResult out{view_of(position), view_of(sigma), view_of(mean), view_of(modulation),
                                      view_of(rejected)};
    {
        nb::gil_scoped_release release;
        if (narrow)
            gray_edges<std::uint8_t>(images, inverse, white, black, settings, threads, out);
        else
            gray_edges<std::uint16_t>(images, inverse, white, black, settings, threads, out);
    }
    return nb::make_tuple(position, sigma, mean, modulation, rejected);
}

}  // namespace

void bind_decoding(nb::module_& m) {
    m.def("decode_phase", &decode_phase);
    m.def("sample_disagreement", &sample_disagreement);
    m.def("gray_edges", static_cast<nb::tuple (*)(const std::vector<AnyImage>&, const std::vector<int>&, int, int,
                                                  float, float, float, float, float, float, int)>(&gray_edges));
    m.def("decode_gray", &decode_gray);
    m.def("repair_periods", &repair_periods);
    m.def("sample_noise", &sample_noise);
    m.def("bin_noise", &bin_noise);
}
