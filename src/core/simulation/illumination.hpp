#pragma once

#include <Eigen/Core>

#include "core/common/camera.hpp"
#include "core/simulation/scene_surface.hpp"

namespace planish {

/// Everything that lights the part; positions and directions in the object frame.
struct Illumination {
    double reference_distance = 800;  ///< distance [mm] at which the projector's irradiance is 1
    double specular = 0;              ///< strength of the microfacet lobe
    double roughness = 0.3;           ///< GGX alpha
    double ambient = 0;               ///< room light, share of the projector's irradiance at the reference
    Eigen::Vector3d ambient_gradient = Eigen::Vector3d::Zero();  ///< relative change of the room light per mm
    double lamp = 0;                                             ///< irradiance of a distant lamp
    Eigen::Vector3d lamp_direction = Eigen::Vector3d::UnitZ();   ///< unit, from the part to the lamp
};

/// What a point sends to the camera per unit of the projector's pattern, and without the projector.
struct Radiance {
    double diffuse = 0;          ///< times reflectance times pattern
    double specular = 0;         ///< times pattern
    double ambient_diffuse = 0;  ///< times reflectance
    double ambient_specular = 0;
    bool lit = false;  ///< the projector reaches the point
};

/// Lambert plus GGX microfacets (Walter et al., Microfacet models for refraction through rough surfaces, EGSR 2007).
Radiance illuminate(const Surface& surface, bool self_shadow, const Hit& hit, const Eigen::Vector3d& eye,
                    const Eigen::Vector3d& projector, const Illumination& light);

}  // namespace planish
