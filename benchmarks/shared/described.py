"""The detectors and descriptors that planish is compared with, on its texture images; each place gets a local frame."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from planish.registration.keypoints.detect import KeypointOptions, detect_keypoints, keypoints_at
from planish.registration.keypoints.frames import places_on_surface
from planish.registration.keypoints.keypoints import Keypoints
from planish.registration.match.descriptors import nearest_neighbours
from planish.registration.match.matching import MatchOptions
from planish.registration.texture.resample import TextureImage

Images = tuple[TextureImage, ...]
#: Grey levels (of 255) that one robust standard deviation of the texture is spread to, for detectors of 8 bit pictures.
GREY_PER_DEVIATION = 22.0
#: SIFT's threshold on such pictures: low, for the number of keypoints is limited anyway.
SIFT_CONTRAST = 0.02
#: Nearest over second nearest descriptor distance; grain needs more freedom than the usual 0.8.
MAX_RATIO = 0.95


@dataclass(frozen=True)
class Found:
    """Keypoints, and their descriptors where these are bits (N, bytes) to be compared by Hamming's distance."""

    keypoints: Keypoints
    bits: NDArray[np.uint8] | None = None


def to_grey(image: TextureImage) -> NDArray[np.uint8]:
    """Return the texture as an 8 bit picture (h, w): mid grey outside the mask, robustly stretched."""
    inside = image.value[image.mask]
    deviation = 1.4826 * float(np.median(np.abs(inside))) if inside.size else 1.0
    grey = 128 + image.value * (GREY_PER_DEVIATION / max(deviation, 1e-9))
    return np.clip(np.rint(grey), 0, 255).astype(np.uint8)


def mutual_matches(a: Found, b: Found) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the indices of mutual nearest neighbours that pass the ratio test."""
    if a.bits is None or b.bits is None:
        every = len(a.keypoints) + len(b.keypoints)
        found = nearest_neighbours(a.keypoints, b.keypoints, MatchOptions().max_size_ratio, every, threads=1)
        good = found.mutual & (found.ratio <= MAX_RATIO)
        return found.index_a[good], found.index_b[good]
    none = np.empty(0, np.int64)
    if min(len(a.bits), len(b.bits)) < 2:
        return none, none
    matcher = cv2.BFMatcher(cv2.NORM_HAMMING)
    forward, backward = matcher.knnMatch(a.bits, b.bits, k=2), matcher.match(b.bits, a.bits)
    nearest = {m.queryIdx: m.trainIdx for m in backward}
    good = [
        (m.queryIdx, m.trainIdx)
        for m, n in forward
        if nearest[m.trainIdx] == m.queryIdx and m.distance <= MAX_RATIO * n.distance
    ]
    return (
        (np.array([g[0] for g in good], np.int64), np.array([g[1] for g in good], np.int64)) if good else (none, none)
    )


def opencv(detector: Any, images: Images, count: int, widen: float = 1.0) -> Found:
    """Return the keypoints of an OpenCV detector, strongest first, described over `widen` times their size."""
    parts, words = [], []
    for chart, image in enumerate(images):
        grey, mask = to_grey(image), image.mask.astype(np.uint8) * 255
        found = sorted(detector.detect(grey, mask), key=lambda k: (-k.response, k.pt, k.angle))[: count // len(images)]
        for k in found:
            k.size *= widen
        found, described = detector.compute(grey, found)
        if found:
            parts.append(_on_surface(image, chart, found, described, widen))
            words.append(parts[-1].descriptors)
    keypoints = _joined(parts)
    binary = detector.defaultNorm() == cv2.NORM_HAMMING
    return Found(keypoints, keypoints.descriptors if binary else None)


def _on_surface(image: TextureImage, chart: int, found: Sequence[Any], described: Any, widen: float) -> Keypoints:
    height, width = image.mask.shape
    xy = np.clip(np.array([k.pt for k in found], float), 0, [width - 1, height - 1])
    angle = np.deg2rad([k.angle for k in found])
    size = np.array([k.size for k in found]) / widen * image.pitch_mm
    known = np.isin(np.arange(len(xy)), _kept(image, xy, angle))
    places = places_on_surface(image, xy, angle)
    return keypoints_at(chart, places, size[known], np.rint(described[known]).astype(np.uint8))


def _kept(image: TextureImage, xy: NDArray[Any], angle: NDArray[Any]) -> NDArray[np.intp]:
    """Indices of the places that `places_on_surface` keeps: it keeps their order."""
    kept = places_on_surface(image, xy, np.arange(len(angle), dtype=float)).angle
    return kept.astype(np.intp)


def _joined(parts: Sequence[Keypoints]) -> Keypoints:
    if not parts:
        return detect_keypoints(())
    return Keypoints(*(np.concatenate([getattr(p, name) for p in parts]) for name in Keypoints.__dataclass_fields__))


def sift(images: Images, count: int, widen: float = 1.0) -> Found:
    """SIFT (Lowe 2004), with its neighbourhood `widen` times as wide."""
    # Precise upscaling: without it every position is off by a constant quarter of a pixel.
    detector = cv2.SIFT.create(nfeatures=0, contrastThreshold=SIFT_CONTRAST, enable_precise_upscale=True)
    return opencv(detector, images, count, widen)


def akaze(images: Images, count: int) -> Found:
    """AKAZE (Alcantarilla 2013) with its binary descriptor; OpenCV 5 has it in its contrib wheel alone."""
    home = cv2 if hasattr(cv2, "AKAZE_create") else cv2.xfeatures2d
    return opencv(home.AKAZE_create(threshold=1e-4), images, count)


def orb(images: Images, count: int) -> Found:
    """ORB (Rublee 2011)."""
    return opencv(cv2.ORB.create(nfeatures=count, fastThreshold=5), images, count)


def blobs_sift(images: Images, count: int) -> Found:
    """Planish's keypoints, described by SIFT over as wide a neighbourhood."""
    keypoints = detect_keypoints(images, KeypointOptions(max_keypoints=count))
    detector, words = cv2.SIFT.create(), np.empty((len(keypoints), 128), np.uint8)
    for chart, image in enumerate(images):
        at = np.flatnonzero(keypoints.chart == chart)
        scale = keypoints.size_mm[at] / 2 / image.pitch_mm
        # SIFT's picture of 2 px is layer 1 of octave 0 and of 4 px layer 1 of octave 1; 4 bins of 1.5 sizes each side
        # of the middle cover the radius of ten scales.
        asked = [
            cv2.KeyPoint(*map(float, xy), float(3.33 * s), float(np.rad2deg(angle)) % 360, 1.0, int(s > 3) | 1 << 8, i)
            for i, (xy, s, angle) in enumerate(
                zip(keypoints.chart_px[at], scale, keypoints.chart_angle_rad[at], strict=True)
            )
        ]
        found, described = detector.compute(to_grey(image), asked)
        for k, word in zip(found, described if described is not None else (), strict=True):
            words[at[k.class_id]] = np.rint(word)
    return Found(replace(keypoints, descriptors=words))


def planish(images: Images, count: int) -> Found:
    """Planish's keypoints and descriptors."""
    return Found(detect_keypoints(images, KeypointOptions(max_keypoints=count)))


DETECTORS: dict[str, Callable[[Images, int], Found]] = {
    "SIFT": sift,
    "SIFT, neighbourhood 3 x as wide": lambda images, count: sift(images, count, 3.0),
    "AKAZE": akaze,
    "ORB": orb,
    "planish's keypoints, SIFT's descriptor": blobs_sift,
    "planish": planish,
}
