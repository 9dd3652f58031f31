"""One measurement as the refinement sees it: points, normals and filtered texture at several resolutions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from planish import _core
from planish.geometry import Array
from planish.measurement import Map, Measurement
from planish.options import thread_count
from planish.registration.refine.bending import displacement, moved_back
from planish.registration.refine.blur import height_by_blur
from planish.registration.refine.filtering import filter_texture
from planish.registration.refine.smoothing import smooth_map
from planish.registration.refine.spectrum import seen_apart
from planish.registration.surface import Surface
from planish.registration.texture.lowpass import bell
from planish.registration.tiles import held_out, tile_size_px

#: Standard deviation of the Gaussian before every n-th pixel is taken, in parts of n: what aliases is below 1 %.
_BEFORE_THINNING = 0.6
#: A Gaussian of s px leaves 1 / (4 pi s^2) of the variance of white noise; of n^2 pixels one is taken.
_THINNED_NOISE = 1 / (4 * np.pi * _BEFORE_THINNING**2)
#: Pixels per independent value of white noise after that Gaussian: its power spectrum is one of 1 / sqrt(2) the width.
_THINNED_PER_VALUE = 2 * np.pi * _BEFORE_THINNING**2
#: Where the low-pass of the shading had less than this share of its window, the rim of the part or a shadow is near,
#: and slow shading was left in the texture.
_INSIDE = 0.9
#: Every so many pixels tell what a whole window holds.
_SPARSE = 4
#: Variance of the images' blur and its standard deviation [px^2]: a pixel's aperture alone has 1 / 12, optics that
#: suit it about as much as 0.4.
_BLUR, _BLUR_SIGMA = 0.3, 0.15
#: Reach of the Gaussian before thinning, in standard deviations.
_REACH = 4.0
#: A pixel and its four neighbours.
_CROSS = np.array([[0, 1, 0], [1, 1, 1], [0, 1, 0]], np.uint8)
#: What the kernel takes for a texture that tells its slopes itself.
_NO_SLOPES = np.empty((0, 0, 2), np.float32)


@dataclass(frozen=True)
class JointSide:
    """One measurement at one resolution: every n-th pixel of its organising camera.

    Parameters
    ----------
    camera : ndarray (29,)
        Kernel parameters of the organising camera, for these pixels.
    spacing_px : int
        n.
    values : ndarray (H, W, 12) float32
        Point [mm], variance along its normal [mm^2], normal, variance of the texture, its gradient [1/mm],
        standard deviation of what the images' blur displaces along the normal [mm].
    texture : ndarray (H, W) float32
        Filtered texture; NaN where it takes no part.
    use : ndarray (H, W) uint8
        0 = takes no part.
    noise_passed : float
        Variance that the texture's filter leaves of white noise of unit variance.
    pixels_per_value : float
        Pixels per independent value of the texture.
    """

    camera: Array
    spacing_px: int
    values: Map
    texture: Map
    use: NDArray[np.uint8]
    noise_passed: float
    pixels_per_value: float = 1.0

    def without(self, mask: NDArray[np.bool_]) -> JointSide:
        """Return the same, without some pixels (of the whole resolution)."""
        kept = ~mask[:: self.spacing_px, :: self.spacing_px]
        return replace(self, use=np.where(kept, self.use, np.uint8(0)))

    @property
    def maps(self) -> tuple[Map, Map, NDArray[np.uint8]]:
        """The arrays in the order of the kernels."""
        return self.values, self.texture, self.use


def held_out_pixels(measurement: Measurement) -> NDArray[np.bool_]:
    """Return the pixels (H, W) of the tiles that take no part in any fit against this measurement."""
    size = tile_size_px(measurement)
    height, width = measurement.shape
    of_tiles = held_out(*np.indices((-(-height // size), -(-width // size))))
    return of_tiles.repeat(size, 0).repeat(size, 1)[:height, :width]


def joint_sides(
    measurement: Measurement,
    surface: Surface,
    contrast: tuple[Map, Map],
    spacings_px: Sequence[int],
    shading_mm: float,
    threads: int | None = None,
) -> dict[int, JointSide]:
    """Return the measurement at several resolutions.

    Parameters
    ----------
    measurement : Measurement
    surface : Surface
    contrast : tuple of two ndarray (H, W)
        Local contrast and its standard deviation.
    spacings_px : sequence of int
        Every n-th pixel, for each of them.
    shading_mm : float
        Scale of the low-pass that the contrast is free of [mm].
    threads : int, optional
    """
    gsd = measurement.sample_distance_mm
    shading_px = shading_mm / gsd if np.isfinite(gsd) else 1.0
    value, sigma = contrast
    known, count = np.isfinite(value), thread_count(threads)
    inside = known & _inside(measurement.valid, known, shading_px)
    filtered = filter_texture(value, sigma, shading_px, seen_apart(measurement, inside, sigma, shading_px), count)
    by_blur, by_spline = height_by_blur(measurement, surface, count)
    # The points as measured: the smoothed ones lie behind a curved surface by an amount that depends on the view.
    points = np.ascontiguousarray(measurement.points_sensor, np.float32)
    maps = points, measurement.sigma_mm, surface.normals_sensor, surface.tangents_sensor, by_blur, sigma, by_spline
    fine = moved_back(filtered.value, displacement(surface.tangents_sensor, filtered.reach))
    beside = cv2.erode(inside.view(np.uint8), _CROSS, borderValue=0).view(np.bool_)
    sides = {}
    for n in spacings_px:
        # Coarse levels must lead here from afar: there the texture is as it is, its slow changes the strongest.
        if n == 1:
            level, slopes = np.where(inside, fine, np.float32(np.nan)), _NO_SLOPES
        else:
            level, slopes = thinned_texture(value, known, _BEFORE_THINNING * n, n, count)
            level[~inside[::n, ::n]] = np.nan
            slopes[~beside[::n, ::n]] = np.nan
        values = _core.joint_values(
            maps, level, slopes, measurement.camera.center_sensor, _BLUR, _BLUR_SIGMA, n, count
        )  # fmt: skip
        camera = measurement.camera.kernel_parameters.copy()
        camera[:5] /= n
        use = np.ones(values.shape[:2], np.uint8)
        of_filter = filtered.noise_passed, filtered.pixels_per_value
        smoothed = _THINNED_NOISE, max(filtered.pixels_per_value / n**2, _THINNED_PER_VALUE)
        sides[n] = JointSide(camera, n, values, level, use, *(of_filter if n == 1 else smoothed))
    return sides


def thinned_texture(
    value: Map, known: NDArray[np.bool_], sigma_px: float, step_px: int, threads: int = 1
) -> tuple[Map, Map]:
    """Gaussian averages of known pixels (normalised convolution) around every n-th pixel, and their slopes.

    Parameters
    ----------
    value : ndarray (H, W)
    known : ndarray (H, W) bool
    sigma_px : float
        Standard deviation of the Gaussian.
    step_px : int
        n.
    threads : int

    Returns
    -------
    smooth : ndarray (h, w) float32
        NaN where `value` is unknown.
    slopes : ndarray (h, w, 2) float32
        Change of `smooth` per pixel along u and v.
    """
    reach = int(np.ceil(_REACH * sigma_px))
    weights = bell(sigma_px, reach)
    # The derivative of an average is the average under the derivative of the bell.
    taps = [weights.tolist(), (weights * np.arange(-reach, reach + 1) / sigma_px**2).tolist()]
    shape = (-(-value.shape[0] // step_px), -(-value.shape[1] // step_px))
    filled, seen = np.where(known, value, np.float32(0)), known.astype(np.float32)
    total, weight = (
        _core.window_moments(image, taps, [(0, 0), (1, 0), (0, 1)], step_px, shape, threads) for image in (filled, seen)
    )
    weight[0][~known[::step_px, ::step_px]] = np.nan
    smooth = total[0] / weight[0]
    slopes = np.stack(
        [
            (of_total - smooth * of_weight) / weight[0]
            for of_total, of_weight in zip(total[1:], weight[1:], strict=True)
        ],
        -1,
    )
    return smooth, slopes


def _inside(valid: NDArray[np.bool_], known: NDArray[np.bool_], shading_px: float) -> NDArray[np.bool_]:
    """Where the low-pass saw nearly as much of the surface as it does anywhere (a narrow strip is all rim)."""
    if not known.any():
        return known
    density = smooth_map(valid.astype(np.float32), shading_px, shading_px)
    some = density[::_SPARSE, ::_SPARSE][known[::_SPARSE, ::_SPARSE]]
    return np.asarray(density > _INSIDE * np.quantile(some, 0.9)) if some.size else known
