"""Keypoints: places on the surface with a right-handed local frame, in a fixed order."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

import matched
import sheets
import synthetic
from given_surface import GivenSurface
from planish.geometry import transform_points
from planish.registration.keypoints.blobs import Blobs, smooth_texture, spread_evenly
from planish.registration.keypoints.detect import KeypointOptions, detect_keypoints
from planish.registration.texture.resample import TextureImage

#: float64 products of rotations that come from float32 normals.
ORTHONORMAL_TOLERANCE = 1e-6
#: The look-up rounds places to 1/32 of a texture pixel, which is 1.5 camera pixels wide and more where foreshortened.
PIXEL_TOLERANCE = 0.04
#: Smoothed point noise (0.03 / 7 mm, four times) and what the plane fit cuts off the bend (see test_texture_images).
SURFACE_TOLERANCE_MM = 0.04
#: Orientation of one keypoint: bins of 10 degrees, interpolated; the median is far better.
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
    found = matched.by_descriptors(a, b)
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
    found = matched.by_descriptors(a, b)
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


def flat(value, sigma, mask=None):
    """A texture image of a plane, seen from its front: half a millimetre per pixel."""
    h, w = value.shape
    mask = np.ones((h, w), bool) if mask is None else mask
    source = np.stack(np.meshgrid(np.arange(w), np.arange(h)), -1).astype(np.float32)
    points = np.dstack([0.5 * source * np.float32([1, -1]), np.zeros((h, w), np.float32)])
    normal, x_axis = (np.broadcast_to(np.array(v, np.float32), (h, w, 3)).copy() for v in ((0, 0, 1), (1, 0, 0)))
    return TextureImage(
        0.5, np.where(mask, value, 0).astype(np.float32), np.full((h, w), sigma, np.float32), mask, source,
        GivenSurface(points, normal, x_axis),
    )  # fmt: skip


def noise(shape, seed, blur_px=0.0):
    white = np.random.default_rng(seed).standard_normal(shape).astype(np.float32)
    if blur_px:
        white = cv2.GaussianBlur(white, (0, 0), blur_px)
    return white / white.std()


def test_the_surest_keypoints_are_kept(sides):
    few = detect_keypoints(sides[0].images, KeypointOptions(max_keypoints=50))
    assert 40 <= len(few) <= 50
    everything = {tuple(p) for p in detect_keypoints(sides[0].images).points_sensor}
    assert all(tuple(p) in everything for p in few.points_sensor)


def test_a_picture_without_texture_has_no_keypoints(sides):
    image = sides[0].images[0]
    assert len(detect_keypoints((replace(image, value=np.zeros_like(image.value)),))) == 0
    nothing = replace(image, mask=np.zeros_like(image.mask))
    assert len(detect_keypoints((nothing,))) == len(detect_keypoints(())) == 0


@pytest.mark.parametrize("scale_px", KeypointOptions().scales_px)
def test_significance_is_in_standard_deviations_of_the_noise_whatever_its_size(scale_px):
    # The left half is three times as noisy as the right, and says so.
    sigma = np.where(np.arange(600) < 300, 0.03, 0.01) * np.ones((400, 1))
    image = replace(flat(sigma * noise((400, 600), 3), 1.0), sigma=sigma.astype(np.float32))
    found = smooth_texture(image, scale_px).significance
    for half in (found[20:-20, 20:270], found[20:-20, 330:-20]):
        # 250 x 360 px hold 90000 / (4 pi 4^2) = 450 independent values at the coarser scale: four times 3 %.
        assert half.std() == pytest.approx(1, abs=0.12)


def test_few_keypoints_are_made_of_noise_and_none_where_only_strong_texture_counts():
    image = flat(0.01 * noise((400, 600), 4), 0.01)
    textured = flat(0.01 * noise((400, 600), 4) + 0.02 * noise((400, 600), 5, 3.0), 0.01)
    assert len(detect_keypoints((image,))) < 0.4 * len(detect_keypoints((textured,)))
    assert len(detect_keypoints((image,), KeypointOptions(min_significance=6.0))) == 0


def test_noise_of_the_picture_far_from_a_blob_does_not_move_it():
    y, x = np.mgrid[:120, :160]
    blob = np.exp(-((x - 70.3) ** 2 + (y - 55.6) ** 2) / (2 * 4.0**2))
    for sign in (1, -1):
        found = detect_keypoints((flat(0.1 * sign * blob, 0.001),), KeypointOptions(scales_px=(4.0,)))
        strongest = found.chart_px[0]
        # A parabola through three samples of this blob is wrong by less than a twentieth of a pixel.
        assert np.abs(strongest - [70.3, 55.6]).max() < 0.05


def test_strong_texture_in_one_corner_leaves_keypoints_to_the_rest():
    value = noise((480, 480), 6, 2.0) * 0.01
    value[:240, :240] *= 20
    found = detect_keypoints((flat(value, 0.001),), KeypointOptions(max_keypoints=400))
    column, row = found.chart_px.T
    quadrants = np.bincount((column > 240).astype(int) + 2 * (row > 240), minlength=4)
    assert quadrants.min() > 0.7 * quadrants.max()


def test_blobs_are_taken_from_every_cell_in_turn_strongest_first():
    xy = np.array([[1.0, 1], [2, 2], [3, 3], [15, 1], [16, 2]])
    order = spread_evenly(Blobs(xy, np.array([5.0, 9, 7, 1, 3])), 10.0)
    assert order.tolist() == [1, 4, 2, 3, 0]


def test_the_rim_of_the_surface_has_no_keypoints():
    mask = np.zeros((300, 400), bool)
    mask[40:260, 50:330] = True
    found = detect_keypoints((flat(0.02 * noise((300, 400), 7, 2.5) + 0.05, 0.002, mask),))
    column, row = found.chart_px.T
    assert len(found) > 100
    # One and a half of the smaller scale of 2 px, less half a pixel of the refined place.
    assert min(column.min() - 50, 329 - column.max(), row.min() - 40, 259 - row.max()) >= 2.5


def test_a_place_in_two_charts_is_described_once():
    value = 0.03 * noise((300, 300), 8, 2.0)
    left, right = np.ones((2, 300, 300), bool)
    left[:, 200:], right[:, :100] = False, False
    alone = detect_keypoints((flat(value, 0.002, left),))
    both = detect_keypoints((flat(value, 0.002, left), flat(value, 0.002, right)))
    # No two of one scale in two charts are nearer than the scale; beyond the overlap the second chart has its own.
    first, second = both.take(both.chart == 0), both.take(both.chart == 1)
    distance = np.linalg.norm(first.points_sensor[:, None] - second.points_sensor, axis=2)
    same_size = first.size_mm[:, None] == second.size_mm
    assert (distance[same_size] >= 1.0).all()
    assert (second.chart_px[:, 0] > 195).sum() > 100
    assert len(first) == len(alone)


def test_the_descriptor_turns_with_the_picture():
    value = 0.03 * noise((240, 240), 9, 3.0)
    upright = detect_keypoints((flat(value, 0.001),))
    turned = detect_keypoints((flat(np.rot90(value), 0.001),))
    # Counter-clockwise by a quarter: column and row (x, y) become (y, 239 - x).
    expected = np.column_stack([upright.chart_px[:, 1], 239 - upright.chart_px[:, 0]])
    distance = np.linalg.norm(expected[:, None] - turned.chart_px, axis=2)
    angle = np.angle(np.exp(1j * (upright.chart_angle_rad[:, None] - np.pi / 2 - turned.chart_angle_rad)))
    distance[(np.abs(angle) > 0.1) | (upright.size_mm[:, None] != turned.size_mm)] = np.inf
    nearest = distance.argmin(1)
    same = distance.min(1) < 0.1
    assert same.mean() > 0.9
    difference = upright.descriptors[same].astype(int) - turned.descriptors[nearest[same]]
    # Look-ups between pixels are rounded to 1/32: a few steps of 255.
    assert np.abs(difference).mean() < 3


def test_the_distance_of_descriptors_is_the_correlation_of_what_they_describe():
    k = detect_keypoints((flat(0.03 * noise((300, 300), 10, 2.5), 0.001),)).descriptors.astype(float) - 128
    squared = ((k[:1] - k[1:]) ** 2).sum(1)
    cosine = (k[:1] * k[1:]).sum(1) / (np.linalg.norm(k[0]) * np.linalg.norm(k[1:], axis=1))
    # 256 steps per unit: each value is rounded by 0.3 of them, 128 values by 3 in a length of 256.
    assert np.median(np.abs(squared / 256**2 - (2 - 2 * cosine))) < 0.02
