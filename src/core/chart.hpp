#pragma once

#include <Eigen/Core>

#include "core/image.hpp"

namespace planish {

/// A plane raster over a surface: pixel (column, row) has its centre at (column, row) * pitch in the chart's frame.
struct ChartFrame {
    Eigen::Matrix3d R_chart_sensor;
    Eigen::Vector3d t_chart_sensor;
    double pitch;
};

/// For every chart pixel the place (u, v) on the camera's pixel grid and the height (chart z) of the surface above it,
/// by linear interpolation over the two triangles between four neighbouring points. Where surfaces lie over each other
/// the one nearer to the sensor (least z) counts. Points whose normal leaves `min_cosine` of the chart's axis are left
/// out.
void rasterise_chart(const Image<const float>& points, const Image<const float>& normals, const ChartFrame& frame,
                     double min_cosine, double max_edge, const Image<float>& source, const Image<float>& height);

}  // namespace planish
