// Bindings of the sensing kernels.

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/vector.h>

#include <algorithm>
#include <cstdint>
#include <initializer_list>
#include <memory>
#include <stdexcept>
#include <thread>
#include <vector>

#include "bindings/arrays.hpp"
#include "bindings/bindings.hpp"
#include "core/camera.hpp"
#include "core/correspond.hpp"
#include "core/decode_gray.hpp"
#include "core/decode_phase.hpp"
#include "core/grazing.hpp"
#include "core/image.hpp"
#include "core/islands.hpp"
#include "core/noise_samples.hpp"
#include "core/pages.hpp"
#include "core/phase_edges.hpp"
#include "core/repair_periods.hpp"
#include "core/triangulate.hpp"
#include "core/undistortion.hpp"

namespace {

// --- arrays --------------------------------------------------------------------------------------------------------

template <class T>
using AnyIn = nb::ndarray<const T, nb::c_contig, nb::device::cpu>;
template <class T>
using Shared = nb::ndarray<T, nb::c_contig, nb::device::cpu>;
template <class T>
using AnyOut = nb::ndarray<nb::numpy, T>;
using AnyImage = nb::ndarray<nb::ro, nb::ndim<2>, nb::c_contig, nb::device::cpu>;

/// What the maps of one capture of two cameras take. Never destroyed: arrays may outlive everything else.
planish::PagePool& page_pool() {
    static auto* pool = new planish::PagePool(std::size_t{128} << 20U);
    return *pool;
}

/// A new array that Python owns; its values are not set.
template <class T>
AnyOut<T> make_array(std::initializer_list<std::size_t> shape) {
    std::size_t size = 1;
    for (const std::size_t n : shape) size *= n;
    auto pages = std::make_unique<planish::Pages>(page_pool().take(size * sizeof(T)));
    T* raw = static_cast<T*>(pages->data);
    nb::capsule owner(pages.release(), [](void* p) noexcept {
        const std::unique_ptr<planish::Pages> returned(static_cast<planish::Pages*>(p));
        page_pool().give_back(*returned);
    });
    return AnyOut<T>(raw, shape.size(), shape.begin(), owner);
}

/// View of an array (H, W) or (H, W, C) of any number of dimensions; an array of size 0 becomes an empty view.
template <class Array>
auto view_of(const Array& a) {
    using T = std::remove_pointer_t<decltype(a.data())>;
    if (a.size() == 0) return planish::Image<T>{};
    return planish::Image<T>{a.data(), static_cast<int>(a.shape(0)), static_cast<int>(a.shape(1)),
                             a.ndim() > 2 ? static_cast<int>(a.shape(2)) : 1};
}

planish::Camera make_camera(const AnyIn<double>& parameters) {
    return camera_from(parameters.data(), parameters.size());
}

// --- sensing -------------------------------------------------------------------------------------------------------

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

bool is_8_bit(const std::vector<AnyImage>& images) {
    if (images.empty()) throw std::invalid_argument("no images");
    const auto type = images.front().dtype();
    for (const auto& image : images)
        if (image.dtype() != type || image.shape(0) != images.front().shape(0) ||
            image.shape(1) != images.front().shape(1))
            throw std::invalid_argument("images differ in size or type");
    if (type == nb::dtype<std::uint8_t>()) return true;
    if (type == nb::dtype<std::uint16_t>()) return false;
    throw std::invalid_argument("images must be uint8 or uint16");
}

planish::DecodeSettings make_settings(const nb::dict& values) {
    const auto number = [&](const char* name) { return nb::cast<float>(values[name]); };
    planish::DecodeSettings settings;
    settings.noise = {number("saturation"), number("noise_offset"), number("noise_slope")};
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

AnyOut<float> undistortion_shifts(const AnyIn<double>& camera, int height, int width, int threads) {
    auto shifts = make_array<float>({static_cast<std::size_t>(height), static_cast<std::size_t>(width), 2});
    const auto out = view_of(shifts);
    const planish::Camera model = make_camera(camera);
    nb::gil_scoped_release release;
    planish::undistortion_shifts(model, threads, out);
    return shifts;
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

AnyOut<std::uint8_t> phase_edges(const AnyIn<float>& position, const AnyIn<float>& sigma, float jump_px, float sigmas,
                                 int threads) {
    auto edge = make_array<std::uint8_t>({position.shape(0), position.shape(1)});
    const auto out = view_of(edge);
    const auto p = view_of(position), s = view_of(sigma);
    nb::gil_scoped_release release;
    planish::phase_edges(p, s, jump_px, sigmas, threads, out);
    return edge;
}

nb::tuple correspond(const AnyIn<float>& own_position, const AnyIn<float>& own_sigma, const AnyIn<float>& own_shift,
                     const AnyIn<float>& other_position, const AnyIn<float>& other_sigma,
                     const AnyIn<float>& other_shift, const AnyIn<double>& F, int threads) {
    const std::size_t h = own_position.shape(0), w = own_position.shape(1);
    auto pixel = make_array<float>({h, w, 2}), sigma = make_array<float>({h, w});
    const planish::PhaseView own{view_of(own_position), view_of(own_sigma), view_of(own_shift)};
    const planish::PhaseView other{view_of(other_position), view_of(other_sigma), view_of(other_shift)};
    const Eigen::Matrix3d line = Eigen::Map<const Eigen::Matrix<double, 3, 3, Eigen::RowMajor>>(F.data());
    const planish::CorrespondResult out{view_of(pixel), view_of(sigma)};
    {
        nb::gil_scoped_release release;
        planish::correspond(own, other, line, threads, out);
    }
    return nb::make_tuple(pixel, sigma);
}

nb::tuple triangulate(const AnyIn<double>& own, const AnyIn<float>& own_shift, const AnyIn<double>& other,
                      const AnyIn<float>& other_shift, const AnyIn<float>& pixel, const AnyIn<float>& sigma,
                      int threads) {
    const std::size_t h = pixel.shape(0), w = pixel.shape(1);
    auto points = make_array<float>({h, w, 3}), sigma_mm = make_array<float>({h, w}), miss = make_array<float>({h, w});
    const planish::ViewGeometry a{make_camera(own), view_of(own_shift)}, b{make_camera(other), view_of(other_shift)};
    const planish::TriangulateResult out{view_of(points), view_of(sigma_mm), view_of(miss)};
    const auto p = view_of(pixel), s = view_of(sigma);
    {
        nb::gil_scoped_release release;
        planish::triangulate(a, b, p, s, threads, out);
    }
    return nb::make_tuple(points, sigma_mm, miss);
}

nb::tuple projector_residual(const AnyIn<double>& projector, int axis, const AnyIn<double>& center,
                             const AnyIn<float>& points, const AnyIn<float>& sigma_mm, const AnyIn<float>& position,
                             const AnyIn<float>& position_sigma, int threads) {
    const std::size_t h = points.shape(0), w = points.shape(1);
    auto residual = make_array<float>({h, w}), sigma = make_array<float>({h, w});
    const planish::Camera model = make_camera(projector);
    const Eigen::Vector3d origin(center.data()[0], center.data()[1], center.data()[2]);
    const auto x = view_of(points), s = view_of(sigma_mm), p = view_of(position), ps = view_of(position_sigma);
    const auto r = view_of(residual), rs = view_of(sigma);
    {
        nb::gil_scoped_release release;
        planish::projector_residual(model, axis, origin, x, s, p, ps, threads, r, rs);
    }
    return nb::make_tuple(residual, sigma);
}

AnyOut<std::uint8_t> grazing_points(const AnyIn<float>& depth, const AnyIn<float>& sigma,
                                    const AnyIn<std::uint8_t>& lit, float pixel_size, float max_slope, float rim_px,
                                    float sigmas, int threads) {
    auto grazing = make_array<std::uint8_t>({depth.shape(0), depth.shape(1)});
    const auto out = view_of(grazing);
    const auto z = view_of(depth), s = view_of(sigma);
    const auto l = view_of(lit);
    nb::gil_scoped_release release;
    planish::grazing_points(z, s, l, {pixel_size, max_slope, rim_px, sigmas}, threads, out);
    return grazing;
}

AnyOut<std::uint8_t> islands(const AnyIn<float>& depth, const AnyIn<float>& sigma, float depth_per_pixel, float sigmas,
                             int min_pixels) {
    auto small = make_array<std::uint8_t>({depth.shape(0), depth.shape(1)});
    const auto out = view_of(small);
    const auto z = view_of(depth), s = view_of(sigma);
    nb::gil_scoped_release release;
    planish::islands(z, s, {depth_per_pixel, sigmas, min_pixels}, out);
    return small;
}

}  // namespace

void bind_sensing(nb::module_& m) {
    m.def("decode_phase", &decode_phase);
    m.def("sample_disagreement", &sample_disagreement);
    m.def("decode_gray", &decode_gray);
    m.def("undistortion_shifts", &undistortion_shifts);
    m.def("repair_periods", &repair_periods);
    m.def("sample_noise", &sample_noise);
    m.def("bin_noise", &bin_noise);
    m.def("phase_edges", &phase_edges);
    m.def("correspond", &correspond);
    m.def("triangulate", &triangulate);
    m.def("projector_residual", &projector_residual);
    m.def("grazing_points", &grazing_points);
    m.def("islands", &islands);
}
