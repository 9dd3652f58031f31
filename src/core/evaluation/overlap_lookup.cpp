#include "core/evaluation/overlap_lookup.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <vector>

#include "core/common/moved_camera.hpp"
#include "core/common/parallel.hpp"
#include "core/common/prefetch.hpp"
#include "core/common/view_cone.hpp"

namespace planish {
namespace {

constexpr float NOT_A_NUMBER = std::numeric_limits<float>::quiet_NaN();
/// A pixel this near to a column or row lies on it [px]: float32 points do not project back any better.
constexpr double SNAP_PX = 1e-3;
/// Edge of the blocks of b that are passed over where a's camera sees none of them [px].
constexpr int BLOCK_PX = 32;

/// Bilinear weights of one coordinate: 1 - f at `first`, f at `first + 1` (not needed where f = 0).
struct Weight {
    int first;
    double f;
};

/// False outside `size` pixels.
bool weigh(double coordinate, int size, Weight& out) {
    if (!(coordinate > -SNAP_PX && coordinate < size - 1 + SNAP_PX)) return false;
    const int nearest = static_cast<int>(coordinate + 0.5);
    if (std::abs(coordinate - nearest) < SNAP_PX) {
        out = {nearest, 0.0};
        return true;
    }
    out.first = static_cast<int>(coordinate);
    out.f = coordinate - out.first;
    return true;
}

using Vector = Eigen::Vector3d;

/// Values that the compiler takes at once.
constexpr int LANES = 8;
/// Up to so many values, ranks by comparing each with all others are found sooner than by sorting, which branches.
constexpr int FEW = 128;

/// Median of the first `count` of `values`, which it may reorder; there are `LANES` more than can count.
float median(std::vector<float>& values, int count) {
    if (count > FEW) {
        const auto end = values.begin() + count, middle = values.begin() + count / 2;
        std::nth_element(values.begin(), middle, end);
        return count % 2 == 0 ? 0.5F * (*middle + *std::max_element(values.begin(), middle)) : *middle;
    }
    std::fill_n(values.begin() + count, LANES, std::numeric_limits<float>::infinity());
    const int filled = (count + LANES - 1) / LANES * LANES, lower_rank = (count - 1) / 2, upper_rank = count / 2;
    float lower = NOT_A_NUMBER, upper = NOT_A_NUMBER;
    for (int i = 0; i < count; ++i) {
        const float value = values[i];
        int less = 0, no_more = 0;
        for (int j = 0; j < filled; ++j) {
            less += values[j] < value ? 1 : 0;
            no_more += values[j] <= value ? 1 : 0;
        }
        // Equal values share their ranks.
        if (less <= lower_rank && lower_rank < no_more) lower = value;
        if (less <= upper_rank && upper_rank < no_more) upper = value;
        if (lower == lower && upper == upper) break;
    }
    return 0.5F * (lower + upper);
}

/// Points of one row of b, and where they lie in a's image.
struct Ahead {
    int count = 0;
    std::array<int, kAhead> columns{};
    Places places;
};

using Values = std::array<float, kAhead>;

/// Points that lie in a's image, value by value: with their normals, and what a has there.
struct Pairs {
    int count = 0;
    std::array<int, kAhead> columns{}, from{};
    std::array<double, kAhead> right{}, down{};  ///< how far behind the first of four pixels of a
    std::array<Values, 3> point{}, normal_b{}, normal_a{};
    std::array<std::array<Values, 3>, 4> corners{};
};

struct Problem {
    const OrganisedSurface &a, &b;
    Eigen::Matrix3d R;
    Vector t;
    MovedCamera camera;
    double max_distance;

    Problem(const OrganisedSurface& a_, const OrganisedSurface& b_, const Eigen::Matrix4d& T_a_b, double max_distance_)
        : a(a_),
          b(b_),
          R(T_a_b.topLeftCorner<3, 3>()),
          t(T_a_b.topRightCorner<3, 1>()),
          camera(a_.camera, R, t),
          max_distance(max_distance_) {}

    /// Which blocks of a row of blocks a's camera may see.
    [[nodiscard]] std::vector<bool> seen_blocks(const ViewCone& cone, int top, int bottom) const {
        std::vector<bool> seen;
        for (int left = 0; left < b.points.width; left += BLOCK_PX)
            seen.push_back(
                cone.may_see(box_of(b.points, top, left, bottom, std::min(left + BLOCK_PX, b.points.width))));
        return seen;
    }

    /// Takes the next points of a row, and asks for what will be read of a.
    void take(const float* points, int& next, int end, Ahead& out) const {
        out.count = 0;
        Places& p = out.places;
        for (; next < end && out.count < kAhead; ++next) {
            const float* point = points + std::ptrdiff_t{3} * next;
            if (std::isnan(point[2])) continue;
            out.columns[out.count] = next;
            p.x[out.count] = point[0];
            p.y[out.count] = point[1];
            p.z[out.count] = point[2];
            ++out.count;
        }
        camera.project(p);
        for (int i = 0; i < out.count; ++i) {
            if (!(p.u[i] >= 0 && p.v[i] >= 0 && p.u[i] < a.points.width - 1 && p.v[i] < a.points.height - 1)) continue;
            const int u = static_cast<int>(p.u[i]), v = static_cast<int>(p.v[i]);
            for (const auto* map : {&a.points, &a.normals}) {
                prefetch(map->at(v, u));
                prefetch(map->at(v + 1, u));
            }
        }
    }

