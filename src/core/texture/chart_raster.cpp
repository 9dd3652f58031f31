#include <algorithm>
#include <cmath>
#include <limits>
#include <utility>
#include <vector>

#include "core/common/parallel.hpp"
#include "core/common/range.hpp"
#include "core/texture/chart.hpp"

namespace planish {
namespace {

/// What a cell, between four neighbouring camera pixels, means for the raster.
constexpr int kNothing = -1, kLookCloser = -2;
/// Slightly generous, so that no pixel falls into the crack between two triangles.
constexpr float kOutside = -1e-4F;
/// Triangles of less area [raster px^2, doubled] have no inside.
constexpr float kLeastArea = 1e-9F;

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
    if (!(std::fabs(area) > kLeastArea)) return;
    for (int y = y0; y <= y1; ++y)
        for (int x = x0; x <= x1; ++x) {
            float* out = source.at(y, x);
            if (!std::isnan(out[0])) continue;
            const auto fx = static_cast<float>(x), fy = static_cast<float>(y);
            const float wb = ((fx - a.x) * (c.y - a.y) - (c.x - a.x) * (fy - a.y)) / area;
            const float wc = ((b.x - a.x) * (fy - a.y) - (fx - a.x) * (b.y - a.y)) / area;
            const float wa = 1.0F - wb - wc;
            if (wa < kOutside || wb < kOutside || wc < kOutside) continue;
            out[0] = wa * a.u + wb * b.u + wc * c.u;
            out[1] = wa * a.v + wb * b.v + wc * c.v;
        }
}

/// The places of one camera row in raster pixels, and the raster rows that they reach.
struct Line {
    std::vector<float> x, y;
    float top = 0, bottom = 0;
    int row = 0;

    explicit Line(int width) : x(width), y(width) {}
    [[nodiscard]] Corner at(std::size_t u) const {
        return {x[u], y[u], static_cast<float>(u), static_cast<float>(row)};
    }
};

void read_line(const Image<const float>& coordinates, const ChartRaster& raster, int v, Line& line) {
    const float* __restrict p = coordinates.row(v);
    float* __restrict x = line.x.data();
    float* __restrict y = line.y.data();
    for (int u = 0; u < coordinates.width; ++u) {
        x[u] = static_cast<float>((p[2 * u] - raster.x) / raster.pitch);
        y[u] = static_cast<float>((p[2 * u + 1] - raster.y) / raster.pitch);
    }
    line.row = v;
    range(line.y.data(), coordinates.width, line.top, line.bottom);
}

/// The cells of one row: the raster pixel that each fills, or what else is to be done, and the place to fill in.
struct Cells {
    std::vector<int> row, column;
    std::vector<float> u, v;

    explicit Cells(int width) : row(width), column(width), u(width), v(width) {}
};

float least(float p, float q) { return p < q ? p : q; }
float most(float p, float q) { return p > q ? p : q; }

/// The weights of a triangle's corners at the pixel (x, y), and 1 where it holds that pixel, as in `fill`, else 0.
struct Inside {
    float wa, wb, wc, holds;

