#include "core/checks/shift_sums.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <vector>

#include "core/common/parallel.hpp"

namespace planish {
namespace {

constexpr int kReach = 3, kTaps = 2 * kReach + 1, kRows = kShiftBlock + 2 * kReach;

/// Gaussian of 1 px and its slope: unit response to a constant and to a ramp.
struct Taps {
    std::array<float, kTaps> smooth{}, slope{};
    Taps() {
        std::array<double, kTaps> g{};
        double sum = 0, ramp = 0;
        for (int i = 0; i < kTaps; ++i) sum += g[i] = std::exp(-0.5 * (i - kReach) * (i - kReach));
        for (int i = 0; i < kTaps; ++i) ramp += g[i] / sum * (i - kReach) * (i - kReach);
        for (int i = 0; i < kTaps; ++i) {
            smooth[i] = static_cast<float>(g[i] / sum);
            slope[i] = static_cast<float>(g[i] / sum * (i - kReach) / ramp);
        }
    }
};

/// Means of both images over blocks and their neighbours, to be interpolated between the blocks' centres.
struct LocalMeans {
    int rows, columns, block;
    std::vector<float> first, last;

    LocalMeans(Image<const float> a, Image<const float> b, Image<const std::uint8_t> usable, int size)
        : rows(std::max(1, a.height / size)),
          columns(std::max(1, a.width / size)),
          block(size),
          first(static_cast<std::size_t>(rows) * columns),
          last(first.size()) {
        std::vector<std::array<float, 3>> sums(first.size());
        // Columns first: sums side by side, which need not wait for each other.
        const auto width = static_cast<std::size_t>(std::min(a.width, columns * block));
        std::vector<float> lines(3 * width);
        for (int r = 0; r < rows; ++r) {
            std::fill(lines.begin(), lines.end(), 0.0F);
            float* __restrict n = lines.data(), * __restrict x = n + width, * __restrict y = x + width;
            for (int v = r * block; v < std::min(a.height, (r + 1) * block); ++v) {
                const float* __restrict p = a.row(v), * __restrict q = b.row(v);
                const std::uint8_t* __restrict use = usable.row(v);
                for (std::size_t u = 0; u < width; ++u) {
                    const float w = static_cast<float>(use[u]);
                    n[u] += w;
                    x[u] += w * p[u];
                    y[u] += w * q[u];
                }
            }
            for (std::size_t u = 0; u < width; ++u) {
                auto& sum = sums[static_cast<std::size_t>(r) * columns + u / static_cast<std::size_t>(block)];
                for (std::size_t k = 0; k < 3; ++k) sum[k] += lines[k * width + u];
            }
        }
        for (int r = 0; r < rows; ++r)
            for (int c = 0; c < columns; ++c) {
                std::array<float, 3> sum{};
                for (int y = std::max(r - 1, 0); y <= std::min(r + 1, rows - 1); ++y)
                    for (int x = std::max(c - 1, 0); x <= std::min(c + 1, columns - 1); ++x)
                        for (int k = 0; k < 3; ++k) sum[k] += sums[static_cast<std::size_t>(y) * columns + x][k];
                const float count = std::max(sum[0], 1.0F);
                first[static_cast<std::size_t>(r) * columns + c] = sum[1] / count;
                last[static_cast<std::size_t>(r) * columns + c] = sum[2] / count;
            }
    }

    /// Writes the means along row v.
    void interpolate(int v, const std::vector<float>& grid, std::vector<float>& line, int width) const {
        const float y = std::clamp((static_cast<float>(v) + 0.5F) / static_cast<float>(block) - 0.5F, 0.0F,
                                   static_cast<float>(rows - 1));
        const int r = std::min(static_cast<int>(y), std::max(rows - 2, 0)), below = std::min(r + 1, rows - 1);
        const float fy = y - static_cast<float>(r);
        const auto at = [&](int c) {
            const std::size_t i = static_cast<std::size_t>(c);
            return (1 - fy) * grid[static_cast<std::size_t>(r) * columns + i] +
                   fy * grid[static_cast<std::size_t>(below) * columns + i];
        };
        for (int c = -1; c < columns; ++c) {
            const float left = at(std::max(c, 0)), right = at(std::min(c + 1, columns - 1));
            const int start = c * block + block / 2, end = c + 1 == columns ? width : start + block;
            const float step = (right - left) / static_cast<float>(block);
            for (int u = std::max(start, 0); u < std::min(end, width); ++u)
                line[static_cast<std::size_t>(u)] = left + step * (static_cast<float>(u - start) + 0.5F);
        }
    }
};

/// The rows that one row of blocks needs, filtered along the rows.
class Strip {
  public:
    explicit Strip(int width)
        : width_(width),
          smooth_(size()),
          slope_(size()),
          difference_(size()),
          t_(size()),
          variance_(size()),
          line_t_(static_cast<std::size_t>(width) + 2 * kReach),
          line_e_(line_t_.size()),
          mean_first_(static_cast<std::size_t>(width)),
          mean_last_(mean_first_.size()) {}

