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
                     double min_cosine, double max_edge, int threads, const Image<float>& source,
                     const Image<float>& height);

/// Value and standard deviation of a map at the places `source` of a chart, by cubic convolution. Where chart pixels
/// are larger than the map's, the kernel widens with them: what the chart cannot show is averaged, not folded into it.
/// `sigma` is that of errors of which the share `interpolated` of the variance has been read by cubic convolution
/// before, so that neighbours share it; the rest is independent. NaN where the kernel's core meets NaN; its outer part
/// leaves NaN out.
void sample_chart(const Image<const float>& value, const Image<const float>& sigma, const Image<const float>& source,
                  float interpolated, int threads, const Image<float>& out_value, const Image<float>& out_sigma);

}  // namespace planish
