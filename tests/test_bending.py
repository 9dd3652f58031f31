"""Filtered textures of bent surfaces stand where the surface has them."""

from __future__ import annotations

import numpy as np
import pytest

from planish.registration.refine.bending import displacement, filter_reach, moved_back

#: Size of the images and of the transform, rows and columns [px].
SIZE = (128, 160)
#: Standard deviation of a Gaussian filter [px].
GAUSS_PX = 2.0
#: Radius of a pipe and its pixels' distance in the image, seen from afar [mm].
RADIUS_MM, PIXEL_MM = 150.0, 0.5
#: Waves so long that the filter passes them [cycles per pixel].
SLOW = 0.006
#: Frequencies are averaged before their derivatives are taken from differences; waves are not infinitely long.
REACH_SHARE = 0.1
#: What is left of a displacement where it is some hundredths of a pixel: its second order.
LEFT_SHARE = 0.1


def frequencies():
    return np.fft.fftfreq(SIZE[0])[:, None], np.fft.rfftfreq(SIZE[1])[None]


def gauss():
    fy, fx = frequencies()
    return np.exp(-2 * (np.pi * GAUSS_PX) ** 2 * (fy**2 + fx**2))


def test_a_gaussian_reaches_as_far_as_its_variance_in_all_directions():
    # Weights of its own variance v and a taper of w have the variance v w / (v + w).
    taper_px = 4 * GAUSS_PX
    fy, fx = frequencies()
    slow = gauss() * np.exp(-0.5 * (fy**2 + fx**2) / SLOW**2)
    reach = filter_reach(gauss(), slow, SIZE, taper_px)
    variance = 1 / (1 / GAUSS_PX**2 + 1 / taper_px**2)
    expected = np.einsum("kl,ij->klij", np.eye(2), variance * np.eye(2))
    np.testing.assert_allclose(reach, expected, atol=REACH_SHARE * variance)


def test_a_filter_that_passes_everything_moves_nothing():
    reach = filter_reach(np.ones_like(gauss()), gauss(), SIZE, 8.0)
    np.testing.assert_allclose(reach, 0, atol=1e-4)


def tangents_of_a_pipe():
    """Tangents (H, W, 6) of a pipe along v whose middle column is seen under 45 degrees, and its slopes."""
    u = np.arange(SIZE[1])[None].repeat(SIZE[0], 0)
    sine = np.sin(np.pi / 4) + (u - SIZE[1] / 2) * PIXEL_MM / RADIUS_MM
    cosine = np.sqrt(1 - sine**2)
    zero, one = np.zeros(SIZE), np.full(SIZE, PIXEL_MM)
    return np.stack([one, zero, -PIXEL_MM * sine / cosine, zero, one, zero], -1).astype(np.float32), sine, cosine


def test_a_texture_around_a_pipe_moves_as_its_arc_length_bends():
    tangents, sine, cosine = tangents_of_a_pipe()
    reach = np.einsum("kl,ij->klij", np.eye(2), GAUSS_PX**2 * np.eye(2))
    moved = displacement(tangents, reach)
    # s = R asin(x / R): s'' / s' = x / (R^2 cos^2), in pixels.
    expected = GAUSS_PX**2 / 2 * PIXEL_MM * sine / (RADIUS_MM * cosine**2)
    # Towards the limb it changes much from square to square.
    inner = np.s_[32:-32, 32:-72]
    np.testing.assert_allclose(moved[..., 0][inner], expected[inner], rtol=LEFT_SHARE)
    np.testing.assert_allclose(moved[..., 1][inner], 0, atol=1e-4)


def test_a_plane_moves_nothing():
    plane = np.tile(np.array([0.4, 0, 0.1, 0.05, 0.5, -0.2], np.float32), (*SIZE, 1))
    reach = np.einsum("kl,ij->klij", np.eye(2), np.eye(2))
    np.testing.assert_allclose(displacement(plane, reach), 0, atol=1e-6)


@pytest.mark.parametrize("wave_mm", [30.0, 45.0])
def test_waves_around_a_pipe_stand_where_they_are_after_they_are_moved_back(wave_mm):
    tangents, sine, _ = tangents_of_a_pipe()
    k = 2 * np.pi / wave_mm
    arc = RADIUS_MM * np.arcsin(sine)
    pixels = np.arange(-8, 9)
    weights = np.exp(-0.5 * (pixels / GAUSS_PX) ** 2)
    waves = np.exp(1j * k * arc)
    filtered = np.apply_along_axis(np.convolve, 1, waves, weights / weights.sum(), "same")
    reach = np.einsum("kl,ij->klij", np.eye(2), GAUSS_PX**2 * np.eye(2))
    moved = displacement(tangents, reach)
    back = moved_back(filtered.real.astype(np.float32), moved) + 1j * moved_back(
        filtered.imag.astype(np.float32), moved
    )
    inner = np.s_[32:-32, 32:-32]
    before, after = (np.angle(x / waves)[inner] / k for x in (filtered, back))
    assert np.abs(before).mean() > 0.003
    assert np.abs(after).mean() < 2 * LEFT_SHARE * np.abs(before).mean()
