"""What is fixed to the sensor: found where it is, told from texture that stands still, and removed."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import cv2
import numpy as np
import pytest

import sheets
import synthetic
from planish.geometry import exp_se3
from planish.measurement import View
from planish.registration.texture.fixed_pattern import estimate_fixed_patterns
from planish.registration.texture.photometric import local_contrast
from planish.rig import Rig

#: Photo response of the pixels, rms, as of the reference sensor.
RESPONSE = 0.005
#: Where a dust spot lies [px], its radius and depth.
DUST_PX, DUST_RADIUS_PX, DUST_DEPTH = (120, 90), 4.0, 0.04
#: Variance of a capture's noise and grain, about; both count as noise of the pattern.
NOISE_VARIANCE, GRAIN = 3.3e-5, 0.005
#: The variance that is left may exceed the optimum by this factor: the weights follow from the data, too.
LOSS = 1.15


@cache
def quiet(number):
    """A flat sheet without noise, captured from different places; 0.5 % grain."""
    T = exp_se3(
        [
            0.05 * np.sin(number),
            0.04 * np.cos(2 * number),
            0.7 * number,
            25.0 * number - 60,
            40 * np.sin(3 * number),
            4 * number,
        ]
    )
    return synthetic.measurement(
        T, sheets.grain(GRAIN), name=f"m{number:02d}", scale=sheets.SCALE, noise=sheets.QUIET, sigma_mm=0.0
    )  # fmt: skip


@cache
def background_picture(shape):
    """A picture with detail of about a pixel, 3 % rms."""
    noise = cv2.GaussianBlur(np.random.default_rng(9).standard_normal(shape), (0, 0), 0.8)
    return 100 * (1 + 0.03 * noise / noise.std())


@cache
def response(camera, shape):
    pattern = RESPONSE * np.random.default_rng(ord(camera)).standard_normal(shape)
    if camera == "A":
        rows, columns = np.indices(shape)
        pattern -= DUST_DEPTH * (np.hypot(columns - DUST_PX[0], rows - DUST_PX[1]) < DUST_RADIUS_PX)
    return 1 + pattern


def capture(number, seen=None, cameras=("A", "B"), background=None):
    """Capture of place `seen`: both cameras see the same picture, each with its own response and noise."""
    m = quiet(number if seen is None else seen)
    image = m.views["A"].mean.copy()
    if background is not None:
        image[background] = background_picture(image.shape)[background]
    rng = np.random.default_rng([number, 5])
    views = {}
    for camera in cameras:
        grey = image * response(camera, image.shape)
        grey += rng.standard_normal(grey.shape) * np.sqrt(sheets.NOISE.variance(image) / 12)
        views[camera] = View(None, grey.astype(np.float32), None, 12, sheets.NOISE, 255.0)
    rows, columns = np.indices(image.shape).astype(np.float32)
    return replace(
        m,
        name=f"m{number:02d}",
        rig=Rig(dict.fromkeys(cameras, m.camera)),
        views=views,
        texture_views=tuple(cameras),
        correspondence_px=np.stack([columns, rows], -1) if len(cameras) > 1 else None,
    )


def left_of_the_response(pattern, camera):
    """Share of the response's variance that the estimate leaves, away from dust and rim."""
    estimate, _ = pattern.cameras[camera].estimate()
    truth = response(camera, estimate.shape)
    truth = truth - cv2.GaussianBlur(truth, (0, 0), 1.9)
    inner = np.ones(estimate.shape, bool)
    inner[DUST_PX[1] - 15 : DUST_PX[1] + 15, DUST_PX[0] - 15 : DUST_PX[0] + 15] = False
    inner[:15], inner[-15:], inner[:, :15], inner[:, -15:] = False, False, False, False
    return np.var((truth - estimate)[inner]) / np.var(truth[inner])


@pytest.mark.parametrize("captures", [2, 5, 10])
@pytest.mark.parametrize("cameras", [("A", "B"), ("A",)])
def test_the_response_of_the_pixels_is_found_as_well_as_noise_and_texture_allow(captures, cameras):
    taken = [capture(i, cameras=cameras) for i in range(captures)]
    pattern = estimate_fixed_patterns(taken)["m00"]
    optimum = 1 / (1 + captures * RESPONSE**2 / (NOISE_VARIANCE + GRAIN**2))
    for camera in cameras:
        assert left_of_the_response(pattern, camera) < LOSS * optimum


def test_the_pattern_of_a_camera_is_the_same_where_the_organising_one_serves_no_texture():
    taken = [capture(i) for i in range(2)]
    both = estimate_fixed_patterns(taken)["m00"].cameras["B"].estimate()
    alone = estimate_fixed_patterns([replace(m, texture_views=("B",)) for m in taken])["m00"].cameras["B"].estimate()
    np.testing.assert_array_equal(alone, both)


def test_the_stated_uncertainty_of_the_pattern_is_its_error():
    pattern = estimate_fixed_patterns([capture(i) for i in range(6)])["m00"].cameras["A"]
    estimate, sigma = pattern.estimate()
    truth = response("A", estimate.shape)
    truth = truth - cv2.GaussianBlur(truth, (0, 0), 1.9)
    inner = np.s_[150:240, 30:320]
    ratio = np.sqrt(np.mean((truth - estimate)[inner] ** 2) / np.mean(sigma[inner] ** 2))
    # The prior is a median over places whose texture differs.
    assert 0.85 < ratio < 1.1


