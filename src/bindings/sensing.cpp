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
#include "bindings/maps.hpp"
#include "core/camera.hpp"
#include "core/correspond.hpp"
#include "core/grazing.hpp"
#include "core/image.hpp"
#include "core/islands.hpp"
#include "core/phase_edges.hpp"
#include "core/triangulate.hpp"
#include "core/undistortion.hpp"

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
    m.def("undistortion_shifts", &undistortion_shifts);
    m.def("phase_edges", &phase_edges);
    m.def("correspond", &correspond);
    m.def("triangulate", &triangulate);
    m.def("projector_residual", &projector_residual);
    m.def("grazing_points", &grazing_points);
    m.def("islands", &islands);
}
