// Bindings of the kernels that make the refinement's maps of one measurement.

#include <nanobind/stl/array.h>
#include <nanobind/stl/vector.h>

#include <array>
#include <vector>

#include "bindings/arrays.hpp"
#include "bindings/bindings.hpp"
#include "core/refinement/joint.hpp"
#include "core/refinement/joint_values.hpp"
#include "core/refinement/spectrum_cells.hpp"
#include "core/refinement/window_moments.hpp"

namespace {

Out<float, 3> joint_values(const nb::tuple& maps, const In<float, 2>& texture, const In<float, 3>& slopes,
                           const In<double, 1>& centre, double blur, double blur_sigma, int spacing, int threads) {
    const auto three = [&](int k) { return view<float, 3>(nb::cast<In<float, 3>>(maps[k])); };
    const auto two = [&](int k) { return view<float, 2>(nb::cast<In<float, 2>>(maps[k])); };
    planish::JointSources in{three(0), two(1), three(2), three(3), two(4), two(5), two(6), view<float, 2>(texture), {}};
    if (slopes.size() > 0) in.slopes = view<float, 3>(slopes);
    const planish::JointValueOptions options{Eigen::Vector3d(centre(0), centre(1), centre(2)).cast<float>(),
                                             static_cast<float>(blur), static_cast<float>(blur_sigma), spacing};
    Owned<float> values(in.texture.height, in.texture.width, planish::joint::channels);
    {
        nb::gil_scoped_release release;
        planish::joint_values(in, options, threads, values.image);
    }
    return values.maps();
}

/// Sums (pairs, h, w) under windows around every n-th pixel.
Out<float, 3> window_moments(const In<float, 2>& image, std::vector<std::vector<float>> taps,
                             std::vector<std::array<int, 2>> pairs, int step, const std::array<int, 2>& shape,
                             int threads) {
    const int count = static_cast<int>(pairs.size());
    const planish::MomentWindow window{std::move(taps), std::move(pairs), step};
    Owned<float> sums(count, shape[0], shape[1]);
    {
        nb::gil_scoped_release release;
        planish::window_moments(view<float, 2>(image), window, threads, sums.image);
    }
    return sums.maps();
}

Out<float, 2> spectrum_products(const In<float, 3>& first, const In<float, 3>& second, int step, int threads) {
    const auto in = view<float, 3>(first);
    Owned<float> cells(in.height / step, (in.width - 1) / step + 1, 1);
    {
        nb::gil_scoped_release release;
        planish::spectrum_products(in, view<float, 3>(second), step, threads, cells.image);
    }
    return cells.map();
}

void weigh_spectrum(const nb::ndarray<float, nb::ndim<3>, nb::c_contig, nb::device::cpu>& spectrum,
                    const In<float, 2>& cells, int step, double shading, int threads) {
    const planish::Image<float> image{spectrum.data(), static_cast<int>(spectrum.shape(0)),
                                      static_cast<int>(spectrum.shape(1)), 2};
    nb::gil_scoped_release release;
    planish::weigh_spectrum(image, view<float, 2>(cells), step, shading, threads);
}

}  // namespace

void bind_refinement(nb::module_& m) {
    m.def("joint_values", &joint_values, "maps"_a, "texture"_a, "slopes"_a, "centre"_a, "blur"_a, "blur_sigma"_a,
          "spacing"_a, "threads"_a);
    m.def("window_moments", &window_moments, "image"_a, "taps"_a, "pairs"_a, "step"_a, "shape"_a, "threads"_a);
    m.def("spectrum_products", &spectrum_products, "first"_a, "second"_a, "step"_a, "threads"_a);
    m.def("weigh_spectrum", &weigh_spectrum, "spectrum"_a, "cells"_a, "step"_a, "shading"_a, "threads"_a);
}