    void fill(Image<const float> first, Image<const float> last, Image<const std::uint8_t> usable,
              const LocalMeans& means, const PairNoise& noise, int top) {
        for (int k = 0; k < kRows; ++k) {
            const int v = std::clamp(top - kReach + k, 0, first.height - 1);
            means.interpolate(v, means.first, mean_first_, width_);
            means.interpolate(v, means.last, mean_last_, width_);
            const float* __restrict a = first.row(v), * __restrict b = last.row(v);
            const float* __restrict mean_a = mean_first_.data(), * __restrict mean_b = mean_last_.data();
            const std::uint8_t* __restrict use = usable.row(v);
            float* __restrict t = row(t_, k), * __restrict variance = row(variance_, k);
            float* __restrict lt = line_t_.data() + kReach, * __restrict le = line_e_.data() + kReach;
            for (int u = 0; u < width_; ++u) {
                const float ratio = mean_a[u] / std::max(mean_b[u], 1e-3F), w = static_cast<float>(use[u]);
                const float x = w * (a[u] - mean_a[u]), y = w * ratio * (b[u] - mean_b[u]);
                t[u] = lt[u] = 0.5F * (x + y);
                le[u] = x - y;
                variance[u] = noise.first * (noise.offset + noise.slope * a[u]) +
                              ratio * ratio * noise.last * (noise.offset + noise.slope * b[u]);
            }
            filter(k);
        }
    }

    /// Writes the sums of the block of columns that begins at `left`; `inner` tells, per row of the block, which pixels
    /// count.
    void sum(int left, Image<const std::uint8_t> inner, double* sums) const {
        using Lane = std::array<float, kShiftBlock>;
        std::array<Lane, kShiftSums> total{};
        for (int k = 0; k < kShiftBlock; ++k) {
            Lane gu{}, gv{}, tt{}, ee{}, w{}, corner{};
            for (int i = 0; i < kTaps; ++i) {
                const float *s = row(smooth_, k + i) + left, *d = row(slope_, k + i) + left;
                const float *e = row(difference_, k + i) + left, a = taps_.smooth[i], b = taps_.slope[i];
                for (int u = 0; u < kShiftBlock; ++u) {
                    gu[u] += a * d[u];
                    gv[u] += b * s[u];
                    tt[u] += a * s[u];
                    ee[u] += a * e[u];
                }
            }
            const std::uint8_t* use = inner.row(k) + left;
            const float *t0 = row(t_, k + kReach - 1) + left, *t1 = t0 + width_, *t2 = t1 + width_;
            const float* variance = row(variance_, k + kReach) + left;
            for (int u = 0; u < kShiftBlock; ++u) {
                w[u] = static_cast<float>(use[u]);
                // A pixel that counts has neighbours on all sides.
                corner[u] = (t0[u - 1] - 2 * t0[u] + t0[u + 1] - 2 * (t1[u - 1] - 2 * t1[u] + t1[u + 1]) + t2[u - 1] -
                             2 * t2[u] + t2[u + 1]) /
                            6.0F;
            }
            for (int u = 0; u < kShiftBlock; ++u) {
                const float x = w[u] * gu[u], y = w[u] * gv[u], t = w[u] * tt[u], e = ee[u];
                total[kUU][u] += x * gu[u];
                total[kUV][u] += x * gv[u];
                total[kUT][u] += x * tt[u];
                total[kVV][u] += y * gv[u];
                total[kVT][u] += y * tt[u];
                total[kTT][u] += t * tt[u];
                total[kUE][u] += x * e;
                total[kVE][u] += y * e;
                total[kTE][u] += t * e;
                total[kEE][u] += w[u] * e * e;
                total[kFloor][u] += w[u] * corner[u] * corner[u];
                total[kVariance][u] += w[u] * variance[u];
            }
        }
        for (int i = 0; i < kShiftSums; ++i) {
            sums[i] = 0;
            for (const float value : total[i]) sums[i] += static_cast<double>(value);
        }
    }

