#include "core/chart.hpp"

#include <Eigen/Core>
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

/// Weighted sum of the first four values of the four nodes around a pixel; the first is the sum of the weights.
Eigen::Array4f blend(const Image<const float>& nodes, const Between& row, const Between& column) {
    const auto part = [&](int r, int c, float weight) -> Eigen::Array4f {
        return (weight + least_weight) * Eigen::Map<const Eigen::Array4f>(nodes.at(r, c));
    };
    return part(row.first, column.first, (1 - row.weight) * (1 - column.weight)) +
           part(row.first, column.second, (1 - row.weight) * column.weight) +
           part(row.second, column.first, row.weight * (1 - column.weight)) +
           part(row.second, column.second, row.weight * column.weight);
}

void grow(ChartExtent& extent, const ChartExtent& by) {
    extent.left = std::min(extent.left, by.left);
    extent.top = std::min(extent.top, by.top);
    extent.right = std::max(extent.right, by.right);
    extent.bottom = std::max(extent.bottom, by.bottom);
}

/// Linear interpolation of a map (H, W, 3) in the first three of four values; the place lies within it.
Eigen::Array4f bilinear(const Image<const float>& map, float u, float v) {
    const int column = std::clamp(static_cast<int>(u), 0, std::max(0, map.width - 2));
    const int row = std::clamp(static_cast<int>(v), 0, std::max(0, map.height - 2));
    const float fu = u - static_cast<float>(column), fv = v - static_cast<float>(row);
    const bool last = row + 2 == map.height && column + 2 == map.width;
    const auto at = [&](int r, int c) -> Eigen::Array4f {
        const float* p = map.at(r, c);
        // Nothing lies behind the last pixel.
        if (last) return {p[0], p[1], p[2], 0.0F};
        return Eigen::Map<const Eigen::Array4f>(p);
    };
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
            float* out = source.at(y, x);
            if (!std::isnan(out[0])) continue;
            const auto fx = static_cast<float>(x), fy = static_cast<float>(y);
            const float wb = ((fx - a.x) * (c.y - a.y) - (c.x - a.x) * (fy - a.y)) / area;
            const float wc = ((b.x - a.x) * (fy - a.y) - (fx - a.x) * (b.y - a.y)) / area;
            const float wa = 1.0F - wb - wc;
            // Slightly generous, so that no pixel falls into the crack between two triangles.
            if (wa < -1e-4F || wb < -1e-4F || wc < -1e-4F) continue;
            out[0] = wa * a.u + wb * b.u + wc * c.u;
            out[1] = wa * a.v + wb * b.v + wc * c.v;
        }
}

/// The places of one camera row in raster pixels, and the raster rows that they reach.
struct Line {
    std::vector<float> x, y;
    float top = std::numeric_limits<float>::infinity(), bottom = -top;
    int row = 0;

    [[nodiscard]] Corner at(std::size_t u) const {
        return {x[u], y[u], static_cast<float>(u), static_cast<float>(row)};
    }
};

Line read_line(const Image<const float>& coordinates, const ChartRaster& raster, int v) {
    Line line;
    line.row = v;
    line.x.resize(coordinates.width);
    line.y.resize(coordinates.width);
    const float* p = coordinates.row(v);
    for (int u = 0; u < coordinates.width; ++u) {
        line.x[u] = static_cast<float>((p[2 * u] - raster.x) / raster.pitch);
        line.y[u] = static_cast<float>((p[2 * u + 1] - raster.y) / raster.pitch);
    }
    for (const float y : line.y) {
        line.top = y < line.top ? y : line.top;  // false for NaN
        line.bottom = y > line.bottom ? y : line.bottom;
    }
    return line;
}

/// Whether four corners have no whole number between them. Never true where b, c and one of a, d are known and have;
/// no coordinate is below that of the first pixel, but for rounding, where 0 is assumed between.
bool holds_none(float a, float b, float c, float d) {
    const auto least = [](float p, float q) { return p < q ? p : q; };
    const auto most = [](float p, float q) { return p > q ? p : q; };
    const auto last = static_cast<float>(static_cast<int>(most(most(a, b), most(c, d))));
    return last < least(least(a, b), least(c, d));
}

void fill_between(const Image<float>& source, const Band& band, const Line& above, const Line& below, float limit,
                  std::vector<unsigned char>& empty) {
    const std::size_t cells = above.x.size() - 1;
    const float *ax = above.x.data(), *ay = above.y.data(), *bx = below.x.data(), *by = below.y.data();
    for (std::size_t u = 0; u < cells; ++u)
        empty[u] = static_cast<unsigned char>(holds_none(ax[u], ax[u + 1], bx[u], bx[u + 1]) |
                                              holds_none(ay[u], ay[u + 1], by[u], by[u + 1]));
    const auto near = [&](const Corner& a, const Corner& b) {  // false for NaN
        return std::fabs(a.x - b.x) <= limit && std::fabs(a.y - b.y) <= limit;
    };
    for (std::size_t u = 0; u < cells; ++u) {
        if (empty[u] != 0) continue;
        const Corner a = above.at(u), b = above.at(u + 1), c = below.at(u), d = below.at(u + 1);
        if (!near(b, c)) continue;
        if (near(a, b) && near(a, c)) fill(source, band, a, b, c);
        if (near(d, b) && near(d, c)) fill(source, band, d, c, b);
    }
}

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

