#include "core/sensing/correlate.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <vector>

#include "core/common/parallel.hpp"
#include "core/common/rejection.hpp"
#include "core/sensing/curve_scores.hpp"
#include "core/sensing/curve_table.hpp"
#include "core/sensing/epipolar.hpp"
#include "core/sensing/temporal_fit.hpp"
#include "core/sensing/temporal_support.hpp"

namespace planish {
namespace {

constexpr float kNaN = std::numeric_limits<float>::quiet_NaN();
/// Columns are left out as long as the correlation half-way between those looked at is as high.
constexpr double kStrideCorrelation = 0.95;
constexpr int kMaxStride = 4, kLags = 33;
/// Two places are different ones where the correlation between them would be lower.
constexpr double kApartCorrelation = 0.5;
/// On the grid, at most half a stride and a row beside the place, a correlation is at least so much of the true one.
constexpr float kGridShare = 0.85F;
/// A pixel whose best place loses less is a mixture of what is seen there and something else.
constexpr float kMixedLoss = 0.1F;
/// Rows of the curves at the middle column lie within so many image heights.
constexpr double kMaxHeights = 2;
constexpr int kColdIterations = 6;
constexpr Rejection kNone{};

/// Everything that belongs to one camera.
struct Prepared {
    std::vector<float> mean, norm;
    std::vector<std::uint8_t> saturated, usable;

    [[nodiscard]] TemporalStatistics statistics(int height, int width) {
        return {{mean.data(), height, width, 1}, {norm.data(), height, width, 1}, {saturated.data(), height, width, 1}};
    }
};

/// Loss of correlation by the noise of one pixel.
float noise_loss(int steps, float mean, float norm, const GreyNoise& noise) {
    return static_cast<float>(steps - 1) * (noise.offset + noise.slope * mean) / (norm * norm);
}

void prepare(const CorrelateCamera& camera, const CorrelateSettings& settings, int threads, Prepared& out) {
    const TemporalStack& stack = camera.stack;
    const std::size_t pixels = static_cast<std::size_t>(stack.height) * stack.width;
    out.mean.resize(pixels);
    out.norm.resize(pixels);
    out.saturated.resize(pixels);
    out.usable.resize(pixels);
    temporal_statistics(stack, camera.noise.saturation, threads, out.statistics(stack.height, stack.width));
    const float limit = settings.max_loss.back();
    for (std::size_t i = 0; i < pixels; ++i)
        out.usable[i] = stack.steps - out.saturated[i] >= settings.min_steps &&
                                noise_loss(stack.steps, out.mean[i], out.norm[i], camera.noise) < limit
                            ? 1
                            : 0;
}

/// Vector of an own pixel without its saturated steps; false where too few are left.
bool own_vector(const TemporalStack& stack, const GreyNoise& noise, int min_steps, int v, int u, OwnVector& out) {
    const std::uint16_t* grey = stack.at(v, u);
    float sum = 0;
    out.steps = 0;
    for (int k = 0; k < stack.steps; ++k) {
        const auto g = static_cast<float>(grey[k]);
        out.weight[k] = g < noise.saturation ? 1.0F : 0.0F;
        out.variance[k] = noise.offset + noise.slope * g;
        out.steps += out.weight[k] > 0 ? 1 : 0;
        sum += out.weight[k] * g;
    }
    if (out.steps < min_steps) return false;
    out.mean = sum / static_cast<float>(out.steps);
    float squares = 0;
    for (int k = 0; k < stack.steps; ++k) {
        out.centred[k] = out.weight[k] * (static_cast<float>(grey[k]) - out.mean);
        squares += out.centred[k] * out.centred[k];
    }
    out.norm = std::sqrt(squares);
    return true;
}

/// One row of the organising camera after the other.
class Worker {
  public:
    Worker(const CorrelateCamera& own, const CorrelateCamera& other, const TemporalView& view,
           const UnitVectorField& field, const CurveTable& table, const Eigen::Matrix3d& F,
           const CorrelateSettings& settings, int apart, const CorrelateResult& out, Image<std::uint8_t> weak,
           Image<float> loss)
        : own_(own),
          other_(other),
          table_(table),
          F_(F),
          settings_(settings),
          apart_(apart),
          out_(out),
          weak_(weak),
          loss_(loss),
          fitter_(view, field, settings.min_steps),
          scores_(table, own.stack.steps) {
        for (auto& vector : vectors_)
            for (auto* values : {&vector.centred, &vector.weight, &vector.variance})
                values->assign(own.stack.padded, 0.0F);
    }

