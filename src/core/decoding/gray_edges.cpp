#include "core/decoding/gray_edges.hpp"

#include <algorithm>
#include <bit>
#include <cmath>
#include <limits>

#include "core/common/parallel.hpp"
#include "core/common/rejection.hpp"

namespace planish {
namespace {

constexpr float kNaN = std::numeric_limits<float>::quiet_NaN();
/// Signals beyond are in the flat part of an edge: their place says nothing.
constexpr float kLargestSignal = 0.97F;
/// So many edges between two pixels are still one surface: cells half as wide as a pixel.
constexpr std::int32_t kMaxStep = 2;
/// Variance of 2 I - high - low over that of I, where high and low are the extremes of about six images each: 4 from I,
/// 0.42 from either (order statistics of the normal distribution).
constexpr float kThresholdNoise = 4.84F;
/// Edges this far apart [px] are blurred each for itself; nearer ones lean on each other.
constexpr float kFreeSpacing = 3.0F;
/// Below this spacing [px] a stripe is hardly wider than the blur, and the lean grows so many times as fast.
constexpr float kNarrowSpacing = 1.2F, kNarrowGrowth = 2.0F;
/// Successive edges nearer than this [px] have been swapped by noise.
constexpr float kMinSpacing = 0.05F;

/// Inverse of the normal distribution at (1 + s) / 2: Giles, "Approximating the erfinv function", GPU Computing Gems 2,
/// 2011, single precision, central branch (|s| < 0.9966).
float normal_score(float s) {
    s = std::clamp(s, -kLargestSignal, kLargestSignal);
    const float w = -std::log((1 - s) * (1 + s)) - 2.5F;
    float p = 2.81022636e-08F;
    p = 3.43273939e-07F + p * w;
    p = -3.5233877e-06F + p * w;
    p = -4.39150654e-06F + p * w;
    p = 0.00021858087F + p * w;
    p = -0.00125372503F + p * w;
    p = -0.00417768164F + p * w;
    p = 0.246640727F + p * w;
    p = 1.50140941F + p * w;
    return 1.41421356F * p * s;
}

/// d score / d s = 1 / (2 phi(score)), phi the normal density.
float score_slope(float score) { return 1.25331414F * std::exp(0.5F * score * score); }

struct Edge {
    float at = 0, variance = 0;  ///< place along the line [px]
    std::int32_t boundary = 0;   ///< between cells boundary - 1 and boundary
    std::int32_t chain = 0;      ///< edges of one chain have no gap between them
};

struct Line {
    std::vector<float> signal;  ///< one row per bit, from the most significant on
    std::vector<float> variance, amplitude, mean;
    std::vector<std::int32_t> cell;
    std::vector<std::uint16_t> rejected;
    std::vector<Edge> edges;

    Line(std::size_t width, std::size_t bits)
        : signal(width * bits), variance(width), amplitude(width), mean(width), cell(width), rejected(width) {}
};

template <class T>
class Decoder {
  public:
    Decoder(const std::vector<GrayBit<T>>& bits, const T* white, const T* black, const GrayEdgeSettings& settings,
            const GrayEdgeResult& out)
        : bits_(bits),
          white_(white),
          black_(black),
          settings_(settings),
          out_(out),
          width_(static_cast<std::size_t>(out.position_px.width)),
          inverses_(std::all_of(bits.begin(), bits.end(), [](const auto& bit) { return bit.inverse != nullptr; })) {}

    void decode_row(int v, Line& line) const {
        const std::size_t offset = static_cast<std::size_t>(v) * width_;
        for (std::size_t u = 0; u < width_; ++u) read_pixel(offset + u, u, line);
        find_edges(line);
        merge_repeated(line.edges);
        write(v, line);
    }