  private:
    [[nodiscard]] std::size_t size() const { return static_cast<std::size_t>(width_) * kRows + 1; }
    [[nodiscard]] float* row(std::vector<float>& map, int k) const {
        return map.data() + static_cast<std::size_t>(width_) * k;
    }
    [[nodiscard]] const float* row(const std::vector<float>& map, int k) const {
        return map.data() + static_cast<std::size_t>(width_) * k;
    }

    void filter(int k) {
        float* __restrict s = row(smooth_, k), * __restrict d = row(slope_, k), * __restrict e = row(difference_, k);
        const float* __restrict t = line_t_.data(), * __restrict difference = line_e_.data();
        const int width = width_;
        const std::array<float, kTaps> a = taps_.smooth, b = taps_.slope;
        for (int u = 0; u < width; ++u) {
            float smooth = 0, slope = 0, other = 0;
            for (int i = 0; i < kTaps; ++i) {
                smooth += a[i] * t[u + i];
                slope += b[i] * t[u + i];
                other += a[i] * difference[u + i];
            }
            s[u] = smooth;
            d[u] = slope;
            e[u] = other;
        }
    }

    int width_;
    Taps taps_;
    std::vector<float> smooth_, slope_, difference_, t_, variance_;
    std::vector<float> line_t_, line_e_, mean_first_, mean_last_;
};

/// Writes 1 where pixels of row v, and all within reach of the filters, are usable.
void surrounded(Image<const std::uint8_t> usable, int v, std::vector<std::uint8_t>& column, std::uint8_t* out) {
    const int width = usable.width;
    std::uint8_t* __restrict line = out;
    std::uint8_t* __restrict all = column.data();
    std::fill_n(line, width, std::uint8_t{0});
    if (v < kReach || v + kReach >= usable.height || width <= 2 * kReach) return;
    std::copy_n(usable.row(v - kReach), width, all);
    for (int i = 1 - kReach; i <= kReach; ++i) {
        const std::uint8_t* __restrict row = usable.row(v + i);
        for (int u = 0; u < width; ++u) all[u] = static_cast<std::uint8_t>(all[u] & row[u]);
    }
    static_assert(kReach == 3);
    for (int u = kReach; u < width - kReach; ++u)
        line[u] = static_cast<std::uint8_t>(all[u - 3] & all[u - 2] & all[u - 1] & all[u] & all[u + 1] & all[u + 2] &
                                            all[u + 3]);
}

}  // namespace

void shift_sums(Image<const float> first, Image<const float> last, Image<const std::uint8_t> usable,
                const PairNoise& noise, int threads, Image<double> sums) {
    const int width = first.width;
    const LocalMeans means(first, last, usable, kShiftBlock);
    parallel_for(static_cast<std::size_t>(sums.height), threads, [&](std::size_t begin, std::size_t end) {
        Strip strip(width);
        const auto wide = static_cast<std::size_t>(width);
        std::vector<std::uint8_t> column(wide), inner(wide * kShiftBlock);
        for (std::size_t r = begin; r < end; ++r) {
            const int top = static_cast<int>(r) * kShiftBlock;
            strip.fill(first, last, usable, means, noise, top);
            for (int k = 0; k < kShiftBlock; ++k)
                surrounded(usable, top + k, column, inner.data() + wide * static_cast<std::size_t>(k));
            const Image<const std::uint8_t> counts{inner.data(), kShiftBlock, width};
            for (int c = 0; c < sums.width; ++c) strip.sum(c * kShiftBlock, counts, sums.at(static_cast<int>(r), c));
        }
    });
}

}  // namespace planish