/// A row of vectors, each of whose components is a row.
struct Vectors {
    std::array<std::vector<float>, 3> component;

    explicit Vectors(int width) { component.fill(std::vector<float>(width)); }
    void set(int x, const Eigen::Array4f& value, int first) {
        for (int i = 0; i < 3; ++i) component[i][x] = value[first + i];
    }
    void write(float* __restrict out) const {
        const float *x = component[0].data(), *y = component[1].data(), *z = component[2].data();
        for (std::size_t i = 0; i < component[0].size(); ++i) {
            out[3 * i] = x[i];
            out[3 * i + 1] = y[i];
            out[3 * i + 2] = z[i];
        }
    }
};

/// Makes normals unit vectors, and axes unit tangents.
void normalise(Vectors& normals, Vectors& axes) {
    float *nx = normals.component[0].data(), *ny = normals.component[1].data(), *nz = normals.component[2].data();
    float *ax = axes.component[0].data(), *ay = axes.component[1].data(), *az = axes.component[2].data();
    for (std::size_t i = 0; i < normals.component[0].size(); ++i) {
        const float per = 1 / std::sqrt(nx[i] * nx[i] + ny[i] * ny[i] + nz[i] * nz[i]);
        const float x = nx[i] * per, y = ny[i] * per, z = nz[i] * per;
        const float along = ax[i] * x + ay[i] * y + az[i] * z;
        const float tx = ax[i] - along * x, ty = ay[i] - along * y, tz = az[i] - along * z;
        const float length = 1 / std::sqrt(tx * tx + ty * ty + tz * tz);
        nx[i] = x, ny[i] = y, nz[i] = z;
        ax[i] = tx * length, ay[i] = ty * length, az[i] = tz * length;
    }
}

}  // namespace

ChartExtent chart_coordinates(const Image<const float>& points, const Image<const float>& nodes, int step,
                              double max_height, const Image<float>& coordinates, int threads) {
    constexpr float far = std::numeric_limits<float>::infinity();
    std::vector<Between> columns(points.width);
    for (int u = 0; u < points.width; ++u) columns[u] = between(static_cast<float>(u), step, nodes.width);
    std::vector<ChartExtent> extents(points.height, {far, far, -far, -far});
    parallel_for(points.height, threads, [&](std::size_t first, std::size_t last) {
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
            const float* out = coordinates.row(v);
            for (int u = 0; u < points.width; ++u) {
                const float x = out[2 * u], y = out[2 * u + 1];
                extent.left = x < extent.left ? x : extent.left;  // false for NaN
                extent.right = x > extent.right ? x : extent.right;
                extent.top = y < extent.top ? y : extent.top;
                extent.bottom = y > extent.bottom ? y : extent.bottom;
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
        std::vector<unsigned char> empty(coordinates.width);
        for (std::size_t v = 1; v < lines.size(); ++v) {
            const Line &above = lines[v - 1], &below = lines[v];
            if (std::min(above.top, below.top) <= static_cast<float>(last) &&
                std::max(above.bottom, below.bottom) >= static_cast<float>(first))
                fill_between(source, band, above, below, limit, empty);
        }
    });
}

void chart_surface(const Image<const float>& source, const Image<const float>& points,
                   const Image<const float>& normals, const Image<const float>& nodes, int step,
                   const ChartSurface& out, int threads) {
    constexpr float nan = std::numeric_limits<float>::quiet_NaN();
    parallel_for(source.height, threads, [&](std::size_t first, std::size_t last) {
        Vectors point(source.width), normal(source.width), axis(source.width);
        for (int y = static_cast<int>(first); y < static_cast<int>(last); ++y) {
            for (int x = 0; x < source.width; ++x) {
                const float *at = source.at(y, x), u = at[0], v = at[1];
                if (std::isnan(u)) {
                    for (auto* vectors : {&point, &normal, &axis}) vectors->set(x, Eigen::Array4f::Constant(nan), 0);
                    continue;
                }
                point.set(x, bilinear(points, u, v), 0);
                normal.set(x, bilinear(normals, u, v), 0);
                axis.set(x, blend(nodes, between(v, step, nodes.height), between(u, step, nodes.width)), 1);
            }
            normalise(normal, axis);
            point.write(out.points.row(y));
            normal.write(out.normals.row(y));
            axis.write(out.x_axis.row(y));
        }
    });
}

}  // namespace planish