    void row(int v) {
        for (int u = 0; u < own_.stack.width; u += kTogether) four(v, u);
    }

  private:
    void four(int v, int u) {
        const int count = std::min(kTogether, own_.stack.width - u);
        bool any = false;
        for (int i = 0; i < kTogether; ++i) {
            reasons_[i] = i < count ? vector_of(v, u + i, vectors_[i]) : kMasked;
            if (reasons_[i] != kNone) std::fill(vectors_[i].centred.begin(), vectors_[i].centred.end(), 0.0F);
            if (reasons_[i] != kNone) vectors_[i].steps = 0;
            any = any || reasons_[i] == kNone;
        }
        const int middle = std::min(u + kTogether / 2, own_.stack.width - 1);
        const int curve = any ? table_.curve(table_.crossing(line(v, middle))) : -1;
        const auto [first, last] = range(v, middle);
        const bool search = curve >= 0 && first < last;
        if (search) scores_.compute(vectors_, curve, first, last);
        for (int i = 0; i < count; ++i) {
            float* pixel = out_.pixel_px.at(v, u + i);
            pixel[0] = pixel[1] = *out_.sigma_px.at(v, u + i) = kNaN;
            Rejection reason = reasons_[i];
            if (reason == kNone && !search) reason = first < last ? kUnmatched : kMasked;
            if (reason == kNone) reason = match(v, u + i, i);
            *out_.rejected.at(v, u + i) = reason;
        }
    }

    [[nodiscard]] Rejection vector_of(int v, int u, OwnVector& vector) const {
        if (!own_vector(own_.stack, own_.noise, settings_.min_steps, v, u, vector)) return kSaturated;
        const float loss = noise_loss(vector.steps, vector.mean, vector.norm, own_.noise);
        return loss < settings_.max_loss[vector.steps] ? kNone : kDark;
    }

    [[nodiscard]] Eigen::Vector3d line(int v, int u) const { return F_ * undistorted_pixel(own_.shift_px, u, v); }

    /// Blocks of columns to be searched for the pixels around (u, v).
    [[nodiscard]] std::array<int, 2> range(int v, int u) const {
        const Image<const float>& nodes = settings_.range_px;
        if (nodes.empty()) return {0, table_.blocks()};
        float low = std::numeric_limits<float>::infinity(), high = -low;
        const int row = v / settings_.range_spacing, column = u / settings_.range_spacing;
        for (int y = std::max(row - 1, 0); y <= std::min(row + 2, nodes.height - 1); ++y)
            for (int x = std::max(column - 1, 0); x <= std::min(column + 2, nodes.width - 1); ++x) {
                const float* node = nodes.at(y, x);
                if (!(node[0] <= node[1])) continue;
                low = std::min(low, node[0]);
                high = std::max(high, node[1]);
            }
        if (!(low <= high)) return {0, 0};
        const double block = static_cast<double>(table_.stride()) * kColumnBlock;
        const auto limit = [&](double x) { return static_cast<int>(std::clamp(x, 0.0, 1.0 * table_.blocks())); };
        return {limit(std::floor((low - apart_ * table_.stride()) / block)),
                limit(std::ceil((high + apart_ * table_.stride()) / block))};
    }

