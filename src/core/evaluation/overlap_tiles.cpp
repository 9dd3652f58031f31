#include "core/evaluation/overlap_tiles.hpp"

#include <Eigen/LU>
#include <array>
#include <cmath>
#include <cstddef>

#include "core/common/parallel.hpp"

namespace planish {
namespace {

constexpr int MAX_STEPS = 12;
/// A step shorter than this [px] ends the iteration.
constexpr double LAST_STEP_PX = 1e-3;

/// Edge of the blocks whose residuals are taken as belonging together [px].
constexpr int CLUSTER_PX = 6;

struct Sample {
    double value, du, dv, variance;
};

using Four = Eigen::Array4f;

/// Weights of Keys' cubic convolution (1981, a = -1/2) and their derivatives at fraction f between pixels 0 and 1.
struct Cubic {
    Four w, d;

    explicit Cubic(float f) {
        const Four once(-0.5F, 0.0F, 0.5F, 0.0F), twice(1.0F, -2.5F, 2.0F, -0.5F), thrice(-0.5F, 1.5F, -1.5F, 0.5F),
            second(0.0F, 1.0F, 0.0F, 0.0F);
        w = ((thrice * f + twice) * f + once) * f + second;
        d = (3.0F * thrice * f + 2.0F * twice) * f + once;
    }
};

/// Value and derivatives at a pixel; false where the 4 x 4 neighbourhood is not whole.
bool sample(const Contrast& b, double u, double v, Sample& out) {
    if (!(u >= 1 && v >= 1 && u < b.value.width - 2 && v < b.value.height - 2)) return false;
    const int iu = static_cast<int>(u), iv = static_cast<int>(v);
    const auto fu = static_cast<float>(u - iu), fv = static_cast<float>(v - iv);
    const Cubic along(fu), down(fv);
    const float* p = b.value.at(iv - 1, iu - 1);
    const auto step = static_cast<std::ptrdiff_t>(b.value.width);
    const Four q[] = {Four::Map(p), Four::Map(p + step), Four::Map(p + 2 * step), Four::Map(p + 3 * step)};
    const Four values = down.w[0] * q[0] + down.w[1] * q[1] + down.w[2] * q[2] + down.w[3] * q[3];
    const Four slopes = down.d[0] * q[0] + down.d[1] * q[1] + down.d[2] * q[2] + down.d[3] * q[3];
    const float sigma = *b.sigma.at(iv + (fv > 0.5F), iu + (fu > 0.5F));
    out = {(along.w * values).sum(), (along.d * values).sum(), (along.w * slopes).sum(),
           static_cast<double>(sigma) * sigma};
    return out.value == out.value && out.variance == out.variance;
}

/// One pixel of a tile of a: its value, its gradient along the tangent directions [1 / mm], its pixel in b.
struct Template {
    double value, variance;
    Eigen::Vector2d gradient, pixel_b;
    int cluster;
};

void gather(const Contrast& a, const Image<const float>& pixels_b, const Tile& tile, int size,
            std::vector<Template>& out) {
    out.clear();
    const int v_end = std::min((tile.row + 1) * size, a.value.height - 1);
    const int u_end = std::min((tile.column + 1) * size, a.value.width - 1);
    for (int v = std::max(1, tile.row * size); v < v_end; ++v)
        for (int u = std::max(1, tile.column * size); u < u_end; ++u) {
            const float* pixel = pixels_b.at(v, u);
            const Eigen::Vector2d gradient(0.5 * (*a.value.at(v, u + 1) - *a.value.at(v, u - 1)),
                                           0.5 * (*a.value.at(v + 1, u) - *a.value.at(v - 1, u)));
            const double value = *a.value.at(v, u), sigma = *a.sigma.at(v, u);
            const double all = value + sigma + gradient.sum() + pixel[0] + pixel[1];
            if (!(all == all)) continue;
            const int cluster =
                (v - tile.row * size) / CLUSTER_PX * (size / CLUSTER_PX + 1) + (u - tile.column * size) / CLUSTER_PX;
            out.push_back({value, sigma * sigma, tile.J_a.transpose() * gradient, {pixel[0], pixel[1]}, cluster});
        }
}

/// Weighted sums over the pixels of a tile at one shift.
struct Fit {
    Eigen::Vector2d rhs{0, 0};
    Eigen::Matrix2d curvature{Eigen::Matrix2d::Zero()};
    Eigen::Matrix2d spread{Eigen::Matrix2d::Zero()};
    double residual_variance = 0;
    double correlation = 0;
    int pixels = 0;
};

/// What a pixel of a and its place in b differ by, and what that weighs.
struct Difference {
    const Template* pixel;
    double weight, value;
};

/// `differences`, where given, becomes those of all pixels that b is known at.
Fit evaluate(const Contrast& b, const Tile& tile, const std::vector<Template>& pixels, const Eigen::Vector2d& shift,
             std::vector<Difference>* differences = nullptr) {
    if (differences) differences->clear();
    const Eigen::Vector2d step_b = tile.J_b * shift + tile.offset_b;
    double sw = 0, sa = 0, sb = 0, saa = 0, sab = 0, sbb = 0;
    Eigen::Vector2d sg(0, 0), sga(0, 0), sgb(0, 0), sh(0, 0);
    Eigen::Matrix2d sgg = Eigen::Matrix2d::Zero(), sgh = Eigen::Matrix2d::Zero();
    Fit fit;
    for (const Template& p : pixels) {
        Sample s;
        if (!sample(b, p.pixel_b.x() + step_b.x(), p.pixel_b.y() + step_b.y(), s)) continue;
        const double w = 1 / (p.variance + s.variance);
        const Eigen::Vector2d h = tile.J_b.transpose() * Eigen::Vector2d(s.du, s.dv);
        ++fit.pixels;
        if (differences) differences->push_back({&p, w, p.value - s.value});
        sw += w;
        sa += w * p.value;
        sb += w * s.value;
        saa += w * p.value * p.value;
        sab += w * p.value * s.value;
        sbb += w * s.value * s.value;
        sg += w * p.gradient;
        sh += w * h;
        sga += w * p.gradient * p.value;
        sgb += w * p.gradient * s.value;
        sgg += w * p.gradient * p.gradient.transpose();
        sgh += w * p.gradient * h.transpose();
    }
    if (fit.pixels == 0) return fit;
    // An offset between the two textures is a nuisance: eliminate it by taking every sum about its weighted mean.
    fit.rhs = (sga - sg * sa / sw) - (sgb - sg * sb / sw);
    sgg -= sg * sg.transpose() / sw;
    sgh -= sg * sh.transpose() / sw;
    const double aa = saa - sa * sa / sw, ab = sab - sa * sb / sw, bb = sbb - sb * sb / sw;
    fit.curvature = 0.5 * (sgh + sgh.transpose());
    fit.spread = sgg;
    fit.residual_variance = (aa - 2 * ab + bb) / fit.pixels;  // in units of the stated variances
    fit.correlation = ab / std::sqrt(aa * bb);
    return fit;
}

/// Ratio of the variance of the right-hand side as the spread of the blocks' sums shows it to what independent
/// residuals would give (cluster-robust "sandwich", Liang and Zeger 1986), mean of both directions.
double inflation(const std::vector<Difference>& differences, const Fit& fit) {
    std::vector<Eigen::Vector3d> blocks;
    Eigen::Vector2d sg(0, 0);
    double sw = 0, sd = 0;
    // Products about the means: these must be known before.
    for (const auto& [pixel, w, value] : differences) {
        sw += w;
        sd += w * value;
        sg += w * pixel->gradient;
    }
    for (const auto& [pixel, w, value] : differences) {
        const auto cluster = static_cast<std::size_t>(pixel->cluster);
        if (cluster >= blocks.size()) blocks.resize(cluster + 1, Eigen::Vector3d::Zero());
        const Eigen::Vector2d score = w * (pixel->gradient - sg / sw) * (value - sd / sw);
        blocks[cluster] += Eigen::Vector3d(score.x(), score.y(), 1);
    }
    Eigen::Matrix2d sum = Eigen::Matrix2d::Zero();
    double filled = 0;
    for (const Eigen::Vector3d& block : blocks) {
        if (block.z() == 0) continue;
        sum += block.head<2>() * block.head<2>().transpose();
        filled += 1;
    }
    if (filled < 8) return 1;
    const double ratio = (fit.spread.inverse() * sum).trace() / 2 / std::max(1.0, fit.residual_variance);
    return ratio * filled / (filled - 2);  // two parameters were fitted
}

/// Normal equations of one shift for several tiles.
struct Normal {
    Eigen::Vector2d rhs{0, 0};
    Eigen::Matrix2d curvature{Eigen::Matrix2d::Zero()};

