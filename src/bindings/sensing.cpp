// Bindings of the sensing kernels.

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/vector.h>

#include <algorithm>
#include <cstdint>
#include <initializer_list>
#include <memory>
#include <optional>
#include <stdexcept>
#include <thread>
#include <vector>

#include "bindings/arrays.hpp"
#include "bindings/bindings.hpp"
#include "bindings/maps.hpp"
#include "core/common/camera.hpp"
#include "core/common/image.hpp"
#include "core/sensing/check_points.hpp"
#include "core/sensing/correlate.hpp"
#include "core/sensing/correspond.hpp"
#include "core/sensing/grazing.hpp"
#include "core/sensing/intersect.hpp"
#include "core/sensing/islands.hpp"
#include "core/sensing/phase_edges.hpp"
#include "core/sensing/projector_residual.hpp"
#include "core/sensing/temporal.hpp"
#include "core/sensing/triangulate.hpp"
#include "core/sensing/undistortion.hpp"

namespace {

// --- arrays --------------------------------------------------------------------------------------------------------

planish::Camera make_camera(const AnyIn<double>& parameters) {
    return camera_from(parameters.data(), parameters.size());
}

// --- sensing -------------------------------------------------------------------------------------------------------

AnyOut<float> undistortion_shifts(const AnyIn<double>& camera, int height, int width, int threads) {
    auto shifts = make_array<float>({static_cast<std::size_t>(height), static_cast<std::size_t>(width), 2});
    const auto out = view_of(shifts);
    const planish::Camera model = make_camera(camera);
    nb::gil_scoped_release release;
    planish::undistortion_shifts(model, threads, out);
    return shifts;
}

nb::tuple phase_edges(const AnyIn<float>& position, const AnyIn<float>& sigma, const AnyIn<std::uint16_t>& rejected,
                      float jump_px, float sigmas, int reason, int threads) {
    const std::size_t h = position.shape(0), w = position.shape(1);
    auto new_position = make_array<float>({h, w}), new_sigma = make_array<float>({h, w});
    auto new_rejected = make_array<std::uint16_t>({h, w});
    const planish::PhaseMaps maps{view_of(position), view_of(sigma), view_of(rejected)};
    const planish::PhaseMapsOut out{view_of(new_position), view_of(new_sigma), view_of(new_rejected)};
    {
        nb::gil_scoped_release release;
        planish::phase_edges(maps, jump_px, sigmas, static_cast<std::uint16_t>(reason), threads, out);
    }
    return nb::make_tuple(new_position, new_sigma, new_rejected);
}

nb::tuple correspond(const AnyIn<float>& own_position, const AnyIn<float>& own_sigma, const AnyIn<float>& own_shift,
                     const AnyIn<float>& other_position, const AnyIn<float>& other_sigma,
                     const AnyIn<double>& other_camera, bool transposed, const AnyIn<double>& F, int threads) {
    const std::size_t h = own_position.shape(0), w = own_position.shape(1);
    auto pixel = make_array<float>({h, w, 2}), sigma = make_array<float>({h, w});
    const planish::OwnView own{view_of(own_position), view_of(own_sigma), view_of(own_shift)};
    const planish::OtherView other{view_of(other_position), view_of(other_sigma), make_camera(other_camera),
                                   transposed};
    const Eigen::Matrix3d line = Eigen::Map<const Eigen::Matrix<double, 3, 3, Eigen::RowMajor>>(F.data());
    const planish::CorrespondResult out{view_of(pixel), view_of(sigma)};
    {
        nb::gil_scoped_release release;
        planish::correspond(own, other, line, threads, out);
    }
    return nb::make_tuple(pixel, sigma);
}

template <class T>
planish::TemporalStack interleave(const std::vector<AnyImage>& images, int threads) {
    std::vector<const T*> data;
    for (const auto& image : images) data.push_back(static_cast<const T*>(image.data()));
    return planish::interleave<T>(data, static_cast<int>(images[0].shape(0)), static_cast<int>(images[0].shape(1)),
                                  threads);
}

planish::TemporalStack temporal_stack(const std::vector<AnyImage>& images, int threads) {
    return is_8_bit(images) ? interleave<std::uint8_t>(images, threads) : interleave<std::uint16_t>(images, threads);
}

nb::tuple temporal_statistics(const std::vector<AnyImage>& images, float saturation, int threads) {
    const bool any = !images.empty();
    const std::size_t h = any ? images[0].shape(0) : 0, w = any ? images[0].shape(1) : 0;
    auto mean = make_array<float>({h, w}), norm = make_array<float>({h, w});
    auto saturated = make_array<std::uint8_t>({h, w});
    const planish::TemporalStatistics out{view_of(mean), view_of(norm), view_of(saturated)};
    {
        nb::gil_scoped_release release;
        planish::temporal_statistics(temporal_stack(images, threads), saturation, threads, out);
    }
    return nb::make_tuple(mean, norm, saturated);
}

/// `noise`: offset, slope and saturation, own then other.
nb::tuple correlate(const std::vector<AnyImage>& own_images, const AnyIn<float>& own_shift,
                    const std::vector<AnyImage>& other_images, const AnyIn<float>& other_shift,
                    const AnyIn<float>& noise, const AnyIn<double>& F, int min_steps, const AnyIn<float>& max_loss,
                    const AnyIn<float>& sure_loss, const AnyIn<float>& max_misfit, float model_loss, float min_gap,
                    const AnyIn<float>& range, int range_spacing, int threads) {
    const bool any = !own_images.empty();
    const std::size_t h = any ? own_images[0].shape(0) : 0, w = any ? own_images[0].shape(1) : 0;
    auto pixel = make_array<float>({h, w, 2}), sigma = make_array<float>({h, w});
    auto rejected = make_array<std::uint16_t>({h, w});
    const Eigen::Matrix3d line = Eigen::Map<const Eigen::Matrix<double, 3, 3, Eigen::RowMajor>>(F.data());
    const float* n = noise.data();
    const planish::CorrelateSettings settings{min_steps,
                                              {max_loss.data(), max_loss.size()},
                                              {sure_loss.data(), sure_loss.size()},
                                              {max_misfit.data(), max_misfit.size()},
                                              model_loss,
                                              min_gap,
                                              view_of(range),
                                              range_spacing};
    const auto shift = view_of(own_shift), shift_other = view_of(other_shift);
    const planish::CorrelateResult out{view_of(pixel), view_of(sigma), view_of(rejected)};
    {
        nb::gil_scoped_release release;
        const planish::TemporalStack a = temporal_stack(own_images, threads), b = temporal_stack(other_images, threads);
        planish::correlate({a, shift, {n[0], n[1], n[2]}}, {b, shift_other, {n[3], n[4], n[5]}}, line, settings,
                           threads, out);
    }
    return nb::make_tuple(pixel, sigma, rejected);
}

nb::tuple triangulate(const AnyIn<double>& own, const AnyIn<float>& own_shift, const AnyIn<double>& other,
                      const AnyIn<float>& pixel, const AnyIn<float>& sigma, int threads) {
    const std::size_t h = pixel.shape(0), w = pixel.shape(1);
    auto points = make_array<float>({h, w, 3}), sigma_mm = make_array<float>({h, w}), miss = make_array<float>({h, w});
    const planish::ViewGeometry a{make_camera(own), view_of(own_shift)};
    const planish::Camera b = make_camera(other);
    const planish::TriangulateResult out{view_of(points), view_of(sigma_mm), view_of(miss)};
    const auto p = view_of(pixel), s = view_of(sigma);
    {
        nb::gil_scoped_release release;
        planish::triangulate(a, b, p, s, threads, out);
    }
    return nb::make_tuple(points, sigma_mm, miss);
}

planish::ProjectorRay make_projector(const AnyIn<double>& projector, int axis, const AnyIn<double>& center) {
    return {make_camera(projector), axis, Eigen::Vector3d(center.data()[0], center.data()[1], center.data()[2])};
}

nb::tuple projector_residual(const AnyIn<double>& projector, int axis, const AnyIn<double>& center,
                             const AnyIn<float>& points, const AnyIn<float>& sigma_mm, const AnyIn<float>& position,
                             const AnyIn<float>& position_sigma, int threads) {
    const std::size_t h = points.shape(0), w = points.shape(1);
    auto residual = make_array<float>({h, w}), sigma = make_array<float>({h, w});
    const planish::ProjectorRay ray = make_projector(projector, axis, center);
    const auto x = view_of(points), s = view_of(sigma_mm), p = view_of(position), ps = view_of(position_sigma);
    const auto r = view_of(residual), rs = view_of(sigma);
    {
        nb::gil_scoped_release release;
        planish::projector_residual(ray, x, s, p, ps, threads, r, rs);
    }
    return nb::make_tuple(residual, sigma);
}

/// `projector` of size 0: there is none. `limits`: largest miss, allowed disagreement with the projector, standard
/// deviations on top of it, box low (3) and high (3). `reasons`: bits of unmatched, outside, mismatch.
nb::tuple check_points(const AnyIn<float>& points, const AnyIn<float>& sigma_mm, const AnyIn<float>& miss,
                       const AnyIn<float>& position, const AnyIn<float>& position_sigma,
                       const AnyIn<std::uint16_t>& rejected, const AnyIn<double>& own, const AnyIn<double>& projector,
                       int axis, const std::vector<float>& limits, const std::vector<int>& reasons, int threads) {
    const std::size_t h = points.shape(0), w = points.shape(1);
    auto depth = make_array<float>({h, w});
    auto mask = make_array<std::uint16_t>({h, w});
    const planish::Camera camera = make_camera(own);
    const Eigen::Vector3d center = camera.center_sensor();
    std::optional<planish::ProjectorRay> ray;
    if (projector.size() != 0) ray.emplace(make_camera(projector), axis, center);
    planish::CheckedPoints in{view_of(points),
                              view_of(sigma_mm),
                              view_of(miss),
                              view_of(position),
                              view_of(position_sigma),
                              ray ? &*ray : nullptr,
                              {}};
    in.depth_row << camera.R_camera_sensor.row(2).transpose().cast<float>(),
        static_cast<float>(camera.t_camera_sensor.z());
    const planish::CheckLimits limit{limits.at(0), limits.at(1), limits.at(2),
                                     Eigen::Vector3f(limits.at(3), limits.at(4), limits.at(5)),
                                     Eigen::Vector3f(limits.at(6), limits.at(7), limits.at(8))};
    const auto bit = [&](std::size_t i) { return static_cast<std::uint16_t>(reasons.at(i)); };
    const planish::CheckReasons bits{bit(0), bit(1), bit(2)};
    const auto z = view_of(depth);
    const auto r = view_of(mask);
    {
        nb::gil_scoped_release release;
        std::copy_n(rejected.data(), h * w, mask.data());
        planish::check_points(in, limit, bits, threads, r, z);
    }
    return nb::make_tuple(mask, depth);
}

void drop_rejected(const AnyIn<std::uint16_t>& rejected,
                   const nb::ndarray<float, nb::c_contig, nb::device::cpu>& values, int threads) {
    const auto r = view_of(rejected);
    const planish::Image<float> x{values.data(), r.height, r.width,
                                  static_cast<int>(values.size() / std::max<std::size_t>(rejected.size(), 1))};
    nb::gil_scoped_release release;
    planish::drop_rejected(r, threads, x);
}

nb::tuple intersect(const AnyIn<double>& own, const AnyIn<float>& own_shift, const AnyIn<double>& projector, int width,
                    int height, const AnyIn<float>& position_u, const AnyIn<float>& sigma_u,
                    const AnyIn<float>& position_v, const AnyIn<float>& sigma_v, int primary, int threads) {
    const auto& given = primary == 0 ? position_u : position_v;
    const std::size_t h = given.shape(0), w = given.shape(1);
    auto points = make_array<float>({h, w, 3}), sigma = make_array<float>({h, w}), miss = make_array<float>({h, w}),
         miss_sigma = make_array<float>({h, w});
    const planish::ViewGeometry view{make_camera(own), view_of(own_shift)};
    const planish::Camera model = make_camera(projector);
    const planish::DecodedAxis axes[2] = {{view_of(position_u), view_of(sigma_u)},
                                          {view_of(position_v), view_of(sigma_v)}};
    const planish::IntersectResult out{view_of(points), view_of(sigma), view_of(miss), view_of(miss_sigma)};
    {
        nb::gil_scoped_release release;
        planish::intersect(view, model, width, height, axes, primary, threads, out);
    }
    return nb::make_tuple(points, sigma, miss, miss_sigma);
}

AnyOut<std::uint8_t> grazing_points(const AnyIn<float>& depth, const AnyIn<float>& sigma, const AnyIn<float>& position,
                                    float pixel_size, float max_slope, float rim_px, float sigmas, int threads) {
    auto grazing = make_array<std::uint8_t>({depth.shape(0), depth.shape(1)});
    const auto out = view_of(grazing);
    const auto z = view_of(depth), s = view_of(sigma), x = view_of(position);
    nb::gil_scoped_release release;
    planish::grazing_points(z, s, x, {pixel_size, max_slope, rim_px, sigmas}, threads, out);
    return grazing;
}

AnyOut<std::uint8_t> islands(const AnyIn<float>& depth, const AnyIn<float>& sigma, const AnyIn<std::uint8_t>& excluded,
                             float depth_per_pixel, float sigmas, int min_pixels, int threads) {
    auto small = make_array<std::uint8_t>({depth.shape(0), depth.shape(1)});
    const auto out = view_of(small);
    const auto z = view_of(depth), s = view_of(sigma);
    const auto x = view_of(excluded);
    nb::gil_scoped_release release;
    planish::islands(z, s, x, {depth_per_pixel, sigmas, min_pixels}, threads, out);
    return small;
}

}  // namespace

void bind_sensing(nb::module_& m) {
    m.def("undistortion_shifts", &undistortion_shifts);
    m.def("phase_edges", &phase_edges);
    m.def("correspond", &correspond);
    m.def("temporal_statistics", &temporal_statistics);
    m.def("correlate", &correlate);
    m.def("triangulate", &triangulate);
    m.def("projector_residual", &projector_residual);
    m.def("check_points", &check_points);
    m.def("drop_rejected", &drop_rejected);
    m.def("intersect", &intersect);
    m.def("grazing_points", &grazing_points);
    m.def("islands", &islands);
}
