// The only file that knows Python: turns arrays into views, releases the GIL, turns results into arrays. Names, checks,
// defaults and error texts belong to the Python side.

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <thread>

#include "core/camera.hpp"
#include "core/image.hpp"
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

bool cpu_has_avx2() {
#if defined(__x86_64__) && (defined(__GNUC__) || defined(__clang__))
    return __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma");
#else
    return false;
#endif
}

}  // namespace

NB_MODULE(PLANISH_MODULE, m) {
    m.def("cpu_has_avx2", &cpu_has_avx2, "True where the AVX2 + FMA build of the kernels may be used.");
    m.def("cpu_count", [] { return static_cast<int>(std::thread::hardware_concurrency()); });

    // --- sensing -----------------------------------------------------------------------------------------------

    // --- registration ------------------------------------------------------------------------------------------
    m.def("fit_surface", &fit_surface, "points"_a, "camera"_a, "radius"_a, "max_slope"_a, "threads"_a);

    // --- evaluation --------------------------------------------------------------------------------------------

    // --- simulation --------------------------------------------------------------------------------------------
}
