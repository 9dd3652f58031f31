"""The dense path: matches of windows where the texture is too weak for keypoints."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from pydantic import Field

from planish.options import Options, thread_count
from planish.registration.dense.develop import Development, develop
from planish.registration.dense.search import Placement, search
from planish.registration.dense.spectrum import Spectrum, analyse, plan_rotations
from planish.registration.dense.windows import Windows, find_windows
from planish.registration.matches import Matches, no_matches
from planish.registration.texture.resample import TextureImage


class DenseOptions(Options):
    """Options of the dense path."""

    #: Whether pairs without a significant consensus of keypoints are correlated.
    enabled: bool = True
    #: Pixel of the correlated texture in pixels of the texture images.
    pitch_factor: int = Field(default=2, ge=1, le=10)
    #: Texture without a direction is correlated only if its variance is below this many times that of its noise:
    #: keypoints find the rest, and all rotations would have to be tried. Grain that runs one way is always correlated,
    #: for its keypoints look alike.
    max_signal_to_noise: float = Field(default=4.0, ge=0)
    #: Distance from a common placement within which each window is sought [mm].
    search_mm: float = Field(default=24.0, gt=0)
    #: A placement that other than by chance comes second has at least this share of the best one's significance.
    second_share: float = Field(default=0.6, gt=0, le=1)


@dataclass(frozen=True)
class DenseTexture:
    """What the dense path needs of one patch of a measurement, computed once."""

    development: Development
    spectrum: Spectrum


def prepare_dense(images: Sequence[TextureImage], options: DenseOptions | None = None) -> tuple[DenseTexture, ...]:
    """Return the reduced, filtered texture of each large chart of a measurement."""
    options = options or DenseOptions()
    return tuple(DenseTexture(d, analyse(d)) for d in develop(images, options.pitch_factor))


@dataclass(frozen=True)
class WindowMatches:
    """Matches of windows and how chance makes them.

    Parameters
    ----------
    matches : Matches
    chance : float
        Probability that a window lands within the tolerance of a wrong placement: it is sought around it only.
    tried : float
        Number of placements that were looked at.
    sigma : float
        Significance of the best placement's correlation [standard deviations].
    """

    matches: Matches
    chance: float
    tried: float
    sigma: float


def match_windows(
    a: Sequence[DenseTexture],
    b: Sequence[DenseTexture],
    tolerance_mm: float,
    options: DenseOptions | None = None,
    threads: int | None = None,
) -> WindowMatches:
    """Return the windows of b in a around the most significant placements of one texture on the other."""
    options, count = options or DenseOptions(), thread_count(threads)
    found, tried = _placements(a, b, count)
    parts, chances = [], []
    for x, y, placement in found[:_MOST_PLACEMENTS]:
        if placement.sigma < options.second_share * found[0][2].sigma:
            break
        pitch = x.development.pitch_mm
        radius = max(2, round(options.search_mm / pitch))
        windows, _ = find_windows((x.development, x.spectrum), (y.development, y.spectrum), placement, radius)
        parts.append(_as_matches(x, y, windows, placement.angle_rad))
        # Half a tolerance of freedom that the fit takes.
        chances.append(np.pi * (1.5 * tolerance_mm / pitch) ** 2 / np.maximum(windows.looked_at_px, 1))
    if not sum(map(len, chances)):
        return WindowMatches(no_matches(), 1.0, tried, found[0][2].sigma if found else 0.0)
    # Hoeffding 1956: the tail of a sum of unequal chances is bounded by that of their mean.
    chance = float(np.minimum(np.concatenate(chances), 1).mean())
    return WindowMatches(_joined(parts), chance, tried, found[0][2].sigma)


#: Placements whose windows are looked at.
_MOST_PLACEMENTS = 3


def _placements(
    a: Sequence[DenseTexture], b: Sequence[DenseTexture], threads: int
) -> tuple[list[tuple[DenseTexture, DenseTexture, Placement]], float]:
    """The placements of all patches on all patches, best first, and how many were looked at."""
    found: list[tuple[DenseTexture, DenseTexture, Placement]] = []
    tried = 1.0
    for x in a:
        for y in b:
            masks = x.development.mask, y.development.mask
            area_mm2 = min(int(m.sum()) for m in masks) * x.development.pitch_mm**2
            angles = plan_rotations(x.spectrum, y.spectrum, 0.5 * area_mm2).angles
            result = search(x.spectrum.filtered, masks[0], y.spectrum.filtered, masks[1], angles, threads)
            tried += result.looked_at
            found += [(x, y, placement) for placement in result.placements]
    return sorted(found, key=lambda item: -item[2].sigma), tried


def _as_matches(a: DenseTexture, b: DenseTexture, windows: Windows, angle: float) -> Matches:
    # One direction on the part: the x axis of a's development, which b's shows turned back.
    none = np.zeros(len(windows.at_a))
    point_a, frame_a, pixel_a = a.development.locate(windows.at_a, none)
    point_b, frame_b, pixel_b = b.development.locate(windows.at_b, none - angle)
    found = Matches(point_a, point_b, frame_a, frame_b, pixel_a, pixel_b, windows.correlation)
    order = np.flatnonzero(np.isfinite(point_a + point_b).all(1))
    return found.take(order[np.argsort(-windows.correlation[order], kind="stable")])


def _joined(parts: Sequence[Matches]) -> Matches:
    return Matches(*(np.concatenate([getattr(p, name) for p in parts]) for name in Matches.__dataclass_fields__))
