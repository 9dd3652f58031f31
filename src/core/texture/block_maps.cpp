#include "core/texture/block_maps.hpp"

#include <algorithm>
#include <cmath>
#include <limits>

namespace planish {

void block_centres(const Image<const float>& image, int factor, const Image<float>& out) {
    const int half = factor / 2, channels = image.channels;
    for (int y = 0; y < out.height; ++y) {
        const int v = std::min(y * factor + half, image.height - 1);
        float* to = out.row(y);
        for (int x = 0; x < out.width; ++x) {
            const float* from = image.at(v, std::min(x * factor + half, image.width - 1));
            for (int c = 0; c < channels; ++c) *to++ = from[c];
        }
    }
}

void mark_blocks(const Image<const float>& places, int factor, const Image<std::uint8_t>& out) {
    std::fill_n(out.data, out.pixels(), std::uint8_t{0});
    const auto size = static_cast<float>(factor), right = static_cast<float>(out.width - 1),
               bottom = static_cast<float>(out.height - 1);
    for (std::size_t i = 0; i < places.pixels(); ++i) {
        const float u = (places.data[2 * i] + 0.5F) / size, v = (places.data[2 * i + 1] + 0.5F) / size;
        if (std::isnan(u) || std::isnan(v)) continue;
        *out.at(static_cast<int>(std::clamp(v, 0.0F, bottom)), static_cast<int>(std::clamp(u, 0.0F, right))) = 1;
    }
}

void fill_gaps(const Image<const float>& blocks, float otherwise, const Image<float>& out) {
    const int height = blocks.height, width = blocks.width;
    std::vector<float> before(blocks.data, blocks.data + blocks.pixels());
    std::copy(before.begin(), before.end(), out.data);
    for (int round = 0; round < 2; ++round) {
        for (int y = 0; y < height; ++y)
            for (int x = 0; x < width; ++x) {
                if (!std::isnan(before[static_cast<std::size_t>(y) * width + x])) continue;
                float sum = 0, count = 0;
                for (int dy = -1; dy <= 1; ++dy)
                    for (int dx = -1; dx <= 1; ++dx) {
                        const int row = std::clamp(y + dy, 0, height - 1), column = std::clamp(x + dx, 0, width - 1);
                        const float value = before[static_cast<std::size_t>(row) * width + column];
                        if (std::isnan(value)) continue;
                        sum += value;
                        count += 1;
                    }
                if (count > 0) *out.at(y, x) = sum / count;
            }
        std::copy_n(out.data, out.pixels(), before.begin());
    }
    for (std::size_t i = 0; i < out.pixels(); ++i)
        if (std::isnan(out.data[i])) out.data[i] = otherwise;
}

void lambert(const Image<const float>& points, const Image<const float>& normals, const Eigen::Vector3f& source,
             float least_cosine, const Image<float>& out) {
    constexpr float nan = std::numeric_limits<float>::quiet_NaN();
    const float sx = source[0], sy = source[1], sz = source[2];
    const auto count = static_cast<int>(out.pixels());
    const float* __restrict p = points.data;
    const float* __restrict n = normals.data;
    float* __restrict irradiance = out.data;
    for (int i = 0; i < count; ++i) {
        const float x = sx - p[3 * i], y = sy - p[3 * i + 1], z = sz - p[3 * i + 2];
        const float nx = n[3 * i], ny = n[3 * i + 1], nz = n[3 * i + 2];
        const float squared = x * x + y * y + z * z, length = nx * nx + ny * ny + nz * nz;
        const float cosine = (nx * x + ny * y + nz * z) / std::sqrt(length * squared);
        const float held = cosine > least_cosine ? cosine : least_cosine;
        irradiance[i] = length > 0 ? held / squared : nan;
    }
}

}  // namespace planish
