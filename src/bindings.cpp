// The only file that knows Python: turns arrays into views, releases the GIL, turns results into arrays. Names, checks,
// defaults and error texts belong to the Python side.

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/pair.h>

#include <cmath>
#include <cstdint>
#include <thread>
#include <vector>

#include "core/camera.hpp"
#include "core/chart.hpp"
#include "core/consensus.hpp"
#include "core/image.hpp"
#include "core/joint.hpp"
#include "core/overlap_lookup.hpp"
#include "core/overlap_tiles.hpp"
#include "core/surface.hpp"

namespace nb = nanobind;
using namespace nb::literals;

namespace {

template <class T, int N>
using In = nb::ndarray<const T, nb::ndim<N>, nb::c_contig, nb::device::cpu>;
template <class T, int N>
using Out = nb::ndarray<nb::numpy, T, nb::ndim<N>>;

/// A view of an array (H, W) or (H, W, C).
template <class T, int N>
planish::Image<const T> view(const In<T, N>& array) {
    static_assert(N == 2 || N == 3);
    return {array.data(), static_cast<int>(array.shape(0)), static_cast<int>(array.shape(1)),
            N == 3 ? static_cast<int>(array.shape(N - 1)) : 1};
}

/// A new array that owns its memory, and a view of it.
template <class T>
struct Owned {
    planish::Image<T> image;
    nb::capsule owner;

