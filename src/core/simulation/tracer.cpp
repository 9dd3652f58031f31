#include "core/simulation/tracer.hpp"

#include <algorithm>
#include <limits>

#include "core/common/parallel.hpp"

namespace planish {

namespace {

/// Where second differences between neighbouring pixels exceed this, rays are traced per sample instead of expanded:
/// the third-order remainder is then far below 1e-3 of a projector pixel (u, v) or a micrometre (s, t).
constexpr double kSmoothPx = 0.01, kSmoothMm = 0.01, kSmoothRadiance = 0.01;

}  // namespace

Hit Tracer::hit(const Eigen::Vector2d& pixel, RowHint& hint) const {
    const Eigen::Vector2d n = undistort(pixel, hint);
    const Ray ray{eye_, scene_.camera.R_camera_sensor.transpose() * Eigen::Vector3d(n.x(), n.y(), 1)};
    Hit hit = scene_.surface.intersect(ray, hint.distance);
    if (hit.patch >= 0) {
        hint.distance = hit.distance;
    } else if (scene_.background) {
        const auto& plane = *scene_.background;
        const double distance = plane.normal.dot(plane.origin - ray.origin) / plane.normal.dot(ray.direction);
        const Eigen::Vector3d offset = ray.at(distance) - plane.origin;
        if (distance > 0) {
            hit = {distance,        ray.at(distance), plane.normal, offset.dot(plane.axis_x), offset.dot(plane.axis_y),
                   kBackgroundPatch};
        }
    }
    return hit;
}

Sample Tracer::sample(const Eigen::Vector2d& pixel, RowHint& hint) const {
    Sample out;
    const Hit found = hit(pixel, hint);
    if (found.patch < 0) return out;
    const bool on_part = found.patch != kBackgroundPatch;
    Radiance r = illuminate(scene_.surface, on_part, found, eye_, source_, scene_.light);
    if (!on_part && r.lit) {
        // The part throws its shadow on the background.
        const Ray ray{source_, found.point - source_};
        const Hit blocker = scene_.surface.intersect(ray, 1.0);
        if (blocker.patch >= 0 && blocker.distance < 1) r.lit = false, r.diffuse = r.specular = 0;
    }
    const Eigen::Vector3d in_projector = scene_.projector.to_camera(found.point);
    Eigen::Vector2d at(-1e6, -1e6);
    if (in_projector.z() > 0) at = scene_.projector.project(found.point);
    out.value << found.s, found.t, at.x(), at.y(), r.diffuse, r.specular, r.ambient_diffuse, r.ambient_specular;
    out.patch = found.patch;
    out.lit = r.lit;
    return out;
}

Eigen::Vector2d Tracer::undistort(const Eigen::Vector2d& pixel, RowHint& hint) const {
    const Eigen::Vector2d distorted = scene_.camera.from_pixel(pixel);
    Eigen::Vector2d n = distorted;
    if (hint.count > 0) n = hint.normalised;
    if (hint.count > 1) n += hint.step;
    for (int i = 0; i < 50; ++i) {
        const Eigen::Vector2d correction = distorted - scene_.camera.distort(n);
        n += correction;
        if (correction.squaredNorm() < 1e-24) break;
    }
    if (hint.count > 0) hint.step = n - hint.normalised;
    hint.normalised = n;
    ++hint.count;
    return n;
}

Expansion::Expansion(const Sample* above, const Sample* here, const Sample* below) : here_(here) {
    smooth_ = true;
    for (const Sample* row : {above, here, below})
        for (int i = -1; i <= 1; ++i) smooth_ &= row[i].patch == here->patch && row[i].lit == here->lit;
    edge_ = !smooth_;
    if (edge_ || here->patch < 0) return;
    const auto &l = here[-1].value, &c = here->value, &r = here[1].value;
    const auto &a = above->value, &b = below->value;
    du_ = 0.5 * (r - l);
    dv_ = 0.5 * (b - a);
    duu_ = r - 2 * c + l;
    dvv_ = b - 2 * c + a;
    duv_ = 0.25 * (below[1].value - below[-1].value - above[1].value + above[-1].value);
    const Values bend = duu_.abs().max(dvv_.abs()).max(duv_.abs());
    smooth_ = bend.head<2>().maxCoeff() < kSmoothMm && bend.segment<2>(2).maxCoeff() < kSmoothPx &&
              bend.tail<4>().maxCoeff() < kSmoothRadiance;
}

Sample Expansion::at(double x, double y) const {
    Sample out;
    out.value = here_->value + du_ * x + dv_ * y + duu_ * (0.5 * x * x) + dvv_ * (0.5 * y * y) + duv_ * (x * y);
    out.value.tail<4>() = out.value.tail<4>().max(0.0);
    out.patch = here_->patch;
    out.lit = here_->lit;
    return out;
}

SurfacePrint::Footprint Expansion::footprint(int samples) const {
    if (edge_ || here_->patch < 0) return {};
    return {du_.head<2>().matrix() / samples, dv_.head<2>().matrix() / samples};
}

void trace_image(const RenderScene& scene, const std::optional<Eigen::Vector3d>& other_center, Image<double> points,
                 Image<std::uint8_t> lit, int threads) {
    const Tracer tracer(scene);
    parallel_for(points.height, threads, [&](std::size_t first, std::size_t last) {
        for (int v = static_cast<int>(first); v < static_cast<int>(last); ++v) {
            RowHint hint;
            for (int u = 0; u < points.width; ++u) {
                const Hit hit = tracer.hit({u, v}, hint);
                const bool on_part = hit.patch >= 0 && hit.patch != kBackgroundPatch;
                double* point = points.at(v, u);
                for (int i = 0; i < 3; ++i) {
                    point[i] = on_part ? hit.point[i] : std::numeric_limits<double>::quiet_NaN();
                }
                *lit.at(v, u) = on_part && !scene.surface.occluded(hit, tracer.source()) &&
                                (!other_center || !scene.surface.occluded(hit, *other_center));
            }
        }
    });
}

}  // namespace planish