  private:
    /// Amplitude, signals and cell of one pixel.
    void read_pixel(std::size_t pixel, std::size_t u, Line& line) const {
        float low = std::numeric_limits<float>::max(), high = 0, sum = 0;
        bool both_clipped = false;
        const auto look = [&](const T* image) {
            const auto grey = static_cast<float>(image[pixel]);
            low = std::min(low, grey);
            high = std::max(high, grey);
            return grey;
        };
        for (const auto& bit : bits_) {
            const float lit = look(bit.image);
            if (!inverses_) continue;
            const float unlit = look(bit.inverse);
            sum += lit + unlit;
            both_clipped = both_clipped || std::min(lit, unlit) >= settings_.saturation;
        }
        if (white_ != nullptr) look(white_);
        if (black_ != nullptr) look(black_);
        const float amplitude = high - low, per_amplitude = 1 / std::max(amplitude, 1.0F);
        // Where lit and unlit are alike, both are at half of the light. A signal I - I' has the noise of two images.
        const float noise = settings_.noise_offset + settings_.noise_slope * 0.5F * (high + low);
        line.amplitude[u] = amplitude;
        line.mean[u] = inverses_ ? sum / (2 * static_cast<float>(bits_.size())) : 0.5F * (high + low);
        line.variance[u] = (inverses_ ? 2.0F : kThresholdNoise) * noise * per_amplitude * per_amplitude;
        std::int32_t cell = 0;
        for (std::size_t b = 0; b < bits_.size(); ++b) {
            const auto lit = static_cast<float>(bits_[b].image[pixel]);
            const float difference =
                inverses_ ? lit - static_cast<float>(bits_[b].inverse[pixel]) : 2 * lit - high - low;
            line.signal[b * width_ + u] = difference * per_amplitude;
            // Binary bit = Gray bit XOR the binary bit above it.
            cell = 2 * cell + ((cell & 1) ^ (difference > 0 ? 1 : 0));
        }
        line.cell[u] = cell;
        // With inverse images a clipped value changes both sides of an edge alike, and its middle stays where it is.
        const bool clipped = inverses_ ? both_clipped : high >= settings_.saturation;
        const bool dark = !(line.variance[u] <= settings_.max_signal_sigma * settings_.max_signal_sigma);
        line.rejected[u] = static_cast<std::uint16_t>((clipped ? kSaturated : 0) | (dark ? kDark : 0));
    }

    void find_edges(Line& line) const {
        line.edges.clear();
        std::int32_t chain = 0;
        for (std::size_t u = 0; u + 1 < width_; ++u) {
            const std::int32_t here = line.cell[u], step = line.cell[u + 1] - here;
            if ((line.rejected[u] | line.rejected[u + 1]) != 0 || std::abs(step) > kMaxStep) {
                ++chain;
                continue;
            }
            for (std::int32_t k = 0; k < std::abs(step); ++k) {
                const std::int32_t boundary = step > 0 ? here + 1 + k : here - k;
                line.edges.push_back(locate(line, u, boundary, chain));
            }
        }
    }

    Edge locate(const Line& line, std::size_t u, std::int32_t boundary, std::int32_t chain) const {
        // The reflected code changes in one bit at each boundary: that of its number's lowest set bit.
        const std::size_t b =
            bits_.size() - 1 - static_cast<std::size_t>(std::countr_zero(static_cast<unsigned>(boundary)));
        const float* signal = line.signal.data() + b * width_;
        const float before = normal_score(signal[u]), after = normal_score(signal[u + 1]);
        const float span = before - after, f = before / span;
        const float noise_before = score_slope(before) * score_slope(before) * line.variance[u];
        const float noise_after = score_slope(after) * score_slope(after) * line.variance[u + 1];
        // f = p0 / (p0 - p1): df/dp0 = -p1 / (p0 - p1)^2, df/dp1 = p0 / (p0 - p1)^2.
        const float variance =
            (after * after * noise_before + before * before * noise_after) / (span * span * span * span);
        return {static_cast<float>(u) + f, variance, boundary, chain};
    }

