#pragma once

#include <Eigen/Core>
#include <algorithm>
#include <array>
#include <cmath>
#include <cstdlib>
#include <vector>

#include "core/sensing/curve_table.hpp"
#include "core/sensing/temporal_fit.hpp"

namespace planish {

/// Neighbouring pixels of a row that are searched on one curve: theirs differ by a fraction of a pixel.
constexpr int kTogether = 4;
/// Most places that are refined, best first.
constexpr int kMaxCandidates = 4;

struct Candidate {
    int column = -1;
    float correlation = 0;
};

/// Correlations of four own vectors with every column of a curve.
class CurveScores {
  public:
    CurveScores(const CurveTable& table, int steps) : table_(table), steps_(steps) {
        for (auto& row : scores_) row.assign(static_cast<std::size_t>(table.blocks()) * kColumnBlock, 0.0F);
        for (auto& row : highest_) row.assign(table.blocks(), 0.0F);
    }

    void compute(const std::array<OwnVector, kTogether>& own, int curve, int first, int last) {
        first_ = first;
        last_ = last;
        for (int block = first; block < last; ++block) {
            const float* unit = table_.block(curve, block);
            std::array<Block, kTogether> sum;
            for (auto& s : sum) s.setZero();
            for (int k = 0; k < steps_; ++k) {
                const BlockMap b(unit + k * kColumnBlock);
                for (int i = 0; i < kTogether; ++i) sum[i] += own[i].centred[k] * b;
            }
            for (int i = 0; i < kTogether; ++i) {
                Eigen::Map<Block>(at(i, block)) = sum[i];
                highest_[i][block] = sum[i].maxCoeff();
            }
        }
        for (int i = 0; i < kTogether; ++i)
            if (own[i].steps > 0 && own[i].steps < steps_) normalise(own[i], i, curve);
        for (int i = 0; i < kTogether; ++i) scale_[i] = own[i].norm > 0 ? 1 / own[i].norm : 0;
    }

    /// Best places above a correlation `least`, best first, no two of them nearer than `apart` columns.
    int best(int pixel, float least, int apart, std::array<Candidate, kMaxCandidates>& found) const {
        int count = 0;
        for (; count < kMaxCandidates; ++count) {
            Candidate top{-1, least / scale_[pixel]};
            for (int block = first_; block < last_; ++block) {
                if (highest_[pixel][block] <= top.correlation) continue;
                const BlockMap values(at(pixel, block));
                for (int i = 0; i < kColumnBlock; ++i) {
                    const int column = block * kColumnBlock + i;
                    if (values[i] <= top.correlation) continue;
                    const auto near = [&](const Candidate& c) { return std::abs(c.column - column) < apart; };
                    if (std::none_of(found.begin(), found.begin() + count, near)) top = {column, values[i]};
                }
            }
            if (top.column < 0) break;
            found[count] = top;
        }
        for (int i = 0; i < count; ++i) found[i].correlation *= scale_[pixel];
        return count;
    }

    /// Column of a maximum by the parabola through it and its neighbours, in columns of the grid.
    [[nodiscard]] double peak(int pixel, int column) const {
        const int end = table_.columns() - 1;
        if (column <= first_ * kColumnBlock || column >= std::min(end, last_ * kColumnBlock - 1)) return column;
        const float* s = scores_[pixel].data() + column;
        const double below = s[0] - s[-1], above = s[0] - s[1];
        return below >= 0 && above >= 0 && below + above > 0 ? column + 0.5 * (below - above) / (below + above)
                                                             : column;
    }

  private:
    using Block = Eigen::Array<float, kColumnBlock, 1>;
    using BlockMap = Eigen::Map<const Block>;

    [[nodiscard]] float* at(int pixel, int block) { return scores_[pixel].data() + block * kColumnBlock; }
    [[nodiscard]] const float* at(int pixel, int block) const { return scores_[pixel].data() + block * kColumnBlock; }

    /// Over fewer steps the other vectors have another mean and length.
    void normalise(const OwnVector& own, int pixel, int curve) {
        const float n = static_cast<float>(own.steps);
        for (int block = first_; block < last_; ++block) {
            const float* unit = table_.block(curve, block);
            Block sum = Block::Zero(), squares = Block::Zero();
            for (int k = 0; k < steps_; ++k) {
                if (own.weight[k] == 0) continue;
                const BlockMap b(unit + k * kColumnBlock);
                sum += b;
                squares += b * b;
            }
            const Block length = (squares - sum * sum / n).max(1e-12F).sqrt();
            Eigen::Map<Block> score(at(pixel, block));
            score = (squares > 0.05F).select(score / length, 0.0F);
            highest_[pixel][block] = score.maxCoeff();
        }
    }

    const CurveTable& table_;
    int steps_, first_ = 0, last_ = 0;
    std::array<std::vector<float>, kTogether> scores_, highest_;
    std::array<float, kTogether> scale_{};
};

}  // namespace planish
