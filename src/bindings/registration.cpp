// Bindings of the registration kernels.

#include <cmath>
#include <cstdint>
#include <vector>

#include "bindings/arrays.hpp"
#include "bindings/bindings.hpp"
#include "core/refinement/joint.hpp"
#include "core/refinement/joint_lookup.hpp"
#include "core/refinement/joint_pull.hpp"
#include "core/refinement/joint_samples.hpp"
#include "core/registration/align_texture.hpp"
#include "core/registration/consensus.hpp"
#include "core/registration/count_places.hpp"
#include "core/registration/match.hpp"
#include "core/registration/nearest_pixels.hpp"
#include "core/registration/patches.hpp"
#include "core/registration/surface.hpp"
#include "core/texture/chart.hpp"

namespace {

nb::tuple fit_surface(const In<float, 3>& points, const In<double, 1>& camera, int radius, double max_slope,
                      int threads) {
    const auto in = view<float, 3>(points);
    Owned<float> smoothed(in.height, in.width, 3), normals(in.height, in.width, 3), tangents(in.height, in.width, 6);
    {
        nb::gil_scoped_release release;
        planish::fit_surface(in, camera_from(camera), {radius, max_slope}, threads, smoothed.image, normals.image,
                             tangents.image);
    }
    return nb::make_tuple(smoothed.maps(), normals.maps(), tangents.maps());
}

nb::tuple chart_coordinates(const In<float, 3>& points, const In<float, 3>& nodes, int step, double max_height,
                            int threads) {
    const auto image = view<float, 3>(points);
    Owned<float> coordinates(image.height, image.width, 2);
    Owned<std::uint8_t> known(image.height, image.width, 1);
    planish::ChartExtent extent{};
    {
        nb::gil_scoped_release release;
        extent = planish::chart_coordinates(image, view<float, 3>(nodes), step, max_height, coordinates.image,
                                            known.image, threads);
    }
    return nb::make_tuple(coordinates.maps(), known.map(),
                          nb::make_tuple(extent.left, extent.top, extent.right, extent.bottom));
}

nb::tuple chart_surface(const In<float, 3>& source, const In<float, 3>& points, const In<float, 3>& normals,
                        const In<float, 3>& nodes, int step, int threads) {
    const auto raster = view<float, 3>(source);
    Owned<float> on(raster.height, raster.width, 3), normal(raster.height, raster.width, 3),
        axis(raster.height, raster.width, 3);
    {
        nb::gil_scoped_release release;
        planish::chart_surface(raster, view<float, 3>(points), view<float, 3>(normals), view<float, 3>(nodes), step,
                               {on.image, normal.image, axis.image}, threads);
    }
    return nb::make_tuple(on.maps(), normal.maps(), axis.maps());
}

Out<float, 3> rasterise_chart(const In<float, 3>& coordinates, double x, double y, double pitch, double max_edge,
                              int height, int width, int threads) {
    Owned<float> source(height, width, 2);
    {
        nb::gil_scoped_release release;
        planish::rasterise_chart(view<float, 3>(coordinates), {x, y, pitch}, max_edge, threads, source.image);
    }
    return source.maps();
}

/// Points (M, 3) and frames (M, 3, 3) of both sides of M matches. Returns transforms (K, 4, 4), best first, and their
/// places and agreeing matches (K, 2).
nb::tuple find_consensus(const In<double, 2>& points_a, const In<double, 2>& points_b, const In<double, 3>& frames_a,
                         const In<double, 3>& frames_b, double tolerance, double frame_angle, double normal_angle,
                         double distinct, int keep, int threads) {
    std::vector<planish::FramedMatch> matches(points_a.shape(0));
    for (std::size_t m = 0; m < matches.size(); ++m)
        for (int i = 0; i < 3; ++i) {
            matches[m].point_a[i] = points_a(m, i);
            matches[m].point_b[i] = points_b(m, i);
            for (int j = 0; j < 3; ++j) {
                matches[m].frame_a(i, j) = frames_a(m, i, j);
                matches[m].frame_b(i, j) = frames_b(m, i, j);
            }
        }
    std::vector<planish::Hypothesis> found;
    {
        nb::gil_scoped_release release;
        found = planish::find_consensus(matches, {tolerance, frame_angle, normal_angle, distinct}, keep, threads);
    }
    const auto count = static_cast<int>(found.size());
    Owned<double> transforms(count, 4, 4);
    Owned<std::int32_t> support(count, 2, 1);
    for (int h = 0; h < count; ++h) {
        for (int i = 0; i < 4; ++i)
            for (int j = 0; j < 4; ++j)
                transforms.image.at(h, i)[j] = i == 3   ? (j == 3 ? 1.0 : 0.0)
                                               : j == 3 ? found[h].t_a_b[i]
                                                        : found[h].R_a_b(i, j);
        *support.image.at(h, 0) = found[h].places;
        *support.image.at(h, 1) = found[h].support;
    }
    return nb::make_tuple(transforms.maps(), support.map());
}

int count_places(const In<double, 2>& points, double distinct) {
    std::vector<Eigen::Vector3d> places;
    for (std::size_t i = 0; i < points.shape(0); ++i) places.emplace_back(points(i, 0), points(i, 1), points(i, 2));
    return planish::count_places(places, distinct);
}

planish::JointMaps joint_maps(const nb::tuple& maps) {
    return {view<float, 3>(nb::cast<In<float, 3>>(maps[0])), view<float, 2>(nb::cast<In<float, 2>>(maps[1])),
            view<std::uint8_t, 2>(nb::cast<In<std::uint8_t, 2>>(maps[2]))};
}

Out<double, 2> matrix6(const planish::Matrix6& value) {
    Owned<double> out(6, 6, 1);
    for (int i = 0; i < 6; ++i)
        for (int j = 0; j < 6; ++j) *out.image.at(i, j) = value(i, j);
    return out.map();
}

nb::tuple normal_equations(const planish::Normal& n) {
    Owned<double> g(1, 6, 1), blur(1, 6, 1);
    std::copy_n(n.g.data(), 6, g.image.data);
    std::copy_n(n.blur.data(), 6, blur.image.data);
    return nb::make_tuple(matrix6(n.H), g.map(), n.cost, n.count, n.weights > 0 ? n.slopes / n.weights : 1.0,
                          blur.map());
}

planish::JointOptions joint_options(const nb::tuple& options) {
    return {nb::cast<double>(options[0]), nb::cast<double>(options[1]), nb::cast<int>(options[2]),
            nb::cast<int>(options[3])};
}

/// (tile rows, tile columns, 8): scale, weight, gain and offset of distance (its gain and offset unused), of texture.
std::vector<planish::TileWeight> tile_weights(const In<float, 3>& weights) {
    std::vector<planish::TileWeight> out(weights.shape(0) * weights.shape(1) * 2);
    for (std::size_t k = 0; k < out.size(); ++k) {
        const float* w = weights.data() + 4 * k;
        out[k] = {w[0], w[1], w[2], w[3]};
    }
    return out;
}

/// Maps a, camera a, maps b: see planish::JointMaps. Returns normal equations of distance and texture, the unbiased
/// information of both, correlation, tile gradients (rows, columns, 6 of the distance and 6 of the texture), number
/// and sum of absolute residuals per tile (rows, columns, 2 of the distance and 2 of the texture), shading per tile
/// (rows, columns, 6 of `change` by the gain, 6 by the offset, 4 of `square`, 2 of `residual`) and, if asked for, the
/// residual maps.
nb::tuple joint_normal_equations(const nb::tuple& maps_a, const In<double, 1>& camera_a, const nb::tuple& maps_b,
                                 const In<double, 2>& T_a_b, const In<double, 1>& about, const nb::tuple& options,
                                 const In<float, 3>& weights, bool with_residuals, int threads) {
    const auto o = joint_options(options);
    const auto counted = tile_weights(weights);
    const auto a = joint_maps(maps_a), b = joint_maps(maps_b);
    const Rigid T(T_a_b);
    Owned<float> distances(with_residuals ? b.values.height : 0, b.values.width, 1);
    Owned<float> differences(with_residuals ? b.values.height : 0, b.values.width, 1);
    planish::JointResult result;
    {
        const auto camera = camera_from(camera_a);
        nb::gil_scoped_release release;
        const planish::Image<float> none;
        result = planish::joint_normal_equations(a, camera, b, T.R, T.t, {about(0), about(1), about(2)}, o, counted,
                                                 threads, with_residuals ? distances.image : none,
                                                 with_residuals ? differences.image : none);
    }
    Owned<double> tiles(result.tile_rows, result.tile_columns, 12);
    for (std::size_t i = 0; i < result.tile_gradients.size(); ++i)
        std::copy_n(result.tile_gradients[i].data(), 12, tiles.image.data + 12 * i);
    Owned<double> sizes(result.tile_rows, result.tile_columns, 4);
    for (std::size_t i = 0; i < result.tile_sizes.size(); ++i)
        std::copy_n(result.tile_sizes[i].data(), 4, sizes.image.data + 4 * i);
    Owned<double> shading(result.tile_rows, result.tile_columns, 18);
    for (std::size_t i = 0; i < result.tile_shading.size(); ++i) {
        double* to = shading.image.data + 18 * i;
        to = std::copy_n(result.tile_shading[i].change.data(), 12, to);
        to = std::copy_n(result.tile_shading[i].square.data(), 4, to);
        std::copy_n(result.tile_shading[i].residual.data(), 2, to);
    }
    const auto& s = result.sums;
    const double norm = std::sqrt(s.correlation_aa * s.correlation_bb);
    return nb::make_tuple(normal_equations(s.distance), normal_equations(s.texture), matrix6(s.H_distance_unbiased),
                          matrix6(s.H_texture_unbiased), norm > 0 ? s.correlation_ab / norm : 0.0, tiles.maps(),
                          sizes.maps(), shading.maps(), distances.map(), differences.map());
}

/// See planish::joint_samples. Returns number and sum of absolute residuals per tile (rows, columns, 2 of the distance
/// and 2 of the texture), the samples of the textures (n, 3) and how many of them each tile has (rows x columns,).
nb::tuple joint_samples(const nb::tuple& maps_a, const In<double, 1>& camera_a, const nb::tuple& maps_b,
                        const In<double, 2>& T_a_b, const nb::tuple& options, int threads) {
    const auto o = joint_options(options);
    const auto a = joint_maps(maps_a), b = joint_maps(maps_b);
    const auto camera = camera_from(camera_a);
    const Rigid T(T_a_b);
    planish::JointSamples found;
    {
        nb::gil_scoped_release release;
        found = planish::joint_samples(a, camera, b, T.R, T.t, o, threads);
    }
    Owned<double> sizes(found.tile_rows, found.tile_columns, 4);
    for (std::size_t i = 0; i < found.tile_sizes.size(); ++i)
        std::copy_n(found.tile_sizes[i].data(), 4, sizes.image.data + 4 * i);
    Owned<float> textures(static_cast<int>(found.textures.size()), 3, 1);
    for (std::size_t i = 0; i < found.textures.size(); ++i) {
        const auto& [texture_a, texture_b, over_sigma] = found.textures[i];
        float* to = textures.image.data + 3 * i;
        to[0] = texture_a;
        to[1] = texture_b;
        to[2] = over_sigma;
    }
    Owned<std::int64_t> counts(1, static_cast<int>(found.counts.size()), 1);
    std::copy(found.counts.begin(), found.counts.end(), counts.image.data);
    return nb::make_tuple(sizes.maps(), textures.map(), counts.map());
}

/// See planish::joint_pull. Returns the pull (rows x columns, 6, 3) of all tiles and their pixels (rows x columns,).
nb::tuple joint_pull(const nb::tuple& maps_a, const In<double, 1>& camera_a, const nb::tuple& maps_b,
                     const In<double, 2>& T_a_b, const In<double, 1>& about, const nb::tuple& options,
                     const In<float, 3>& weights, int threads) {
    const auto o = joint_options(options);
    const auto counted = tile_weights(weights);
    const auto a = joint_maps(maps_a), b = joint_maps(maps_b);
    const Rigid T(T_a_b);
    planish::JointPull result;
    {
        const auto camera = camera_from(camera_a);
        nb::gil_scoped_release release;
        result = planish::joint_pull(a, camera, b, T.R, T.t, {about(0), about(1), about(2)}, o, counted, threads);
    }
    const auto count = static_cast<int>(result.tiles.size());
    Owned<double> tiles(count, 6, 3);
    Owned<std::int64_t> pixels(1, count, 1);
    for (int k = 0; k < count; ++k) {
        for (int i = 0; i < 6; ++i)
            for (int j = 0; j < 3; ++j) tiles.image.at(k, i)[j] = result.tiles[k](i, j);
        *pixels.image.at(0, k) = result.pixel[k];
    }
    return nb::make_tuple(tiles.maps(), pixels.map());
}

/// Points, sigma, normals, tangents, displacement by blur, texture and its sigma: see planish::JointSources.
Out<std::int32_t, 2> nearest_rows(const std::vector<planish::Nearest>& found) {
    Owned<std::int32_t> out(static_cast<int>(found.size()), 3, 1);
    for (std::size_t i = 0; i < found.size(); ++i) {
        std::int32_t* row = out.image.row(static_cast<int>(i));
        row[0] = found[i].best;
        row[1] = found[i].best_squared;
        row[2] = found[i].second_squared;
    }
    return out.map();
}

/// Per row of a: nearest row of b (-1 = none), its squared distance, that of the second (INT32_MAX = none), as (N, 3);
/// and the same per row of b.
nb::tuple nearest_descriptors(const In<std::uint8_t, 2>& a, const In<double, 1>& size_a, const In<std::uint8_t, 2>& b,
                              const In<double, 1>& size_b, double max_size_ratio, int threads) {
    const auto wrap = [](const In<std::uint8_t, 2>& d, const In<double, 1>& size) {
        return planish::Descriptors{{d.data(), d.size()}, {size.data(), size.size()}, d.shape(1)};
    };
    planish::BothNearest found;
    {
        nb::gil_scoped_release release;
        found = planish::nearest_descriptors(wrap(a, size_a), wrap(b, size_b), max_size_ratio, threads);
    }
    return nb::make_tuple(nearest_rows(found.of_a), nearest_rows(found.of_b));
}

std::vector<planish::Image<const float>> chart_views(const nb::list& charts) {
    std::vector<planish::Image<const float>> out;
    for (const auto& chart : charts) out.push_back(view<float, 2>(nb::cast<In<float, 2>>(chart)));
    return out;
}

/// Places (N, 6) [u, v, axes row by row] and their charts (N,).
std::vector<planish::PatchPlace> patch_places(const In<double, 2>& places, const In<std::int32_t, 1>& charts) {
    std::vector<planish::PatchPlace> out(places.shape(0));
    for (std::size_t i = 0; i < out.size(); ++i)
        out[i] = {charts(i), places(i, 0), places(i, 1), {places(i, 2), places(i, 3), places(i, 4), places(i, 5)}};
    return out;
}

/// Per pair (M, 2) of places: correlation, offset x and y, turn, compared pixels, as (M, 5). See
/// planish::align_patches.
Out<double, 2> align_patches(const nb::list& charts_a, const In<double, 2>& places_a,
                             const In<std::int32_t, 1>& chart_a, const nb::list& charts_b,
                             const In<double, 2>& places_b, const In<std::int32_t, 1>& chart_b,
                             const In<std::int32_t, 2>& pairs, int radius, int reach, int turns, double turn_step,
                             int threads) {
    const auto views_a = chart_views(charts_a), views_b = chart_views(charts_b);
    const auto at_a = patch_places(places_a, chart_a), at_b = patch_places(places_b, chart_b);
    std::vector<planish::PatchPair> asked(pairs.shape(0));
    for (std::size_t i = 0; i < asked.size(); ++i) asked[i] = {pairs(i, 0), pairs(i, 1)};
    std::vector<planish::PatchAlignment> found;
    {
        nb::gil_scoped_release release;
        found = planish::align_patches(views_a, views_b, at_a, at_b, asked, {radius, reach, turns, turn_step}, threads);
    }
    Owned<double> out(static_cast<int>(found.size()), 5, 1);
    for (std::size_t i = 0; i < found.size(); ++i) {
        const auto& f = found[i];
        const double row[5] = {f.correlation, f.x, f.y, f.turn, static_cast<double>(f.pixels)};
        std::copy_n(row, 5, out.image.row(static_cast<int>(i)));
    }
    return out.map();
}

/// See planish::align_texture. Returns source, value, sigma, common.
nb::tuple align_texture(const In<float, 3>& places, const In<std::uint8_t, 2>& own, const In<float, 3>& points_a,
                        const In<float, 3>& normals_a, const In<double, 1>& camera_b, const In<float, 3>& points_b,
                        const In<float, 2>& value_b, const In<float, 2>& sigma_b, const In<double, 2>& T_b_a,
                        double gate, int threads) {
    const planish::TextureSurface a{view<float, 3>(places), view<std::uint8_t, 2>(own), view<float, 3>(points_a),
                                    view<float, 3>(normals_a)};
    const planish::TexturedPoints b{view<float, 3>(points_b), view<float, 2>(value_b), view<float, 2>(sigma_b)};
    const auto camera = camera_from(camera_b);
    const Rigid T(T_b_a);
    const int height = a.places.height, width = a.places.width;
    Owned<float> source(height, width, 2), value(height, width, 1), sigma(height, width, 1);
    Owned<std::uint8_t> common(height, width, 1);
    {
        nb::gil_scoped_release release;
        planish::align_texture(a, camera, b, T.R, T.t, gate, threads,
                               {source.image, value.image, sigma.image, common.image});
    }
    return nb::make_tuple(source.maps(), value.map(), sigma.map(), common.map());
}

/// See planish::nearest_pixels. Returns flat pixels of b and of a (n, 2) and points (n, 3).
nb::tuple nearest_pixels(const In<float, 3>& points_b, int stride, const In<double, 1>& camera_a, int height_a,
                         int width_a, const In<double, 2>& T_a_b) {
    const auto camera = camera_from(camera_a);
    const Rigid T(T_a_b);
    std::vector<planish::NearestPixel> found;
    {
        nb::gil_scoped_release release;
        found = planish::nearest_pixels(view<float, 3>(points_b), stride, camera, height_a, width_a, T.R, T.t);
    }
    Owned<std::int32_t> pixels(static_cast<int>(found.size()), 2, 1);
    Owned<double> points(static_cast<int>(found.size()), 3, 1);
    for (std::size_t i = 0; i < found.size(); ++i) {
        pixels.image.data[2 * i] = found[i].pixel_b;
        pixels.image.data[2 * i + 1] = found[i].pixel_a;
        for (int k = 0; k < 3; ++k) points.image.data[3 * i + k] = found[i].point[k];
    }
    return nb::make_tuple(pixels.map(), points.map());
}

}  // namespace

