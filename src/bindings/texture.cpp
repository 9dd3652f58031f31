// Bindings of the texture kernels.

#include <nanobind/stl/pair.h>
#include <nanobind/stl/vector.h>

#include <utility>
#include <vector>

#include "bindings/arrays.hpp"
#include "bindings/bindings.hpp"
#include "core/texture/block_maps.hpp"
#include "core/texture/contrast.hpp"
#include "core/texture/contrast_excess.hpp"
#include "core/texture/fixed_pattern.hpp"
#include "core/texture/local_plane.hpp"
#include "core/texture/sample_chart.hpp"
#include "core/texture/split_bands.hpp"

namespace {

using Maps = std::vector<In<float, 2>>;

std::vector<planish::Image<const float>> views(const Maps& maps) {
    std::vector<planish::Image<const float>> out;
    out.reserve(maps.size());
    for (const auto& map : maps) out.push_back(view<float, 2>(map));
    return out;
}

/// An empty view of an array of size 0: everything is seen.
planish::Image<const unsigned char> seen_view(const In<std::uint8_t, 2>& seen) {
    return seen.size() > 0 ? view<std::uint8_t, 2>(seen) : planish::Image<const unsigned char>{};
}

nb::tuple block_sums(const In<float, 2>& image, float low, float high, const In<std::uint8_t, 2>& seen, int factor,
                     int threads) {
    const auto in = view<float, 2>(image);
    const int height = (in.height + factor - 1) / factor, width = (in.width + factor - 1) / factor;
    Owned<float> sum(height, width, 1), count(height, width, 1);
    {
        nb::gil_scoped_release release;
        planish::block_sums({in, low, high, seen_view(seen)}, factor, threads, sum.image, count.image);
    }
    return nb::make_tuple(sum.map(), count.map());
}

Out<float, 3> block_centres(const In<float, 3>& image, int factor) {
    const auto in = view<float, 3>(image);
    Owned<float> out((in.height + factor - 1) / factor, (in.width + factor - 1) / factor, in.channels);
    {
        nb::gil_scoped_release release;
        planish::block_centres(in, factor, out.image);
    }
    return out.maps();
}

/// Blocks (h, w) of an image of (height, width).
Out<std::uint8_t, 2> mark_blocks(const In<float, 3>& places, int factor, int height, int width) {
    Owned<std::uint8_t> out((height + factor - 1) / factor, (width + factor - 1) / factor, 1);
    const auto at = view<float, 3>(places);
    {
        nb::gil_scoped_release release;
        planish::mark_blocks(at, factor, out.image);
    }
    return out.map();
}

Out<float, 2> fill_gaps(const In<float, 2>& blocks, float otherwise) {
    const auto in = view<float, 2>(blocks);
    Owned<float> out(in.height, in.width, 1);
    {
        nb::gil_scoped_release release;
        planish::fill_gaps(in, otherwise, out.image);
    }
    return out.map();
}

Out<float, 2> lambert(const In<float, 3>& points, const In<float, 3>& normals, const In<double, 1>& source,
                      float least_cosine) {
    const auto in = view<float, 3>(points);
    Owned<float> out(in.height, in.width, 1);
    const Eigen::Vector3f from = Eigen::Map<const Eigen::Vector3d>(source.data()).cast<float>();
    {
        nb::gil_scoped_release release;
        planish::lambert(in, view<float, 3>(normals), from, least_cosine, out.image);
    }
    return out.map();
}

/// Images, ranges and levels of two kinds.
std::pair<int, float> contrast_scatter(const std::pair<In<float, 2>, In<float, 2>>& images,
                                       const std::pair<std::pair<float, float>, std::pair<float, float>>& ranges,
                                       const In<std::uint8_t, 2>& seen,
                                       const std::pair<In<float, 2>, In<float, 2>>& levels,
                                       const In<float, 2>& expected, int factor, int step) {
    const auto mask = seen_view(seen);
    const planish::Level first{{view<float, 2>(images.first), ranges.first.first, ranges.first.second, mask},
                               view<float, 2>(levels.first)};
    const planish::Level other{{view<float, 2>(images.second), ranges.second.first, ranges.second.second, mask},
                               view<float, 2>(levels.second)};
    const auto variance = view<float, 2>(expected);
    planish::Scatter found;
    {
        nb::gil_scoped_release release;
        found = planish::contrast_scatter(first, other, variance, factor, step);
    }
    return {found.count, found.deviation};
}

Out<float, 2> local_planes(const In<float, 2>& total, const In<float, 2>& weight, const std::vector<float>& bell,
                           float least_weight, float thin, float steepest, int threads) {
    const auto in = view<float, 2>(total);
    Owned<float> out(in.height, in.width, 1);
    {
        nb::gil_scoped_release release;
        planish::local_planes(in, view<float, 2>(weight), {bell, least_weight, thin, steepest}, threads, out.image);
    }
    return out.map();
}

/// K images with their ranges (low, high), levels and variances; `covariance` of size 0: there is none.
nb::tuple camera_contrast(const Maps& images, const std::vector<std::pair<float, float>>& ranges,
                          const In<std::uint8_t, 2>& seen, const Maps& level, const Maps& variance,
                          const In<float, 2>& covariance, float noise_left, int factor, float limit, int threads) {
    std::vector<planish::Exposed> exposed;
    for (std::size_t k = 0; k < images.size(); ++k)
        exposed.push_back({view<float, 2>(images[k]), ranges[k].first, ranges[k].second, seen_view(seen)});
    planish::ContrastPlan plan{views(level), views(variance), {}, noise_left, factor, limit};
    if (covariance.size() > 0) plan.covariance = view<float, 2>(covariance);
    const auto image = exposed.at(0).image, blocks = plan.level.at(0);
    Owned<float> value(image.height, image.width, 1), spread(image.height, image.width, 1),
        weight(blocks.height, blocks.width, 1);
    {
        nb::gil_scoped_release release;
        planish::camera_contrast(exposed, plan, threads, {value.image, spread.image, weight.image});
    }
    return nb::make_tuple(value.map(), spread.map(), weight.map());
}

/// `place` of size 0: at the camera's own pixels.
nb::tuple compensated_image(const In<float, 2>& value, const In<float, 2>& variance, const In<float, 2>& level,
                            int factor, const In<float, 3>& place, const In<std::uint8_t, 2>& seen, float gain,
                            int threads) {
    const auto places = place.size() > 0 ? view<float, 3>(place) : planish::Image<const float>{};
    const planish::ContrastView own{view<float, 2>(value), view<float, 2>(variance), view<float, 2>(level), factor};
    const auto mask = view<std::uint8_t, 2>(seen);
    const int blocks_high = (mask.height + factor - 1) / factor, blocks_wide = (mask.width + factor - 1) / factor;
    Owned<float> image(mask.height, mask.width, 1), out_variance(mask.height, mask.width, 1),
        sum(blocks_high, blocks_wide, 1), count(blocks_high, blocks_wide, 1);
    {
        nb::gil_scoped_release release;
        planish::compensated_image(own, places, mask, gain, threads,
                                   {image.image, out_variance.image, sum.image, count.image});
    }
    return nb::make_tuple(image.map(), out_variance.map(), sum.map(), count.map());
}

/// Per camera (image, variance, expected, trust).
nb::tuple merge_contrasts(const nb::list& images, const In<std::uint8_t, 2>& valid, int factor, int threads) {
    std::vector<planish::SeenImage> parts;
    for (const auto& item : images) {
        const auto maps = nb::cast<nb::tuple>(item);
        const auto map = [&](int i) { return view<float, 2>(nb::cast<In<float, 2>>(maps[i])); };
        parts.push_back({map(0), map(1), map(2), map(3)});
    }
    const auto points = view<std::uint8_t, 2>(valid);
    Owned<float> value(points.height, points.width, 1), sigma(points.height, points.width, 1);
    {
        nb::gil_scoped_release release;
        planish::merge_contrasts(parts, points, factor, threads, value.image, sigma.image);
    }
    return nb::make_tuple(value.map(), sigma.map());
}

nb::tuple sample_chart(const In<float, 2>& value, const In<float, 2>& sigma, const In<std::uint8_t, 2>& known,
                       const In<float, 3>& source, float interpolated, int threads) {
    const auto places = view<float, 3>(source);
    Owned<float> out_value(places.height, places.width, 1), out_sigma(places.height, places.width, 1);
    Owned<std::uint8_t> mask(places.height, places.width, 1);
    {
        nb::gil_scoped_release release;
        planish::sample_chart(view<float, 2>(value), view<float, 2>(sigma), view<std::uint8_t, 2>(known), places,
                              interpolated, threads, {out_value.image, out_sigma.image, mask.image});
    }
    return nb::make_tuple(out_value.map(), out_sigma.map(), mask.map());
}

using Sums = nb::ndarray<float, nb::ndim<2>, nb::c_contig, nb::device::cpu>;

planish::Image<float> writable(const Sums& map) {
    return {map.data(), static_cast<int>(map.shape(0)), static_cast<int>(map.shape(1)), 1};
}

/// `sum` and `weights` are changed in place.
void add_to_pattern(const In<float, 2>& value, const In<float, 2>& weight, int factor, const Sums& sum,
                    const Sums& weights, int threads) {
    const auto sums = writable(sum), totals = writable(weights);
    nb::gil_scoped_release release;
    planish::add_to_pattern(view<float, 2>(value), view<float, 2>(weight), factor, threads, sums, totals);
}

/// `own` of size 0: the band took no part in the sums. `rest` and `uncertain` are changed in place.
void remove_pattern(const In<float, 2>& band, const In<float, 2>& own, const nb::tuple& knowledge, int factor,
                    float share, const Sums& rest, const Sums& uncertain, int threads) {
    const auto map = [&](int k) { return view<float, 2>(nb::cast<In<float, 2>>(knowledge[k])); };
    const planish::PatternKnowledge known{map(0), map(1), map(2), map(3), map(4), factor};
    const auto mine = own.size() > 0 ? view<float, 2>(own) : planish::Image<const float>{};
    const auto left = writable(rest), variance = writable(uncertain);
    nb::gil_scoped_release release;
    planish::remove_pattern(view<float, 2>(band), mine, known, share, threads, left, variance);
}

/// Fine and coarse band (H, W), per block (h, w) their sums of squares and the number of known pixels.
nb::tuple split_bands(const In<float, 2>& value, const std::vector<float>& bell, int factor, int threads) {
    const auto in = view<float, 2>(value);
    const int height = (in.height + factor - 1) / factor, width = (in.width + factor - 1) / factor;
    Owned<float> fine(in.height, in.width, 1), coarse(in.height, in.width, 1);
    Owned<float> fine_squares(height, width, 1), coarse_squares(height, width, 1), count(height, width, 1);
    {
        nb::gil_scoped_release release;
        planish::split_bands(in, bell, factor, threads,
                             {fine.image, coarse.image, fine_squares.image, coarse_squares.image, count.image});
    }
    return nb::make_tuple(fine.map(), coarse.map(), fine_squares.map(), coarse_squares.map(), count.map());
}

}  // namespace