    /// Collects what the points that lie in a's image are compared by.
    void collect(const Ahead& ahead, int v, Pairs& out) const {
        const float *points = b.points.row(v), *normals = b.normals.row(v);
        const Places& p = ahead.places;
        int count = 0;
        for (int i = 0; i < ahead.count; ++i) {
            Weight at_u{}, at_v{};
            if (!(p.z[i] > 0 && weigh(p.u[i], a.points.width, at_u) && weigh(p.v[i], a.points.height, at_v))) continue;
            const std::ptrdiff_t at = std::ptrdiff_t{3} * ahead.columns[i];
            // Where one weight is 0, its pixel may lie outside, or be unknown: the other one stands for it.
            const std::ptrdiff_t right = at_u.f > 0 ? 3 : 0, down = at_v.f > 0 ? std::ptrdiff_t{3} * a.points.width : 0;
            const float *q = a.points.at(at_v.first, at_u.first),
                        *n = a.normals.at(at_v.first + (at_v.f > 0.5), at_u.first + (at_u.f > 0.5));
            out.columns[count] = ahead.columns[i];
            out.from[count] = i;
            out.right[count] = at_u.f;
            out.down[count] = at_v.f;
            for (int c = 0; c < 3; ++c) {
                out.point[c][count] = points[at + c];
                out.normal_b[c][count] = normals[at + c];
                out.normal_a[c][count] = n[c];
                out.corners[0][c][count] = q[c];
                out.corners[1][c][count] = q[right + c];
                out.corners[2][c][count] = q[down + c];
                out.corners[3][c][count] = q[down + right + c];
            }
            ++count;
        }
        out.count = count;
    }

    /// Distances of points from the surface of a between four pixels, or NaN.
    [[nodiscard]] std::array<double, kAhead> distances_of(const Pairs& p) const {
        const Eigen::Matrix3d M = R;
        const Vector s = t;
        const double limit = max_distance;
        std::array<double, kAhead> out;
        for (int i = 0; i < kAhead; ++i) {
            const double n0 = p.normal_a[0][i], n1 = p.normal_a[1][i], n2 = p.normal_a[2][i];
            const auto along = [&](double x, double y, double z) { return n0 * x + n1 * y + n2 * z; };
            const auto turned = [&](int row, const std::array<Values, 3>& x) {
                return M(row, 0) * x[0][i] + M(row, 1) * x[1][i] + M(row, 2) * x[2][i];
            };
            const auto corner = [&](const std::array<Values, 3>& q) { return along(q[0][i], q[1][i], q[2][i]); };
            const double facing = along(turned(0, p.normal_b), turned(1, p.normal_b), turned(2, p.normal_b));
            const double level = along(turned(0, p.point) + s[0], turned(1, p.point) + s[1], turned(2, p.point) + s[2]);
            const double d0 = level - corner(p.corners[0]), d1 = level - corner(p.corners[1]),
                         d2 = level - corner(p.corners[2]), d3 = level - corner(p.corners[3]);
            const double right = p.right[i], down = p.down[i];
            const double sum = (1 - down) * ((1 - right) * d0 + right * d1) + down * ((1 - right) * d2 + right * d3);
            const double most_1 = d0 > d1 ? d0 : d1, most_2 = d2 > d3 ? d2 : d3;
            const double least_1 = d0 < d1 ? d0 : d1, least_2 = d2 < d3 ? d2 : d3;
            const double spread = (most_1 > most_2 ? most_1 : most_2) - (least_1 < least_2 ? least_1 : least_2);
            // Neighbours on two layers: there is no surface between them. Of `facing` compare with "not less", so that
            // a missing normal of b (NaN) does not exclude the point.
            const bool met = (std::abs(sum) <= limit) & !(spread > limit) & !(facing < 0);
            out[i] = met ? sum : std::numeric_limits<double>::quiet_NaN();
        }
        return out;
    }

