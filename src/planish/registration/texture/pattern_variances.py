"""The variances that tell a sensor's pattern from texture and noise, from sums over captures."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from planish.geometry import Array
from planish.measurement import Map, Measurement
from planish.registration.texture.camera_pattern import BLOCK_PX

#: Windows (standard deviation of a Gaussian [blocks]) in which variances are told apart; the wide one for what is
#: alike over the sensor or over large areas, the narrow one for dust.
_WIDE_BLOCKS, _NARROW_BLOCKS = 8.0, 1.5
#: Texture correlates over about so many pixels along each axis: windows hold as many fewer independent values.
_CORRELATED_PX = 3.0
#: Dust must exceed the chance of textures that happen to agree by so many standard deviations.
_DUST_SIGMAS = 4.0
#: From this share of still texture on, a place says nothing about the level of the pattern, nor about dust: windows
#: mix what lies beside each other.
_MAX_STILL = 0.5
#: Without this share of places that do, the level stays unknown: all captures are of one place.
_MIN_TELLING = 0.2
#: Least share of a capture's variance that is held to be error of its estimate of the pattern.
_MIN_ERRORS = 0.01


@dataclass
class Moments:
    """Sums over captures per block (h, w), with the weights w of the captures."""

    maps: dict[str, Array] = field(default_factory=dict)

    def add(self, weight: Map, squares: Map, count: Map, noise: Map) -> None:
        """Add a capture: its weight, sum of squared contrasts, number of pixels and sum of noise variances (h, w)."""
        w = weight.astype(float)
        _accumulate(
            self.maps,
            {"w": w * count, "ww": w**2 * count, "wwcc": w**2 * squares, "wwn": w**2 * noise},
        )

    def merge(self, other: Moments) -> None:
        """Add the sums over other captures."""
        _accumulate(self.maps, other.maps)

    @property
    def shape(self) -> tuple[int, int]:
        """Number of blocks (h, w)."""
        h, w = self.maps["w"].shape
        return h, w


@dataclass
class StillTexture:
    """What two cameras have in common at corresponding pixels, in one capture and between captures.

    Sums over captures, on every `BLOCK_PX`-th row of the organising camera. Without a second camera, its neighbours
    take the place of the corresponding pixel: a lens makes texture continuous, not the response of pixels.
    """

    own: Map | None = None
    other: Map | None = None
    count: Map | None = None
    maps: dict[str, Array] = field(default_factory=dict)
    captures: int = 0

    def add(self, measurement: Measurement, values: dict[str, Map], weight: Map) -> None:
        """Add a capture: contrasts (H, W) by camera, weights (h, w) of the organising one."""
        rows = slice(BLOCK_PX // 2, None, BLOCK_PX)
        own = values[measurement.organised_on]
        names = [name for name in values if name != measurement.organised_on]
        place = measurement.correspondence_px
        if names and place is not None:
            u, v = (np.nan_to_num(np.ascontiguousarray(place[rows, :, i]), nan=-1e4) for i in (0, 1))
            constant, unknown = cv2.BORDER_CONSTANT, float("nan")
            other = cv2.remap(values[names[0]], u, v, cv2.INTER_LINEAR, borderMode=constant, borderValue=unknown)
        else:
            place = None
            cross = np.array([[0, 1, 0], [1, 0, 1], [0, 1, 0]], np.float32) / 4
            other = cv2.filter2D(own, -1, cross)[rows]
        a, b = own[rows], other
        w = np.repeat(weight[: len(a)], BLOCK_PX, axis=1)[:, : a.shape[1]]
        known = np.isfinite(a) & np.isfinite(b) & (w > 0) & measurement.valid[rows]
        a, b, w = (np.where(known, m, np.float32(0)) for m in (a, b, w))
        if self.own is None or self.other is None or self.count is None:
            self.own, self.other, self.count = (np.zeros_like(a) for _ in range(3))
        # In units of its standard deviation, a strongly textured place counts no more than a weak one.
        a, b = a * np.sqrt(w), b * np.sqrt(w)
        self.own += a
        self.other += b
        self.count += known
        self.captures += 1
        sums: dict[str, NDArray[Any]] = {"product": _columns(a * b), "count": _columns(known)}
        if place is not None:
            at = place[rows, BLOCK_PX // 2 :: BLOCK_PX]
            held = np.isfinite(at[..., 0])
            sums |= {"seen": held, "u": np.where(held, at[..., 0], 0), "v": np.where(held, at[..., 1], 0)}
        _accumulate(self.maps, sums)

    def merge(self, other: StillTexture) -> None:
        """Add the sums over other captures."""
        if self.own is None or self.other is None or self.count is None:
            self.own, self.other, self.count = other.own, other.other, other.count
        elif other.own is not None and other.other is not None and other.count is not None:
            self.own, self.other, self.count = self.own + other.own, self.other + other.other, self.count + other.count
        self.captures += other.captures
        _accumulate(self.maps, other.maps)

    def share(self) -> Array:
        """Return the share of the texture's variance that stood still, on the blocks of the organising camera."""
        assert self.own is not None
        assert self.other is not None
        assert self.count is not None
        product, count = (_smooth(self.maps[name], _WIDE_BLOCKS) for name in ("product", "count"))
        between = _smooth(_columns(self.own.astype(float) * self.other), _WIDE_BLOCKS) - product
        pairs = _smooth(_columns(self.count.astype(float) ** 2), _WIDE_BLOCKS) - count
        # Twice the standard deviation of what both have in common by chance keeps the ratio quiet where there is no
        # texture. It does not average out over captures: patterns of both cameras are as fixed as still texture.
        chance = 2 * _spread_of_products(self.own, self.other)
        with np.errstate(divide="ignore", invalid="ignore"):
            within = np.maximum(product / count, 0) + chance / pairs
            # What chance explains is no still texture, or dust beside it would stay.
            certain = np.clip(2 * between / chance - 1, 0, 1)
            shared = certain * between / pairs
            return np.asarray(np.nan_to_num(shared / within, nan=0.0, posinf=0.0, neginf=0.0).clip(0, 1))

    def at_camera(self, share: Array, shape: tuple[int, int], own: bool) -> Array:
        """Return what `share` has found on the h x w blocks of a camera, the organising one or the other."""
        if not own:
            return self._at_other(share, shape)
        out = np.zeros(shape)
        out[: share.shape[0]] = share[: shape[0], : shape[1]]
        return out

    def _at_other(self, found: Array, shape: tuple[int, int]) -> Array:
        """Carry a map to where the blocks lie in the other camera, on average: what stands still lies there always."""
        seen = self.maps["seen"]
        held = seen > 0
        column, row = (
            (self.maps[name][held] / seen[held] / BLOCK_PX).astype(np.intp).clip(0, n - 1)
            for name, n in (("u", shape[1]), ("v", shape[0]))
        )
        total, count = np.zeros(shape), np.zeros(shape)
        np.add.at(total, (row, column), found[: held.shape[0], : held.shape[1]][held])
        np.add.at(count, (row, column), 1.0)
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.nan_to_num(_smooth(total, 1.0) / _smooth(count, 1.0)).clip(0, 1)


