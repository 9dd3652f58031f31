#include "core/sensing/undistortion.hpp"

#include <array>
#include <vector>

#include "core/common/parallel.hpp"

namespace planish {
namespace {

constexpr int kSpacing = 16;

/// Weights of four nodes at -1, 0, 1, 2 for a position in [0, 1).
std::array<double, 4> lagrange(double t) {
    return {-t * (t - 1) * (t - 2) / 6, (t + 1) * (t - 1) * (t - 2) / 2, -(t + 1) * t * (t - 2) / 2,
            (t + 1) * t * (t - 1) / 6};
}

}  // namespace

void undistortion_shifts(const Camera& camera, int threads, Image<float> shifts) {
    // Node (i, j) stands at pixel ((j - 1) * spacing, (i - 1) * spacing): one node beyond every border.
    const int columns = shifts.width / kSpacing + 4, rows = shifts.height / kSpacing + 4;
    const auto count = static_cast<std::size_t>(rows);
    std::vector<Eigen::Vector2d> nodes(count * columns);
    parallel_for(count, threads, [&](std::size_t begin, std::size_t end) {
        for (std::size_t i = begin; i < end; ++i)
            for (int j = 0; j < columns; ++j) {
                const Eigen::Vector2d pixel((j - 1) * kSpacing, (static_cast<double>(i) - 1) * kSpacing);
                nodes[i * columns + j] = camera.to_pixel(camera.undistort(camera.from_pixel(pixel))) - pixel;
            }
    });
    std::array<std::array<double, 4>, kSpacing> weights;
    for (int t = 0; t < kSpacing; ++t) weights[t] = lagrange(static_cast<double>(t) / kSpacing);
    parallel_for(static_cast<std::size_t>(shifts.height), threads, [&](std::size_t begin, std::size_t end) {
        std::vector<Eigen::Vector2d> line(columns);
        for (std::size_t v = begin; v < end; ++v) {
            const auto& wv = weights[v % kSpacing];
            for (int j = 0; j < columns; ++j) {
                line[j].setZero();
                for (int i = 0; i < 4; ++i) line[j] += wv[i] * nodes[(v / kSpacing + i) * columns + j];
            }
            float* out = shifts.row(static_cast<int>(v));
            for (int u = 0; u < shifts.width; ++u) {
                const auto& wu = weights[u % kSpacing];
                const Eigen::Vector2d* node = &line[u / kSpacing];
                const Eigen::Vector2d shift = wu[0] * node[0] + wu[1] * node[1] + wu[2] * node[2] + wu[3] * node[3];
                out[2 * u] = static_cast<float>(shift.x());
                out[2 * u + 1] = static_cast<float>(shift.y());
            }
        }
    });
}

}  // namespace planish
