#pragma once

#include <Eigen/Core>
#include <cstdint>
#include <optional>

#include "core/common/camera.hpp"
#include "core/common/image.hpp"
#include "core/simulation/illumination.hpp"
#include "core/simulation/scene_surface.hpp"
#include "core/simulation/surface_print.hpp"
#include "core/simulation/surface_texture.hpp"

namespace planish {

/// A textured plane behind the part that does not move with it; vectors in the object frame.
struct BackgroundPlane {
    Eigen::Vector3d origin, axis_x, axis_y, normal;
    SurfaceTexture texture;
};

/// A part in front of one camera and the projector. Their `sensor` frame is the object frame here.
struct RenderScene {
    Camera camera, projector;
    Surface surface;
    SurfaceTexture texture;
    Illumination light;
    std::optional<BackgroundPlane> background;
    std::optional<SurfacePrint> print;
};

inline constexpr int kBackgroundPatch = 1000;

/// What the camera meets along one ray.
struct Sample {
    /// Surface coordinates s, t [mm], projector coordinates u, v [px], then the parts of Radiance.
    enum Slot { s, t, u, v, diffuse, specular, ambient_diffuse, ambient_specular };

    Eigen::Array<double, 8, 1> value = Eigen::Array<double, 8, 1>::Zero();
    int patch = -1;
    bool lit = false;
};

/// Follows a row of pixels: where the last rays went is the start for the next. Results do not depend on it beyond
/// rounding; every row starts anew, so that they do not depend on how rows are shared among threads either.
struct RowHint {
    double distance = -1;
    Eigen::Vector2d normalised = Eigen::Vector2d::Zero(), step = Eigen::Vector2d::Zero();
    int count = 0;
};

/// Follows the rays of one camera to the part or the background.
class Tracer {
  public:
    explicit Tracer(const RenderScene& scene)
        : scene_(scene), eye_(scene.camera.center_sensor()), source_(scene.projector.center_sensor()) {}

    [[nodiscard]] Hit hit(const Eigen::Vector2d& pixel, RowHint& hint) const;
    [[nodiscard]] Sample sample(const Eigen::Vector2d& pixel, RowHint& hint) const;
    [[nodiscard]] const Eigen::Vector3d& source() const { return source_; }

  private:
    /// Fixed-point iteration as in Camera::undistort, started from the continuation of the row.
    [[nodiscard]] Eigen::Vector2d undistort(const Eigen::Vector2d& pixel, RowHint& hint) const;

    const RenderScene& scene_;
    Eigen::Vector3d eye_, source_;
};

/// Second-order expansion of the samples around one pixel, from its eight neighbours.
class Expansion {
  public:
    /// `above`, `here`, `below` point to the same column of three rows.
    Expansion(const Sample* above, const Sample* here, const Sample* below);

    /// False where an edge or a strong bend forbids the expansion.
    [[nodiscard]] bool smooth() const { return smooth_; }
    /// True where neighbours lie on another patch, in shadow or beside the part.
    [[nodiscard]] bool edge() const { return edge_; }
    /// The sample at an offset of up to half a pixel.
    [[nodiscard]] Sample at(double x, double y) const;
    /// How far one of `samples` per pixel and axis reaches on the surface; a point at edges.
    [[nodiscard]] SurfacePrint::Footprint footprint(int samples) const;

  private:
    using Values = Eigen::Array<double, 8, 1>;
    const Sample* here_;
    bool smooth_, edge_;
    Values du_, dv_, duu_, dvv_, duv_;
};

/// Points (object frame, NaN where none) at the pixel centres; `lit` = 1 where the projector reaches the point and
/// `other_center`, the second camera, sees it as far as the surface itself is concerned.
void trace_image(const RenderScene& scene, const std::optional<Eigen::Vector3d>& other_center, Image<double> points,
                 Image<std::uint8_t> lit, int threads);

}  // namespace planish