    Normal& operator+=(const Normal& other) {
        rhs += other.rhs;
        curvature += other.curvature;
        return *this;
    }
};

/// Values of a tile's pixels about their mean, and their places in b before any shift; filled up with places outside to
/// whole vectors.
struct TilePixels {
    static constexpr std::size_t lane = 8;
    std::vector<float> value, u, v;

    TilePixels(const std::vector<Template>& pixels, const Tile& tile) {
        double mean = 0;
        for (const Template& p : pixels) mean += p.value / static_cast<double>(pixels.size());
        for (const Template& p : pixels) {
            value.push_back(static_cast<float>(p.value - mean));
            u.push_back(static_cast<float>(p.pixel_b.x() + tile.offset_b.x()));
            v.push_back(static_cast<float>(p.pixel_b.y() + tile.offset_b.y()));
        }
        const std::size_t size = (pixels.size() + lane - 1) / lane * lane;
        value.resize(size, 0.0F);
        u.resize(size, -1e9F);
        v.resize(size, -1e9F);
    }
};

/// Correlation coefficient of a tile and b at one shift, 0 where b has no texture there.
double correlation(const Image<const float>& b, const Tile& tile, const TilePixels& pixels,
                   const Eigen::Vector2d& shift) {
    constexpr std::size_t lane = TilePixels::lane;
    using Lanes = Eigen::Array<float, lane, 1>;
    const Eigen::Vector2f step = (tile.J_b * shift).cast<float>();
    const float du = step.x(), dv = step.y(), right = static_cast<float>(b.width - 1),
                bottom = static_cast<float>(b.height - 1);
    const int width = b.width;
    const float* __restrict data = b.data;
    std::array<Lanes, 6> sums;
    sums.fill(Lanes::Zero());
    for (std::size_t first = 0; first < pixels.value.size(); first += lane) {
        const float *at_u = &pixels.u[first], *at_v = &pixels.v[first];
        Lanes known, other;
        for (std::size_t x = 0; x < lane; ++x) {
            const float u = at_u[x] + du, v = at_v[x] + dv;
            const bool inside = (u >= 0) & (v >= 0) & (u < right) & (v < bottom);
            const float uc = inside ? u : 0.0F, vc = inside ? v : 0.0F;
            const int iu = static_cast<int>(uc), iv = static_cast<int>(vc), at = iv * width + iu;
            const float fu = uc - static_cast<float>(iu), fv = vc - static_cast<float>(iv);
            const float top = (1 - fu) * data[at] + fu * data[at + 1],
                        low = (1 - fu) * data[at + width] + fu * data[at + width + 1];
            const float value = (1 - fv) * top + fv * low;
            const bool counts = inside & (value == value);
            known[static_cast<Eigen::Index>(x)] = counts ? 1.0F : 0.0F;
            other[static_cast<Eigen::Index>(x)] = counts ? value : 0.0F;
        }
        const Lanes own = known * Eigen::Map<const Lanes>(&pixels.value[first]);
        sums[0] += known;
        sums[1] += own;
        sums[2] += other;
        sums[3] += own * own;
        sums[4] += own * other;
        sums[5] += other * other;
    }
    std::array<double, 6> total{};
    for (std::size_t i = 0; i < sums.size(); ++i) total[i] = sums[i].cast<double>().sum();
    const auto [n, sa, sb, saa, sab, sbb] = total;
    const double r = (n * sab - sa * sb) / std::sqrt((n * saa - sa * sa) * (n * sbb - sb * sb));
    return std::isfinite(r) ? r : 0.0;
}

TileShift align(const Contrast& b, const Tile& tile, const std::vector<Template>& pixels,
                const Eigen::Vector2d& start) {
    TileShift out;
    out.shift_mm = start;
    std::vector<Difference> differences;
    for (int step = 0; step < MAX_STEPS; ++step) {
        const Fit fit = evaluate(b, tile, pixels, out.shift_mm, &differences);
        out.pixels = fit.pixels;
        out.correlation = fit.correlation;
        const double determinant = fit.curvature.determinant();
        if (!(determinant > 0 && fit.curvature.trace() > 0)) return out;
        const Eigen::Matrix2d inverse = fit.curvature.inverse();
        // The residuals of the tile itself stand for the noise: they hold what the stated noise leaves out.
        out.covariance = std::max(1.0, fit.residual_variance) * inverse * fit.spread * inverse;
        const Eigen::Vector2d delta = inverse * fit.rhs;
        out.shift_mm += delta;
        if ((tile.J_a * delta).norm() < LAST_STEP_PX) {
            out.converged = true;
            // A step as short as the last one changes nothing of them.
            out.inflation = inflation(differences, fit);
            return out;
        }
    }
    return out;
}

}  // namespace

std::vector<TileShift> tile_shifts(const Contrast& a, const Contrast& b, const Image<const float>& pixels_b,
                                   const std::vector<Tile>& tiles, int size, const Eigen::Vector2d& start_mm,
                                   int threads) {
    std::vector<TileShift> out(tiles.size());
    parallel_for(tiles.size(), threads, [&](std::size_t first, std::size_t last) {
        std::vector<Template> pixels;
        for (std::size_t i = first; i < last; ++i) {
            gather(a, pixels_b, tiles[i], size, pixels);
            out[i] = align(b, tiles[i], pixels, start_mm);
        }
    });
    return out;
}

Eigen::Vector2d common_shift(const Contrast& a, const Contrast& b, const Image<const float>& pixels_b,
                             const std::vector<Tile>& tiles, int size, const Eigen::Vector2d& start_mm, int threads) {
    std::vector<std::vector<Template>> pixels(tiles.size());
    parallel_for(tiles.size(), threads, [&](std::size_t first, std::size_t last) {
        for (std::size_t i = first; i < last; ++i) gather(a, pixels_b, tiles[i], size, pixels[i]);
    });
    Eigen::Vector2d shift = start_mm;
    for (int step = 0; step < MAX_STEPS; ++step) {
        const Normal sum = parallel_sum<Normal>(tiles.size(), 1, threads, [&](std::size_t i, std::size_t) {
            const Fit fit = evaluate(b, tiles[i], pixels[i], shift);
            return Normal{fit.rhs, fit.curvature};
        });
        if (!(sum.curvature.determinant() > 0 && sum.curvature.trace() > 0)) return start_mm;
        const Eigen::Vector2d delta = sum.curvature.inverse() * sum.rhs;
        shift += delta;
        if ((tiles.front().J_a * delta).norm() < LAST_STEP_PX) return shift;
    }
    return start_mm;
}

std::vector<double> shift_scores(const Contrast& a, const Contrast& b, const Image<const float>& pixels_b,
                                 const std::vector<Tile>& tiles, int size, const std::vector<Eigen::Vector2d>& shifts,
                                 int threads) {
    std::vector<std::vector<double>> per_tile(tiles.size());
    parallel_for(tiles.size(), threads, [&](std::size_t first, std::size_t last) {
        std::vector<Template> pixels;
        for (std::size_t i = first; i < last; ++i) {
            gather(a, pixels_b, tiles[i], size, pixels);
            const TilePixels own(pixels, tiles[i]);
            for (const auto& shift : shifts) per_tile[i].push_back(correlation(b.value, tiles[i], own, shift));
        }
    });
    std::vector<double> out(shifts.size(), 0.0);
    for (const auto& scores : per_tile)
        for (std::size_t i = 0; i < shifts.size(); ++i) out[i] += scores[i];
    return out;
}

}  // namespace planish
