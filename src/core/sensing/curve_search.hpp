#pragma once

#include <Eigen/Core>
#include <cmath>
#include <vector>

#include "core/common/camera.hpp"
#include "core/common/image.hpp"
#include "core/common/lens.hpp"
#include "core/sensing/block_index.hpp"

namespace planish {

/// The camera that is searched; `transposed` where its maps have rows and columns exchanged.
struct OtherView {
    Image<const float> position_px, sigma_px;
    Camera camera;
    bool transposed = false;
};

/// An epipolar line in ideal pixels relative to the lens's centre: y = m x + k.
struct Line {
    float m = 0, k = 0;
};

/// A place on an epipolar curve: row v at column u, slope m = dv / du there, and the ideal column less u.
struct Spot {
    float u = 0, v = 0, m = 0, shift = 0;
};

/// Where a position lies on an epipolar curve: between columns u and u + 1, whose positions p0 and p1 enclose it.
struct Crossing {
    int u = -1;
    float p0 = 0, p1 = 0;
    Spot spot;  ///< on the curve, at or near column u

    [[nodiscard]] bool found() const { return u >= 0; }
    [[nodiscard]] float row() const { return spot.v + (static_cast<float>(u) - spot.u) * spot.m; }
};

/// Looks for positions on the epipolar curves of one camera's image.
class CurveSearch {
  public:
    /// A step of the column on the curve [px] after which the next would be below rounding: it is squared times the
    /// curvature of the distortion, 1e-3 per pixel at most.
    static constexpr float kLastStep = 0.25F;

    CurveSearch(const OtherView& view, int threads);

    [[nodiscard]] const Lens& lens() const { return lens_; }

    /// The curve at column u; `shift` is near the one there.
    [[nodiscard]] Spot locate(const Line& line, float u, float shift) const;

    /// The crossing to which the slopes lead from the predicted place along the curve, within a few pixels.
    [[nodiscard]] Crossing near(const Line& line, float target, Spot spot) const;

    /// Of all crossings of the whole curve the one nearest to `predicted_u`; where that is NaN, the only one.
    [[nodiscard]] Crossing anywhere(const Line& line, float target, float predicted_u) const;

  private:
    template <class Action>
    void scan(const Line& line, float target, int begin, float shift, const Action& action) const;
    [[nodiscard]] Crossing exact(const Line& line, Crossing crossing) const;

    Image<const float> position_;
    BlockIndex blocks_;
    Lens lens_;
    std::vector<Eigen::Vector2f> shifts_;  ///< of each block's centre to its ideal place
    float largest_ = 0;                    ///< largest shift of a row
};

}  // namespace planish
