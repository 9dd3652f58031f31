"""What the residuals of a fit say about it: are they as large as noise makes them, or as large as a wrong fit does?

Covariances and tiles kept out compare a fit with its surroundings: at a wrong optimum they may agree. The size of what
is left does not: textures that belong together leave their noise, unrelated ones leave themselves.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from planish.geometry import Array
from planish.measurement import Map
from planish.registration.refine.local_correlation import local_correlation_sigma
from planish.registration.refine.residuals import PER_MEAN_ABSOLUTE, Weights, around, equations, tile_of
from planish.registration.refine.sides import JointSide
from planish.registration.refine.solve import Refined, RefineOptions
from planish.registration.refine.spectrum import MOST_NOISE

#: Every n-th pixel along both axes tells how large the residuals are, and how large the noise that is expected.
_STRIDE, _NOISE_STRIDE = 3, 12
#: Whole textures that correlate by so many standard deviations need not be asked tile by tile.
_CLEAR_SIGMA = 10.0


@dataclass(frozen=True)
class FitStatistics:
    """Residuals against expectation. All are medians over the overlap: up to half of it may be disturbed.

    Parameters
    ----------
    distance_scale : float
        Of the surfaces' distances over their noise, standard deviation; 0 without any.
    distance_mm : float
        Distance that the noise does not explain, standard deviation [mm].
    texture_scale : float
        Of the textures' differences over what their noise leaves of them, standard deviation; 0 without any.
    common_texture : float
        Share of the textures' variance without noise that they have in common: 1 = one texture, 0 = unrelated ones.
    most_common_texture : float
        The same if there were as much more noise than stated as the filter reckons with; 1 where that would be all that
        is seen.
    sigma : float
        Standard deviation of `common_texture` by the number of independent values alone.
    correlation_sigma : float
        Correlation of the textures in standard deviations of that of unrelated ones: of the whole or, where a highlight
        rules that, tile by tile; the greater.
    """

    distance_scale: float
    distance_mm: float
    texture_scale: float
    common_texture: float
    most_common_texture: float
    sigma: float
    correlation_sigma: float


def fit_statistics(
    a: JointSide,
    b: JointSide,
    refined: Refined,
    options: RefineOptions | None = None,
    threads: int = 1,
    shading_px: float | None = None,
) -> FitStatistics:
    """Return what the residuals of a and b (last level, with the tiles kept out) say about a fit.

    `shading_px` is the low-pass that took the shading from b; None = tiles are not asked whether they correlate.

    Surfaces count as far apart as on any level: the last one would leave out what contradicts it most.

    Notes
    -----
    Per tile and its neighbours, r the difference of the textures and m their mean in units of the noise of r, P the
    noise that the filter passes: var(r) = P + 2 S (1 - c), 4 var(m) = P + 2 S (1 + c), S the signal and c what both
    have in common.
    """
    options = options or RefineOptions()
    tile = tile_of(_STRIDE, refined.weights.tile)
    weights = Weights.alike(b, tile).shaded(_shading_of(refined.weights, b, tile))
    e = equations(
        a, b, refined.T_a_b, refined.about, weights, max_distance_mm=max(options.max_distance_mm),
        max_normal_rad=options.max_normal_rad, stride=_STRIDE, tile_px=tile, residuals=False, threads=threads,
    )  # fmt: skip
    number_d, rms_d = _sizes(e.tile_sizes[:, :, 0])
    number, rms = _sizes(e.tile_sizes[:, :, 1])
    scale = _weighted_median(rms_d, number_d)
    sigma_mm = np.sqrt(_median(a.values[..., 3]) + _median(b.values[..., 3]))
    noise = (a.noise_passed + b.noise_passed) / 2
    with np.errstate(divide="ignore", invalid="ignore"):
        four_means = np.where(number > 0, 4 * around(e.tile_shading[..., 12]) / around(e.tile_sizes[:, :, 1, 0]), 0)
    both, common = four_means + rms**2, four_means - rms**2
    pixels_per_value = float(np.sqrt(a.pixels_per_value * b.pixels_per_value))
    values = max(e.texture_points * _STRIDE**2 / pixels_per_value, 1.0)
    sigma = refined.equations.correlation * float(np.sqrt(refined.equations.texture_points / pixels_per_value))
    if shading_px is not None and sigma < _CLEAR_SIGMA:
        sigma = max(sigma, local_correlation_sigma(a, b, refined, shading_px, options, threads))
    return FitStatistics(
        scale,
        float(np.sqrt(max(scale**2 - 1, 0)) * sigma_mm),
        _weighted_median(rms, number) / float(np.sqrt(noise)),
        _common(common, both - 2 * noise, number),
        _common(common, both - 2 * MOST_NOISE * noise, number),
        float(1 / np.sqrt(values)),
        sigma,
    )


def _shading_of(weights: Weights, b: JointSide, tile: int) -> Map:
    on = weights.on(b.texture.shape, tile)
    return on.reshape(*on.shape[:2], 2, 4)[:, :, 1, 2:]


def _sizes(tile_sizes: Array) -> tuple[Array, Array]:
    """Number of each tile's own residuals, and their standard deviation there and around."""
    number, absolute = around(tile_sizes[..., 0]), around(tile_sizes[..., 1])
    with np.errstate(divide="ignore", invalid="ignore"):
        # Mean absolute values, which outliers move less than squares.
        return tile_sizes[..., 0], np.where(number > 0, PER_MEAN_ABSOLUTE * absolute / number, 0)


def _common(common: Array, signal: Array, number: Array) -> float:
    """Median of common / signal over what holds any; 1 where noise alone may be all that is seen."""
    # Not by the signal: a highlight or a lamp's glare on the smaller part would speak for all.
    weight = np.where(signal > 0, number, 0)
    # Textures in which most tiles hold no signal say nothing.
    if (number * signal).sum() <= 0:
        return 1.0
    with np.errstate(divide="ignore", invalid="ignore"):
        return _weighted_median(np.where(weight > 0, common / signal, 0), weight)


def _weighted_median(values: Array, weights: Array) -> float:
    use: NDArray[np.bool_] = weights > 0
    if not use.any():
        return 0.0
    order = np.argsort(values[use], kind="stable")
    sums = np.cumsum(weights[use][order])
    return float(values[use][order][np.searchsorted(sums, sums[-1] / 2)])


def _median(variance: Map) -> float:
    sample = variance[::_NOISE_STRIDE, ::_NOISE_STRIDE]
    known = sample[np.isfinite(sample)]
    return float(np.median(known)) if len(known) else 0.0