    Owned(int height, int width, int channels)
        : image{new T[static_cast<std::size_t>(height) * width * channels], height, width, channels},
          owner(image.data, [](void* p) noexcept { delete[] static_cast<T*>(p); }) {}
    [[nodiscard]] Out<T, 2> map() const {
        const std::size_t shape[2] = {static_cast<std::size_t>(image.height), static_cast<std::size_t>(image.width)};
        return Out<T, 2>(image.data, 2, shape, owner);
    }
    [[nodiscard]] Out<T, 3> maps() const {
        const std::size_t shape[3] = {static_cast<std::size_t>(image.height), static_cast<std::size_t>(image.width),
                                      static_cast<std::size_t>(image.channels)};
        return Out<T, 3>(image.data, 3, shape, owner);
    }
};

/// Camera from planish.rig.Camera.kernel_parameters.
planish::Camera camera_from(const In<double, 1>& p) {
    planish::Camera camera{};
    const double* x = p.data();
    camera.fx = x[0];
    camera.fy = x[1];
    camera.cx = x[2];
    camera.cy = x[3];
    camera.skew = x[4];
    std::copy_n(x + 5, 12, camera.k.begin());
    for (int i = 0; i < 3; ++i) {
        for (int j = 0; j < 3; ++j) camera.R_camera_sensor(i, j) = x[17 + 3 * i + j];
        camera.t_camera_sensor[i] = x[26 + i];
    }
    return camera;
}

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

/// Rows (K, 9): shift (2), covariance (4), pixels, correlation, converged.
Out<double, 2> tile_shifts(const In<float, 2>& value_a, const In<float, 2>& sigma_a, const In<float, 2>& value_b,
                           const In<float, 2>& sigma_b, const In<float, 3>& pixels_b, const In<double, 2>& tiles,
                           int size, double start_1, double start_2, int threads) {
    const planish::Contrast a{view<float, 2>(value_a), view<float, 2>(sigma_a)};
    const planish::Contrast b{view<float, 2>(value_b), view<float, 2>(sigma_b)};
    const auto list = tiles_from(tiles);
    Owned<double> out(static_cast<int>(list.size()), 9, 1);
    {
        nb::gil_scoped_release release;
        const auto shifts =
            planish::tile_shifts(a, b, view<float, 3>(pixels_b), list, size, {start_1, start_2}, threads);
        for (std::size_t i = 0; i < shifts.size(); ++i) {
            const planish::TileShift& s = shifts[i];
            const double row[9] = {s.shift_mm.x(),     s.shift_mm.y(),     s.covariance(0, 0),
                                   s.covariance(0, 1), s.covariance(1, 0), s.covariance(1, 1),
                                   double(s.pixels),   s.correlation,      s.converged ? 1.0 : 0.0};
            std::copy_n(row, 9, out.image.row(static_cast<int>(i)));
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

bool cpu_has_avx2() {
#if defined(__x86_64__) && (defined(__GNUC__) || defined(__clang__))
    return __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma");
#else
    return false;
#endif
}

/// Rigid transform from an array (4, 4).
struct Rigid {
    Eigen::Matrix3d R;
    Eigen::Vector3d t;
    explicit Rigid(const In<double, 2>& T) {
        for (int i = 0; i < 3; ++i) {
            for (int j = 0; j < 3; ++j) R(i, j) = T(i, j);
            t[i] = T(i, 3);
        }
    }
};

nb::tuple rasterise_chart(const In<float, 3>& points, const In<float, 3>& normals, const In<double, 2>& T_chart_sensor,
                          double pitch, double min_cosine, double max_edge, int height, int width) {
    Owned<float> source(height, width, 2), z(height, width, 1);
    {
        const Rigid T(T_chart_sensor);
        nb::gil_scoped_release release;
        planish::rasterise_chart(view<float, 3>(points), view<float, 3>(normals), {T.R, T.t, pitch}, min_cosine,
                                 max_edge, source.image, z.image);
    }
    return nb::make_tuple(source.maps(), z.map());
}

/// Points (M, 3) and frames (M, 3, 3) of both sides of M matches.
nb::tuple find_consensus(const In<double, 2>& points_a, const In<double, 2>& points_b, const In<double, 3>& frames_a,
                         const In<double, 3>& frames_b, double tolerance, double frame_angle, double normal_angle,
                         double min_baseline, int seeds, int partners, int keep, int threads) {
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
        found = planish::find_consensus(matches, {tolerance, frame_angle, normal_angle, min_baseline, seeds, partners},
                                        keep, threads);
    }
    const auto count = static_cast<int>(found.size());
    Owned<double> transforms(count, 4, 4);
    Owned<std::int32_t> support(count, 1, 1);
    for (int h = 0; h < count; ++h) {
        for (int i = 0; i < 4; ++i)
            for (int j = 0; j < 4; ++j)
                transforms.image.at(h, i)[j] = i == 3   ? (j == 3 ? 1.0 : 0.0)
                                               : j == 3 ? found[h].t_a_b[i]
                                                        : found[h].R_a_b(i, j);
        *support.image.at(h, 0) = found[h].support;
    }
    return nb::make_tuple(transforms.maps(), support.map());
}

planish::JointMaps joint_maps(const nb::tuple& maps) {
    return {
        view<float, 3>(nb::cast<In<float, 3>>(maps[0])), view<float, 3>(nb::cast<In<float, 3>>(maps[1])),
        view<float, 2>(nb::cast<In<float, 2>>(maps[2])), view<float, 3>(nb::cast<In<float, 3>>(maps[3])),
        view<float, 2>(nb::cast<In<float, 2>>(maps[4])), view<std::uint8_t, 2>(nb::cast<In<std::uint8_t, 2>>(maps[5]))};
}

Out<double, 2> matrix6(const planish::Matrix6& value) {
    Owned<double> out(6, 6, 1);
    for (int i = 0; i < 6; ++i)
        for (int j = 0; j < 6; ++j) *out.image.at(i, j) = value(i, j);
    return out.map();
}

nb::tuple normal_equations(const planish::Normal& n) {
    Owned<double> g(1, 6, 1);
    std::copy_n(n.g.data(), 6, g.image.data);
    return nb::make_tuple(matrix6(n.H), g.map(), n.cost, n.count);
}

/// Maps a, camera a, maps b: see planish::JointMaps. Returns normal equations of distance and texture, the unbiased
/// texture information, correlation, number of conflicts, tile gradients (tiles, 6) and, if asked for, the residual
/// maps.
nb::tuple joint_normal_equations(const nb::tuple& maps_a, const In<double, 1>& camera_a, const nb::tuple& maps_b,
                                 const In<double, 2>& T_a_b, const In<double, 1>& about, const nb::tuple& options,
                                 bool with_residuals, int threads) {
    const auto number = [&](int i) { return nb::cast<double>(options[i]); };
    const planish::JointOptions o{number(0),
                                  number(1),
                                  number(2),
                                  number(3),
                                  number(4),
                                  number(5),
                                  nb::cast<int>(options[6]),
                                  nb::cast<int>(options[7])};
    const auto a = joint_maps(maps_a), b = joint_maps(maps_b);
    const Rigid T(T_a_b);
    Owned<float> distances(with_residuals ? b.points.height : 0, b.points.width, 1);
    Owned<float> differences(with_residuals ? b.points.height : 0, b.points.width, 1);
    planish::JointResult result;
    {
        const auto camera = camera_from(camera_a);
        nb::gil_scoped_release release;
        const planish::Image<float> none;
        result = planish::joint_normal_equations(a, camera, b, T.R, T.t, {about(0), about(1), about(2)}, o, threads,
                                                 with_residuals ? distances.image : none,
                                                 with_residuals ? differences.image : none);
    }
    Owned<double> tiles(static_cast<int>(result.tile_gradients.size()), 6, 1);
    for (std::size_t i = 0; i < result.tile_gradients.size(); ++i)
        std::copy_n(result.tile_gradients[i].data(), 6, tiles.image.row(static_cast<int>(i)));
    const auto& s = result.sums;
    const double norm = std::sqrt(s.correlation_aa * s.correlation_bb);
    return nb::make_tuple(normal_equations(s.distance), normal_equations(s.texture), matrix6(s.H_texture_unbiased),
                          norm > 0 ? s.correlation_ab / norm : 0.0, s.conflicts, tiles.map(), distances.map(),
                          differences.map());
}

}  // namespace

NB_MODULE(PLANISH_MODULE, m) {
    m.def("cpu_has_avx2", &cpu_has_avx2, "True where the AVX2 + FMA build of the kernels may be used.");
    m.def("cpu_count", [] { return static_cast<int>(std::thread::hardware_concurrency()); });

    // --- sensing -----------------------------------------------------------------------------------------------

    // --- registration ------------------------------------------------------------------------------------------
    m.def("fit_surface", &fit_surface, "points"_a, "camera"_a, "radius"_a, "max_slope"_a, "threads"_a);
    m.def("rasterise_chart", &rasterise_chart, "points"_a, "normals"_a, "T_chart_sensor"_a, "pitch"_a, "min_cosine"_a,
          "max_edge"_a, "height"_a, "width"_a);
    m.def("find_consensus", &find_consensus, "points_a"_a, "points_b"_a, "frames_a"_a, "frames_b"_a, "tolerance"_a,
          "frame_angle"_a, "normal_angle"_a, "min_baseline"_a, "seeds"_a, "partners"_a, "keep"_a, "threads"_a);
    m.def("joint_normal_equations", &joint_normal_equations, "maps_a"_a, "camera_a"_a, "maps_b"_a, "T_a_b"_a, "about"_a,
          "options"_a, "with_residuals"_a, "threads"_a);

    // --- evaluation --------------------------------------------------------------------------------------------
    m.def("look_up_distance", &look_up_distance, "points_a"_a, "normals_a"_a, "camera_a"_a, "points_b"_a, "normals_b"_a,
          "T_a_b"_a, "max_distance"_a, "with_pixels"_a, "threads"_a);
    m.def("cell_medians", &cell_medians, "map"_a, "size"_a, "min_count"_a, "threads"_a);
    m.def("tile_shifts", &tile_shifts, "value_a"_a, "sigma_a"_a, "value_b"_a, "sigma_b"_a, "pixels_b"_a, "tiles"_a,
          "size"_a, "start_1"_a, "start_2"_a, "threads"_a);
    m.def("common_shift", &common_shift, "value_a"_a, "sigma_a"_a, "value_b"_a, "sigma_b"_a, "pixels_b"_a, "tiles"_a,
          "size"_a, "start_1"_a, "start_2"_a, "threads"_a);
    m.def("shift_scores", &shift_scores, "value_a"_a, "sigma_a"_a, "value_b"_a, "sigma_b"_a, "pixels_b"_a, "tiles"_a,
          "size"_a, "shifts"_a, "threads"_a);

    // --- simulation --------------------------------------------------------------------------------------------
}
