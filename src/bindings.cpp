// The only file that knows Python: turns arrays into views, releases the GIL, turns results into arrays. Names, checks,
// defaults and error texts belong to the Python side.

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include <algorithm>
#include <cstdint>
#include <initializer_list>
#include <memory>
#include <optional>
#include <span>
#include <stdexcept>
#include <string>
#include <thread>
#include <vector>

#include "core/camera.hpp"
#include "core/correspond.hpp"
#include "core/counter_noise.hpp"
#include "core/decode_gray.hpp"
#include "core/decode_phase.hpp"
#include "core/image.hpp"
#include "core/islands.hpp"
#include "core/phase_edges.hpp"
#include "core/repair_periods.hpp"
#include "core/render.hpp"
#include "core/triangulate.hpp"
#include "core/undistortion.hpp"

namespace nb = nanobind;

namespace {

bool cpu_has_avx2() {
#if defined(__x86_64__) && (defined(__GNUC__) || defined(__clang__))
    return __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma");
#else
    return false;
#endif
}

// --- arrays --------------------------------------------------------------------------------------------------------

template <class T>
using In = nb::ndarray<const T, nb::c_contig, nb::device::cpu>;
template <class T>
using Out = nb::ndarray<nb::numpy, T>;
using AnyImage = nb::ndarray<nb::ro, nb::ndim<2>, nb::c_contig, nb::device::cpu>;

/// A new array that Python owns; its values are not set.
template <class T>
Out<T> make_array(std::initializer_list<std::size_t> shape) {
    std::size_t size = 1;
    for (const std::size_t n : shape) size *= n;
    auto data = std::make_unique_for_overwrite<T[]>(size);
    T* raw = data.release();
    nb::capsule owner(raw, [](void* p) noexcept { delete[] static_cast<T*>(p); });
    return Out<T>(raw, shape.size(), shape.begin(), owner);
}

/// View of an array (H, W) or (H, W, C); an array of size 0 becomes an empty view.
template <class Array>
auto view(const Array& a) {
    using T = std::remove_pointer_t<decltype(a.data())>;
    if (a.size() == 0) return planish::Image<T>{};
    return planish::Image<T>{a.data(), static_cast<int>(a.shape(0)), static_cast<int>(a.shape(1)),
                             a.ndim() > 2 ? static_cast<int>(a.shape(2)) : 1};
}

/// Camera from Camera.kernel_parameters (29,).
planish::Camera make_camera(const In<double>& parameters) {
    if (parameters.size() != 29) throw std::invalid_argument("a camera has 29 parameters");
    const double* p = parameters.data();
    planish::Camera camera{p[0], p[1], p[2], p[3], p[4], {}, {}, {}};
    std::copy_n(p + 5, 12, camera.k.begin());
    camera.R_camera_sensor = Eigen::Map<const Eigen::Matrix<double, 3, 3, Eigen::RowMajor>>(p + 17);
    camera.t_camera_sensor = Eigen::Map<const Eigen::Vector3d>(p + 26);
    return camera;
}

// --- sensing -------------------------------------------------------------------------------------------------------

namespace sensing {

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

nb::tuple decode_phase(const std::vector<AnyImage>& images, const std::vector<int>& counts,
                       const std::vector<float>& angles_cos, const std::vector<float>& angles_sin,
                       const std::vector<float>& periods, const In<float>& coarse, float saturation,
                       float noise_offset, float noise_slope, float max_phase_sigma_rad, float coarse_limit_px,
                       float range_start_px, float range_length_px, int threads) {
    const bool narrow = is_8_bit(images);
    const std::size_t h = images[0].shape(0), w = images[0].shape(1);
    auto position = make_array<float>({h, w}), sigma = make_array<float>({h, w}), mean = make_array<float>({h, w}),
         modulation = make_array<float>({h, w});
    auto rejected = make_array<std::uint16_t>({h, w});
    const planish::DecodeSettings settings{saturation,      noise_offset,   noise_slope,    max_phase_sigma_rad,
                                           coarse_limit_px, range_start_px, range_length_px};
    const planish::PhaseResult out{view(position), view(sigma), view(mean), view(modulation), view(rejected)};
    const auto coarse_view = view(coarse);
    {
        nb::gil_scoped_release release;
        if (narrow)
            planish::decode_phase(make_steps<std::uint8_t>(images, counts, angles_cos, angles_sin, periods),
                                  coarse_view, settings, threads, out);
        else
            planish::decode_phase(make_steps<std::uint16_t>(images, counts, angles_cos, angles_sin, periods),
                                  coarse_view, settings, threads, out);
    }
    return nb::make_tuple(position, sigma, mean, modulation, rejected);
}

template <class T>
std::vector<planish::GrayBit<T>> make_bits(const std::vector<AnyImage>& images, const std::vector<int>& inverse) {
    std::vector<planish::GrayBit<T>> bits;
    for (std::size_t i = 0; i < inverse.size(); ++i)
        bits.push_back({static_cast<const T*>(images[i].data()),
                        inverse[i] < 0 ? nullptr : static_cast<const T*>(images[inverse[i]].data())});
    return bits;
}

Out<float> decode_gray(const std::vector<AnyImage>& images, const std::vector<int>& inverse,
                       const In<float>& threshold, int threads) {
    const bool narrow = is_8_bit(images);
    auto cell = make_array<float>({images[0].shape(0), images[0].shape(1)});
    const auto out = view(cell);
    const auto limit = view(threshold);
    nb::gil_scoped_release release;
    if (narrow)
        planish::decode_gray(make_bits<std::uint8_t>(images, inverse), limit, threads, out);
    else
        planish::decode_gray(make_bits<std::uint16_t>(images, inverse), limit, threads, out);
    return cell;
}

Out<float> undistortion_shifts(const In<double>& camera, int height, int width, int threads) {
    auto shifts = make_array<float>({static_cast<std::size_t>(height), static_cast<std::size_t>(width), 2});
    const auto out = view(shifts);
    const planish::Camera model = make_camera(camera);
    nb::gil_scoped_release release;
    planish::undistortion_shifts(model, threads, out);
    return shifts;
}

nb::tuple repair_periods(const In<float>& position, const In<float>& sigma, const In<std::uint16_t>& rejected,
                         float period_px, float tolerance_px, float sigmas, int threads) {
    const std::size_t h = position.shape(0), w = position.shape(1);
    auto new_position = make_array<float>({h, w}), new_sigma = make_array<float>({h, w});
    auto new_rejected = make_array<std::uint16_t>({h, w});
    const auto p = view(position), s = view(sigma);
    const auto r = view(rejected);
    const auto np = view(new_position), ns = view(new_sigma);
    const auto nr = view(new_rejected);
    {
        nb::gil_scoped_release release;
        planish::repair_periods(p, s, r, period_px, tolerance_px, sigmas, threads, np, ns, nr);
    }
    return nb::make_tuple(new_position, new_sigma, new_rejected);
}

Out<std::uint8_t> phase_edges(const In<float>& position, const In<float>& sigma, float jump_px, float sigmas,
                              int threads) {
    auto edge = make_array<std::uint8_t>({position.shape(0), position.shape(1)});
    const auto out = view(edge);
    const auto p = view(position), s = view(sigma);
    nb::gil_scoped_release release;
    planish::phase_edges(p, s, jump_px, sigmas, threads, out);
    return edge;
}

nb::tuple correspond(const In<float>& own_position, const In<float>& own_sigma, const In<float>& own_shift,
                     const In<float>& other_position, const In<float>& other_sigma, const In<float>& other_shift,
                     const In<double>& F, int threads) {
    const std::size_t h = own_position.shape(0), w = own_position.shape(1);
    auto pixel = make_array<float>({h, w, 2}), sigma = make_array<float>({h, w});
    const planish::PhaseView own{view(own_position), view(own_sigma), view(own_shift)};
    const planish::PhaseView other{view(other_position), view(other_sigma), view(other_shift)};
    const Eigen::Matrix3d line = Eigen::Map<const Eigen::Matrix<double, 3, 3, Eigen::RowMajor>>(F.data());
    const planish::CorrespondResult out{view(pixel), view(sigma)};
    {
        nb::gil_scoped_release release;
        planish::correspond(own, other, line, threads, out);
    }
    return nb::make_tuple(pixel, sigma);
}

nb::tuple triangulate(const In<double>& own, const In<float>& own_shift, const In<double>& other,
                      const In<float>& other_shift, const In<float>& pixel, const In<float>& sigma, int threads) {
    const std::size_t h = pixel.shape(0), w = pixel.shape(1);
    auto points = make_array<float>({h, w, 3}), sigma_mm = make_array<float>({h, w}), miss = make_array<float>({h, w});
    const planish::ViewGeometry a{make_camera(own), view(own_shift)}, b{make_camera(other), view(other_shift)};
    const planish::TriangulateResult out{view(points), view(sigma_mm), view(miss)};
    const auto p = view(pixel), s = view(sigma);
    {
        nb::gil_scoped_release release;
        planish::triangulate(a, b, p, s, threads, out);
    }
    return nb::make_tuple(points, sigma_mm, miss);
}

nb::tuple projector_residual(const In<double>& projector, int axis, const In<double>& center, const In<float>& points,
                             const In<float>& sigma_mm, const In<float>& position, const In<float>& position_sigma,
                             int threads) {
    const std::size_t h = points.shape(0), w = points.shape(1);
    auto residual = make_array<float>({h, w}), sigma = make_array<float>({h, w});
    const planish::Camera model = make_camera(projector);
    const Eigen::Vector3d origin(center.data()[0], center.data()[1], center.data()[2]);
    const auto x = view(points), s = view(sigma_mm), p = view(position), ps = view(position_sigma);
    const auto r = view(residual), rs = view(sigma);
    {
        nb::gil_scoped_release release;
        planish::projector_residual(model, axis, origin, x, s, p, ps, threads, r, rs);
    }
    return nb::make_tuple(residual, sigma);
}

Out<std::uint8_t> islands(const In<float>& depth, const In<float>& sigma, float depth_per_pixel, float sigmas,
                          int min_pixels) {
    auto small = make_array<std::uint8_t>({depth.shape(0), depth.shape(1)});
    const auto out = view(small);
    const auto z = view(depth), s = view(sigma);
    nb::gil_scoped_release release;
    planish::islands(z, s, {depth_per_pixel, sigmas, min_pixels}, out);
    return small;
}

}  // namespace sensing

// --- simulation ------------------------------------------------------------------------------------------------

namespace simulation {

using Vector = nb::ndarray<const double, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
using Matrix = nb::ndarray<const double, nb::ndim<2>, nb::c_contig, nb::device::cpu>;
using Map = nb::ndarray<const float, nb::ndim<2>, nb::c_contig, nb::device::cpu>;

template <class T>
T get(const nb::dict& values, const char* key) {
    return nb::cast<T>(values[key]);
}

planish::Image<const float> image(const Map& map) {
    return {map.data(), static_cast<int>(map.shape(0)), static_cast<int>(map.shape(1))};
}

Eigen::Vector3d vector3(const nb::dict& values, const char* key) {
    const auto v = get<Vector>(values, key);
    if (v.size() != 3) throw std::invalid_argument(std::string(key) + ": expected 3 numbers");
    return {v(0), v(1), v(2)};
}

/// From Camera.kernel_parameters: fx fy cx cy skew, 12 distortion, R row by row, t.
planish::Camera camera(const nb::dict& values, const char* key) {
    const auto p = get<Vector>(values, key);
    if (p.size() != 29) throw std::invalid_argument(std::string(key) + ": expected 29 numbers");
    planish::Camera out{p(0), p(1), p(2), p(3), p(4), {}, {}, {}};
    for (int i = 0; i < 12; ++i) out.k[i] = p(5 + i);
    for (int i = 0; i < 9; ++i) out.R_camera_sensor(i / 3, i % 3) = p(17 + i);
    for (int i = 0; i < 3; ++i) out.t_camera_sensor(i) = p(26 + i);
    return out;
}

planish::Surface surface(const nb::dict& values) {
    using Kind = planish::Surface::Kind;
    const auto name = get<std::string>(values, "kind");
    planish::Surface out;
    out.kind = name == "door"       ? Kind::door
               : name == "cylinder" ? Kind::cylinder
               : name == "waves"    ? Kind::waves
               : name == "step"     ? Kind::step
                                    : Kind::plate;
    const auto read = [&](const char* key, double& field) {
        if (values.contains(key)) field = get<double>(values, key);
    };
    planish::Door& d = out.door;
    read("half_s", out.half_s), read("half_t", out.half_t), read("corner", out.corner), read("radius", out.radius);
    read("amplitude", out.amplitude), read("wavelength", out.wavelength), read("step", out.step);
    read("radius_x", d.radius_x), read("radius_y", d.radius_y), read("line_y", d.line_y);
    read("line_slope", d.line_slope), read("line_height", d.line_height), read("line_edge", d.line_edge);
    read("line_fade", d.line_fade), read("recess_x", d.recess_x), read("recess_y", d.recess_y);
    read("recess_half_x", d.recess_half_x), read("recess_half_y", d.recess_half_y);
    read("recess_depth", d.recess_depth), read("recess_wall", d.recess_wall);
    return out;
}

planish::SurfaceTexture texture(const nb::dict& values) {
    std::vector<planish::GrainScale> grain;
    const auto scales = get<Matrix>(values, "grain");  // along_mm across_mm angle amplitude seed
    for (std::size_t i = 0; i < scales.shape(0); ++i) {
        grain.push_back(
            {scales(i, 0), scales(i, 1), scales(i, 2), scales(i, 3), static_cast<std::uint32_t>(scales(i, 4))});
    }
    std::vector<planish::Mark> marks;
    const auto rows = get<Matrix>(values, "marks");  // kind s t angle half_length half_width curvature contrast
    for (std::size_t i = 0; i < rows.shape(0); ++i) {
        marks.push_back({static_cast<planish::Mark::Kind>(static_cast<int>(rows(i, 0))), rows(i, 1), rows(i, 2),
                         rows(i, 3), rows(i, 4), rows(i, 5), rows(i, 6), rows(i, 7)});
    }
    return {get<double>(values, "albedo"), std::move(grain), std::move(marks), get<double>(values, "half_s"),
            get<double>(values, "half_t")};
}

planish::Illumination illumination(const nb::dict& v) {
    return {get<double>(v, "reference_distance"), get<double>(v, "specular"),
            get<double>(v, "roughness"),          get<double>(v, "ambient"),
            vector3(v, "ambient_gradient"),       get<double>(v, "lamp"),
            vector3(v, "lamp_direction")};
}

planish::RenderScene scene(const nb::dict& v) {
    planish::RenderScene out{camera(v, "camera"),
                             camera(v, "projector"),
                             surface(get<nb::dict>(v, "surface")),
                             texture(get<nb::dict>(v, "texture")),
                             illumination(get<nb::dict>(v, "light")),
                             std::nullopt};
    if (v.contains("background")) {
        const auto b = get<nb::dict>(v, "background");
        out.background = planish::BackgroundPlane{vector3(b, "origin"), vector3(b, "axis_x"), vector3(b, "axis_y"),
                                                  vector3(b, "normal"), texture(get<nb::dict>(b, "texture"))};
    }
    return out;
}

template <class Pixel>
void render(const nb::dict& scene_values, const nb::dict& pattern_values, const nb::dict& sensor_values,
            nb::ndarray<Pixel, nb::ndim<3>, nb::c_contig, nb::device::cpu> out, int threads) {
    const planish::RenderScene what = scene(scene_values);
    const auto profiles = get<Map>(pattern_values, "profiles");
    const auto gain = get<Map>(pattern_values, "gain");
    const auto along_v = get<std::vector<int>>(pattern_values, "along_v");
    const planish::ProjectedPatterns patterns{image(profiles),
                                              along_v,
                                              get<double>(pattern_values, "first"),
                                              get<double>(pattern_values, "samples_per_px"),
                                              image(gain),
                                              get<double>(pattern_values, "grid_depth")};
    const auto response = get<Map>(sensor_values, "response");
    const auto number = [&](const char* key) { return get<double>(sensor_values, key); };
    const planish::SensorResponse sensor{number("psf_px"),
                                         get<int>(sensor_values, "supersampling"),
                                         number("levels_per_radiance"),
                                         number("electrons_per_level"),
                                         number("read_noise"),
                                         number("noise_factor"),
                                         number("black_level"),
                                         number("saturation"),
                                         number("gamma"),
                                         number("quantum"),
                                         image(response),
                                         get<std::uint64_t>(sensor_values, "seed"),
                                         get<std::uint64_t>(sensor_values, "stream")};
    const int height = static_cast<int>(out.shape(1)), width = static_cast<int>(out.shape(2));
    if (height != sensor.response.height || width != sensor.response.width || out.shape(0) != along_v.size() ||
        profiles.shape(0) != along_v.size()) {
        throw std::invalid_argument("render: images, profiles and response differ in size");
    }
    std::vector<planish::Image<Pixel>> images;
    for (std::size_t k = 0; k < along_v.size(); ++k) {
        images.push_back({out.data() + k * static_cast<std::size_t>(height) * width, height, width});
    }
    nb::gil_scoped_release release;
    planish::render_images<Pixel>(what, patterns, sensor, images, threads);
}

void trace(const nb::dict& scene_values,
           nb::ndarray<double, nb::shape<-1, -1, 3>, nb::c_contig, nb::device::cpu> points,
           nb::ndarray<std::uint8_t, nb::ndim<2>, nb::c_contig, nb::device::cpu> lit, int threads) {
    const planish::RenderScene what = scene(scene_values);
    std::optional<Eigen::Vector3d> other;
    if (scene_values.contains("other_center")) other = vector3(scene_values, "other_center");
    const int height = static_cast<int>(points.shape(0)), width = static_cast<int>(points.shape(1));
    const planish::Image<double> out{points.data(), height, width, 3};
    const planish::Image<std::uint8_t> mask{lit.data(), height, width};
    nb::gil_scoped_release release;
    planish::trace_image(what, other, out, mask, threads);
}

void intersect(const nb::dict& surface_values, const Matrix& origins, const Matrix& directions,
               nb::ndarray<double, nb::ndim<2>, nb::c_contig, nb::device::cpu> hits) {
    const planish::Surface what = surface(surface_values);
    for (std::size_t i = 0; i < origins.shape(0); ++i) {
        const planish::Ray ray{{origins(i, 0), origins(i, 1), origins(i, 2)},
                               {directions(i, 0), directions(i, 1), directions(i, 2)}};
        const planish::Hit hit = what.intersect(ray, -1);
        if (hit.patch < 0) continue;
        const double row[] = {hit.point.x(),  hit.point.y(),  hit.point.z(), hit.normal.x(),
                              hit.normal.y(), hit.normal.z(), hit.s,         hit.t};
        for (int j = 0; j < 8; ++j) hits(i, j) = row[j];
    }
}

void albedo(const nb::dict& texture_values, const Matrix& at,
            nb::ndarray<double, nb::ndim<1>, nb::c_contig, nb::device::cpu> out) {
    const planish::SurfaceTexture what = texture(texture_values);
    for (std::size_t i = 0; i < at.shape(0); ++i) out(i) = what.albedo(at(i, 0), at(i, 1));
}

void normal_numbers(std::uint64_t seed, std::uint64_t stream,
                    nb::ndarray<float, nb::ndim<1>, nb::c_contig, nb::device::cpu> out) {
    planish::normal_numbers(seed, stream, 0, {out.data(), out.size()});
}

}  // namespace simulation

}  // namespace

