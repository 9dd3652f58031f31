#pragma once

// Maps of any number of dimensions as views for the sensing kernels, and new maps that Python owns.

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <cstddef>
#include <cstdint>
#include <initializer_list>
#include <stdexcept>
#include <type_traits>
#include <vector>

#include "bindings/arrays.hpp"
#include "core/common/image.hpp"

template <class T>
using AnyIn = nb::ndarray<const T, nb::c_contig, nb::device::cpu>;
template <class T>
using Shared = nb::ndarray<T, nb::c_contig, nb::device::cpu>;
template <class T>
using AnyOut = nb::ndarray<nb::numpy, T>;
using AnyImage = nb::ndarray<nb::ro, nb::ndim<2>, nb::c_contig, nb::device::cpu>;

/// A new array that Python owns; its values are not set.
template <class T>
AnyOut<T> make_array(std::initializer_list<std::size_t> shape) {
    std::size_t size = 1;
    for (const std::size_t n : shape) size *= n;
    auto [raw, owner] = pooled<T>(size);
    return AnyOut<T>(raw, shape.size(), shape.begin(), owner);
}

/// View of an array (H, W) or (H, W, C) of any number of dimensions; an array of size 0 becomes an empty view.
template <class Array>
auto view_of(const Array& a) {
    using T = std::remove_pointer_t<decltype(a.data())>;
    if (a.size() == 0) return planish::Image<T>{};
    return planish::Image<T>{a.data(), static_cast<int>(a.shape(0)), static_cast<int>(a.shape(1)),
                             a.ndim() > 2 ? static_cast<int>(a.shape(2)) : 1};
}

/// Whether images are uint8, which else must be uint16; all of one size and type.
inline bool is_8_bit(const std::vector<AnyImage>& images) {
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
