#pragma once

#include <Eigen/Core>
#include <cstdint>
#include <span>
#include <vector>

namespace planish {

/// One scale of the grain: smooth noise on a stretched, turned lattice.
struct GrainScale {
    double along_mm, across_mm;  ///< lattice spacing along and across the brush
    double angle;                ///< direction of the brush against s [rad]
    double amplitude;            ///< rms of the relative reflectance
    std::uint32_t seed;
};

/// A single mark on the surface: relative change of the reflectance `contrast` at its middle.
struct Mark {
    enum class Kind { scratch, speck, smudge };

    Kind kind;
    double s, t, angle;              ///< middle [mm] and direction [rad]
    double half_length, half_width;  ///< scratch: half length and standard deviation across; others: half axes [mm]
    double curvature;                ///< scratch: bow, y = curvature x^2 [1/mm]
    double contrast;
};

/// Smooth aperiodic noise of unit rms over a lattice of spacing 1: cubic B-spline of independent numbers.
double lattice_noise(double x, double y, std::uint32_t seed);

/// Reflectance over surface coordinates (s, t) [mm].
class SurfaceTexture {
  public:
    SurfaceTexture(double albedo, std::vector<GrainScale> grain, std::vector<Mark> marks, double half_s, double half_t);

    /// Writes the reflectance at the places (s[i], t[i]); many at once, for the grain runs in vector registers. What
    /// comes out at a place does not depend on the others.
    void albedo(std::span<const double> s, std::span<const double> t, std::span<double> out) const;

  private:
    struct Frame {
        double along_s, along_t, across_s, across_t;  ///< rows of the map from (s, t) to the lattice
    };

    void add_grain(const GrainScale& scale, const Frame& frame, std::span<const double> s, std::span<const double> t,
                   std::span<double> out) const;
    [[nodiscard]] double marks(double s, double t) const;
    [[nodiscard]] double profile(int mark, double s, double t) const;
    void index_marks(double half_s, double half_t);

    double albedo_;
    std::vector<GrainScale> grain_;
    std::vector<Frame> frames_;
    std::vector<Mark> marks_;
    std::vector<Eigen::Vector2d> mark_axes_;  ///< unit vectors along the marks
    // Marks per square bin of the surface: those of bin i stand in bin_marks_[bin_begin_[i] .. bin_begin_[i + 1]).
    double origin_s_ = 0, origin_t_ = 0;
    int bins_s_ = 0, bins_t_ = 0;
    std::vector<int> bin_begin_, bin_marks_;
};

}  // namespace planish