    Inside(const Corner& a, const Corner& b, const Corner& c, float x, float y) {
        const float area = (b.x - a.x) * (c.y - a.y) - (c.x - a.x) * (b.y - a.y);
        wb = ((x - a.x) * (c.y - a.y) - (c.x - a.x) * (y - a.y)) / area;
        wc = ((b.x - a.x) * (y - a.y) - (x - a.x) * (b.y - a.y)) / area;
        wa = 1.0F - wb - wc;
        const float left = least(least(a.x, b.x), c.x), right = most(most(a.x, b.x), c.x);
        const float top = least(least(a.y, b.y), c.y), bottom = most(most(a.y, b.y), c.y);
        const float smallest = least(least(wa, wb), wc);
        const float within = least(least(x - left, right - x), least(y - top, bottom - y));
        holds = (std::fabs(area) > kLeastArea ? 1.0F : 0.0F) * (smallest >= kOutside ? 1.0F : 0.0F) *
                (within >= 0.0F ? 1.0F : 0.0F);
    }
};

/// The longer of two corners' distances along x and y.
float apart(const Corner& a, const Corner& b) { return most(std::fabs(a.x - b.x), std::fabs(a.y - b.y)); }

/// Finds what the cells between two camera rows fill. Nearly all hold one pixel of the raster or none: these are done
/// here, in a loop without branches; those at gaps, or of several pixels, are left.
void find_pixels(const Line& above, const Line& below, float limit, int width, Cells& cells) {
    const float* __restrict ax = above.x.data();
    const float* __restrict ay = above.y.data();
    const float* __restrict cx = below.x.data();
    const float* __restrict cy = below.y.data();
    int* __restrict row = cells.row.data();
    int* __restrict column = cells.column.data();
    float* __restrict place_u = cells.u.data();
    float* __restrict place_v = cells.v.data();
    const auto v0 = static_cast<float>(above.row), v1 = static_cast<float>(below.row), end = static_cast<float>(width);
    const int count = static_cast<int>(above.x.size()) - 1;
    for (int i = 0; i < count; ++i) {
        const auto u = static_cast<float>(i), next = static_cast<float>(i + 1);
        const Corner a{ax[i], ay[i], u, v0}, b{ax[i + 1], ay[i + 1], next, v0};
        const Corner c{cx[i], cy[i], u, v1}, d{cx[i + 1], cy[i + 1], next, v1};
        const float left = least(least(a.x, b.x), least(c.x, d.x)), right = most(most(a.x, b.x), most(c.x, d.x));
        const float top = least(least(a.y, b.y), least(c.y, d.y)), bottom = most(most(a.y, b.y), most(c.y, d.y));
        // The last whole number: no coordinate is below that of the first pixel, but for rounding.
        const int x = static_cast<int>(right), y = static_cast<int>(bottom);
        const auto fx = static_cast<float>(x), fy = static_cast<float>(y);
        const Inside upper(a, b, c, fx, fy), lower(d, c, b, fx, fy);
        const float first = upper.holds, second = 1.0F - first;
        const float upper_u = upper.wa * a.u + upper.wb * b.u + upper.wc * c.u;
        const float lower_u = lower.wa * d.u + lower.wb * c.u + lower.wc * b.u;
        const float upper_v = upper.wa * a.v + upper.wb * b.v + upper.wc * c.v;
        const float lower_v = lower.wa * d.v + lower.wb * c.v + lower.wc * b.v;
        place_u[i] = first > 0.5F ? upper_u : lower_u;
        place_v[i] = first > 0.5F ? upper_v : lower_v;
        column[i] = x;
        // False for NaN.
        const float known = (apart(b, c) <= limit ? 1.0F : 0.0F) * (apart(a, b) <= limit ? 1.0F : 0.0F) *
                            (apart(a, c) <= limit ? 1.0F : 0.0F) * (apart(d, b) <= limit ? 1.0F : 0.0F) *
                            (apart(d, c) <= limit ? 1.0F : 0.0F);
        const float some = (fx >= left ? 1.0F : 0.0F) * (fy >= top ? 1.0F : 0.0F);
        const float several = some * (1.0F - (fx - 1.0F < left ? 1.0F : 0.0F) * (fy - 1.0F < top ? 1.0F : 0.0F));
        const float filled = some * (first + second * lower.holds) * (fx < end ? 1.0F : 0.0F);
        const float looked = known * (1.0F - several);
        const int pixel = filled > 0.5F ? y : kNothing;
        row[i] = looked > 0.5F ? pixel : kLookCloser;
    }
}

void fill_between(const Image<float>& source, const Band& band, const Line& above, const Line& below, float limit,
                  Cells& cells) {
    find_pixels(above, below, limit, source.width, cells);
    const auto near = [&](const Corner& a, const Corner& b) {  // false for NaN
        return std::fabs(a.x - b.x) <= limit && std::fabs(a.y - b.y) <= limit;
    };
    const std::size_t count = above.x.size() - 1;
    for (std::size_t u = 0; u < count; ++u) {
        const int row = cells.row[u];
        if (row >= band.first && row < band.end) {
            float* out = source.at(row, cells.column[u]);
            if (!std::isnan(out[0])) continue;
            out[0] = cells.u[u];
            out[1] = cells.v[u];
        } else if (row == kLookCloser) {
            const Corner a = above.at(u), b = above.at(u + 1), c = below.at(u), d = below.at(u + 1);
            if (!near(b, c)) continue;
            if (near(a, b) && near(a, c)) fill(source, band, a, b, c);
            if (near(d, b) && near(d, c)) fill(source, band, d, c, b);
        }
    }
}

}  // namespace

void rasterise_chart(const Image<const float>& coordinates, const ChartRaster& raster, double max_edge, int threads,
                     const Image<float>& source) {
    std::fill_n(source.data, source.pixels() * 2, std::numeric_limits<float>::quiet_NaN());
    const auto limit = static_cast<float>(max_edge / raster.pitch);
    // Bands of the raster side by side: every pixel meets the same triangles in the same order, whatever the bands.
    parallel_for(source.height, threads, [&](std::size_t first, std::size_t last) {
        const Band band{static_cast<int>(first), static_cast<int>(last)};
        Line above(coordinates.width), below(coordinates.width);
        Cells cells(coordinates.width);
        read_line(coordinates, raster, 0, below);
        for (int v = 1; v < coordinates.height; ++v) {
            std::swap(above, below);
            read_line(coordinates, raster, v, below);
            if (std::min(above.top, below.top) <= static_cast<float>(last) &&
                std::max(above.bottom, below.bottom) >= static_cast<float>(first))
                fill_between(source, band, above, below, limit, cells);
        }
    });
}

}  // namespace planish
