// Bindings of the evaluation kernels.

#include <nanobind/stl/pair.h>

#include <stdexcept>
#include <vector>

#include "bindings/arrays.hpp"
#include "bindings/bindings.hpp"
#include "core/evaluation/overlap_lookup.hpp"
#include "core/evaluation/overlap_tiles.hpp"

namespace {

// --- evaluation ---

Eigen::Matrix4d transform_from(const In<double, 2>& T) {
    return Eigen::Map<const Eigen::Matrix<double, 4, 4, Eigen::RowMajor>>(T.data());
}

nb::tuple look_up_distance(const In<float, 3>& points_a, const In<float, 3>& normals_a, const In<double, 1>& camera_a,
                           const In<float, 3>& points_b, const In<float, 3>& normals_b, const In<double, 2>& T_a_b,
                           double max_distance, bool with_pixels, int threads) {
    const planish::OrganisedSurface a{view<float, 3>(points_a), view<float, 3>(normals_a), camera_from(camera_a)};
    const planish::OrganisedSurface b{view<float, 3>(points_b), view<float, 3>(normals_b), {}};
    const Eigen::Matrix4d T = transform_from(T_a_b);
    Owned<float> distances(b.points.height, b.points.width, 1);
    Owned<float> pixels(with_pixels ? b.points.height : 0, b.points.width, 2);
    {
        nb::gil_scoped_release release;
        const auto pixel_map = with_pixels ? pixels.image : planish::Image<float>{};
        planish::look_up_distance(a, b, T, max_distance, threads, distances.image, pixel_map);
    }
    return nb::make_tuple(distances.map(), pixels.maps());
}

/// Number of known distances, sum of their squares, area of their pixels.
nb::tuple known_distances(const In<float, 2>& distances, const In<float, 2>& areas, int threads) {
    const auto map = view<float, 2>(distances), area = view<float, 2>(areas);
    if (map.height != area.height || map.width != area.width) throw std::invalid_argument("maps differ in size");
    planish::Known found;
    {
        nb::gil_scoped_release release;
        found = planish::known_distances(map, area, threads);
    }
    return nb::make_tuple(found.count, found.squares, found.area);
}

Out<float, 2> pixel_areas(const In<float, 3>& tangents, int threads) {
    const auto in = view<float, 3>(tangents);
    if (in.channels != 6) throw std::invalid_argument("tangents must be (H, W, 6)");
    Owned<float> areas(in.height, in.width, 1);
    {
        nb::gil_scoped_release release;
        planish::pixel_areas(in, threads, areas.image);
    }
    return areas.map();
}

Out<float, 2> cell_medians(const In<float, 2>& map, int size, int min_count, int threads) {
    const auto in = view<float, 2>(map);
    Owned<float> medians((in.height + size - 1) / size, (in.width + size - 1) / size, 1);
    {
        nb::gil_scoped_release release;
        planish::cell_medians(in, size, min_count, threads, medians.image);
    }
    return medians.map();
}

/// Tiles from rows (K, 12): tile row, tile column, J_a row by row, J_b row by row, offset_b.
std::vector<planish::Tile> tiles_from(const In<double, 2>& rows) {
    std::vector<planish::Tile> tiles(rows.shape(0));
    for (std::size_t i = 0; i < tiles.size(); ++i) {
        const double* x = rows.data() + 12 * i;
        tiles[i].row = static_cast<int>(x[0]);
        tiles[i].column = static_cast<int>(x[1]);
        tiles[i].J_a << x[2], x[3], x[4], x[5];
        tiles[i].J_b << x[6], x[7], x[8], x[9];
        tiles[i].offset_b << x[10], x[11];
    }
    return tiles;
}

/// Rows (K, 10): shift (2), covariance (4), pixels, correlation, converged, inflation.
Out<double, 2> tile_shifts(const In<float, 2>& value_a, const In<float, 2>& sigma_a, const In<float, 2>& value_b,
                           const In<float, 2>& sigma_b, const In<float, 3>& pixels_b, const In<double, 2>& tiles,
                           int size, double start_1, double start_2, int threads) {
    const planish::Contrast a{view<float, 2>(value_a), view<float, 2>(sigma_a)};
    const planish::Contrast b{view<float, 2>(value_b), view<float, 2>(sigma_b)};
    const auto list = tiles_from(tiles);
    Owned<double> out(static_cast<int>(list.size()), 10, 1);
    {
        nb::gil_scoped_release release;
        const auto shifts =
            planish::tile_shifts(a, b, view<float, 3>(pixels_b), list, size, {start_1, start_2}, threads);
        for (std::size_t i = 0; i < shifts.size(); ++i) {
            const planish::TileShift& s = shifts[i];
            const double row[10] = {s.shift_mm.x(),          s.shift_mm.y(),     s.covariance(0, 0), s.covariance(0, 1),
                                    s.covariance(1, 0),      s.covariance(1, 1), double(s.pixels),   s.correlation,
                                    s.converged ? 1.0 : 0.0, s.inflation};
            std::copy_n(row, 10, out.image.row(static_cast<int>(i)));
        }
    }
    return out.map();
}

std::pair<double, double> common_shift(const In<float, 2>& value_a, const In<float, 2>& sigma_a,
                                       const In<float, 2>& value_b, const In<float, 2>& sigma_b,
                                       const In<float, 3>& pixels_b, const In<double, 2>& tiles, int size,
                                       double start_1, double start_2, int threads) {
    const planish::Contrast a{view<float, 2>(value_a), view<float, 2>(sigma_a)};
    const planish::Contrast b{view<float, 2>(value_b), view<float, 2>(sigma_b)};
    nb::gil_scoped_release release;
    const Eigen::Vector2d shift =
        planish::common_shift(a, b, view<float, 3>(pixels_b), tiles_from(tiles), size, {start_1, start_2}, threads);
    return {shift.x(), shift.y()};
}

Out<double, 2> shift_scores(const In<float, 2>& value_a, const In<float, 2>& sigma_a, const In<float, 2>& value_b,
                            const In<float, 2>& sigma_b, const In<float, 3>& pixels_b, const In<double, 2>& tiles,
                            int size, const In<double, 2>& shifts, int threads) {
    const planish::Contrast a{view<float, 2>(value_a), view<float, 2>(sigma_a)};
    const planish::Contrast b{view<float, 2>(value_b), view<float, 2>(sigma_b)};
    std::vector<Eigen::Vector2d> list(shifts.shape(0));
    for (std::size_t i = 0; i < list.size(); ++i) list[i] = {shifts.data()[2 * i], shifts.data()[2 * i + 1]};
    Owned<double> out(1, static_cast<int>(list.size()), 1);
    {
        nb::gil_scoped_release release;
        const auto scores =
            planish::shift_scores(a, b, view<float, 3>(pixels_b), tiles_from(tiles), size, list, threads);
        std::copy(scores.begin(), scores.end(), out.image.data);
    }
    return out.map();
}

}  // namespace

