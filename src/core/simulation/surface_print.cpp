#include "core/simulation/surface_print.hpp"

#include <algorithm>
#include <cmath>
#include <utility>

namespace planish {

namespace {

double wrapped(double x, const std::vector<double>& edges) {
    const double period = edges.back() - edges.front(), turns = std::floor((x - edges.front()) / period);
    return x - turns * period;
}

/// Share of [low, high] within cell i of the edges; what lies before the first or behind the last has its own cell.
double overlap(const std::vector<double>& edges, int i, double low, double high) {
    const int cells = static_cast<int>(edges.size()) - 1;
    const double a = i < 0 ? low : std::max(low, edges[i]), b = i >= cells ? high : std::min(high, edges[i + 1]);
    return (b - a) / (high - low);
}

}  // namespace

SurfacePrint::SurfacePrint(std::vector<double> x_edges, std::vector<double> y_edges, std::vector<float> factors,
                           std::vector<Disc> discs, const Eigen::Matrix2d& linear, const Eigen::Vector2d& offset,
                           bool repeat_x, bool repeat_y)
    : x_edges_(std::move(x_edges)),
      y_edges_(std::move(y_edges)),
      factors_(std::move(factors)),
      discs_(std::move(discs)),
      linear_(linear),
      offset_(offset),
      repeat_x_(repeat_x),
      repeat_y_(repeat_y) {
    index_discs();
}

void SurfacePrint::index_discs() {
    if (discs_.empty()) return;
    double x1 = discs_[0].x, y1 = discs_[0].y, widest = 0;
    bins_x0_ = x1, bins_y0_ = y1;
    for (const Disc& d : discs_) {
        bins_x0_ = std::min(bins_x0_, d.x - 2 * d.radius), x1 = std::max(x1, d.x + 2 * d.radius);
        bins_y0_ = std::min(bins_y0_, d.y - 2 * d.radius), y1 = std::max(y1, d.y + 2 * d.radius);
        widest = std::max(widest, 2 * d.radius);
    }
    // Bins of a disc's width, but never more of them than a few per disc.
    bin_ = std::max(widest, std::sqrt((x1 - bins_x0_) * (y1 - bins_y0_) / (4.0 * static_cast<double>(discs_.size()))));
    bins_x_ = static_cast<int>((x1 - bins_x0_) / bin_) + 1;
    bins_y_ = static_cast<int>((y1 - bins_y0_) / bin_) + 1;
    std::vector<std::pair<int, int>> entries;
    for (int k = 0; k < static_cast<int>(discs_.size()); ++k) {
        // Twice the radius: a footprint may reach in from outside.
        const Disc& d = discs_[k];
        const auto cell = [&](double x, double origin, int bins) {
            return std::clamp(static_cast<int>((x - origin) / bin_), 0, bins - 1);
        };
        for (int j = cell(d.y - 2 * d.radius, bins_y0_, bins_y_); j <= cell(d.y + 2 * d.radius, bins_y0_, bins_y_); ++j)
            for (int i = cell(d.x - 2 * d.radius, bins_x0_, bins_x_); i <= cell(d.x + 2 * d.radius, bins_x0_, bins_x_);
                 ++i)
                entries.emplace_back(j * bins_x_ + i, k);
    }
    std::sort(entries.begin(), entries.end());
    bin_begin_.assign(static_cast<std::size_t>(bins_x_) * bins_y_ + 1, 0);
    for (const auto& [bin, disc] : entries) {
        ++bin_begin_[bin + 1];
        bin_discs_.push_back(disc);
    }
    for (std::size_t i = 1; i < bin_begin_.size(); ++i) bin_begin_[i] += bin_begin_[i - 1];
}

int SurfacePrint::find(const std::vector<double>& edges, double x, int hint) {
    const int cells = static_cast<int>(edges.size()) - 1;
    if (hint >= 0 && hint < cells && x >= edges[hint] && x < edges[hint + 1]) return hint;
    return static_cast<int>(std::upper_bound(edges.begin(), edges.end(), x) - edges.begin()) - 1;
}

double SurfacePrint::value(int column, int row) const {
    const int columns = static_cast<int>(x_edges_.size()) - 1, rows = static_cast<int>(y_edges_.size()) - 1;
    if (repeat_x_) column = (column + columns) % columns;
    if (repeat_y_) row = (row + rows) % rows;
    if (column < 0 || row < 0 || column >= columns || row >= rows) return 1;
    return factors_[static_cast<std::size_t>(row) * columns + column];
}

double SurfacePrint::cells(const Eigen::Vector2d& at, const Eigen::Vector2d& half, Cursor& cursor) const {
    cursor.column = find(x_edges_, at.x(), cursor.column);
    cursor.row = find(y_edges_, at.y(), cursor.row);
    const double x0 = at.x() - half.x(), x1 = at.x() + half.x(), y0 = at.y() - half.y(), y1 = at.y() + half.y();
    const int columns = static_cast<int>(x_edges_.size()) - 1, rows = static_cast<int>(y_edges_.size()) - 1;
    int left = cursor.column, right = left, top = cursor.row, bottom = top;
    while (left >= 0 && x0 < x_edges_[left]) --left;
    while (right < columns && x1 > x_edges_[right + 1]) ++right;
    while (top >= 0 && y0 < y_edges_[top]) --top;
    while (bottom < rows && y1 > y_edges_[bottom + 1]) ++bottom;
    if (left == right && top == bottom) return value(left, top);
    double sum = 0;
    for (int j = top; j <= bottom; ++j) {
        const double share = top == bottom ? 1 : overlap(y_edges_, j, y0, y1);
        for (int i = left; i <= right; ++i) {
            sum += share * (left == right ? 1 : overlap(x_edges_, i, x0, x1)) * value(i, j);
        }
    }
    return sum;
}

double SurfacePrint::on_discs(const Eigen::Vector2d& at, const Eigen::Matrix2d& span, double below) const {
    const int i = static_cast<int>(std::floor((at.x() - bins_x0_) / bin_));
    const int j = static_cast<int>(std::floor((at.y() - bins_y0_) / bin_));
    if (i < 0 || j < 0 || i >= bins_x_ || j >= bins_y_) return below;
    const std::size_t bin = static_cast<std::size_t>(j) * bins_x_ + i;
    for (int k = bin_begin_[bin]; k < bin_begin_[bin + 1]; ++k) {
        const Disc& d = discs_[bin_discs_[k]];
        const Eigen::Vector2d from(at.x() - d.x, at.y() - d.y);
        const double distance = from.norm(), inside = d.radius - distance;
        // The footprint's width across the edge; a disc's edge is straight as far as a footprint goes.
        const double width = distance > 0 ? (span.transpose() * from).norm() / distance : span.norm();
        const double share = width > 0 ? std::clamp(0.5 + inside / width, 0.0, 1.0) : (inside >= 0 ? 1.0 : 0.0);
        below += share * (d.factor - below);
    }
    return below;
}

double SurfacePrint::factor(double s, double t, const Footprint& footprint, Cursor& cursor) const {
    Eigen::Vector2d at = linear_ * Eigen::Vector2d(s, t) + offset_;
    Eigen::Matrix2d span;
    span.col(0) = linear_ * footprint.along_u;
    span.col(1) = linear_ * footprint.along_v;
    if (repeat_x_) at.x() = wrapped(at.x(), x_edges_);
    if (repeat_y_) at.y() = wrapped(at.y(), y_edges_);
    // The box with the second moments of the parallelogram: no edge is moved, whatever its direction.
    double factor = cells(at, 0.5 * span.rowwise().norm(), cursor);
    if (!discs_.empty()) factor = on_discs(at, span, factor);
    return factor;
}

}  // namespace planish
