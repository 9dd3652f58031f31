"""Patches of two texture images: aligned to a fraction of a pixel, told from unrelated ones, weighted by noise."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

import sheets
from given_surface import GivenSurface
from planish import _core
from planish.geometry import transform_points
from planish.registration.match.descriptors import nearest_neighbours
from planish.registration.match.matching import MatchOptions, match
from planish.registration.match.patches import PatchSearch, PatchSide, align_patches
from planish.registration.match.whitening import patch_images
from planish.registration.texture.resample import TextureImage
from reference import patches as reference

RADIUS, REACH, TURNS, STEP = 10, 2, 2, 0.1
#: Products summed in float32 over some 300 pixels.
CORRELATION_TOLERANCE = 1e-5
#: A parabola through a correlation peak of about the pixels' own width is biased by a tenth of a pixel at worst.
OFFSET_TOLERANCE_PX = 0.12
#: The same at the rim of the patch.
TURN_TOLERANCE_RAD = OFFSET_TOLERANCE_PX / RADIUS
LEVEL = np.array([1.0, 0.0, 0.0, 1.0])


def smooth_noise(seed, shape=(120, 140), sigma=1.0):
    noise = np.random.default_rng(seed).standard_normal(shape).astype(np.float32)
    return np.ascontiguousarray(cv2.GaussianBlur(noise, (0, 0), sigma))


def turned(chart, angle, shift, about=(70.0, 60.0)):
    """The chart turned by `angle` about a place, then shifted: what stood at `about` stands at `about` + `shift`."""
    c, s = np.cos(angle), np.sin(angle)
    M = np.array([[c, -s, 0.0], [s, c, 0.0]])
    M[:, 2] = np.array(about) + shift - M[:, :2] @ about
    return np.ascontiguousarray(cv2.warpAffine(chart, M, chart.shape[::-1], flags=cv2.INTER_CUBIC))


def kernel(a, at_a, b, at_b, threads=1, turns=TURNS):
    one = np.zeros(len(at_a), np.int32)
    pairs = np.repeat(np.arange(len(at_a), dtype=np.int32)[:, None], 2, 1)
    return _core.align_patches([a], at_a, one, [b], at_b, one, pairs, RADIUS, REACH, turns, STEP, threads)


def place(u, v, axes=LEVEL):
    return np.array([[u, v, *axes]])


@pytest.mark.parametrize("angle", [0.0, 0.07, -0.2])
@pytest.mark.parametrize("shift", [(0.0, 0.0), (1.0, -1.0), (0.4, 1.3), (-1.7, -0.3)])
def test_offset_and_turn_between_two_pictures_are_found(angle, shift):
    a = smooth_noise(1)
    b = turned(a, angle, np.array(shift))
    ((correlation, x, y, turn, _),) = kernel(a, place(70, 60), b, place(70, 60))
    np.testing.assert_allclose([x, y], shift, atol=OFFSET_TOLERANCE_PX)
    assert turn == pytest.approx(angle, abs=TURN_TOLERANCE_RAD)
    assert correlation > 0.8


def test_the_correlation_is_that_of_its_definition_and_no_whole_offset_is_better():
    rng = np.random.default_rng(3)
    a, b = smooth_noise(2), smooth_noise(3)
    a[:, :50] = 0  # no texture there
    at = [np.column_stack([rng.uniform(20, 110, (30, 2)), rng.uniform(-0.3, 0.3, (30, 4)) + LEVEL]) for _ in range(2)]
    for i, (correlation, x, y, turn, pixels) in enumerate(kernel(a, at[0], b, at[1])):
        if pixels == 0:
            continue
        # The fractions follow from neighbours; the value is that of the whole step.
        steps = np.arange(-2 * TURNS - 1, 2 * TURNS + 2) * STEP / 2
        t = steps[np.argmin(np.abs(steps - turn))]
        expected = reference.correlation(a, at[0][i], b, at[1][i], RADIUS, round(x), round(y), t)
        assert (correlation, pixels) == (pytest.approx(expected[0], abs=CORRELATION_TOLERANCE), expected[1])
        for dx, dy in ((1, 0), (-1, 0), (0, 1), (0, -1)):
            if max(abs(round(x) + dx), abs(round(y) + dy)) <= REACH:
                other = reference.correlation(a, at[0][i], b, at[1][i], RADIUS, round(x) + dx, round(y) + dy, t)
                assert other[0] <= correlation + CORRELATION_TOLERANCE


def test_patches_without_common_texture_have_no_correlation():
    a, nothing = smooth_noise(4), np.zeros((120, 140), np.float32)
    for other in (place(70, 60), place(-500, 60), place(1e6, 1e6)):
        found = kernel(a, place(70, 60), nothing, other)
        assert (found[0, [0, 4]] == 0).all()


def test_the_alignment_is_the_same_for_any_number_of_threads():
    rng = np.random.default_rng(5)
    a, b = smooth_noise(6), smooth_noise(7)
    at = np.column_stack([rng.uniform(0, 140, (40, 2)), np.tile(LEVEL, (40, 1))])
    assert len({kernel(a, at, b, at, threads).tobytes() for threads in (1, 2, 7)}) == 1


def image(value, sigma=0.01, mask=None):
    mask = np.ones(value.shape, bool) if mask is None else mask
    space = np.zeros((*value.shape, 3), np.float32)
    sigma = np.broadcast_to(np.float32(sigma), value.shape).copy()
    value = np.where(mask, value, 0).astype(np.float32)
    source = np.zeros((*value.shape, 2), np.float32)
    return TextureImage(1.0, value, sigma, mask, source, GivenSurface(space, space, space))


def unrelated(whitened):
    """Standardised correlations of discs of two pictures that have nothing in common."""
    a, b = whitened
    rng = np.random.default_rng(8)
    at = [np.column_stack([rng.uniform(15, 240, (300, 2)), np.tile(LEVEL, (300, 1))]) for _ in range(2)]
    found = [reference.correlation(a.value, p, b.value, q, RADIUS, 0, 0, 0.0) for p, q in zip(*at, strict=True)]
    return np.array([r * np.sqrt(n * a.cells_per_px) for r, n in found])


@pytest.mark.parametrize("grain_px", [(0.6, 0.6), (2.0, 2.0), (0.8, 4.0)])
@pytest.mark.parametrize("noise", [0.1, 1.0, 4.0])
def test_the_correlation_of_unrelated_texture_has_the_stated_deviation(grain_px, noise):
    rng = np.random.default_rng(9)
    images = []
    for seed in (10, 11):
        white = np.random.default_rng(seed).standard_normal((256, 256)).astype(np.float32)
        grain = cv2.GaussianBlur(white, (0, 0), grain_px[0], sigmaY=grain_px[1])
        images.append(image(grain / grain.std() + noise * rng.standard_normal(grain.shape), noise))
    # 300 values know their deviation to 4 %, and the cells are estimated. Where little but noise is left, the filters
    # of both pictures differ by chance and the correlation scatters less than stated, which is safe; where it is fine,
    # the linear interpolation between pixels smooths it and leaves fewer independent values.
    assert 0.65 < np.std(unrelated(patch_images(tuple(images)))) < 1.25


def separation(pictures):
    """Mean correlation of what belongs together, over the scatter of what does not."""
    at = np.random.default_rng(14).uniform(20, 230, (150, 2))
    places = np.column_stack([at, np.tile(LEVEL, (len(at), 1))])

    def correlations(shift):
        return np.array([
            reference.correlation(pictures[0], p, pictures[1], q, RADIUS, 0, 0, 0.0)[0]
            for p, q in zip(places, np.roll(places, shift, 0), strict=True)
        ])  # fmt: skip

    return correlations(0).mean() / np.std([correlations(shift) for shift in (1, 2, 3)])


def test_fine_grain_below_a_coarse_mottle_tells_places_apart_better_after_the_weighting():
    rng = np.random.default_rng(12)
    coarse, fine = smooth_noise(12, (256, 256), 5.0), smooth_noise(13, (256, 256), 0.8)
    texture = coarse / coarse.std() + 0.3 * fine / fine.std()
    pictures = [image(texture + 0.1 * rng.standard_normal(texture.shape), 0.1) for _ in range(2)]
    assert separation([p.value for p in patch_images(tuple(pictures))]) > 2 * separation([p.value for p in pictures])


@pytest.mark.parametrize("grain_px", [(0.8, 0.8), (0.8, 4.0)])
def test_grain_that_drowns_in_noise_loses_little_by_the_weighting(grain_px):
    rng = np.random.default_rng(12)
    grain = cv2.GaussianBlur(rng.standard_normal((256, 256)), (0, 0), grain_px[0], sigmaY=grain_px[1])
    pictures = [image(grain / grain.std() + 2 * rng.standard_normal(grain.shape), 2.0) for _ in range(2)]
    assert separation([p.value for p in patch_images(tuple(pictures))]) > 0.85 * separation([p.value for p in pictures])


def test_noisy_places_count_less_and_places_without_texture_not_at_all():
    value = smooth_noise(13, (256, 256), 1.5)
    value /= value.std()
    sigma = np.full(value.shape, 0.3)
    sigma[:, 128:] = 3.0
    mask = np.ones(value.shape, bool)
    mask[:40] = False
    (whitened,) = patch_images((image(value, sigma, mask),))
    assert (whitened.value[:40] == 0).all()
    assert np.std(whitened.value[60:, 150:]) < 0.3 * np.std(whitened.value[60:, :100])


def test_an_empty_chart_gives_an_empty_picture():
    (whitened,) = patch_images((image(np.zeros((30, 20)), mask=np.zeros((30, 20), bool)),))
    assert (whitened.value == 0).all()
    assert np.isfinite(whitened.cells_per_px)


@pytest.fixture(scope="module")
def sides():
    return [PatchSide(side.keypoints, side.images, side.patches) for side in sheets.pair()]


def errors(found):
    """Distance [mm] and angle [rad] by which matches miss the truth."""
    shift = found.points_a - transform_points(sheets.T_TRUE, found.points_b)
    turned = sheets.T_TRUE[:3, :3] @ found.frames_b
    angle = np.arctan2(
        (found.frames_a[:, :, 1] * turned[:, :, 0]).sum(1), (found.frames_a[:, :, 0] * turned[:, :, 0]).sum(1)
    )
    return np.linalg.norm(shift, axis=1), np.abs(angle)


def test_aligned_matches_lie_nearer_to_the_truth_than_their_keypoints(sides):
    a, b = sides
    found = match(a, b)
    distance, angle = errors(found)
    right = (distance < 2 * sheets.PITCH_MM) & (angle < 0.2)
    assert right.sum() > 50
    assert np.median(distance[right]) < 0.15 * sheets.PITCH_MM
    assert np.median(angle[right]) < 0.015


def test_the_most_significant_matches_are_right_and_stand_first(sides):
    distance, _ = errors(match(*sides))
    assert (distance[:50] < sheets.PITCH_MM).all()
    assert len(match(*sides, MatchOptions(max_matches=30))) == 30


def test_moved_places_lie_on_the_surface_and_their_pixels_are_their_projections(sides):
    found = match(*sides)
    b = sheets.pair()[1].measurement
    # Pixels are looked up linearly between texture pixels 1.5 camera pixels apart.
    np.testing.assert_allclose(b.camera.project(found.points_b), found.pixels_b, atol=0.1)
    np.testing.assert_allclose(
        np.swapaxes(found.frames_b, 1, 2) @ found.frames_b, np.tile(np.eye(3), (len(found), 1, 1)), atol=1e-6
    )


def test_each_keypoint_of_a_stands_in_one_match(sides):
    found = match(*sides)
    assert len(np.unique(np.hstack([found.points_a, found.frames_a[:, :, 0]]), axis=0)) == len(found)


def test_turning_a_keypoint_turns_the_alignment_and_not_the_match(sides):
    a, b = sides
    near = nearest_neighbours(a.keypoints, b.keypoints, 1.4, 40, 1)
    search = PatchSearch(12, 2, 3, 0.1)
    spin = 0.1
    other = replace(b, keypoints=replace(b.keypoints, chart_angle_rad=b.keypoints.chart_angle_rad + spin))
    one = align_patches(a, b, near.index_a, near.index_b, search, 1)
    two = align_patches(a, other, near.index_a, near.index_b, search, 1)
    sure = one.correlation > 0.7
    assert sure.sum() > 20
    assert np.median(np.abs(two.chart_angle_rad - one.chart_angle_rad)[sure]) < 0.01
    assert np.median(np.abs(two.correlation - one.correlation)[sure]) < 0.05


def test_without_keypoints_there_are_no_matches(sides):
    a, b = sides
    nothing = replace(a, keypoints=a.keypoints.take(np.zeros(len(a.keypoints), bool)))
    assert len(match(nothing, b)) == len(match(b, nothing)) == 0