void bind_evaluation(nb::module_& m) {
    m.def("look_up_distance", &look_up_distance, "points_a"_a, "normals_a"_a, "camera_a"_a, "points_b"_a, "normals_b"_a,
          "T_a_b"_a, "max_distance"_a, "with_pixels"_a, "threads"_a);
    m.def("known_distances", &known_distances, "distances"_a, "areas"_a, "threads"_a);
    m.def("pixel_areas", &pixel_areas, "tangents"_a, "threads"_a);
    m.def("cell_medians", &cell_medians, "map"_a, "size"_a, "min_count"_a, "threads"_a);
    m.def("tile_shifts", &tile_shifts, "value_a"_a, "sigma_a"_a, "value_b"_a, "sigma_b"_a, "pixels_b"_a, "tiles"_a,
          "size"_a, "start_1"_a, "start_2"_a, "threads"_a);
    m.def("common_shift", &common_shift, "value_a"_a, "sigma_a"_a, "value_b"_a, "sigma_b"_a, "pixels_b"_a, "tiles"_a,
          "size"_a, "start_1"_a, "start_2"_a, "threads"_a);
    m.def("shift_scores", &shift_scores, "value_a"_a, "sigma_a"_a, "value_b"_a, "sigma_b"_a, "pixels_b"_a, "tiles"_a,
          "size"_a, "shifts"_a, "threads"_a);
}
