#pragma once

#include <span>
#include <vector>

#include "core/registration/consensus.hpp"

namespace planish {

/// The turn about one match's normal that the most places agree on.
struct TurnVote {
    double turn = 0.0;
    int places = 0;
};

/// Lets all matches vote for the turn of one of them (see find_consensus).
class TurnVoting {
  public:
    /// `cells`: per match the number of its cell, below `cell_count`.
    TurnVoting(std::span<const FramedMatch> matches, std::span<const int> cells, int cell_count,
               const ConsensusOptions& options);

    /// The best turn of match i.
    TurnVote vote(std::size_t i);

    /// The matches that agree with a turn of match i, itself included.
    std::vector<std::size_t> voters(std::size_t i, double turn);

  private:
    struct Interval {
        std::size_t match;
        double low, high;
    };
    void collect(std::size_t i);

    std::span<const FramedMatch> matches_;
    std::span<const int> cells_;
    ConsensusOptions o_;
    std::vector<Interval> intervals_;
    std::vector<int> in_cell_;
    struct End {
        double at;
        bool closes;
        int cell;
    };
    std::vector<End> ends_;
};

}  // namespace planish
