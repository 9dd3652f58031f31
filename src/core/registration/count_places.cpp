#include "core/registration/count_places.hpp"

#include <algorithm>
#include <cstddef>
#include <limits>
#include <vector>

namespace planish {
namespace {

/// Places that are held against a point together.
constexpr std::size_t lane = 16;

}  // namespace

int count_places(std::span<const Eigen::Vector3d> points, double distinct) {
    // Filled up to whole lanes with places that are far from everything.
    const std::size_t most = (points.size() + lane - 1) / lane * lane;
    std::vector<double> x(most, std::numeric_limits<double>::infinity()), y(most, 0.0), z(most, 0.0);
    std::size_t count = 0;
    const double squared = distinct * distinct;
    for (const auto& p : points) {
        const double a = p[0], b = p[1], c = p[2];
        bool near = false;
        for (std::size_t first = 0; first < count && !near; first += lane) {
            double least = std::numeric_limits<double>::infinity();
            for (std::size_t i = first; i < first + lane; ++i) {
                const double dx = x[i] - a, dy = y[i] - b, dz = z[i] - c, d = dx * dx + dy * dy + dz * dz;
                least = d < least ? d : least;
            }
            near = least <= squared;
        }
        if (near) continue;
        x[count] = a;
        y[count] = b;
        z[count] = c;
        ++count;
    }
    return static_cast<int>(count);
}

}  // namespace planish