    Rejection match(int v, int u, int i) {
        std::array<Candidate, kMaxCandidates> found;
        const OwnVector& own = vectors_[i];
        const float least = kGridShare * std::sqrt(1 - settings_.max_loss[own.steps]);
        const int count = scores_.best(i, least, apart_, found);
        const EpipolarCurve curve(other_.shift_px, line(v, u));
        TemporalFit best, rival;
        CurvePiece best_piece;
        bool dark = false, mixed = false;
        for (int c = 0; c < count && !(best.found && found[c].correlation < rival_correlation(best)); ++c) {
            const double start = scores_.peak(i, found[c].column) * table_.stride();
            const CurvePiece piece = piece_of(curve, start);
            TemporalFit fit = fitter_.fit(own, piece, start, false);
            // Beside edges the spline mixes two surfaces, the four pixels around perhaps not.
            if (!fit.found || (fit.loss < kMixedLoss && !fits(fit))) {
                const TemporalFit linear = fitter_.fit(own, piece, start, true);
                if (linear.found && (!fit.found || linear.misfit < fit.misfit)) fit = linear;
            }
            // Without the likeliest place the others are chance.
            if (fit.vague && !best.found) return kDark;
            if (!fit.found) continue;
            mixed = mixed || fit.loss < kMixedLoss;
            dark = dark || (misfit_allowed(fit) && !loss_allowed(fit));
            if (!fits(fit)) continue;
            if (!best.found || fit.misfit < best.misfit) {
                std::swap(best, rival);
                best = fit;
                best_piece = piece;
            } else if (!rival.found || fit.misfit < rival.misfit) {
                rival = fit;
            }
        }
        if (!best.found) return dark ? kDark : mixed ? kMixed : kUnmatched;
        const bool same = std::fabs(best.u - rival.u) < 0.5 * apart_ * table_.stride();
        if (rival.found && !same && rival.misfit - best.misfit < settings_.min_gap) return kAmbiguous;
        float* pixel = out_.pixel_px.at(v, u);
        pixel[0] = static_cast<float>(best.u);
        pixel[1] = static_cast<float>(best_piece.at(best.u));
        *out_.sigma_px.at(v, u) = best.sigma;
        *weak_.at(v, u) = std::max(best.loss, best.expected_loss) > settings_.sure_loss[best.steps] ? 1 : 0;
        *loss_.at(v, u) = best.loss;
        return kNone;
    }

    /// Correlation on the grid that another place needs at least to fit as well as `best`, but for the gap demanded.
    [[nodiscard]] float rival_correlation(const TemporalFit& best) const {
        const float per_loss = static_cast<float>(best.steps) / best.expected_loss;
        return kGridShare * std::sqrt(std::max(1 - (best.misfit + settings_.min_gap) / per_loss, 0.0F));
    }

    /// The curve near a column, a straight line: it bends by less than 1e-4 px over some pixels.
    [[nodiscard]] CurvePiece piece_of(const EpipolarCurve& curve, double u) const {
        const int left = std::clamp(static_cast<int>(u), 0, other_.stack.width - 2);
        const double v0 = curve.row(left, curve.undistorted_row(left), kColdIterations);
        const double v1 = curve.row(left + 1, v0 + curve.slope(), kColdIterations);
        return {static_cast<double>(left), v0, v1 - v0};
    }

    [[nodiscard]] bool loss_allowed(const TemporalFit& fit) const {
        return std::max(fit.loss, fit.expected_loss) <= settings_.max_loss[fit.steps];
    }
    [[nodiscard]] bool misfit_allowed(const TemporalFit& fit) const {
        // The misfit that the model's own loss makes: in units of the noise.
        return fit.misfit <= settings_.max_misfit[fit.steps] +
                                 settings_.model_loss * static_cast<float>(fit.steps) / fit.expected_loss;
    }
    [[nodiscard]] bool fits(const TemporalFit& fit) const { return loss_allowed(fit) && misfit_allowed(fit); }

