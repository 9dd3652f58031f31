#pragma once

#include <cstddef>

namespace planish {

/// A dense row-major image of `channels` interleaved values per pixel; does not own its data.
template <class T>
struct Image {
    T* data = nullptr;
    int height = 0;
    int width = 0;
    int channels = 1;

    [[nodiscard]] bool empty() const { return data == nullptr; }
    [[nodiscard]] std::size_t pixels() const { return static_cast<std::size_t>(height) * width; }
    [[nodiscard]] T* row(int v) const { return data + static_cast<std::size_t>(v) * width * channels; }
    [[nodiscard]] T* at(int v, int u) const { return row(v) + static_cast<std::size_t>(u) * channels; }
};

}  // namespace planish
