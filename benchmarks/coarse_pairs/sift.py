"""The peer that everybody can build: SIFT on the equalised white images, ratio test, 3-point RANSAC on 3D points."""

from __future__ import annotations

import cv2
import numpy as np

from planish.geometry import Array, fit_rigid, transform_points
from planish.measurement import Measurement

RATIO, TRIALS, TOLERANCE_MM, LEAST = 0.8, 5000, 1.0, 6
#: Clip limit and tiles of the adaptive histogram equalisation (CLAHE) before SIFT, and its contrast threshold: the best
#: of four settings tried.
EQUALISATION, CONTRAST = (4.0, (16, 16)), 0.02
#: Trials whose residuals are computed at once.
BATCH = 500


def sift_keypoints(m: Measurement) -> tuple[Array, np.ndarray]:
    """Return points (N, 3) [mm] and descriptors (N, 128) of the white image of a measurement's organising camera."""
    view = m.views[m.organised_on]
    image = view.white if view.white is not None else view.mean
    assert image is not None
    grey = np.clip(image * (255 / np.nanpercentile(image, 99.9)), 0, 255).astype(np.uint8)
    # With its own threshold and without equalisation SIFT finds a dozen keypoints in such images, or none.
    grey = cv2.createCLAHE(*EQUALISATION).apply(grey)
    detector = cv2.SIFT.create(5000, contrastThreshold=CONTRAST)
    found, words = detector.detectAndCompute(grey, m.valid.astype(np.uint8) * 255)
    if words is None:
        return np.empty((0, 3)), np.empty((0, 128), np.float32)
    at = np.rint([k.pt for k in found]).astype(int)
    points = m.points_sensor[at[:, 1], at[:, 0]].astype(float)
    known = np.isfinite(points[:, 2])
    return points[known], words[known]


def register_plain_sift(a: tuple[Array, np.ndarray], b: tuple[Array, np.ndarray]) -> Array | None:
    """Return T_a_b (4, 4) of the largest consensus, None with fewer than LEAST matches that agree."""
    (points_a, words_a), (points_b, words_b) = a, b
    if min(len(points_a), len(points_b)) < LEAST:
        return None
    best = cv2.BFMatcher(cv2.NORM_L2).knnMatch(words_b, words_a, k=2)
    good = [(m.trainIdx, m.queryIdx) for m, n in best if m.distance < RATIO * n.distance]
    if len(good) < LEAST:
        return None
    pa, pb = points_a[[g[0] for g in good]], points_b[[g[1] for g in good]]
    rng = np.random.default_rng(0)
    inside = np.zeros(len(pa), bool)
    for _ in range(TRIALS // BATCH):
        pick = np.argsort(rng.random((BATCH, len(pa))), axis=1)[:, :3] if len(pa) < 30 else _distinct(rng, len(pa))
        R, t = _fit_many(pa[pick], pb[pick])
        agree = np.linalg.norm(pb @ R.transpose(0, 2, 1) + t[:, None] - pa, axis=2) < TOLERANCE_MM
        most = agree.sum(1).argmax()
        if agree[most].sum() > inside.sum():
            inside = agree[most]
    if inside.sum() < LEAST:
        return None
    T = fit_rigid(pa[inside], pb[inside])
    inside = np.linalg.norm(transform_points(T, pb) - pa, axis=1) < TOLERANCE_MM
    return fit_rigid(pa[inside], pb[inside]) if inside.sum() >= LEAST else T


def _distinct(rng: np.random.Generator, count: int) -> np.ndarray:
    pick = rng.integers(0, count, (BATCH, 3))
    return pick[(pick[:, 0] != pick[:, 1]) & (pick[:, 1] != pick[:, 2]) & (pick[:, 0] != pick[:, 2])]


def _fit_many(pa: Array, pb: Array) -> tuple[Array, Array]:
    """Return rotations (N, 3, 3) and translations (N, 3) that move pb (N, 3, 3) onto pa.

    Source: Arun, Huang, Blostein, Least-squares fitting of two 3-D point sets, 1987.
    """
    ca, cb = pa.mean(1, keepdims=True), pb.mean(1, keepdims=True)
    U, _, Vt = np.linalg.svd((pa - ca).transpose(0, 2, 1) @ (pb - cb))
    U[:, :, 2] *= np.sign(np.linalg.det(U @ Vt))[:, None]
    R = U @ Vt
    return R, (ca - cb @ R.transpose(0, 2, 1))[:, 0]
