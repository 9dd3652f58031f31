#pragma once

#include <Eigen/Core>

#include "core/common/image.hpp"

namespace planish {

/// Maps of one measurement at full resolution, all of one size, but for the texture.
struct JointSources {
    Image<const float> points;         ///< (H, W, 3) as measured [mm]
    Image<const float> sigma;          ///< (H, W) of a point along its ray [mm]
    Image<const float> normals;        ///< (H, W, 3), NaN where there is no surface
    Image<const float> tangents;       ///< (H, W, 6) change of the surface's point per pixel along u and v [mm]
    Image<const float> by_blur;        ///< (H, W) displacement along the normal by a blur of 1 px^2 [mm]
    Image<const float> texture_sigma;  ///< (H, W) of the texture at the whole resolution
    Image<const float> by_spline;      ///< (H, W) displacement along the normal by interpolation [mm]
    Image<const float> texture;        ///< (height, width) at every n-th pixel, NaN where it takes no part
    Image<const float> slopes;  ///< (height, width, 2) its change per pixel of the whole resolution along u and v;
                                ///< empty where the texture itself is of that resolution
};

struct JointValueOptions {
    Eigen::Vector3f centre;  ///< of the camera [mm]
    float blur, blur_sigma;  ///< variance of the images' blur and its standard deviation [px^2]
    int spacing;             ///< every n-th pixel along both axes
};

/// The channels `joint::` of every n-th pixel (height, width, joint::channels), with points corrected for interpolation
/// and for the blur.
///
/// The gradient of the texture is the tangent vector G with G . X_u = f_u, G . X_v = f_v, from its slopes f_u, f_v per
/// pixel of the whole resolution and the tangents X_u, X_v; where no slopes are given they are differences, NaN at the
/// border and beside NaN. One value of the texture stands for n^2 independent ones.
void joint_values(const JointSources& in, const JointValueOptions& options, int threads, const Image<float>& values);

}  // namespace planish
