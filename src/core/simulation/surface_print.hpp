#pragma once

#include <Eigen/Core>
#include <vector>

namespace planish {

/// Something printed on a surface: cells of even reflectance between straight lines, and discs on top of them.
/// Both are averaged over the footprint of a sample, so that an edge lies where it is however few the samples are.
class SurfacePrint {
  public:
    struct Disc {
        double x, y, radius, factor;
    };
    /// Where the last sample was; results do not depend on it.
    struct Cursor {
        int column = 0, row = 0;
    };
    /// Derivative of the surface coordinates (s, t) across one sample: along the image's u and v [mm].
    struct Footprint {
        Eigen::Vector2d along_u = Eigen::Vector2d::Zero(), along_v = Eigen::Vector2d::Zero();
    };

    /// `x_edges`, `y_edges`: the lines between the cells, ascending [mm]; `factors`: row by row, one per cell;
    /// `linear`, `offset`: from surface coordinates to those of the print. Where the print repeats along an axis, its
    /// period is the distance of the first line to the last, and discs must be given in every period they reach into.
    SurfacePrint(std::vector<double> x_edges, std::vector<double> y_edges, std::vector<float> factors,
                 std::vector<Disc> discs, const Eigen::Matrix2d& linear, const Eigen::Vector2d& offset, bool repeat_x,
                 bool repeat_y);

    /// Factor on the reflectance of the surface; 1 beside the print.
    [[nodiscard]] double factor(double s, double t, const Footprint& footprint, Cursor& cursor) const;

  private:
    /// The cell of [edges[i], edges[i + 1]) that holds x; -1 before the first, the number of cells behind the last.
    [[nodiscard]] static int find(const std::vector<double>& edges, double x, int hint);
    [[nodiscard]] double cells(const Eigen::Vector2d& at, const Eigen::Vector2d& half, Cursor& cursor) const;
    [[nodiscard]] double on_discs(const Eigen::Vector2d& at, const Eigen::Matrix2d& span, double below) const;
    [[nodiscard]] double value(int column, int row) const;
    void index_discs();

    std::vector<double> x_edges_, y_edges_;
    std::vector<float> factors_;
    std::vector<Disc> discs_;
    Eigen::Matrix2d linear_;
    Eigen::Vector2d offset_;
    bool repeat_x_, repeat_y_;
    // Discs per square bin: those of bin i stand in bin_discs_[bin_begin_[i] .. bin_begin_[i + 1]).
    double bin_ = 1, bins_x0_ = 0, bins_y0_ = 0;
    int bins_x_ = 0, bins_y_ = 0;
    std::vector<int> bin_begin_, bin_discs_;
};

}  // namespace planish
