#include "core/chart.hpp"

#include <Eigen/Geometry>
#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <vector>

#include "core/parallel.hpp"

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

/// Weighted sum of the first n values of the four nodes around a pixel; the first is the sum of the weights.
template <int n>
std::array<float, n> blend(const Image<const float>& nodes, const Between& row, const Between& column) {
    std::array<float, n> sum{};
    const auto add = [&](int r, int c, float weight) {
        const float* node = nodes.at(r, c);
        for (int i = 0; i < n; ++i) sum[i] += (weight + least_weight) * node[i];
    };
    add(row.first, column.first, (1 - row.weight) * (1 - column.weight));
    add(row.first, column.second, (1 - row.weight) * column.weight);
    add(row.second, column.first, row.weight * (1 - column.weight));
    add(row.second, column.second, row.weight * column.weight);
    return sum;
}

void grow(ChartExtent& extent, const ChartExtent& by) {
    extent.left = std::min(extent.left, by.left);
    extent.top = std::min(extent.top, by.top);
    extent.right = std::max(extent.right, by.right);
    extent.bottom = std::max(extent.bottom, by.bottom);
}

/// Linear interpolation of a map (H, W, 3); the place lies within it.
Eigen::Vector3f bilinear(const Image<const float>& map, float u, float v) {
    const int column = std::clamp(static_cast<int>(u), 0, std::max(0, map.width - 2));
    const int row = std::clamp(static_cast<int>(v), 0, std::max(0, map.height - 2));
    const float fu = u - static_cast<float>(column), fv = v - static_cast<float>(row);
    const auto at = [&](int r, int c) { return Eigen::Map<const Eigen::Vector3f>(map.at(r, c)); };
    return (1 - fv) * ((1 - fu) * at(row, column) + fu * at(row, column + 1)) +
           fv * ((1 - fu) * at(row + 1, column) + fu * at(row + 1, column + 1));
}

struct Corner {
    float x, y;  // raster pixels
    float u, v;  // camera pixels
};

/// Rows of a raster.
struct Band {
    int first, end;
};

/// Fills the pixels of a band of `source` inside a triangle that are still empty.
void fill(const Image<float>& source, const Band& band, const Corner& a, const Corner& b, const Corner& c) {
    const int y0 = std::max(band.first, static_cast<int>(std::ceil(std::min({a.y, b.y, c.y}))));
    const int y1 = std::min(band.end - 1, static_cast<int>(std::floor(std::max({a.y, b.y, c.y}))));
    const int x0 = std::max(0, static_cast<int>(std::ceil(std::min({a.x, b.x, c.x}))));
    const int x1 = std::min(source.width - 1, static_cast<int>(std::floor(std::max({a.x, b.x, c.x}))));
    // Most triangles lie between the raster's pixels.
    if (y0 > y1 || x0 > x1) return;
    const float area = (b.x - a.x) * (c.y - a.y) - (c.x - a.x) * (b.y - a.y);
    if (!(std::fabs(area) > 1e-9F)) return;
    for (int y = y0; y <= y1; ++y)
        for (int x = x0; x <= x1; ++x) {
            const auto fx = static_cast<float>(x), fy = static_cast<float>(y);
            const float wb = ((fx - a.x) * (c.y - a.y) - (c.x - a.x) * (fy - a.y)) / area;
            const float wc = ((b.x - a.x) * (fy - a.y) - (fx - a.x) * (b.y - a.y)) / area;
            const float wa = 1.0F - wb - wc;
            // Slightly generous, so that no pixel falls into the crack between two triangles.
            if (wa < -1e-4F || wb < -1e-4F || wc < -1e-4F) continue;
            float* out = source.at(y, x);
            if (!std::isnan(out[0])) continue;
            out[0] = wa * a.u + wb * b.u + wc * c.u;
            out[1] = wa * a.v + wb * b.v + wc * c.v;
        }
}

/// The corners of one camera row, and the raster rows that they reach.
struct Line {
    std::vector<Corner> corners;
    float top = std::numeric_limits<float>::infinity(), bottom = -top;
};

Line read_line(const Image<const float>& coordinates, const ChartRaster& raster, int v) {
    Line line;
    line.corners.resize(coordinates.width);
    for (int u = 0; u < coordinates.width; ++u) {
        const float* p = coordinates.at(v, u);
        const auto y = static_cast<float>((p[1] - raster.y) / raster.pitch);
        line.corners[u] = {static_cast<float>((p[0] - raster.x) / raster.pitch), y, static_cast<float>(u),
                           static_cast<float>(v)};
        if (y < line.top) line.top = y;  // false for NaN
        if (y > line.bottom) line.bottom = y;
    }
    return line;
}