    /// Noise may cross an edge again and again: an odd number of crossings is one edge at their mean, an even one none.
    static void merge_repeated(std::vector<Edge>& edges) {
        std::size_t kept = 0;
        for (std::size_t i = 0; i < edges.size();) {
            std::size_t end = i + 1;
            while (end < edges.size() && edges[end].boundary == edges[i].boundary && edges[end].chain == edges[i].chain)
                ++end;
            if ((end - i) % 2 == 1) {
                Edge edge = edges[i];
                const float spread = edges[end - 1].at - edges[i].at;
                edge.at += 0.5F * spread;
                edge.variance += 0.25F * spread * spread;
                edges[kept++] = edge;
            }
            i = end;
        }
        edges.resize(kept);
    }

    void write(int v, const Line& line) const {
        float* position = out_.position_px.row(v);
        float* sigma = out_.sigma_px.row(v);
        std::uint16_t* rejected = out_.rejected.row(v);
        std::copy(line.mean.begin(), line.mean.end(), out_.mean.row(v));
        for (std::size_t u = 0; u < width_; ++u) {
            out_.modulation.row(v)[u] = 0.5F * line.amplitude[u];
            position[u] = sigma[u] = kNaN;
            // Until two edges enclose it, a pixel is one at the border of what is seen.
            rejected[u] = line.rejected[u] != 0 ? line.rejected[u] : static_cast<std::uint16_t>(kMixed);
        }
        for (std::size_t i = 0; i + 1 < line.edges.size(); ++i) {
            const Edge &a = line.edges[i], &b = line.edges[i + 1];
            const float spacing = b.at - a.at;
            if (a.chain != b.chain || std::abs(a.boundary - b.boundary) != 1 || spacing < kMinSpacing) continue;
            const float lean = settings_.edge_bias_px * (std::max(0.0F, 1 - spacing / kFreeSpacing) +
                                                         kNarrowGrowth * std::max(0.0F, kNarrowSpacing - spacing));
            const float bias = lean * lean;
            const auto first = static_cast<std::size_t>(std::ceil(a.at)), last = static_cast<std::size_t>(b.at);
            for (std::size_t u = first; u <= last && u < width_; ++u) {
                const float w = (static_cast<float>(u) - a.at) / spacing, x = settings_.cell_px / spacing;
                const auto boundary = (1 - w) * static_cast<float>(a.boundary) + w * static_cast<float>(b.boundary);
                position[u] = boundary * settings_.cell_px - 0.5F;
                sigma[u] = x * std::sqrt((1 - w) * (1 - w) * (a.variance + bias) + w * w * (b.variance + bias));
                rejected[u] = 0;
            }
        }
    }

    const std::vector<GrayBit<T>>& bits_;
    const T* white_;
    const T* black_;
    const GrayEdgeSettings& settings_;
    const GrayEdgeResult& out_;
    std::size_t width_;
    bool inverses_;
};

}  // namespace

template <class T>
void gray_edges(const std::vector<GrayBit<T>>& bits, const T* white, const T* black, const GrayEdgeSettings& settings,
                int threads, const GrayEdgeResult& out) {
    const Decoder<T> decoder(bits, white, black, settings, out);
    const auto width = static_cast<std::size_t>(out.position_px.width);
    parallel_for(static_cast<std::size_t>(out.position_px.height), threads, [&](std::size_t begin, std::size_t end) {
        Line line(width, bits.size());
        for (std::size_t v = begin; v < end; ++v) decoder.decode_row(static_cast<int>(v), line);
    });
}

template void gray_edges(const std::vector<GrayBit<std::uint8_t>>&, const std::uint8_t*, const std::uint8_t*,
                         const GrayEdgeSettings&, int, const GrayEdgeResult&);
template void gray_edges(const std::vector<GrayBit<std::uint16_t>>&, const std::uint16_t*, const std::uint16_t*,
                         const GrayEdgeSettings&, int, const GrayEdgeResult&);

}  // namespace planish