    void compare(const Ahead& ahead, int v, Pairs& pairs, float* distances, float* pixels) const {
        if (ahead.count == 0) return;
        collect(ahead, v, pairs);
        if (pairs.count == 0) return;
        const auto found = distances_of(pairs);
        for (int i = 0; i < pairs.count; ++i) {
            const int u = pairs.columns[i];
            distances[u] = static_cast<float>(found[i]);
            if (!pixels || !(found[i] == found[i])) continue;
            pixels[std::ptrdiff_t{2} * u] = static_cast<float>(ahead.places.u[pairs.from[i]]);
            pixels[std::ptrdiff_t{2} * u + 1] = static_cast<float>(ahead.places.v[pairs.from[i]]);
        }
    }
};

}  // namespace

void look_up_distance(const OrganisedSurface& a, const OrganisedSurface& b, const Eigen::Matrix4d& T_a_b,
                      double max_distance, int threads, const Image<float>& distances, const Image<float>& pixels) {
    const Problem problem(a, b, T_a_b, max_distance);
    const ViewCone cone(problem.camera, a.points.width, a.points.height);
    const int width = b.points.width, height = b.points.height;
    const auto add_row = [&](int v, int first, int end) {
        float *out = distances.row(v), *out_pixels = pixels.empty() ? nullptr : pixels.row(v);
        // While some are compared, memory answers what was asked for by the next.
        std::array<Ahead, 2> ahead;
        Pairs pairs;
        int turn = 0;
        for (int next = first; next < end; turn = 1 - turn) {
            problem.take(b.points.row(v), next, end, ahead[turn]);
            problem.compare(ahead[1 - turn], v, pairs, out, out_pixels);
        }
        problem.compare(ahead[1 - turn], v, pairs, out, out_pixels);
    };
    parallel_tasks(static_cast<std::size_t>((height + BLOCK_PX - 1) / BLOCK_PX), threads, [&](std::size_t row) {
        const int top = static_cast<int>(row) * BLOCK_PX, bottom = std::min(height, top + BLOCK_PX);
        const auto seen = problem.seen_blocks(cone, top, bottom);
        const int blocks = static_cast<int>(seen.size());
        for (int v = top; v < bottom; ++v) {
            std::fill_n(distances.row(v), width, NOT_A_NUMBER);
            if (!pixels.empty()) std::fill_n(pixels.row(v), 2 * static_cast<std::size_t>(width), NOT_A_NUMBER);
            for (int first = 0; first < blocks; ++first) {
                if (!seen[first]) continue;
                int last = first;
                while (last + 1 < blocks && seen[last + 1]) ++last;
                add_row(v, first * BLOCK_PX, std::min(width, (last + 1) * BLOCK_PX));
                first = last;
            }
        }
    });
}

Known known_distances(const Image<const float>& distances, const Image<const float>& areas, int threads) {
    constexpr std::size_t rows = 16;
    return parallel_sum<Known>(distances.height, rows, threads, [&](std::size_t first, std::size_t last) {
        Known sums;
        for (std::size_t v = first; v < last; ++v) {
            const float *d = distances.row(static_cast<int>(v)), *area = areas.row(static_cast<int>(v));
            // Lane by lane, so that the compiler may take several at once.
            constexpr int lanes = 8;
            std::array<double, lanes> squares{}, areas_of{};
            std::array<int, lanes> counts{};
            for (int u = 0; u < distances.width; u += lanes) {
                const int n = std::min(lanes, distances.width - u);
                for (int i = 0; i < n; ++i) {
                    const bool known = d[u + i] == d[u + i];
                    const double value = known ? d[u + i] : 0.0F;
                    squares[i] += value * value;
                    areas_of[i] += known ? area[u + i] : 0.0F;
                    counts[i] += known;
                }
            }
            for (int i = 0; i < lanes; ++i) sums += {counts[i], squares[i], areas_of[i]};
        }
        return sums;
    });
}

void pixel_areas(const Image<const float>& tangents, int threads, const Image<float>& areas) {
    parallel_for(areas.pixels(), threads, [&](std::size_t first, std::size_t last) {
        const float* x = tangents.data + 6 * first;
        for (std::size_t i = first; i < last; ++i, x += 6) {
            const float uu = x[0] * x[0] + x[1] * x[1] + x[2] * x[2], vv = x[3] * x[3] + x[4] * x[4] + x[5] * x[5];
            const float uv = x[0] * x[3] + x[1] * x[4] + x[2] * x[5], squared = uu * vv - uv * uv;
            areas.data[i] = squared > 0 ? std::sqrt(squared) : 0.0F;
        }
    });
}

void cell_medians(const Image<const float>& map, int size, int min_count, int threads, const Image<float>& medians) {
    parallel_for(static_cast<std::size_t>(medians.height), threads, [&](std::size_t first, std::size_t last) {
        // Filled up to whole vectors.
        std::vector<float> values(static_cast<std::size_t>(size) * size + LANES);
        for (int row = static_cast<int>(first); row < static_cast<int>(last); ++row)
            for (int column = 0; column < medians.width; ++column) {
                int count = 0;
                const int right = std::min(map.width, (column + 1) * size);
                for (int v = row * size; v < std::min(map.height, (row + 1) * size); ++v) {
                    const float* from = map.row(v);
                    for (int u = column * size; u < right; ++u) {
                        values[count] = from[u];
                        count += from[u] == from[u] ? 1 : 0;
                    }
                }
                *medians.at(row, column) = count > 0 && count >= min_count ? median(values, count) : NOT_A_NUMBER;
            }
    });
}

}  // namespace planish
