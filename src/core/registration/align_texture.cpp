#include "core/registration/align_texture.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <limits>

#include "core/common/between_pixels.hpp"
#include "core/common/moved_camera.hpp"
#include "core/common/parallel.hpp"
#include "core/common/prefetch.hpp"

namespace planish {
namespace {

constexpr float NOT_A_NUMBER = std::numeric_limits<float>::quiet_NaN();

Eigen::Vector3d vector_at(const Image<const float>& image, int v, int u) {
    return Eigen::Map<const Eigen::Vector3f>(image.at(v, u)).cast<double>();
}

/// Where a pixel of the texture image lies among those of a's camera.
struct OnSurface {
    PixelShare across, down;

    OnSurface(const float* place, const Image<const float>& grid)
        : across(place[0], grid.width), down(place[1], grid.height) {}

    /// A map of the surface there.
    [[nodiscard]] Eigen::Vector3d read(const Image<const float>& map) const {
        const Eigen::Array4f found = between_pixels(map, down.index, across.index, across.share, down.share);
        return found.head<3>().matrix().cast<double>();
    }
};

/// Pixels of one row whose points b's camera may see, and where.
struct Ahead {
    int count = 0;
    std::array<int, kAhead> columns{};
    std::array<Eigen::Vector3d, kAhead> points;
    std::array<double, kAhead> u{}, v{};
};

/// The four pixels around a place, those beyond the rim replaced by the last ones, and their weights.
struct Corners {
    std::array<std::ptrdiff_t, 4> at{};
    std::array<float, 4> weight{};

    Corners(float x, float y, int width, int height) {
        const float left = std::floor(x), top = std::floor(y), fx = x - left, fy = y - top;
        const int u = static_cast<int>(left), v = static_cast<int>(top);
        const std::ptrdiff_t first = std::clamp(u, 0, width - 1), second = std::clamp(u + 1, 0, width - 1);
        const std::ptrdiff_t above = static_cast<std::ptrdiff_t>(std::clamp(v, 0, height - 1)) * width,
                             below = static_cast<std::ptrdiff_t>(std::clamp(v + 1, 0, height - 1)) * width;
        at = {above + first, above + second, below + first, below + second};
        weight = {(1 - fy) * (1 - fx), (1 - fy) * fx, fy * (1 - fx), fy * fx};
    }
};

struct Problem {
    const TextureSurface& a;
    const TexturedPoints& b;
    MovedCamera camera;
    Eigen::Matrix3d R_a_b;
    Eigen::Vector3d t_a_b, centre;
    double gate;

    Problem(const TextureSurface& a_, const TexturedPoints& b_, const Camera& camera_b, const Eigen::Matrix3d& R_b_a,
            const Eigen::Vector3d& t_b_a, double gate_)
        : a(a_),
          b(b_),
          camera(camera_b, R_b_a, t_b_a),
          // The distance between the surfaces is the same in the frame of a.
          R_a_b(R_b_a.transpose()),
          t_a_b(-R_a_b * t_b_a),
          centre(R_a_b * camera_b.center_sensor() + t_a_b),
          gate(gate_) {}

    /// Takes the next pixels of a row that ask, and asks for what will be read of b where its camera may see them.
    void take(int v, int& next, Ahead& out) const {
        const std::uint8_t* own = a.own.row(v);
        Places places;
        std::array<int, kAhead> columns;
        std::array<Eigen::Vector3d, kAhead> points;
        int count = 0;
        for (; next < a.places.width && count < kAhead; ++next) {
            if (own[next] == 0) continue;
            columns[count] = next;
            points[count] = OnSurface(a.places.at(v, next), a.points).read(a.points);
            places.x[count] = points[count][0];
            places.y[count] = points[count][1];
            places.z[count] = points[count][2];
            ++count;
        }
        out.count = 0;
        if (count == 0) return;
        camera.project(places);
        const double right = b.points.width - 0.5, bottom = b.points.height - 0.5;
        for (int i = 0; i < count; ++i) {
            const double x = places.u[i], y = places.v[i];
            if (!(places.z[i] > 0 && x > -0.5 && y > -0.5 && x < right && y < bottom)) continue;
            const int row = static_cast<int>(std::nearbyint(y)), column = static_cast<int>(std::nearbyint(x));
            prefetch(b.points.at(row, column));
            prefetch(b.value.at(row, column));
            prefetch(b.sigma.at(row, column));
            out.columns[out.count] = columns[i];
            out.points[out.count] = points[i];
            out.u[out.count] = x;
            out.v[out.count] = y;
            ++out.count;
        }
    }

    void compare(const Ahead& ahead, int v, const AlignedTexture& out) const {
        for (int i = 0; i < ahead.count; ++i) {
            const double x = ahead.u[i], y = ahead.v[i];
            const Eigen::Vector3d& point = ahead.points[i];
            const int column = ahead.columns[i];
            const Eigen::Vector3d normal = OnSurface(a.places.at(v, column), a.points).read(a.normals).normalized();
            if (!((point - centre).dot(normal) < 0)) continue;
            const Eigen::Vector3d other =
                vector_at(b.points, static_cast<int>(std::nearbyint(y)), static_cast<int>(std::nearbyint(x)));
            if (!(std::abs((R_a_b * other + t_a_b - point).dot(normal)) <= gate)) continue;
            const auto u_b = static_cast<float>(x), v_b = static_cast<float>(y);
            const Corners corners(u_b, v_b, b.value.width, b.value.height);
            float value = 0, sigma = 0;
            for (std::size_t k = 0; k < 4; ++k) {
                const float seen = b.value.data[corners.at[k]];
                value += corners.weight[k] * (seen == seen ? seen : 0.0F);
                sigma += corners.weight[k] * b.sigma.data[corners.at[k]];
            }
            if (!std::isfinite(sigma)) continue;
            float* source = out.source.at(v, column);
            source[0] = u_b;
            source[1] = v_b;
            *out.value.at(v, column) = value;
            *out.sigma.at(v, column) = sigma;
            *out.common.at(v, column) = 1;
        }
    }
};

}  // namespace

void align_texture(const TextureSurface& a, const Camera& camera_b, const TexturedPoints& b,
                   const Eigen::Matrix3d& R_b_a, const Eigen::Vector3d& t_b_a, double gate, int threads,
                   const AlignedTexture& out) {
    const Problem problem(a, b, camera_b, R_b_a, t_b_a, gate);
    const int width = a.places.width;
    const auto wide = static_cast<std::size_t>(width);
    parallel_tasks(static_cast<std::size_t>(a.places.height), threads, [&](std::size_t row) {
        const int v = static_cast<int>(row);
        std::fill_n(out.source.row(v), 2 * wide, NOT_A_NUMBER);
        std::fill_n(out.value.row(v), wide, 0.0F);
        std::fill_n(out.sigma.row(v), wide, 0.0F);
        std::fill_n(out.common.row(v), wide, std::uint8_t{0});
        // While some are compared, memory answers what was asked for by the next.
        std::array<Ahead, 2> ahead;
        int turn = 0;
        for (int next = 0; next < width; turn = 1 - turn) {
            problem.take(v, next, ahead[turn]);
            problem.compare(ahead[1 - turn], v, out);
        }
        problem.compare(ahead[1 - turn], v, out);
    });
}

}  // namespace planish