void fill_between(const Image<float>& source, const Band& band, const Line& above, const Line& below, float limit) {
    const auto near = [&](const Corner& a, const Corner& b) {  // false for NaN
        return std::fabs(a.x - b.x) <= limit && std::fabs(a.y - b.y) <= limit;
    };
    for (std::size_t u = 0; u + 1 < above.corners.size(); ++u) {
        const Corner &a = above.corners[u], &b = above.corners[u + 1], &c = below.corners[u], &d = below.corners[u + 1];
        if (!near(b, c)) continue;
        if (near(a, b) && near(a, c)) fill(source, band, a, b, c);
        if (near(d, b) && near(d, c)) fill(source, band, d, c, b);
    }
}

}  // namespace

ChartExtent chart_coordinates(const Image<const float>& points, const Image<const float>& nodes, int step,
                              double max_height, const Image<float>& coordinates, int threads) {
    constexpr float nan = std::numeric_limits<float>::quiet_NaN(), far = std::numeric_limits<float>::infinity();
    std::vector<Between> columns(points.width);
    for (int u = 0; u < points.width; ++u) columns[u] = between(static_cast<float>(u), step, nodes.width);
    std::vector<ChartExtent> extents(points.height, {far, far, -far, -far});
    parallel_for(points.height, threads, [&](std::size_t first, std::size_t last) {
        for (int v = static_cast<int>(first); v < static_cast<int>(last); ++v) {
            const Between row = between(static_cast<float>(v), step, nodes.height);
            ChartExtent& extent = extents[v];
            for (int u = 0; u < points.width; ++u) {
                const float* p = points.at(v, u);
                float* out = coordinates.at(v, u);
                const auto sum = blend<13>(nodes, row, columns[u]);
                std::array<float, 3> at;
                for (int i = 0; i < 3; ++i)
                    at[i] =
                        (sum[1 + 3 * i] * p[0] + sum[2 + 3 * i] * p[1] + sum[3 + 3 * i] * p[2] + sum[10 + i]) / sum[0];
                const bool ours = std::fabs(at[2]) <= max_height;  // false for NaN
                out[0] = ours ? at[0] : nan;
                out[1] = ours ? at[1] : nan;
                if (ours) grow(extent, {at[0], at[1], at[0], at[1]});
            }
        }
    });
    for (const auto& extent : extents) grow(extents[0], extent);
    return extents[0];
}

void rasterise_chart(const Image<const float>& coordinates, const ChartRaster& raster, double max_edge, int threads,
                     const Image<float>& source) {
    std::fill_n(source.data, source.pixels() * 2, std::numeric_limits<float>::quiet_NaN());
    std::vector<Line> lines(coordinates.height);
    parallel_for(lines.size(), threads, [&](std::size_t first, std::size_t last) {
        for (std::size_t v = first; v < last; ++v) lines[v] = read_line(coordinates, raster, static_cast<int>(v));
    });
    const auto limit = static_cast<float>(max_edge / raster.pitch);
    // Bands of the raster side by side: every pixel meets the same triangles in the same order, whatever the bands.
    parallel_for(source.height, threads, [&](std::size_t first, std::size_t last) {
        const Band band{static_cast<int>(first), static_cast<int>(last)};
        for (std::size_t v = 1; v < lines.size(); ++v) {
            const Line &above = lines[v - 1], &below = lines[v];
            if (std::min(above.top, below.top) <= static_cast<float>(last) &&
                std::max(above.bottom, below.bottom) >= static_cast<float>(first))
                fill_between(source, band, above, below, limit);
        }
    });
}

void chart_surface(const Image<const float>& source, const Image<const float>& points,
                   const Image<const float>& normals, const Image<const float>& nodes, int step,
                   const ChartSurface& out, int threads) {
    constexpr float nan = std::numeric_limits<float>::quiet_NaN();
    parallel_for(source.height, threads, [&](std::size_t first, std::size_t last) {
        for (int y = static_cast<int>(first); y < static_cast<int>(last); ++y)
            for (int x = 0; x < source.width; ++x) {
                const float *at = source.at(y, x), u = at[0], v = at[1];
                Eigen::Map<Eigen::Vector3f> point(out.points.at(y, x)), normal(out.normals.at(y, x)),
                    axis(out.x_axis.at(y, x));
                if (std::isnan(u)) {
                    for (auto* vector : {&point, &normal, &axis}) vector->setConstant(nan);
                    continue;
                }
                point = bilinear(points, u, v);
                normal = bilinear(normals, u, v).normalized();
                const auto sum = blend<4>(nodes, between(v, step, nodes.height), between(u, step, nodes.width));
                axis = Eigen::Vector3f(sum[1], sum[2], sum[3]);
                axis = (axis - axis.dot(normal) * normal).normalized();
            }
    });
}

}  // namespace planish
