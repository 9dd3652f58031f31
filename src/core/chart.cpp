#include "core/chart.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <vector>

#include "core/parallel.hpp"

namespace planish {
namespace {

struct Corner {
    float x, y, z;  // chart pixels, chart pixels, millimetres
    float u, v;     // camera pixels
};

/// Draws triangles into the rows [first, end) of a chart.
class Rasteriser {
  public:
    Rasteriser(const Image<float>& source, const Image<float>& height, int first, int end)
        : source_(source), height_(height), first_(first), end_(end) {}

    void triangle(const Corner& a, const Corner& b, const Corner& c) const {
        const int y0 = std::max(first_, static_cast<int>(std::ceil(std::min({a.y, b.y, c.y}))));
        const int y1 = std::min(end_ - 1, static_cast<int>(std::floor(std::max({a.y, b.y, c.y}))));
        const int x0 = std::max(0, static_cast<int>(std::ceil(std::min({a.x, b.x, c.x}))));
        const int x1 = std::min(height_.width - 1, static_cast<int>(std::floor(std::max({a.x, b.x, c.x}))));
        // Most triangles lie between the chart's pixels.
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
                const float z = wa * a.z + wb * b.z + wc * c.z;
                float& old = *height_.at(y, x);
                if (z >= old) continue;  // false for NaN: an empty pixel takes everything
                old = z;
                source_.at(y, x)[0] = wa * a.u + wb * b.u + wc * c.u;
                source_.at(y, x)[1] = wa * a.v + wb * b.v + wc * c.v;
            }
    }

  private:
    Image<float> source_, height_;
    int first_, end_;
};

/// The points of one camera row in the chart.
struct Line {
    std::vector<Corner> corners;
    float top = std::numeric_limits<float>::infinity(), bottom = -top;  ///< chart rows that it reaches
};

Line make_line(const Image<const float>& points, const Image<const float>& normals, const ChartFrame& frame,
               double min_cosine, int v) {
    constexpr float nan = std::numeric_limits<float>::quiet_NaN();
    const Eigen::Vector3d axis = -frame.R_chart_sensor.row(2);  // normals point against the chart's z
    Line line;
    line.corners.resize(points.width);
    for (int u = 0; u < points.width; ++u) {
        const float* p = points.at(v, u);
        const float* n = normals.at(v, u);
        const bool faces = n[0] * axis[0] + n[1] * axis[1] + n[2] * axis[2] >= min_cosine;
        const Eigen::Vector3d x = frame.R_chart_sensor * Eigen::Vector3d(p[0], p[1], p[2]) + frame.t_chart_sensor;
        const auto row = static_cast<float>(x[1] / frame.pitch);
        line.corners[u] = {faces ? static_cast<float>(x[0] / frame.pitch) : nan, row, static_cast<float>(x[2]),
                           static_cast<float>(u), static_cast<float>(v)};
        // False for NaN.
        if (faces && row < line.top) line.top = row;
        if (faces && row > line.bottom) line.bottom = row;
    }
    return line;
}

void draw_between(const std::vector<Corner>& above, const std::vector<Corner>& below, float limit,
                  const Rasteriser& raster) {
    const auto near = [&](const Corner& a, const Corner& b) {  // false for NaN
        return std::fabs(a.x - b.x) <= limit && std::fabs(a.y - b.y) <= limit;
    };
    for (std::size_t u = 0; u + 1 < above.size(); ++u) {
        const Corner &a = above[u], &b = above[u + 1], &c = below[u], &d = below[u + 1];
        if (!near(b, c)) continue;
        if (near(a, b) && near(a, c)) raster.triangle(a, b, c);
        if (near(d, b) && near(d, c)) raster.triangle(d, c, b);
    }
}

}  // namespace

void rasterise_chart(const Image<const float>& points, const Image<const float>& normals, const ChartFrame& frame,
                     double min_cosine, double max_edge, int threads, const Image<float>& source,
                     const Image<float>& height) {
    constexpr float nan = std::numeric_limits<float>::quiet_NaN();
    std::fill_n(source.data, source.pixels() * 2, nan);
    std::fill_n(height.data, height.pixels(), nan);
    std::vector<Line> lines(points.height);
    parallel_for(lines.size(), threads, [&](std::size_t first, std::size_t last) {
        for (std::size_t v = first; v < last; ++v)
            lines[v] = make_line(points, normals, frame, min_cosine, static_cast<int>(v));
    });
    const auto limit = static_cast<float>(max_edge / frame.pitch);
    // Bands of the chart side by side: every pixel meets the same triangles in the same order, whatever the bands.
    parallel_for(height.height, threads, [&](std::size_t first, std::size_t last) {
        const Rasteriser raster(source, height, static_cast<int>(first), static_cast<int>(last));
        for (std::size_t v = 1; v < lines.size(); ++v) {
            const Line &above = lines[v - 1], &below = lines[v];
            if (std::min(above.top, below.top) <= static_cast<float>(last) &&
                std::max(above.bottom, below.bottom) >= static_cast<float>(first))
                draw_between(above.corners, below.corners, limit, raster);
        }
    });
}

}  // namespace planish
