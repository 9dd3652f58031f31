"""Gray code that stands alone: positions between the sub-pixel edges of its cells."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from planish import _core
from planish.errors import InputError
from planish.measurement import Map, NoiseModel
from planish.sensing.capture.images import GreyImage
from planish.sensing.capture.sequence import AxisCode, GrayCode, Layout
from planish.sensing.decode.phase import PhaseMap

#: Pixels whose normalised signal (-1 ... 1) has a larger standard deviation are dark: a bit is then wrong once in
#: 1e6 where it is fully lit or unlit.
MAX_SIGNAL_SIGMA = 0.2
#: What the place of an edge is off where others blur into it (rms for the narrowest stripes that are still resolved,
#: computed for a pixel and lenses of 0.3 to 1 px) [px]; falls to nothing at edges 3 px apart.
EDGE_BIAS_PX = 0.02
#: Bits whose signal hardly anywhere reaches this are finer than camera and projector resolve: their edges lean on each
#: other by more than noise (with 0.25, stripes of 1.4 px were kept, and sigma was a third too small).
MIN_SIGNAL = 0.4
#: Every so many rows and columns serve to choose the bits and the direction of the lines.
SAMPLE_STRIDE = 7


def decode_gray_edges(
    images: Sequence[GreyImage],
    code: AxisCode,
    layout: Layout,
    noise: NoiseModel,
    saturation: float,
    subject: str,
    threads: int,
) -> tuple[PhaseMap, Map, Map, int]:
    """Return the position of every pixel between two edges; mean and amplitude of the light; images behind the mean.

    Parameters
    ----------
    images : sequence of ndarray (H, W), uint8 or uint16
        All images of the camera in the order of the sequence.
    code : AxisCode
        With a Gray code and no periods.
    layout : Layout
        Where white and black stand.
    noise : NoiseModel
        Variance of a grey value.
    saturation : float
        Grey level at and above which a value is clipped.
    subject : str
        Named in errors.
    threads : int
        Number of threads; the result does not depend on it.

    Raises
    ------
    InputError
        Where no bit can be told from its inverse.

    Notes
    -----
    Along the image line that crosses more cells, the edge between cells m - 1 and m lies where the signal of the one
    bit that changes there crosses zero: s = (I - I') / (I_max - I_min), made linear by the inverse of the normal
    distribution, as an edge blurred by a Gaussian is its distribution function. Its variance follows from the noise of
    the four grey values. A pixel between two successive edges takes its position linearly from both, so the errors of
    neighbours are alike over the distance of the edges: `PhaseMap.local_mean_gain`.
    """
    assert code.gray is not None
    signals, bright = _samples(images, code.gray, layout)
    gray = _usable_bits(code.gray, signals, bright, subject)
    along_columns = _crosses_columns(signals[: len(gray.images)], bright)
    wanted, index = _selected(gray, layout)
    selected: list[NDArray[Any]] = [images[i] for i in wanted]
    if along_columns:
        selected = [np.ascontiguousarray(image.T) for image in selected]
    found = _core.gray_edges(
        selected,
        [index[i] if i >= 0 else -1 for i in gray.inverse],
        index[layout.white[0]] if layout.white else -1,
        index[layout.black[0]] if layout.black else -1,
        gray.cell_px,
        saturation,
        noise.offset,
        noise.slope,
        MAX_SIGNAL_SIGMA,
        EDGE_BIAS_PX,
        threads,
    )
    gain = local_mean_gain(found[0], gray.cell_px)
    *maps, rejected = found
    if along_columns:
        maps, rejected = [np.ascontiguousarray(m.T) for m in maps], np.ascontiguousarray(rejected.T)
    position, sigma, mean, modulation = maps
    count = 2 * len(gray.images) if min(gray.inverse) >= 0 else 2
    return PhaseMap(code.axis, position, sigma, rejected, gain), mean, modulation, count


def local_mean_gain(position_px: Map, cell_px: float) -> float:
    """Return how much noisier a mean of neighbouring positions (H, W) along a row is than of independent ones.

    Notes
    -----
    Linear interpolation between independent edges at distance D has, averaged over where the pixel lies between them,
    the autocovariance of a cubic B-spline: rho(k) = M(k / D) / M(0) (two triangles convolved with each other). The
    weights are those of the cubic B-spline that reads the other camera (points/correspond.py), averaged likewise.
    """
    steps = np.abs(np.diff(position_px[::SAMPLE_STRIDE], axis=1))
    known = steps[np.isfinite(steps)]
    if not known.size:
        return 1.0
    spacing = cell_px / max(float(np.median(known)), 1e-6)
    lags = np.arange(4)
    likeness = _cubic_spline(lags / spacing) / _cubic_spline(np.zeros(1))
    places = (np.arange(16) + 0.5) / 16
    weights = _cubic_spline(np.arange(-1, 3)[:, None] - places)
    alike = sum(likeness[abs(i - j)] * (weights[i] * weights[j]).mean() for i in range(4) for j in range(4))
    return float(np.sqrt(alike / (weights**2).sum(0).mean()))


def _cubic_spline(x: NDArray[np.float64]) -> NDArray[np.float64]:
    x = np.abs(x)
    inner, outer = 2 / 3 - x**2 + x**3 / 2, np.clip(2 - x, 0, None) ** 3 / 6
    return np.where(x < 1, inner, outer)


def _selected(gray: GrayCode, layout: Layout) -> tuple[list[int], dict[int, int]]:
    wanted = [*gray.images, *(i for i in gray.inverse if i >= 0), *layout.white[:1], *layout.black[:1]]
    return wanted, {image: k for k, image in enumerate(wanted)}


def _samples(
    images: Sequence[GreyImage], gray: GrayCode, layout: Layout
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Signals (bits, h, w) of every SAMPLE_STRIDE-th pixel, and which of them are among the brighter half."""
    wanted, index = _selected(gray, layout)
    stack = np.stack([images[i][::SAMPLE_STRIDE, ::SAMPLE_STRIDE] for i in wanted]).astype(float)
    low, high = stack.min(0), stack.max(0)
    signals = []
    for image, inverse in zip(gray.images, gray.inverse, strict=True):
        lit = stack[index[image]]
        difference = lit - stack[index[inverse]] if min(gray.inverse) >= 0 else 2 * lit - high - low
        signals.append(difference / np.maximum(high - low, 1.0))
    return np.array(signals), high - low >= np.median(high - low)


def _usable_bits(gray: GrayCode, signals: NDArray[np.float64], bright: NDArray[np.bool_], subject: str) -> GrayCode:
    # A Gray code without its last bits is the Gray code of cells twice, four times ... as long.
    strength = [float(np.quantile(np.abs(signal[bright]), 0.75)) for signal in signals]
    dropped = 0
    while dropped < len(strength) and strength[len(strength) - 1 - dropped] < MIN_SIGNAL:
        dropped += 1
    kept = len(strength) - dropped
    if kept == 0:
        raise InputError(
            f"{subject}: sequence",
            f"no Gray bit reaches {MIN_SIGNAL:g} of the difference between the brightest and darkest image",
            "images in which the stripes can be seen",
        )
    return replace(gray, cell_px=gray.cell_px * 2**dropped, images=gray.images[:kept], inverse=gray.inverse[:kept])


def _crosses_columns(signals: NDArray[np.float64], bright: NDArray[np.bool_]) -> bool:
    """Whether the position changes more along the columns of the image than along its rows."""
    lit = signals > 0
    turns = [
        sum(int((np.diff(bit, axis=axis) & np.take(bright, range(1, bright.shape[axis]), axis)).sum()) for bit in lit)
        for axis in (0, 1)
    ]
    return turns[0] > turns[1]
