"""Statistical patterns: correspondence by temporal normalised cross-correlation on the exact epipolar curve.

Nothing is known of the patterns but that all images were taken of the same scene at the same places: every pixel is
a vector of grey values over time, and the corresponding pixel has the same one, up to gain and offset.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import lgamma, log

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from planish import _core
from planish.errors import InputError
from planish.geometry import Array
from planish.measurement import Map, NoiseModel, View
from planish.options import Options
from planish.rig import Camera
from planish.sensing.capture.images import GreyImage
from planish.sensing.capture.manifest import Box
from planish.sensing.points.correspond import Correspondences, fundamental_matrix, undistortion_shifts

#: Every so many pixels the range of the search is computed from the volume.
RANGE_SPACING_PX = 16


class CorrelateOptions(Options):
    """Options of the correlation.

    Parameters
    ----------
    min_steps : int
        Images below saturation that a pixel needs; fewer cannot tell places apart.
    false_alarm : float
        Probability with which chance alone may reach, somewhere on a whole image row, the correlation demanded.
    alone_false_alarm : float
        The same for pixels whose neighbours do not agree with them.
    misfit_sigmas : float
        A match fits where the sum of squared residuals, in units of their variances, stays below the quantile of its
        chi-square distribution that a normal distribution reaches at so many standard deviations.
    model_loss : float
        Part of 1 - NCC^2 that is no noise: defocus, curvature, non-linear light.
    min_gap : float
        By so much (of the sum of squared residuals over their variances) a match must fit better than every other
        place: 25 = odds of 270,000 to 1.
    """

    min_steps: int = Field(default=6, ge=6)
    false_alarm: float = Field(default=0.1, gt=0, lt=1)
    alone_false_alarm: float = Field(default=1e-6, gt=0, lt=1)
    misfit_sigmas: float = Field(default=4.75, gt=0)
    model_loss: float = Field(default=2e-3, ge=0, lt=0.5)
    min_gap: float = Field(default=25.0, ge=0)


def correlate(
    own: Sequence[GreyImage],
    other: Sequence[GreyImage],
    own_camera: Camera,
    other_camera: Camera,
    own_noise: NoiseModel,
    other_noise: NoiseModel,
    saturation: tuple[float, float],
    options: CorrelateOptions,
    threads: int,
    volume: Box | None = None,
) -> tuple[Correspondences, NDArray[np.uint16]]:
    """Return the correspondence of every pixel of `own` in `other`, and why pixels have none.

    Parameters
    ----------
    own, other : sequence of ndarray (H, W)
        The statistical images of the organising camera and of the other one, taken together, in the same order.
    own_camera, other_camera : Camera
        Their calibration, with lens distortion.
    own_noise, other_noise : NoiseModel
        Noise of single images.
    saturation : (float, float)
        Grey levels at and above which own and other pixels count as saturated; such steps are left out.
    options : CorrelateOptions
        Limits.
    threads : int
        Number of threads; the result does not depend on it.
    volume : Box, optional
        Points are looked for within this box of the sensor frame only.

    Returns
    -------
    pairs : Correspondences
        As from `correspond`.
    rejected : ndarray (H, W) uint16
        Bit mask of measurement.REJECTIONS: "dark" (temporal modulation below what its noise allows), "saturated" (fewer
        than `min_steps` images below saturation), "unmatched" (nothing alike on the epipolar curve), "mixed" (alike,
        but not within the noise: two surfaces), "ambiguous" (two places fit alike), "masked" (its ray misses the
        volume).

    Raises
    ------
    InputError
        Where the cameras have different numbers of images, too few of them, or stand at one place.

    Notes
    -----
    With the own vector a, the other camera's unit vector b(u) interpolated along the curve, its derivative g across b,
    and the gain q = a.b / b.b: sigma_u^2 = sum_k g_k^2 (var a_k + q^2 w var b_k) / (q^2 (g.g)^2), w the sum of the
    squared interpolation weights. With equal variances this is (var a / q^2 + w var b) / g.g. The noise of b and g is
    taken out of b.b, b.g and g.g (docs/measure.md).
    """
    _check(own, other, own_camera, other_camera, options)
    F = fundamental_matrix(own_camera, other_camera)
    width, height = own_camera.size_px
    line = F @ [0.5 * width, 0.5 * height, 1.0]
    steep = abs(line[0]) > abs(line[1])
    shifts = undistortion_shifts(other_camera, threads)
    searched = [np.ascontiguousarray(image.T if steep else image) for image in other]
    if steep:
        shifts = np.ascontiguousarray(shifts.transpose(1, 0, 2)[..., ::-1])
        F = F[[1, 0, 2]]
    noise = [own_noise.offset, own_noise.slope, saturation[0], other_noise.offset, other_noise.slope, saturation[1]]
    steps = np.arange(len(own) + 1)
    max_loss, sure_loss = (
        np.array([_chance_loss(int(n), probability, max(other_camera.size_px)) for n in steps], np.float32)
        for probability in (options.false_alarm, options.alone_false_alarm)
    )
    pixel, sigma, rejected = _core.correlate(
        [np.ascontiguousarray(image) for image in own],
        undistortion_shifts(own_camera, threads),
        searched,
        shifts,
        np.array(noise, np.float32),
        np.ascontiguousarray(F),
        options.min_steps,
        max_loss,
        sure_loss,
        _largest_misfit(steps, options.misfit_sigmas).astype(np.float32),
        options.model_loss,
        options.min_gap,
        _search_range(own_camera, other_camera, volume, int(steep)),
        RANGE_SPACING_PX,
        threads,
    )
    return Correspondences(np.ascontiguousarray(pixel[..., ::-1]) if steep else pixel, sigma), rejected


def temporal_view(images: Sequence[GreyImage], noise: NoiseModel, saturation: float, threads: int) -> View:
    """Return what a camera saw of a statistical sequence (N images (H, W)).

    `mean` is the mean of all images, `modulation` the temporal standard deviation times sqrt 2: for cosines of random
    phase, as `statistical_profile` makes them, that is their amplitude, as with fringes.
    """
    mean, norm, _ = _core.temporal_statistics([np.ascontiguousarray(i) for i in images], saturation, threads)
    return View(None, mean, norm * np.float32(np.sqrt(2 / len(images))), len(images), noise, saturation)


def _check(
    own: Sequence[GreyImage],
    other: Sequence[GreyImage],
    own_camera: Camera,
    other_camera: Camera,
    options: CorrelateOptions,
) -> None:
    if len(own) != len(other) or len(own) < options.min_steps:
        raise InputError(
            "statistical images",
            f"{len(own)} of one camera and {len(other)} of the other",
            f"the same number of both, at least {options.min_steps}",
        )
    for images, camera in ((own, own_camera), (other, other_camera)):
        for image in images:
            if (image.shape[1], image.shape[0]) != camera.size_px or image.dtype != images[0].dtype:
                raise InputError(
                    "statistical images",
                    f"an image of {image.shape[1]} x {image.shape[0]} px, {image.dtype}",
                    f"{camera.size_px[0]} x {camera.size_px[1]} px and {images[0].dtype}, as its camera and its first",
                )


def _chance_loss(steps: int, false_alarm: float, places: int) -> float:
    """Return the 1 - NCC^2 below which chance gets with probability `false_alarm` in one of `places`.

    Between random vectors of n numbers, mean taken away, 1 - NCC^2 is distributed as Beta((n - 2) / 2, 1 / 2); half of
    them have a positive correlation. Its lower tail is x^a / (a B(a, 1/2)), a = (n - 2) / 2.
    """
    if steps < 3:
        return 0.0
    a = 0.5 * (steps - 2)
    log_beta = lgamma(a) + lgamma(0.5) - lgamma(a + 0.5)
    return float(min(np.exp((log(2 * false_alarm / places) + log(a) + log_beta) / a), 0.5))


def _largest_misfit(steps: NDArray[np.int_], sigmas: float) -> Array:
    """Return the quantile of chi-square with steps - 3 degrees of freedom (Wilson & Hilferty, PNAS 17, 1931)."""
    freedom = np.maximum(steps - 3, 1).astype(float)
    spread = 2 / (9 * freedom)
    return np.asarray(freedom * (1 - spread + sigmas * np.sqrt(spread)) ** 3)


def _search_range(own: Camera, other: Camera, volume: Box | None, axis: int) -> Map:
    """Return the lowest and highest coordinate (h, w, 2) [px] in `other` of the ray of every 16th pixel in the volume.

    NaN where the ray misses the box; of size 0 without a volume.
    """
    if volume is None:
        return np.empty((0, 0, 2), np.float32)
    width, height = own.size_px
    spacing = RANGE_SPACING_PX
    u, v = np.meshgrid(np.arange(0, width + spacing, spacing), np.arange(0, height + spacing, spacing))
    rays, center = own.rays_sensor(np.stack([u, v], -1)), own.center_sensor
    with np.errstate(divide="ignore", invalid="ignore"):
        crossings = (np.array([volume.min, volume.max])[:, None, None] - center) / rays
        near = np.maximum(crossings.min(0).max(-1), 1e-6)
        far = crossings.max(0).min(-1)
        ends = [other.project(center + depth[..., None] * rays)[..., axis] for depth in (near, far)]
        found = np.sort(np.stack(ends, -1), axis=-1)
        found[~(near < far)] = np.nan
    return np.ascontiguousarray(found, np.float32)