def pattern_variances(
    moments: Moments, weighted_sum: Map, weight: Map, still_share: Array, cell_px: float
) -> tuple[Map, Map, Map]:
    """Return the variance of the pattern, that of still texture, and the information per weight (each (h, w)).

    White noise has one independent value per `cell_px` pixels.

    Two captures' covariance at the same pixel is that of the pattern and of still texture; the rest of their variance
    is noise, which is known, and texture. The pattern is taken to be alike over the sensor (its response), but for
    places where much more is in common than chance explains (dust).
    """
    m = moments.maps
    common = _blocks(weighted_sum.astype(float) ** 2) - m["wwcc"]
    pairs = _blocks(weight.astype(float) ** 2) - m["ww"]

    def estimates(width: float) -> tuple[Array, Array, Array]:
        with np.errstate(divide="ignore", invalid="ignore"):
            covariance = _smooth(common, width) / _smooth(pairs, width)
            variance = _smooth(m["wwcc"], width) / _smooth(m["ww"], width)
            noise = _smooth(m["wwn"], width) / _smooth(m["ww"], width)
        return (np.nan_to_num(x, nan=0.0, posinf=0.0, neginf=0.0) for x in (covariance, variance, noise))  # type: ignore[return-value]

    covariance, variance, noise = estimates(_WIDE_BLOCKS)
    # covariance = pattern + share * texture, variance - noise = pattern + texture.
    level = (covariance - still_share * (variance - noise)) / np.maximum(1 - still_share, 1 - _MAX_STILL)
    measured = pairs > 0
    telling = measured & (still_share < _MAX_STILL)
    enough = telling.sum() > _MIN_TELLING * measured.sum()
    response = max(0.0, float(np.median(level[telling]))) if enough else 0.0
    prior = response * (1 - still_share)

    covariance, variance, noise = estimates(_NARROW_BLOCKS)
    still = still_share * np.maximum(variance - noise - response, 0)
    local = covariance - still_share * np.maximum(variance - noise, 0)
    window = 4 * np.pi * (_NARROW_BLOCKS * BLOCK_PX) ** 2
    texture = np.maximum(variance - noise - prior, 0)
    with np.errstate(divide="ignore", invalid="ignore"):
        captures = np.maximum(np.nan_to_num((pairs + m["ww"]) / m["ww"], nan=1.0), 1.0 + 1e-6)
        # Deviation of the covariance of independent captures: noise has as many cells as pixels, texture fewer.
        spread = (cell_px * variance**2 + (_CORRELATED_PX * texture) ** 2) / window
        chance = np.sqrt(2 * spread / (captures * (captures - 1)))
        weight_of_one = m["ww"] / m["w"]
    dust = (local - prior > _DUST_SIGMAS * chance) & (still_share < _MAX_STILL)
    prior = np.where(dust, local, prior)
    # A capture's errors are its noise and its texture; its weight counted the pattern as one more.
    errors = np.maximum(variance - prior, np.maximum(noise, _MIN_ERRORS * variance))
    with np.errstate(divide="ignore", invalid="ignore"):
        gain = np.nan_to_num(1 / (errors * weight_of_one), nan=1.0, posinf=1.0)
    return prior.astype(np.float32), still.astype(np.float32), gain.astype(np.float32)


