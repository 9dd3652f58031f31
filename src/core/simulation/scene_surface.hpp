#pragma once

#include <Eigen/Core>
#include <array>

namespace planish {

struct Ray {
    Eigen::Vector3d origin;
    Eigen::Vector3d direction;  ///< any length; `Hit::distance` counts in its length

    [[nodiscard]] Eigen::Vector3d at(double distance) const { return origin + distance * direction; }
};

struct Hit {
    double distance = 0;
    Eigen::Vector3d point;
    Eigen::Vector3d normal;  ///< unit, out of the material
    double s = 0, t = 0;     ///< surface coordinates [mm], along the surface
    int patch = -1;          ///< smooth part of the surface; -1 = no hit
};

/// A car-door panel: two curvatures, a raised character line y = y0 + slope x, an elliptic recess with steep walls.
struct Door {
    double radius_x = 4500, radius_y = 1400;
    double line_y = 60, line_slope = 0.06, line_height = 5, line_edge = 4, line_fade = 60;
    double recess_x = 180, recess_y = -60, recess_half_x = 90, recess_half_y = 42, recess_depth = 12,
           recess_wall = 0.05;

    /// Height above the object's xy plane [mm] with its slopes along x and y.
    [[nodiscard]] double height(double x, double y, double& slope_x, double& slope_y) const;
};

/// A surface in the object frame, seen from +z (cylinders: from outside; their highest line is the y axis).
struct Surface {
    enum class Kind { plate, door, cylinder, waves, step };

    Kind kind = Kind::plate;
    double half_s = 500, half_t = 350, corner = 0;  ///< outline in (s, t): rectangle with rounded corners [mm]
    double radius = 400;                            ///< cylinder; < 0: a shallow hollow, seen from inside
    double amplitude = 0.5, wavelength = 40;        ///< waves: amplitude cos(2 pi x / wavelength)
    double step = 0.2;                              ///< step: height of x >= 0 above x < 0
    Door door;

    /// First point of the surface along the ray; `hint` is a guess of its distance (any number is allowed).
    [[nodiscard]] Hit intersect(const Ray& ray, double hint) const;
    /// True where the surface itself stands between a point on it and the source at `target`.
    [[nodiscard]] bool occluded(const Hit& hit, const Eigen::Vector3d& target) const;

  private:
    [[nodiscard]] bool inside(double s, double t) const;
    [[nodiscard]] double height(double x, double y, double& slope_x, double& slope_y) const;
    [[nodiscard]] std::array<double, 2> height_range() const;
    /// Upper bound of the slope over the box around a segment of the xy plane.
    [[nodiscard]] double slope_bound(const Eigen::Vector3d& a, const Eigen::Vector3d& b) const;
    [[nodiscard]] Hit intersect_height(const Ray& ray, double hint) const;
    [[nodiscard]] Hit intersect_cylinder(const Ray& ray) const;
    [[nodiscard]] Hit intersect_step(const Ray& ray) const;
    [[nodiscard]] bool height_occluded(const Hit& hit, const Eigen::Vector3d& target) const;
};

}  // namespace planish
