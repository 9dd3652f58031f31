"""Comparison of the metric patches around two keypoints: how well they correlate, and how they lie to each other."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from planish import _core
from planish.geometry import Array
from planish.registration.keypoints.keypoints import Keypoints
from planish.registration.match.whitening import PatchImage
from planish.registration.texture.resample import TextureImage


@dataclass(frozen=True)
class Alignment:
    """How M patches of a lie in the texture images of b.

    Parameters
    ----------
    correlation : ndarray (M,)
        Normalised cross-correlation at the best alignment.
    significance : ndarray (M,)
        The same in standard deviations of the correlation of unrelated texture.
    chart_px : ndarray (M, 2)
        Where a's keypoint lies in the image of b's [texture px].
    chart_angle_rad : ndarray (M,)
        Direction of a's orientation there, from x towards y.
    """

    correlation: Array
    significance: Array
    chart_px: Array
    chart_angle_rad: Array


@dataclass(frozen=True)
class PatchSearch:
    """What is compared and searched, in patch pixels and radians."""

    radius_px: int
    reach_px: int
    turns: int
    turn_step_rad: float


@dataclass(frozen=True)
class PatchSide:
    """One measurement as the comparison needs it: keypoints, their texture images and what patches are read from."""

    keypoints: Keypoints
    images: tuple[TextureImage, ...]
    patches: tuple[PatchImage, ...]

    def places(self, pitch_mm: float) -> Array:
        """Return per keypoint (N, 6) its pixel in its image and what a step of `pitch_mm` along its axes is there.

        The images are metric along the surface, so that an orientation and the pitch are all a patch needs.
        """
        k = self.keypoints
        scale = pitch_mm / np.array([image.pitch_mm for image in self.images])[k.chart]
        c, s = scale * np.cos(k.chart_angle_rad), scale * np.sin(k.chart_angle_rad)
        return np.column_stack([k.chart_px, c, -s, s, c])


def align_patches(
    a: PatchSide,
    b: PatchSide,
    index_a: NDArray[np.int64],
    index_b: NDArray[np.int64],
    search: PatchSearch,
    threads: int,
) -> Alignment:
    """Return the best alignment of the patches of keypoints `index_a` and `index_b` (M,), turned and shifted."""
    pitch_mm = max(image.pitch_mm for image in a.images + b.images)
    # Pairs of one keypoint of a in a row: its turned patches are drawn once.
    order = np.lexsort((index_b, index_a))
    pairs = np.column_stack([index_a, index_b])[order].astype(np.int32)
    places_b = b.places(pitch_mm)
    found = np.empty((len(order), 5))
    found[order] = _core.align_patches(
        [p.value for p in a.patches], a.places(pitch_mm), a.keypoints.chart.astype(np.int32),
        [p.value for p in b.patches], places_b, b.keypoints.chart.astype(np.int32),
        pairs, search.radius_px, search.reach_px, search.turns, search.turn_step_rad, threads,
    )  # fmt: skip
    correlation, offset, turn, pixels = found[:, 0], found[:, 1:3], found[:, 3], found[:, 4]
    cells_a, cells_b = (np.array([p.cells_per_px for p in side.patches]) for side in (a, b))
    # The variance of the correlation holds the product of both autocorrelations, which are alike after the alignment.
    per_px = np.sqrt(cells_a[a.keypoints.chart[index_a]] * cells_b[b.keypoints.chart[index_b]])
    axes = places_b[index_b, 2:].reshape(-1, 2, 2)
    return Alignment(
        correlation,
        correlation * np.sqrt(pixels * per_px),
        b.keypoints.chart_px[index_b] + np.einsum("mij,mj->mi", axes, offset),
        b.keypoints.chart_angle_rad[index_b] + turn,
    )
