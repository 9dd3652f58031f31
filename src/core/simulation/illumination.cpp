#include "core/simulation/illumination.hpp"

#include <algorithm>
#include <cmath>

namespace planish {

namespace {

/// Specular radiance per unit irradiance on a plane facing the light, in units of a white Lambert surface (hence pi).
double ggx(const Eigen::Vector3d& n, const Eigen::Vector3d& to_light, const Eigen::Vector3d& to_eye, double alpha) {
    const double nl = n.dot(to_light), nv = n.dot(to_eye);
    if (nl <= 0 || nv <= 0) return 0;
    const double nh = n.dot((to_light + to_eye).normalized()), a2 = alpha * alpha;
    const double q = nh * nh * (a2 - 1) + 1, distribution = a2 / (q * q);  // pi D, Walter et al. eq. 33
    // Height-correlated Smith term over 4 (n l)(n v): Heitz, Understanding the masking-shadowing function, JCGT 2014.
    const double visibility = 0.5 / (nl * std::sqrt(nv * nv * (1 - a2) + a2) + nv * std::sqrt(nl * nl * (1 - a2) + a2));
    return distribution * visibility * nl;
}

}  // namespace

Radiance illuminate(const Surface& surface, bool self_shadow, const Hit& hit, const Eigen::Vector3d& eye,
                    const Eigen::Vector3d& projector, const Illumination& light) {
    Radiance out;
    const Eigen::Vector3d to_eye = (eye - hit.point).normalized(), to = projector - hit.point;
    const double distance2 = to.squaredNorm();
    const Eigen::Vector3d to_projector = to / std::sqrt(distance2);
    const double cosine = hit.normal.dot(to_projector);
    out.lit = cosine > 0 && !(self_shadow && surface.occluded(hit, projector));
    if (out.lit) {
        const double irradiance = light.reference_distance * light.reference_distance / distance2;
        out.diffuse = cosine * irradiance;
        if (light.specular > 0) {
            out.specular = light.specular * irradiance * ggx(hit.normal, to_projector, to_eye, light.roughness);
        }
    }
    out.ambient_diffuse = light.ambient * std::max(0.0, 1 + light.ambient_gradient.dot(hit.point));
    if (light.lamp > 0) {
        out.ambient_diffuse += light.lamp * std::max(0.0, hit.normal.dot(light.lamp_direction));
        if (light.specular > 0) {
            out.ambient_specular =
                light.lamp * light.specular * ggx(hit.normal, light.lamp_direction, to_eye, light.roughness);
        }
    }
    return out;
}

}  // namespace planish
