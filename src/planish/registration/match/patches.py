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
    """How M patches of a lie in those of b, which are drawn in the tangent frames of their keypoints.

    Parameters
    ----------
    correlation : ndarray (M,)
        Normalised cross-correlation at the best alignment.
    significance : ndarray (M,)
        The same in standard deviations of the correlation of unrelated texture.
    offset_mm : ndarray (M, 2)
        The place of a's keypoint in b's tangent frame.
    turn_rad : ndarray (M,)
        The direction of a's orientation in it.
    """

    correlation: Array
    significance: Array
    offset_mm: Array
    turn_rad: Array


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
        """Return per keypoint (N, 6) its pixel in its chart and what a step of `pitch_mm` along its axes is there.

        The charts are orthographic, so that a tangent seen under an angle is foreshortened: the patch undoes it.
        """
        out = np.empty((len(self.keypoints), 6))
        out[:, :2] = self.keypoints.chart_px
        for chart, image in enumerate(self.images):
            own = self.keypoints.chart == chart
            tangents = self.keypoints.frames_sensor[own, :, :2]
            in_chart = image.T_chart_sensor[:2, :3] @ tangents * (pitch_mm / image.pitch_mm)
            out[own, 2:] = in_chart.reshape(-1, 4)
        return out


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
    found = np.empty((len(order), 5))
    found[order] = _core.align_patches(
        [p.value for p in a.patches], a.places(pitch_mm), a.keypoints.chart.astype(np.int32),
        [p.value for p in b.patches], b.places(pitch_mm), b.keypoints.chart.astype(np.int32),
        pairs, search.radius_px, search.reach_px, search.turns, search.turn_step_rad, threads,
    )  # fmt: skip
    cells_a, cells_b = (np.array([p.cells_per_px for p in side.patches]) for side in (a, b))
    # The variance of the correlation holds the product of both autocorrelations, which are alike after the alignment.
    per_px = np.sqrt(cells_a[a.keypoints.chart[index_a]] * cells_b[b.keypoints.chart[index_b]])
    significance = found[:, 0] * np.sqrt(found[:, 4] * per_px)
    return Alignment(found[:, 0], significance, found[:, 1:3] * pitch_mm, found[:, 3])
