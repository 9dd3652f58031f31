#pragma once

// Arrays of Python as views for the core, and results of the core as arrays of Python.

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <Eigen/Core>
#include <algorithm>
#include <cstddef>
#include <memory>
#include <stdexcept>
#include <utility>

#include "core/common/camera.hpp"
#include "core/common/image.hpp"
#include "core/common/pages.hpp"

namespace nb = nanobind;
using namespace nb::literals;

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

/// What the maps of one capture of two cameras take. Never destroyed: arrays may outlive everything else.
inline planish::PagePool& page_pool() {
    static auto* pool = new planish::PagePool(std::size_t{128} << 20U);
    return *pool;
}

/// Memory of so many values, not set, and what gives it back.
template <class T>
std::pair<T*, nb::capsule> pooled(std::size_t size) {
    auto pages = std::make_unique<planish::Pages>(page_pool().take(size * sizeof(T)));
    T* raw = static_cast<T*>(pages->data);
    nb::capsule owner(pages.release(), [](void* p) noexcept {
        const std::unique_ptr<planish::Pages> returned(static_cast<planish::Pages*>(p));
        page_pool().give_back(*returned);
    });
    return {raw, owner};
}

/// A new array that owns its memory, and a view of it; its values are not set.
template <class T>
struct Owned {
    planish::Image<T> image;
    nb::capsule owner;

    Owned(int height, int width, int channels) {
        auto [raw, kept] = pooled<T>(static_cast<std::size_t>(height) * width * channels);
        image = {raw, height, width, channels};
        owner = std::move(kept);
    }
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

/// Camera from the 29 numbers of planish.rig.Camera.kernel_parameters.
inline planish::Camera camera_from(const double* p, std::size_t size) {
    if (size != 29) throw std::invalid_argument("a camera has 29 parameters");
    planish::Camera camera{p[0], p[1], p[2], p[3], p[4], {}, {}, {}};
    std::copy_n(p + 5, 12, camera.k.begin());
    camera.R_camera_sensor = Eigen::Map<const Eigen::Matrix<double, 3, 3, Eigen::RowMajor>>(p + 17);
    camera.t_camera_sensor = Eigen::Map<const Eigen::Vector3d>(p + 26);
    return camera;
}
inline planish::Camera camera_from(const In<double, 1>& parameters) {
    return camera_from(parameters.data(), parameters.size());
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
