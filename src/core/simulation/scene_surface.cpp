#include "core/simulation/scene_surface.hpp"

#include <algorithm>
#include <cmath>
#include <numbers>

namespace planish {

namespace {

/// Newton stops after a step shorter than this [mm]: the error left is its square times half the curvature (<= 1 / mm).
constexpr double kNewtonStep = 1e-5;
/// A root of the height equation must be met to this [mm]; a bracket without a root fails it by far.
constexpr double kResidual = 1e-9;
/// Shortest march step [mm]: nothing thinner occurs.
constexpr double kMarchStep = 0.02;
/// Beyond this normalised radius, in units of the wall, the recess is below 1e-12 mm.
constexpr double kRecessReach = 32.0;

Hit make_hit(const Ray& ray, double distance, const Eigen::Vector3d& normal, double s, double t, int patch) {
    return {distance, ray.at(distance), normal, s, t, patch};
}

}  // namespace

double Door::height(double x, double y, double& slope_x, double& slope_y) const {
    double z = -x * x / (2 * radius_x) - y * y / (2 * radius_y);
    slope_x = -x / radius_x;
    slope_y = -y / radius_y;

    // Character line: a rounded ridge whose flanks run out over `line_fade`.
    const double d = (y - line_y - line_slope * x), q = std::sqrt(d * d + line_edge * line_edge);
    const double ridge = line_height * std::exp(-(q - line_edge) / line_fade), along = -ridge * d / (q * line_fade);
    z += ridge;
    slope_x -= along * line_slope;
    slope_y += along;

    const double ex = (x - recess_x) / recess_half_x, ey = (y - recess_y) / recess_half_y, r2 = ex * ex + ey * ey;
    const double reach = 1 + kRecessReach * recess_wall;
    if (r2 < reach * reach) {
        const double r = std::sqrt(r2), e = std::exp((r - 1) / recess_wall), depth = recess_depth / (1 + e);
        z -= depth;
        if (r > 0) {
            const double fall = depth * e / ((1 + e) * recess_wall * r);
            slope_x += fall * ex / recess_half_x;
            slope_y += fall * ey / recess_half_y;
        }
    }
    return z;
}

bool Surface::inside(double s, double t) const {
    const double ds = std::abs(s) - half_s, dt = std::abs(t) - half_t;
    if (ds > 0 || dt > 0) return false;
    const double cs = ds + corner, ct = dt + corner;
    return !(cs > 0 && ct > 0) || cs * cs + ct * ct <= corner * corner;
}

double Surface::height(double x, double y, double& slope_x, double& slope_y) const {
    if (kind == Kind::door) return door.height(x, y, slope_x, slope_y);
    slope_x = slope_y = 0;
    if (kind != Kind::waves) return 0;
    const double k = 2 * std::numbers::pi / wavelength;
    slope_x = -amplitude * k * std::sin(k * x);
    return amplitude * std::cos(k * x);
}

std::array<double, 2> Surface::height_range() const {
    if (kind == Kind::waves) return {-amplitude - 1e-3, amplitude + 1e-3};
    if (kind != Kind::door) return {-1e-3, 1e-3};
    const double low = half_s * half_s / (2 * door.radius_x) + half_t * half_t / (2 * door.radius_y);
    return {-low - door.recess_depth - 1e-3, door.line_height + 1e-3};
}

double Surface::slope_bound(const Eigen::Vector3d& a, const Eigen::Vector3d& b) const {
    if (kind == Kind::waves) return amplitude * 2 * std::numbers::pi / wavelength;
    if (kind != Kind::door) return 0;
    const Door& d = door;
    const double x = std::max(std::abs(a.x()), std::abs(b.x())), y = std::max(std::abs(a.y()), std::abs(b.y()));
    const double base = x / d.radius_x + y / d.radius_y;
    const double ridge = d.line_height / d.line_fade * (1 + std::abs(d.line_slope));
    const double reach = 1 + kRecessReach * d.recess_wall;
    const double rx = reach * d.recess_half_x, ry = reach * d.recess_half_y;
    const bool away = std::max(a.x(), b.x()) < d.recess_x - rx || std::min(a.x(), b.x()) > d.recess_x + rx ||
                      std::max(a.y(), b.y()) < d.recess_y - ry || std::min(a.y(), b.y()) > d.recess_y + ry;
    // The logistic wall is steepest at its middle: depth / 4 per wall width.
    const double wall = d.recess_depth / (4 * d.recess_wall * std::min(d.recess_half_x, d.recess_half_y));
    return base + ridge + (away ? 0 : wall);
}

Hit Surface::intersect(const Ray& ray, double hint) const {
    if (kind == Kind::cylinder) return intersect_cylinder(ray);
    if (kind == Kind::step) return intersect_step(ray);
    return intersect_height(ray, hint);
}

Hit Surface::intersect_height(const Ray& ray, double hint) const {
    if (!(ray.direction.z() < 0)) return {};
    const auto [low, high] = height_range();
    double near = (high - ray.origin.z()) / ray.direction.z(), far = (low - ray.origin.z()) / ray.direction.z();
    double sx, sy;
    const auto above = [&](double distance) {
        const Eigen::Vector3d p = ray.at(distance);
        return p.z() - height(p.x(), p.y(), sx, sy);
    };
    const double length = ray.direction.norm();
    const double down = -ray.direction.z(), across = ray.direction.head<2>().norm();
    const double bound = slope_bound(ray.at(near), ray.at(far));
    if (bound * across >= down) {
        // The ray may meet the surface several times: walk, never further than the surface can come near.
        double previous = near;
        for (double value = above(near); value >= 0 && near < far; value = above(near)) {
            previous = near;
            near += std::max(value / (down + bound * across), kMarchStep / length);
        }
        far = std::min(near, far);
        near = previous;
    }
    double distance = hint > near && hint < far ? hint : 0.5 * (near + far);
    for (int i = 0; i < 100; ++i) {
        const double value = above(distance);
        (value >= 0 ? near : far) = distance;
        double next = distance - value / (ray.direction.z() - sx * ray.direction.x() - sy * ray.direction.y());
        const bool newton = next >= near && next <= far;
        if (!newton) next = 0.5 * (near + far);
        const double step = std::abs(next - distance) * length;
        distance = next;
        if ((newton && step < kNewtonStep) || step < kResidual) break;
    }
    if (std::abs(above(distance)) > kResidual) return {};
    const Eigen::Vector3d p = ray.at(distance);
    if (!inside(p.x(), p.y())) return {};
    return make_hit(ray, distance, Eigen::Vector3d(-sx, -sy, 1).normalized(), p.x(), p.y(), 0);
}

Hit Surface::intersect_cylinder(const Ray& ray) const {
    const double ox = ray.origin.x(), oz = ray.origin.z() + radius, dx = ray.direction.x(), dz = ray.direction.z();
    const double a = dx * dx + dz * dz, b = ox * dx + oz * dz, c = ox * ox + oz * oz - radius * radius;
    const double discriminant = b * b - a * c;
    const bool hollow = radius < 0;
    if (!(discriminant > 0) || !(hollow || b < 0)) return {};
    // From outside the nearer root without cancellation, c / (-b + sqrt) instead of (-b - sqrt) / a; from inside the
    // further one.
    const double root = std::sqrt(discriminant);
    const double distance = !hollow ? c / (-b + root) : b > 0 ? -c / (b + root) : (root - b) / a;
    const double sign = hollow ? -1.0 : 1.0;
    const Eigen::Vector3d p = ray.at(distance), normal(p.x() / radius, 0, (p.z() + radius) / radius);
    const double s = radius * std::atan2(sign * p.x(), sign * (p.z() + radius));
    if (!inside(s, p.y())) return {};
    return make_hit(ray, distance, normal, s, p.y(), 0);
}

Hit Surface::intersect_step(const Ray& ray) const {
    Hit best;
    const auto offer = [&](double distance, const Eigen::Vector3d& normal, int patch) {
        if (best.patch >= 0 && distance >= best.distance) return;
        const Eigen::Vector3d p = ray.at(distance);
        const bool on = patch == 0   ? p.x() < 0
                        : patch == 1 ? p.x() >= 0
                                     : p.z() > std::min(0.0, step) && p.z() < std::max(0.0, step);
        if (on && inside(p.x(), p.y())) best = make_hit(ray, distance, normal, p.x(), p.y(), patch);
    };
    const double rise = step > 0 ? 1.0 : -1.0;
    if (ray.direction.z() < 0) {
        offer(-ray.origin.z() / ray.direction.z(), Eigen::Vector3d::UnitZ(), 0);
        offer((step - ray.origin.z()) / ray.direction.z(), Eigen::Vector3d::UnitZ(), 1);
    }
    if (rise * ray.direction.x() > 0) {
        offer(-ray.origin.x() / ray.direction.x(), -rise * Eigen::Vector3d::UnitX(), 2);
    }
    return best;
}

bool Surface::occluded(const Hit& hit, const Eigen::Vector3d& target) const {
    const Eigen::Vector3d to = target - hit.point;
    if (hit.normal.dot(to) <= 0) return true;
    if (kind == Kind::door || kind == Kind::waves) return height_occluded(hit, target);
    if (kind != Kind::step || hit.point.x() * to.x() >= 0) return false;
    const double z_at_wall = hit.point.z() - hit.point.x() / to.x() * to.z();
    return z_at_wall < std::max(0.0, step);
}

bool Surface::height_occluded(const Hit& hit, const Eigen::Vector3d& target) const {
    const Eigen::Vector3d to = (target - hit.point).normalized();
    if (to.z() <= 0) return true;
    const double across = to.head<2>().norm(), end = (height_range()[1] - hit.point.z()) / to.z();
    const double closing = slope_bound(hit.point, hit.point + end * to) * across - to.z();
    if (closing <= 0) return false;  // the line of sight leaves the surface faster than it can rise
    double sx, sy;
    for (double distance = kMarchStep; distance < end;) {
        const Eigen::Vector3d p = hit.point + distance * to;
        const double above = p.z() - height(p.x(), p.y(), sx, sy);
        if (above < 0) return true;
        distance += std::max(above / closing, kMarchStep);
    }
    return false;
}

}  // namespace planish
