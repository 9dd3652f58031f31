#include "core/islands.hpp"

#include <cmath>
#include <vector>

namespace planish {
namespace {

/// Disjoint sets with path halving; the smaller index is the root, so that the result does not depend on the order.
class Sets {
  public:
    explicit Sets(std::size_t count) : parent_(count) {
        for (std::size_t i = 0; i < count; ++i) parent_[i] = static_cast<std::uint32_t>(i);
    }
    std::uint32_t root(std::uint32_t i) {
        while (parent_[i] != i) i = parent_[i] = parent_[parent_[i]];
        return i;
    }
    void join(std::uint32_t a, std::uint32_t b) {
        a = root(a);
        b = root(b);
        if (a < b)
            parent_[b] = a;
        else
            parent_[a] = b;
    }

  private:
    std::vector<std::uint32_t> parent_;
};

}  // namespace

void islands(Image<const float> depth, Image<const float> sigma, const IslandLimits& limits,
             Image<std::uint8_t> small) {
    const auto width = static_cast<std::uint32_t>(depth.width), count = static_cast<std::uint32_t>(depth.pixels());
    const float* z = depth.data;
    const auto connected = [&](std::uint32_t i, std::uint32_t j) {
        const float s = std::sqrt(sigma.data[i] * sigma.data[i] + sigma.data[j] * sigma.data[j]);
        return std::fabs(z[i] - z[j]) <= limits.depth_per_pixel * z[i] + limits.sigmas * s;
    };
    Sets sets(count);
    for (std::uint32_t i = 0; i < count; ++i) {
        if (!(z[i] == z[i])) continue;
        if (i % width != 0 && connected(i, i - 1)) sets.join(i, i - 1);
        if (i >= width && connected(i, i - width)) sets.join(i, i - width);
    }
    std::vector<std::uint32_t> size(count, 0);
    for (std::uint32_t i = 0; i < count; ++i)
        if (z[i] == z[i]) ++size[sets.root(i)];
    for (std::uint32_t i = 0; i < count; ++i)
        small.data[i] = z[i] == z[i] && size[sets.root(i)] < static_cast<std::uint32_t>(limits.min_pixels) ? 1 : 0;
}

}  // namespace planish
