"""The texture kernels in NumPy: slow, short, from the definitions in their headers in src/core/texture/."""

from __future__ import annotations

import numpy as np


def cubic(x):
    d = np.abs(x)
    inner, outer = (1.5 * d - 2.5) * d * d + 1, ((-0.5 * d + 2.5) * d - 4) * d + 2
    return np.where(d < 1, inner, np.where(d < 2, outer, 0.0))


def spread(blocks, factor, shape):
    return np.kron(blocks, np.ones((factor, factor)))[: shape[0], : shape[1]]


def between_blocks(blocks, factor, shape):
    """Linear interpolation between the centres of blocks."""

    def matrix(size, count):
        place = np.clip((np.arange(size) + 0.5) / factor - 0.5, 0, count - 1)
        return np.maximum(0, 1 - np.abs(place[:, None] - np.arange(count)))

    return matrix(shape[0], blocks.shape[0]) @ blocks @ matrix(shape[1], blocks.shape[1]).T


def block_sums(image, low, high, seen, factor):
    known = (image > low) & (image < high) & (seen > 0 if seen.size else True)
    pad = [(0, -n % factor) for n in image.shape]
    out = []
    for m in (np.where(known, image, 0), known.astype(float)):
        padded = np.pad(m, pad)
        h, w = (n // factor for n in padded.shape)
        out.append(padded.reshape(h, factor, w, factor).sum((1, 3)))
    return out


def local_planes(total, weight, bell, least_weight, thin, steepest):
    """Weighted least squares of a plane at every block, each on its own."""
    reach, out = len(bell) // 2, np.full(total.shape, np.nan)
    padded = [np.pad(m.astype(float), reach) for m in (total, weight)]
    y, x = np.indices((len(bell), len(bell))) - reach
    window = np.outer(bell, bell)
    for v, u in np.ndindex(total.shape):
        t, w = (m[v : v + len(bell), u : u + len(bell)] * window for m in padded)
        if w.sum() <= least_weight:
            continue
        mean, middle = t.sum() / w.sum(), np.array([(x * w).sum(), (y * w).sum()]) / w.sum()
        from_middle = np.stack([x - middle[0], y - middle[1]])
        spread_of = np.einsum("iyx,jyx,yx->ij", from_middle, from_middle, w) / w.sum() + thin * np.eye(2)
        slope = np.linalg.solve(spread_of, (from_middle * t).sum((1, 2)) / w.sum())
        out[v, u] = mean - np.clip(middle @ slope, -steepest * abs(mean), steepest * abs(mean))
    return out


def camera_contrast(images, ranges, seen, level, variance, covariance, noise_left, factor, limit):
    """C^-1 1 for the covariance C of the images that are known, block by block."""
    shape, kinds = images[0].shape, len(images)
    where = seen > 0 if seen.size else True
    known = [(i > low) & (i < high) & where for i, (low, high) in zip(images, ranges, strict=True)]
    weight, noise = np.zeros((kinds, *level[0].shape)), np.zeros((kinds, kinds, *level[0].shape))
    for y, x in np.ndindex(*level[0].shape):
        C = np.diag([float(v[y, x]) for v in variance])
        if covariance.size:
            C[0, -1] = C[-1, 0] = covariance[y, x]
        held = np.isfinite(np.diag(C))
        if held.any():
            weight[held, y, x] = np.linalg.solve(C[np.ix_(held, held)], np.ones(held.sum()))
            weight[:, y, x] /= weight[:, y, x].sum()
        noise[:, :, y, x] = np.where(np.outer(held, held), C * noise_left, 0)
    weights = [k * spread(w, factor, shape) for k, w in zip(known, weight, strict=True)]
    total = sum(weights)
    grey = [
        w * np.where(k, i, 0) * between_blocks(1 / m.astype(float), factor, shape)
        for w, k, i, m in zip(weights, known, images, level, strict=True)
    ]
    left = sum(weights[k] * weights[j] * spread(noise[k, j], factor, shape) for k in range(kinds) for j in range(kinds))
    with np.errstate(divide="ignore", invalid="ignore"):
        value = np.where(total > 0, np.clip(sum(grey) / total - 1, -limit, limit), np.nan)
        return value, np.where(total > 0, left / total**2, np.nan), weight[0]


def contrast_scatter(images, ranges, seen, levels, expected, factor, step):
    """Number of pixels and median absolute deviation of the difference of two kinds over its deviation."""
    ratios = []
    for image, (low, high), level in zip(images, ranges, levels, strict=True):
        relative = image / spread(level, factor, image.shape)
        ratios.append(np.where((image > low) & (image < high), relative, np.nan))
    normal = (ratios[1] - ratios[0]) / np.sqrt(spread(expected, factor, images[0].shape))
    normal[~(seen > 0 if seen.size else np.ones(normal.shape, bool))] = np.nan
    normal = normal[step // 2 :: step, step // 2 :: step]
    normal = normal[np.isfinite(normal)]
    return len(normal), np.median(np.abs(normal - np.median(normal)))


def fill_gaps(blocks, otherwise):
    filled = blocks.astype(float)
    for _ in range(2):
        padded, before = np.pad(filled, 1, mode="edge"), filled.copy()
        for y, x in np.argwhere(np.isnan(before)):
            around = padded[y : y + 3, x : x + 3]
            if np.isfinite(around).any():
                filled[y, x] = np.nanmean(around)
    return np.where(np.isnan(filled), otherwise, filled)


def lambert(points, normals, source, least_cosine):
    to_light = source - points.astype(float)
    distance = np.linalg.norm(to_light, axis=-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        unit = normals / np.linalg.norm(normals.astype(float), axis=-1, keepdims=True)
        return np.maximum((unit * to_light).sum(-1) / distance, least_cosine) / distance**2


def taps(place, stretch):
    at = np.arange(np.ceil(place - 2 * stretch), np.floor(place + 2 * stretch) + 1).astype(int)
    w = cubic((at - place) / stretch)
    return at, w / w.sum()


def read_view(value, variance, place):
    out = np.full((2, *place.shape[:2]), np.nan)
    height, width = value.shape
    for v, u in np.ndindex(*place.shape[:2]):
        x, y = place[v, u]
        if not (1 <= x < width - 2 and 1 <= y < height - 2):
            continue
        (columns, across), (rows, down) = taps(x, 1.0), taps(y, 1.0)
        out[0, v, u] = down @ value[np.ix_(rows, columns)] @ across
        nearest = variance[int(np.floor(y + 0.5)), int(np.floor(x + 0.5))]
        out[1, v, u] = nearest * (across**2).sum() * (down**2).sum()
    return out


def at_places(blocks, factor, place):
    """Linear interpolation between the centres of blocks at places (H, W, 2)."""
    out = np.zeros(place.shape[:2])
    axes = ((1, blocks.shape[0]), (0, blocks.shape[1]))
    at = [np.clip((np.nan_to_num(place[..., i]) + 0.5) / factor - 0.5, 0, n - 1) for i, n in axes]
    for row, column in np.ndindex(*blocks.shape):
        out += blocks[row, column] * np.maximum(0, 1 - abs(at[0] - row)) * np.maximum(0, 1 - abs(at[1] - column))
    return out


def compensated_image(value, variance, level, factor, place, seen, gain):
    if place.size:
        grey = at_places(level, factor, place)
        value, variance = read_view(value, variance, place)
    else:
        grey = between_blocks(level, factor, value.shape)
    known = np.isfinite(value) | (place.size == 0)
    image = (1 + value) * grey
    sums = block_sums(image, -np.inf, np.inf, seen, factor)
    return image, np.where(known, gain * variance * grey**2, np.nan), *sums


def merge_contrasts(images, valid, factor):
    weights, total, noise = (np.zeros(valid.shape) for _ in range(3))
    for grey, variance, expected, trust in images:
        even, t = between_blocks(expected, factor, valid.shape), between_blocks(trust, factor, valid.shape)
        known = np.isfinite(grey) & (variance > 0)
        w = np.where(known, even**2 / np.where(known, variance, 1), 0)
        weights += t * w
        total += t * w * np.where(known, grey / even - 1, 0)
        noise += t**2 * w
    with np.errstate(divide="ignore", invalid="ignore"):
        held = (valid > 0) & (weights > 0)
        return np.where(held, total / weights, np.nan), np.where(held, np.sqrt(noise) / weights, np.nan)


def sample_chart(value, sigma, known, source, stretch, interpolated):
    """`stretch` (along u, along v) alike for all pixels, which lie inside the map.

    Kernels exist for every 256th of a pixel, and for widths in eighths of one.
    """
    corner = source.astype(int)
    shown = np.all([known[corner[..., 1] + j, corner[..., 0] + i] > 0 for j in (0, 1) for i in (0, 1)], axis=0)
    source, stretch = np.floor(source * 256 + 0.5) / 256, 1 + np.floor((np.asarray(stretch) - 1) * 8 + 0.5) / 8
    lags = np.array([1.0, 0.15570175, -0.04385965, 0.00219298])
    out = np.zeros((2, *source.shape[:2]))
    for y, x in np.argwhere(shown):
        (columns, across), (rows, down) = taps(source[y, x, 0], stretch[0]), taps(source[y, x, 1], stretch[1])
        window = np.ix_(rows, columns)
        out[0, y, x] = down @ value[window] @ across
        gains = []
        for w in (across, down):
            apart = np.abs(np.subtract.outer(np.arange(len(w)), np.arange(len(w))))
            correlation = np.where(apart < 4, lags[np.minimum(apart, 3)], 0)
            gains.append(w @ correlation @ w / (w @ w))
        squares = (down**2) @ sigma[window] ** 2 @ (across**2)
        out[1, y, x] = np.sqrt(squares * (1 + interpolated * (gains[0] * gains[1] - 1)))
    return *out, shown


def remove_pattern(value, variance, own, total, weight, prior, still, gain, factor):
    shape = value.shape
    prior, still, gain = (between_blocks(m, factor, shape) for m in (prior, still, gain))
    mine = spread(own, factor, shape) if own.size else np.zeros(shape)
    w, s = weight - mine, total - np.where(mine > 0, mine * value, 0)
    with np.errstate(divide="ignore", invalid="ignore"):
        share = np.where(w > 1e-3 * weight, prior / (prior + still + 1 / (gain * w)), 0)
        return value - np.where(share > 0, share * s / w, 0), variance + prior * (1 - share)


def split_bands(value, bell, factor):
    known = np.isfinite(value)

    def average(image):
        out = np.zeros(image.shape)
        padded = np.pad(image.astype(float), len(bell) // 2, mode="reflect")
        for (i, j), weight in np.ndenumerate(np.outer(bell, bell)):
            out += weight * padded[i : i + image.shape[0], j : j + image.shape[1]]
        return out

    coarse = np.where(known, average(np.where(known, value, 0)) / np.maximum(average(known), 1e-6), np.nan)
    squares = [block_sums(band**2, -np.inf, np.inf, np.empty((0, 0)), factor) for band in (value - coarse, coarse)]
    return value - coarse, coarse, squares[0][0], squares[1][0], squares[0][1]
