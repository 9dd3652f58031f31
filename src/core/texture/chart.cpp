#include "core/texture/chart.hpp"

#include <Eigen/Core>
#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <vector>

#include "core/common/between_pixels.hpp"
#include "core/common/parallel.hpp"
#include "core/common/range.hpp"

namespace planish {
namespace {

/// Share of a node that all four around a pixel get, however far: a pixel beside a missing node keeps the others.
constexpr float least_weight = 1e-3F;

/// The two nodes around a pixel along one axis, and the weight of the second.
struct Between {
    int first, second;
    float weight;
};

Between between(float pixel, int step, int count) {
    const float at = (pixel - static_cast<float>(step / 2)) / static_cast<float>(step);
    const int first = std::clamp(static_cast<int>(std::floor(at)), 0, count - 1);
    return {first, std::min(first + 1, count - 1), std::clamp(at - static_cast<float>(first), 0.0F, 1.0F)};
}

/// Weighted sum of the values 1 to 4 of the four nodes around a pixel: the x axis, and one more.
Eigen::Array4f blend(const Image<const float>& nodes, int row, int column, float down, float across) {
    const float* corner = nodes.at(row, column);
    const int right = column + 1 < nodes.width ? nodes.channels : 0,
              below = row + 1 < nodes.height ? nodes.channels * nodes.width : 0;
    const auto part = [&](int offset, float weight) -> Eigen::Array4f {
        return (weight + least_weight) * Eigen::Map<const Eigen::Array4f>(corner + offset + 1);
    };
    return part(0, (1 - down) * (1 - across)) + part(right, (1 - down) * across) + part(below, down * (1 - across)) +
           part(below + right, down * across);
}

void grow(ChartExtent& extent, const ChartExtent& by) {
    extent.left = std::min(extent.left, by.left);
    extent.top = std::min(extent.top, by.top);
    extent.right = std::max(extent.right, by.right);
    extent.bottom = std::max(extent.bottom, by.bottom);
}

/// The places of a row of the raster between pixels and between nodes; what is NaN stays so in the shares.
struct Places {
    std::vector<int> row, column, node_row, node_column;
    std::vector<float> down, across, node_down, node_across;

    explicit Places(int width)
        : row(width),
          column(width),
          node_row(width),
          node_column(width),
          down(width),
          across(width),
          node_down(width),
          node_across(width) {}

    void locate(const float* __restrict at, const Image<const float>& map, const Image<const float>& nodes, int step) {
        split(at, 0, map.width, column.data(), across.data());
        split(at, 1, map.height, row.data(), down.data());
        part(at, 0, step, nodes.width, node_column.data(), node_across.data());
        part(at, 1, step, nodes.height, node_row.data(), node_down.data());
    }

  private:
    void split(const float* __restrict at, int axis, int count, int* __restrict index, float* __restrict share) const {
        for (std::size_t x = 0; x < row.size(); ++x) {
            const PixelShare found(at[2 * x + axis], count);
            index[x] = found.index;
            share[x] = found.share;
        }
    }
    void part(const float* __restrict at, int axis, int step, int count, int* __restrict index,
              float* __restrict share) const {
        const auto first = static_cast<float>(step / 2), size = static_cast<float>(step),
                   last = static_cast<float>(count - 1);
        for (std::size_t x = 0; x < row.size(); ++x) {
            const float node = (at[2 * x + axis] - first) / size, held = node > 0.0F ? node : 0.0F;
            index[x] = static_cast<int>(held < last ? held : last);
            const float beyond = node - static_cast<float>(index[x]), least = beyond < 0.0F ? 0.0F : beyond;
            share[x] = least > 1.0F ? 1.0F : least;
        }
    }
};

/// The blend of the four nodes around the pixels of one row between two columns of nodes: sums of the weighted values,
/// linear in the weight of the second column.
struct RowBlend {
    std::array<float, 13> start, change;

