#pragma once

#include <cstdint>

#include "core/common/image.hpp"

namespace planish {

/// Extent of a chart [mm]; empty (least > greatest) where no point of the surface belongs to it.
struct ChartExtent {
    float left, top, right, bottom;
};

/// Where each pixel of a camera lies on an unrolled surface [mm]; NaN where the surface is not that of the chart.
///
/// `nodes` (rows, columns, 13) holds, every `step` pixels from pixel (step / 2, step / 2) on: 1 (0 = no node), the axes
/// x, y and normal, and three offsets, so that a point X nearby lies at axes X + offsets = (x, y, height). A pixel
/// takes the weighted mean of the four nodes around it. Points higher than `max_height` above or below that are not of
/// this surface. `known` (H, W) takes 1 where there is a point of any surface.
ChartExtent chart_coordinates(const Image<const float>& points, const Image<const float>& nodes, int step,
                              double max_height, const Image<float>& coordinates, const Image<std::uint8_t>& known,
                              int threads);

/// A raster over an unrolled surface: pixel (column, row) has its centre at origin + (column, row) * pitch [mm].
struct ChartRaster {
    double x, y;  ///< origin
    double pitch;
};

/// For every pixel of the raster the place (u, v) on the camera's pixel grid, by linear interpolation over the two
/// triangles between four neighbouring pixels; NaN where there is none. Triangles with an edge longer than `max_edge`
/// [mm] bridge a gap and are left out; where the chart folds over itself, the first in the camera's order counts.
void rasterise_chart(const Image<const float>& coordinates, const ChartRaster& raster, double max_edge, int threads,
                     const Image<float>& source);

/// What the surface is at each pixel of a raster with `source` from `rasterise_chart`: point, unit normal, and the unit
/// tangent along the chart's x; NaN where there is none.
struct ChartSurface {
    Image<float> points, normals, x_axis;  ///< (h, w, 3)
};
void chart_surface(const Image<const float>& source, const Image<const float>& points,
                   const Image<const float>& normals, const Image<const float>& nodes, int step,
                   const ChartSurface& out, int threads);

}  // namespace planish