NB_MODULE(PLANISH_MODULE, m) {
    m.def("cpu_has_avx2", &cpu_has_avx2, "True where the AVX2 + FMA build of the kernels may be used.");
    m.def("cpu_count", [] { return static_cast<int>(std::thread::hardware_concurrency()); });

    // --- sensing -----------------------------------------------------------------------------------------------
    m.def("decode_phase", &sensing::decode_phase);
    m.def("decode_gray", &sensing::decode_gray);
    m.def("undistortion_shifts", &sensing::undistortion_shifts);
    m.def("repair_periods", &sensing::repair_periods);
    m.def("phase_edges", &sensing::phase_edges);
    m.def("correspond", &sensing::correspond);
    m.def("triangulate", &sensing::triangulate);
    m.def("projector_residual", &sensing::projector_residual);
    m.def("islands", &sensing::islands);

    // --- registration ------------------------------------------------------------------------------------------

    // --- evaluation --------------------------------------------------------------------------------------------

    // --- simulation --------------------------------------------------------------------------------------------
    m.def("render_images_8", &simulation::render<std::uint8_t>, "Render all images of one camera into (N, H, W).");
    m.def("render_images_16", &simulation::render<std::uint16_t>, "The same, 16 bit.");
    m.def("trace_image", &simulation::trace, "True points (H, W, 3) in the object frame and their mask (H, W).");
    m.def("intersect_surface", &simulation::intersect, "Per ray: point, normal, s, t into (N, 8); misses stay.");
    m.def("texture_albedo", &simulation::albedo, "Reflectance at (s, t) (N, 2).");
    m.def("normal_numbers", &simulation::normal_numbers, "Standard normal numbers of one stream.");
}
