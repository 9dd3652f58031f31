// Bindings of the texture kernels.

#include <nanobind/stl/pair.h>
#include <nanobind/stl/vector.h>

#include <utility>
#include <vector>

#include "bindings/arrays.hpp"
#include "bindings/bindings.hpp"
#include "core/contrast.hpp"

namespace {

using Maps = std::vector<In<float, 2>>;

std::vector<planish::Image<const float>> views(const Maps& maps) {
    std::vector<planish::Image<const float>> out;
    out.reserve(maps.size());
    for (const auto& map : maps) out.push_back(view<float, 2>(map));
    return out;
}

nb::tuple block_sums(const In<float, 2>& image, float low, float high, int factor, int threads) {
    const auto in = view<float, 2>(image);
    const int height = (in.height + factor - 1) / factor, width = (in.width + factor - 1) / factor;
    Owned<float> sum(height, width, 1), count(height, width, 1);
    {
        nb::gil_scoped_release release;
        planish::block_sums({in, low, high}, factor, threads, sum.image, count.image);
    }
    return nb::make_tuple(sum.map(), count.map());
}

/// K images with their ranges (low, high); per image inverse level and weight; K x K maps of the noise.
nb::tuple camera_contrast(const Maps& images, const std::vector<std::pair<float, float>>& ranges,
                          const Maps& inverse_level, const Maps& weight, const Maps& noise, int factor, float limit,
                          int threads) {
    std::vector<planish::Exposed> exposed;
    for (std::size_t k = 0; k < images.size(); ++k)
        exposed.push_back({view<float, 2>(images[k]), ranges[k].first, ranges[k].second});
    const planish::ContrastPlan plan{views(inverse_level), views(weight), views(noise), factor, limit};
    Owned<float> value(exposed[0].image.height, exposed[0].image.width, 1);
    Owned<float> variance(exposed[0].image.height, exposed[0].image.width, 1);
    {
        nb::gil_scoped_release release;
        planish::camera_contrast(exposed, plan, threads, value.image, variance.image);
    }
    return nb::make_tuple(value.map(), variance.map());
}

/// Per view (value, variance, place, shading, trust); `place` of size 0: the organising camera itself.
nb::tuple merge_contrasts(const nb::list& views, const In<std::uint8_t, 2>& valid, int factor, int threads) {
    std::vector<planish::ContrastView> parts;
    for (const auto& item : views) {
        const auto maps = nb::cast<nb::tuple>(item);
        const auto map = [&](int i) { return view<float, 2>(nb::cast<In<float, 2>>(maps[i])); };
        const auto place = nb::cast<In<float, 3>>(maps[2]);
        parts.push_back({map(0), map(1), place.size() > 0 ? view<float, 3>(place) : planish::Image<const float>{},
                         map(3), map(4)});
    }
    const auto points = view<std::uint8_t, 2>(valid);
    Owned<float> value(points.height, points.width, 1), sigma(points.height, points.width, 1);
    {
        nb::gil_scoped_release release;
        planish::merge_contrasts(parts, points, factor, threads, value.image, sigma.image);
    }
    return nb::make_tuple(value.map(), sigma.map());
}

}  // namespace

void bind_texture(nb::module_& m) {
    m.def("block_sums", &block_sums, "image"_a, "low"_a, "high"_a, "factor"_a, "threads"_a);
    m.def("camera_contrast", &camera_contrast, "images"_a, "ranges"_a, "inverse_level"_a, "weight"_a, "noise"_a,
          "factor"_a, "limit"_a, "threads"_a);
    m.def("merge_contrasts", &merge_contrasts, "views"_a, "valid"_a, "factor"_a, "threads"_a);
}