    const CorrelateCamera& own_;
    const CorrelateCamera& other_;
    const CurveTable& table_;
    const Eigen::Matrix3d& F_;
    const CorrelateSettings& settings_;
    int apart_;
    const CorrelateResult& out_;
    Image<std::uint8_t> weak_;
    Image<float> loss_;
    TemporalFitter fitter_;
    CurveScores scores_;
    std::array<OwnVector, kTogether> vectors_;
    std::array<Rejection, kTogether> reasons_{};
};

/// Lowest and highest row at which curves of own pixels cross the other image's middle column: on the image's border.
Eigen::Vector2d crossings(const CorrelateCamera& own, const CorrelateCamera& other, const Eigen::Matrix3d& F) {
    const int height = own.stack.height, width = own.stack.width;
    double low = std::numeric_limits<double>::infinity(), high = -low;
    const auto visit = [&](int v, int u) {
        const Eigen::Vector3d line = F * undistorted_pixel(own.shift_px, u, v);
        const double row = -(line.x() * 0.5 * other.stack.width + line.z()) / line.y();
        low = std::min(low, row);
        high = std::max(high, row);
    };
    for (int v = 0; v < height; ++v)
        for (const int u : {0, width - 1}) visit(v, u);
    for (int u = 0; u < width; ++u)
        for (const int v : {0, height - 1}) visit(v, u);
    const double most = kMaxHeights * other.stack.height;
    return {std::max(low - 1, -most), std::min(high + 1, most)};
}

/// First lag at which the correlation falls below a limit.
int lag_below(const std::vector<double>& correlation, double limit) {
    for (std::size_t lag = 1; lag < correlation.size(); ++lag)
        if (correlation[lag] < limit) return static_cast<int>(lag);
    return static_cast<int>(correlation.size());
}

int stride_of(const std::vector<double>& correlation) {
    int stride = 1;
    for (int s = 2; s <= kMaxStride; ++s) {
        const double half = s % 2 == 0 ? correlation[s / 2] : 0.5 * (correlation[s / 2] + correlation[s / 2 + 1]);
        if (half < kStrideCorrelation) break;
        stride = s;
    }
    return stride;
}

}  // namespace

void correlate(const CorrelateCamera& own, const CorrelateCamera& other, const Eigen::Matrix3d& F,
               const CorrelateSettings& settings, int threads, const CorrelateResult& out) {
    const TemporalStack& stack = other.stack;
    Prepared prepared;
    prepare(other, settings, threads, prepared);
    const TemporalStatistics statistics = prepared.statistics(stack.height, stack.width);
    const TemporalView view{stack, statistics, {prepared.usable.data(), stack.height, stack.width, 1}, other.noise};
    const UnitVectorField field(stack, statistics, view.usable, threads);
    const std::vector<double> correlation = column_correlation(view, std::min(kLags, stack.width));
    const int stride = stride_of(correlation), apart = lag_below(correlation, kApartCorrelation) / stride + 1;
    const CurveTable table(view, other.shift_px, epipole_of(F), stride, crossings(own, other, F), threads);
    std::vector<std::uint8_t> weak(out.sigma_px.pixels());
    std::vector<float> loss(weak.size());
    const Image<float> loss_view{loss.data(), own.stack.height, own.stack.width, 1};
    const Image<std::uint8_t> weak_view{weak.data(), own.stack.height, own.stack.width, 1};
    parallel_for(static_cast<std::size_t>(own.stack.height), threads, [&](std::size_t begin, std::size_t end) {
        Worker worker(own, other, view, field, table, F, settings, apart, out, weak_view, loss_view);
        for (std::size_t v = begin; v < end; ++v) worker.row(static_cast<int>(v));
    });
    drop_contested({loss.data(), own.stack.height, own.stack.width, 1}, stack.height, stack.width, out.pixel_px,
                   out.sigma_px, out.rejected);
    drop_unsupported({weak.data(), own.stack.height, own.stack.width, 1}, threads, out.pixel_px, out.sigma_px,
                     out.rejected);
}

}  // namespace planish