void bind_registration(nb::module_& m) {
    m.def("nearest_descriptors", &nearest_descriptors, "a"_a, "size_a"_a, "b"_a, "size_b"_a, "max_size_ratio"_a,
          "threads"_a);
    m.def("align_patches", &align_patches, "charts_a"_a, "places_a"_a, "chart_a"_a, "charts_b"_a, "places_b"_a,
          "chart_b"_a, "pairs"_a, "radius"_a, "reach"_a, "turns"_a, "turn_step"_a, "threads"_a);
    m.def("fit_surface", &fit_surface, "points"_a, "camera"_a, "radius"_a, "max_slope"_a, "threads"_a);
    m.def("chart_coordinates", &chart_coordinates, "points"_a, "nodes"_a, "step"_a, "max_height"_a, "threads"_a);
    m.def("rasterise_chart", &rasterise_chart, "coordinates"_a, "x"_a, "y"_a, "pitch"_a, "max_edge"_a, "height"_a,
          "width"_a, "threads"_a);
    m.def("chart_surface", &chart_surface, "source"_a, "points"_a, "normals"_a, "nodes"_a, "step"_a, "threads"_a);
    m.def("find_consensus", &find_consensus, "points_a"_a, "points_b"_a, "frames_a"_a, "frames_b"_a, "tolerance"_a,
          "frame_angle"_a, "normal_angle"_a, "distinct"_a, "keep"_a, "threads"_a);
    m.def("count_places", &count_places, "points"_a, "distinct"_a);
    m.attr("TUKEY") = planish::kTukey;
    m.def("joint_normal_equations", &joint_normal_equations, "maps_a"_a, "camera_a"_a, "maps_b"_a, "T_a_b"_a, "about"_a,
          "options"_a, "weights"_a, "with_residuals"_a, "threads"_a);
    m.def("align_texture", &align_texture, "places"_a, "own"_a, "points_a"_a, "normals_a"_a, "camera_b"_a, "points_b"_a,
          "value_b"_a, "sigma_b"_a, "T_b_a"_a, "gate"_a, "threads"_a);
    m.def("nearest_pixels", &nearest_pixels, "points_b"_a, "stride"_a, "camera_a"_a, "height_a"_a, "width_a"_a,
          "T_a_b"_a);
    m.def("joint_samples", &joint_samples, "maps_a"_a, "camera_a"_a, "maps_b"_a, "T_a_b"_a, "options"_a, "threads"_a);
    m.def("joint_pull", &joint_pull, "maps_a"_a, "camera_a"_a, "maps_b"_a, "T_a_b"_a, "about"_a, "options"_a,
          "weights"_a, "threads"_a);
}