def test_dust_is_found():
    pattern = estimate_fixed_patterns([capture(i) for i in range(5)])["m00"]
    estimate, _ = pattern.cameras["A"].estimate()
    column, row = DUST_PX
    spot = estimate[row - 2 : row + 3, column - 2 : column + 3].mean()
    # The low-pass of 1.9 px follows the middle of a spot of 4 px radius to nine tenths; a rim of it stays, as contrast.
    truth = response("A", estimate.shape)
    truth = (truth - cv2.GaussianBlur(truth, (0, 0), 1.9))[row - 6 : row + 7, column - 6 : column + 7]
    found = estimate[row - 6 : row + 7, column - 6 : column + 7]
    assert np.isfinite(spot)
    assert np.var(truth - found) < 0.15 * np.var(truth)


def test_dust_on_a_blank_part_is_found_beside_the_response_of_both_cameras():
    taken = []
    for number in range(5):
        m = capture(number)
        rng = np.random.default_rng([number, 6])
        views = {}
        for camera, view in m.views.items():
            grey = 100 * response(camera, view.mean.shape)
            grey += rng.standard_normal(grey.shape) * np.sqrt(sheets.NOISE.variance(grey) / 12)
            views[camera] = replace(view, mean=grey.astype(np.float32))
        taken.append(replace(m, views=views))
    estimate, _ = estimate_fixed_patterns(taken)["m00"].cameras["A"].estimate()
    column, row = DUST_PX
    around = np.s_[row - 6 : row + 7, column - 6 : column + 7]
    truth = response("A", estimate.shape)
    truth = (truth - cv2.GaussianBlur(truth, (0, 0), 1.9))[around]
    # Nothing but noise of five captures hides it: what remains is the dust's rim in the low-pass.
    assert np.var(truth - estimate[around]) < 0.1 * np.var(truth)


def test_the_textures_correlate_where_they_should_and_not_at_the_same_pixels():
    taken = [capture(i) for i in range(2)]
    fixed = estimate_fixed_patterns(taken)

    def at_same_pixels(patterns):
        a, b = (local_contrast(m, fixed=patterns.get(m.name))[0][20:-20, 20:-20].ravel() for m in taken)
        return np.corrcoef(a, b)[0, 1]

    before, after = at_same_pixels({}), at_same_pixels(fixed)
    assert before > 0.2
    # Two captures: what one takes from the other makes them differ. Never does it make them agree.
    assert after < 0.02


def test_texture_that_did_not_move_is_not_taken_for_the_sensors():
    taken = [capture(i, seen=0) for i in range(4)]
    fixed = estimate_fixed_patterns(taken)
    before = local_contrast(taken[0])[0][20:-20, 20:-20]
    after = local_contrast(taken[0], fixed=fixed["m00"])[0][20:-20, 20:-20]
    # A fifth of the weakest sigma: the texture itself is as strong as the noise.
    assert np.std(after - before) < 0.15 * np.std(before)


def test_a_background_that_stands_still_harms_neither_itself_nor_the_rest():
    still = np.zeros(quiet(0).shape, bool)
    still[:, 230:] = True
    taken = [capture(i, background=still) for i in range(6)]
    fixed = estimate_fixed_patterns(taken)["m00"]
    estimate, _ = fixed.cameras["A"].estimate()
    part, background = np.s_[30:-30, 30:180], np.s_[30:-30, 265:-20]
    truth = response("A", estimate.shape)
    truth = truth - cv2.GaussianBlur(truth, (0, 0), 1.9)
    plain, _ = estimate_fixed_patterns([capture(i) for i in range(6)])["m00"].cameras["A"].estimate()
    left, alone = (np.var((truth - e)[part]) for e in (estimate, plain))
    assert left < 1.15 * alone
    # All of the background is in common; what is taken for the sensor's is less than the response itself.
    assert np.std(estimate[background]) < RESPONSE


def test_the_order_of_the_captures_and_the_number_of_threads_do_not_matter():
    taken = [capture(i) for i in range(3)]
    one = estimate_fixed_patterns(taken, threads=1)["m01"].cameras["B"]
    other = estimate_fixed_patterns(taken[::-1], threads=3)["m01"].cameras["B"]
    for band, same in zip(one.bands, other.bands, strict=True):
        for name in band.__dataclass_fields__:
            assert getattr(band, name).tobytes() == getattr(same, name).tobytes()


def test_one_capture_of_a_sensor_tells_nothing_about_it():
    taken = [capture(0), capture(1)]
    moved = replace(taken[1].camera, K=taken[1].camera.K + np.diag([1.0, 1.0, 0.0]))
    other = replace(taken[1], rig=Rig({"A": moved, "B": taken[1].camera}))
    assert estimate_fixed_patterns(taken[:1]) == {}
    assert estimate_fixed_patterns([taken[0], other]) == {}


def test_what_stays_uncertain_of_the_pattern_counts_as_noise():
    taken = [capture(i) for i in range(3)]
    _, alone = local_contrast(taken[0])
    _, sigma = local_contrast(taken[0], fixed=estimate_fixed_patterns(taken)["m00"])
    added = np.sqrt(np.nanmedian(sigma[20:-20, 20:-20] ** 2 - alone[20:-20, 20:-20] ** 2))
    # Two cameras, two other captures each: between a fifth and all of one camera's response.
    assert 0.2 * RESPONSE < added < RESPONSE
