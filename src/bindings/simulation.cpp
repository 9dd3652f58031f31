// Bindings of the simulation kernels.

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include <optional>
#include <span>
#include <stdexcept>
#include <string>
#include <thread>
#include <vector>

#include "bindings/arrays.hpp"
#include "bindings/bindings.hpp"
#include "core/simulation/counter_noise.hpp"
#include "core/simulation/render.hpp"

namespace {

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
    return camera_from(p.data(), p.size());
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

planish::SurfacePrint print(const nb::dict& values) {
    const auto x = get<Vector>(values, "x_edges"), y = get<Vector>(values, "y_edges");
    const auto factors = get<Map>(values, "factors");
    const auto rows = get<Matrix>(values, "discs");            // x y radius factor
    const auto affine = get<Matrix>(values, "print_surface");  // (2, 3)
    if (x.size() < 2 || y.size() < 2 || factors.shape(0) + 1 != y.size() || factors.shape(1) + 1 != x.size() ||
        rows.shape(1) != 4 || affine.shape(0) != 2 || affine.shape(1) != 3) {
        throw std::invalid_argument("print: edges, factors, discs or map have the wrong size");
    }
    std::vector<planish::SurfacePrint::Disc> discs;
    for (std::size_t i = 0; i < rows.shape(0); ++i) discs.push_back({rows(i, 0), rows(i, 1), rows(i, 2), rows(i, 3)});
    Eigen::Matrix2d linear;
    linear << affine(0, 0), affine(0, 1), affine(1, 0), affine(1, 1);
    return {{x.data(), x.data() + x.size()},
            {y.data(), y.data() + y.size()},
            {factors.data(), factors.data() + factors.size()},
            std::move(discs),
            linear,
            {affine(0, 2), affine(1, 2)},
            get<bool>(values, "repeat_x"),
            get<bool>(values, "repeat_y")};
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
                             std::nullopt,
                             std::nullopt};
    if (v.contains("print")) out.print = print(get<nb::dict>(v, "print"));
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
    std::vector<double> s(at.shape(0)), t(at.shape(0));
    for (std::size_t i = 0; i < at.shape(0); ++i) s[i] = at(i, 0), t[i] = at(i, 1);
    what.albedo(s, t, {out.data(), out.size()});
}

void print_factor(const nb::dict& print_values, const Matrix& at, const Matrix& footprints,
                  nb::ndarray<double, nb::ndim<1>, nb::c_contig, nb::device::cpu> out) {
    const planish::SurfacePrint what = print(print_values);
    if (at.shape(0) != out.size() || at.shape(1) != 2 || footprints.shape(0) != out.size() ||
        footprints.shape(1) != 4) {
        throw std::invalid_argument("print: places, footprints and output differ in size");
    }
    planish::SurfacePrint::Cursor cursor;
    for (std::size_t i = 0; i < at.shape(0); ++i) {
        const planish::SurfacePrint::Footprint footprint{{footprints(i, 0), footprints(i, 1)},
                                                         {footprints(i, 2), footprints(i, 3)}};
        out(i) = what.factor(at(i, 0), at(i, 1), footprint, cursor);
    }
}

void normal_numbers(std::uint64_t seed, std::uint64_t stream,
                    nb::ndarray<float, nb::ndim<1>, nb::c_contig, nb::device::cpu> out) {
    planish::normal_numbers(seed, stream, 0, {out.data(), out.size()});
}

}  // namespace simulation

}  // namespace

void bind_simulation(nb::module_& m) {
    m.def("render_images_8", &simulation::render<std::uint8_t>, "Render all images of one camera into (N, H, W).");
    m.def("render_images_16", &simulation::render<std::uint16_t>, "The same, 16 bit.");
    m.def("trace_image", &simulation::trace, "True points (H, W, 3) in the object frame and their mask (H, W).");
    m.def("intersect_surface", &simulation::intersect, "Per ray: point, normal, s, t into (N, 8); misses stay.");
    m.def("texture_albedo", &simulation::albedo, "Reflectance at (s, t) (N, 2).");
    m.def("print_factor", &simulation::print_factor, "Factor of a print at (s, t) (N, 2), over footprints (N, 4).");
    m.def("normal_numbers", &simulation::normal_numbers, "Standard normal numbers of one stream.");
}
