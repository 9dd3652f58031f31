"""Keypoints: places on the surface with a right-handed local frame, in a fixed order."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

import sheets
import synthetic
from planish.geometry import transform_points
from planish.registration.keypoints.detect import KeypointOptions, detect_keypoints, to_grey
from planish.registration.match.descriptors import match

#: float64 products of rotations that come from float32 normals.
ORTHONORMAL_TOLERANCE = 1e-6
#: The look-up rounds places to 1/32 of a texture pixel, which is 1.5 camera pixels wide and more where foreshortened.
PIXEL_TOLERANCE = 0.04
#: Smoothed point noise (0.03 / 7 mm, four times) and what the plane fit cuts off the bend (see test_texture_images).
SURFACE_TOLERANCE_MM = 0.04
#: Orientation of one SIFT keypoint: bins of 10 degrees, interpolated; the median is far better.
MEDIAN_ORIENTATION_RAD = 0.06
#: The median right match is good to a third of a texture pixel.
MEDIAN_PLACE_MM = 0.35 * sheets.PITCH_MM


@pytest.fixture(scope="module")
def sides():
    return sheets.pair()


def test_there_are_keypoints_all_over_the_sheet(sides):
    for side in sides:
        assert 200 < len(side.keypoints) <= KeypointOptions().max_keypoints
        x, y = side.keypoints.points_sensor[:, :2].T
        quadrants = (x > np.median(x)).astype(int) * 2 + (y > np.median(y))
        assert np.bincount(quadrants, minlength=4).min() > 20


def test_frames_are_right_handed_and_orthonormal_with_the_normal_towards_the_sensor(sides):
    for side in sides:
        k = side.keypoints
        np.testing.assert_allclose(
            np.swapaxes(k.frames_sensor, 1, 2) @ k.frames_sensor, np.tile(np.eye(3), (len(k), 1, 1)),
            atol=ORTHONORMAL_TOLERANCE,
        )  # fmt: skip
        np.testing.assert_allclose(np.linalg.det(k.frames_sensor), 1, atol=ORTHONORMAL_TOLERANCE)
        towards = side.measurement.camera.center_sensor - k.points_sensor
        assert ((k.frames_sensor[:, :, 2] * towards).sum(1) > 0).all()


def test_pixels_are_the_projections_of_the_points(sides):
    for side in sides:
        k = side.keypoints
        np.testing.assert_allclose(side.measurement.camera.project(k.points_sensor), k.pixels, atol=PIXEL_TOLERANCE)


def test_points_and_normals_are_those_of_the_surface(sides):
    for side, T in zip(sides, (np.eye(4), sheets.T_TRUE), strict=True):
        points = transform_points(T, side.keypoints.points_sensor)
        x, y, z = points.T
        assert np.abs(z - synthetic.height(x, y, sheets.BENT)).max() < SURFACE_TOLERANCE_MM
        normals = side.keypoints.frames_sensor[:, :, 2] @ T[:3, :3].T
        expected = np.column_stack([sheets.BENT * x, 0.5 * sheets.BENT * y, np.ones(len(x))])
        expected /= np.linalg.norm(expected, axis=1, keepdims=True)
        # Slope noise of a plane fit: 0.03 mm / (sqrt(49) * 2 px of 1.3 mm) = 2 mrad, five times that.
        assert np.linalg.norm(normals - expected, axis=1).max() < 0.01


def test_matching_keypoints_have_the_same_place_and_frame_on_the_part(sides):
    a, b = (side.keypoints for side in sides)
    found = match(a, b)
    shift = found.points_a - transform_points(sheets.T_TRUE, found.points_b)
    distance = np.linalg.norm(shift, axis=1)
    right = distance < 2 * sheets.PITCH_MM
    assert right.sum() > 50
    assert np.median(distance[right]) < MEDIAN_PLACE_MM
    turned = sheets.T_TRUE[:3, :3] @ found.frames_b[right]
    cosine = (found.frames_a[right][:, :, 0] * turned[:, :, 0]).sum(1)
    assert np.median(np.arccos(cosine.clip(-1, 1))) < MEDIAN_ORIENTATION_RAD


def test_places_of_right_matches_are_not_shifted_on_average(sides):
    a, b = (side.keypoints for side in sides)
    found = match(a, b)
    shift = found.points_a - transform_points(sheets.T_TRUE, found.points_b)
    right = np.linalg.norm(shift, axis=1) < sheets.PITCH_MM
    # The mean of n shifts is known to their scatter over sqrt(n); a constant quarter of a pixel would stand out.
    limit = 4 * shift[right].std(0) / np.sqrt(right.sum())
    assert (np.abs(shift[right].mean(0)) < limit).all()
    assert limit.max() < 0.25 * sheets.PITCH_MM


def test_order_and_content_do_not_depend_on_the_number_of_threads(sides):
    before, seen = cv2.getNumThreads(), set()
    try:
        for threads in (1, 2, 8):
            cv2.setNumThreads(threads)
            k = detect_keypoints(sides[0].images)
            seen.add(b"".join(getattr(k, name).tobytes() for name in k.__dataclass_fields__))
    finally:
        cv2.setNumThreads(before)
    assert len(seen) == 1


def test_the_strongest_keypoints_are_kept(sides):
    few = detect_keypoints(sides[0].images, KeypointOptions(max_keypoints=50))
    assert len(few) == 50
    everything = {tuple(p) for p in detect_keypoints(sides[0].images).points_sensor}
    assert all(tuple(p) in everything for p in few.points_sensor)


def test_a_picture_without_texture_has_no_keypoints(sides):
    image = sides[0].images[0]
    assert len(detect_keypoints((replace(image, value=np.zeros_like(image.value)),))) == 0
    nothing = replace(image, mask=np.zeros_like(image.mask))
    assert len(detect_keypoints((nothing,))) == len(detect_keypoints(())) == 0


def test_the_grey_picture_is_stretched_by_the_robust_deviation(sides):
    image = sides[0].images[0]
    grey = to_grey(image, 22.0).astype(float)
    inside = grey[image.mask]
    assert 1.4826 * np.median(np.abs(inside - 128)) == pytest.approx(22, abs=1)  # whole grey levels
    scratched = replace(image, value=np.where(np.arange(image.value.shape[1]) == 90, 0.4, image.value))
    assert np.median(np.abs(to_grey(scratched, 22.0).astype(float) - grey)) < 1