    RowBlend(const Image<const float>& nodes, const Between& row, int first, int second) {
        const float *a = nodes.at(row.first, first), *b = nodes.at(row.first, second);
        const float *c = nodes.at(row.second, first), *d = nodes.at(row.second, second);
        for (int i = 0; i < 13; ++i) {
            const float left = (1 - row.weight) * a[i] + row.weight * c[i];
            const float right = (1 - row.weight) * b[i] + row.weight * d[i];
            start[i] = left + least_weight * (a[i] + b[i] + c[i] + d[i]);
            change[i] = right - left;
        }
    }
};

/// Places of one row [mm] between two columns of nodes.
void place_row(const RowBlend& blend, const Between* columns, const float* __restrict points, int count,
               float max_height, float* __restrict out) {
    const auto& s = blend.start;
    const auto& c = blend.change;
    constexpr float nan = std::numeric_limits<float>::quiet_NaN();
    for (int u = 0; u < count; ++u) {
        const float w = columns[u].weight;
        const float *p = points + 3 * u, per = 1 / (s[0] + w * c[0]);
        const auto axis = [&](int i) {
            return ((s[1 + 3 * i] + w * c[1 + 3 * i]) * p[0] + (s[2 + 3 * i] + w * c[2 + 3 * i]) * p[1] +
                    (s[3 + 3 * i] + w * c[3 + 3 * i]) * p[2] + (s[10 + i] + w * c[10 + i])) *
                   per;
        };
        const float x = axis(0), y = axis(1), height = axis(2);
        const bool ours = std::fabs(height) <= max_height;  // false for NaN
        out[2 * u] = ours ? x : nan;
        out[2 * u + 1] = ours ? y : nan;
    }
}

void mark_known(const float* __restrict points, int count, std::uint8_t* __restrict known) {
    for (int u = 0; u < count; ++u) known[u] = points[3 * u + 2] == points[3 * u + 2] ? 1 : 0;  // false for NaN
}

/// Makes normals unit vectors, and axes unit tangents.
void normalise(float* __restrict normals, float* __restrict axes, int count) {
    for (int i = 0; i < 3 * count; i += 3) {
        const float nx = normals[i], ny = normals[i + 1], nz = normals[i + 2];
        const float ax = axes[i], ay = axes[i + 1], az = axes[i + 2];
        const float per = 1 / std::sqrt(nx * nx + ny * ny + nz * nz);
        const float x = nx * per, y = ny * per, z = nz * per;
        const float along = ax * x + ay * y + az * z;
        const float tx = ax - along * x, ty = ay - along * y, tz = az - along * z;
        const float length = 1 / std::sqrt(tx * tx + ty * ty + tz * tz);
        normals[i] = x, normals[i + 1] = y, normals[i + 2] = z;
        axes[i] = tx * length, axes[i + 1] = ty * length, axes[i + 2] = tz * length;
    }
}

}  // namespace

ChartExtent chart_coordinates(const Image<const float>& points, const Image<const float>& nodes, int step,
                              double max_height, const Image<float>& coordinates, const Image<std::uint8_t>& known,
                              int threads) {
    constexpr float far = std::numeric_limits<float>::infinity();
    std::vector<Between> columns(points.width);
    for (int u = 0; u < points.width; ++u) columns[u] = between(static_cast<float>(u), step, nodes.width);
    std::vector<ChartExtent> extents(points.height, {far, far, -far, -far});
    parallel_for(points.height, threads, [&](std::size_t first, std::size_t last) {
        std::vector<float> line(points.width);
        for (int v = static_cast<int>(first); v < static_cast<int>(last); ++v) {
            const Between row = between(static_cast<float>(v), step, nodes.height);
            ChartExtent& extent = extents[v];
            for (int u = 0; u < points.width;) {
                int end = u + 1;
                while (end < points.width && columns[end].first == columns[u].first) ++end;
                const RowBlend around(nodes, row, columns[u].first, columns[u].second);
                place_row(around, columns.data() + u, points.at(v, u), end - u, static_cast<float>(max_height),
                          coordinates.at(v, u));
                u = end;
            }
            mark_known(points.row(v), points.width, known.row(v));
            for (std::size_t k = 0; k < 2; ++k) {
                const float* out = coordinates.row(v) + k;
                for (int u = 0; u < points.width; ++u) line[u] = out[2 * u];
                range(line.data(), points.width, k == 0 ? extent.left : extent.top,
                      k == 0 ? extent.right : extent.bottom);
            }
        }
    });
    for (const auto& extent : extents) grow(extents[0], extent);
    return extents[0];
}

void chart_surface(const Image<const float>& source, const Image<const float>& points,
                   const Image<const float>& normals, const Image<const float>& nodes, int step,
                   const ChartSurface& out, int threads) {
    constexpr float nan = std::numeric_limits<float>::quiet_NaN();
    parallel_for(source.height, threads, [&](std::size_t first, std::size_t last) {
        Places places(source.width);
        // Vectors of three are written as four: the fourth value is overwritten by the next, and lies behind the row.
        std::array<std::vector<float>, 3> rows;
        rows.fill(std::vector<float>(3 * static_cast<std::size_t>(source.width) + 1));
        for (int y = static_cast<int>(first); y < static_cast<int>(last); ++y) {
            const float* at = source.row(y);
            places.locate(at, points, nodes, step);
            float *point = rows[0].data(), *normal = rows[1].data(), *axis = rows[2].data();
            for (int x = 0; x < source.width; ++x, point += 3, normal += 3, axis += 3) {
                Eigen::Map<Eigen::Array4f> to_point(point), to_normal(normal), to_axis(axis);
                if (std::isnan(at[2 * x])) {
                    to_point = to_normal = to_axis = Eigen::Array4f::Constant(nan);
                    continue;
                }
                const float fu = places.across[x], fv = places.down[x];
                to_point = between_pixels(points, places.row[x], places.column[x], fu, fv);
                to_normal = between_pixels(normals, places.row[x], places.column[x], fu, fv);
                to_axis =
                    blend(nodes, places.node_row[x], places.node_column[x], places.node_down[x], places.node_across[x]);
            }
            normalise(rows[1].data(), rows[2].data(), source.width);
            const std::array<float*, 3> lines{out.points.row(y), out.normals.row(y), out.x_axis.row(y)};
            for (std::size_t k = 0; k < 3; ++k) std::copy_n(rows[k].data(), 3 * source.width, lines[k]);
        }
    });
}

}  // namespace planish