def _spread_of_products(own: Map, other: Map) -> Array:
    """Standard deviation (h, w) of the smoothed sums of own times other, if the two have nothing to do with each other.

    Patterns of a sensor are white: pixels are independent.
    """
    squares = _columns((own.astype(float) * other) ** 2)
    # The squared weights of a Gaussian are one of half the variance.
    return np.sqrt(_smooth(squares, _WIDE_BLOCKS / np.sqrt(2)) / (4 * np.pi * _WIDE_BLOCKS**2))


def _accumulate(into: dict[str, Array], maps: Mapping[str, NDArray[Any]]) -> None:
    for name, value in maps.items():
        into[name] = into[name] + value if name in into else value.astype(float)


def _smooth(blocks: Array, width: float) -> Array:
    smooth = cv2.GaussianBlur(blocks.astype(np.float32), (0, 0), width, borderType=cv2.BORDER_CONSTANT)
    return np.asarray(smooth, float)


def _columns(rows: NDArray[Any]) -> Array:
    """Sum a map (h, W) over blocks of columns."""
    padded = np.pad(rows, ((0, 0), (0, -rows.shape[1] % BLOCK_PX))).reshape(rows.shape[0], -1, BLOCK_PX)
    # Column by column: NumPy's sum over an axis as short as this takes several times as long.
    total = padded[..., 0].astype(np.result_type(rows.dtype, np.int8))
    for k in range(1, BLOCK_PX):
        total += padded[..., k]
    return total


def _blocks(image: NDArray[Any]) -> Array:
    """Sum a map (H, W) over blocks."""
    return _columns(_columns(image).T).T