void bind_texture(nb::module_& m) {
    m.def("block_sums", &block_sums, "image"_a, "low"_a, "high"_a, "seen"_a, "factor"_a, "threads"_a);
    m.def("block_centres", &block_centres, "image"_a, "factor"_a);
    m.def("mark_blocks", &mark_blocks, "places"_a, "factor"_a, "height"_a, "width"_a);
    m.def("fill_gaps", &fill_gaps, "blocks"_a, "otherwise"_a);
    m.def("lambert", &lambert, "points"_a, "normals"_a, "source"_a, "least_cosine"_a);
    m.def("contrast_scatter", &contrast_scatter, "images"_a, "ranges"_a, "seen"_a, "levels"_a, "expected"_a, "factor"_a,
          "step"_a);
    m.def("local_planes", &local_planes, "total"_a, "weight"_a, "bell"_a, "least_weight"_a, "thin"_a, "steepest"_a,
          "threads"_a);
    m.def("camera_contrast", &camera_contrast, "images"_a, "ranges"_a, "seen"_a, "level"_a, "variance"_a,
          "covariance"_a, "noise_left"_a, "factor"_a, "limit"_a, "threads"_a);
    m.def("sample_chart", &sample_chart, "value"_a, "sigma"_a, "known"_a, "source"_a, "interpolated"_a, "threads"_a);
    m.def("add_to_pattern", &add_to_pattern, "value"_a, "weight"_a, "factor"_a, "sum"_a, "weights"_a, "threads"_a);
    m.def("remove_pattern", &remove_pattern, "band"_a, "own"_a, "knowledge"_a, "factor"_a, "share"_a, "rest"_a,
          "uncertain"_a, "threads"_a);
    m.def("split_bands", &split_bands, "value"_a, "bell"_a, "factor"_a, "threads"_a);
    m.def("compensated_image", &compensated_image, "value"_a, "variance"_a, "level"_a, "factor"_a, "place"_a, "seen"_a,
          "gain"_a, "threads"_a);
    m.def("merge_contrasts", &merge_contrasts, "images"_a, "valid"_a, "factor"_a, "threads"_a);
}
