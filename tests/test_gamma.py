"""Fringes that are no cosine: found without a model of the response, corrected, and stated in sigma."""

import numpy as np
import pytest

from planish.measurement import NoiseModel
from planish.sensing.capture.sequence import read_layouts
from planish.sensing.decode import DecodeOptions, PhaseMap
from planish.sensing.observe import observe
from planish.sensing.patterns.sequences import encode
from planish.sensing.points.correspond import correspond
from planish.sensing.points.projector import intersect
from planish.sensing.points.triangulate import triangulate
from planish.sensing.waveform.gamma import estimate_wave_error, without_wave_error
from planish.sensing.waveform.response import gamma_finding
from planish.sensing.waveform.straighten import straighten
from sequences import PROJECTOR_PX, manifest, phase_entries, plane_points, small_rig

PERIODS = (320, 80, 20)
NOISE = 1.0
#: Ripple that the noise of 30,000 pixels leaves [rad], and what of the correction its own sigma allows (4 of them).
LEFT_RAD = 2e-3
#: 30,000 pixels, but for the noise model: it is estimated from the images.
SPREAD = 0.05


def positions():
    rig = small_rig()
    return rig.projector.project(plane_points(rig.cameras["A"]))[..., 0]


def observed(steps, projector_gamma=1.0, camera_gamma=1.0, periods=PERIODS, seed=1, level=160.0):
    """What camera A sees of a plane under fringes with a gamma of the projector and one of the camera."""
    place, rng = positions(), np.random.default_rng(seed)
    content = manifest([*phase_entries(periods, steps), {"role": "white"}, {"role": "black"}],
                       projector_px=PROJECTOR_PX)  # fmt: skip
    images = []
    for entry in content.sequence:
        signal = encode(entry, place) ** projector_gamma
        grey = 20 + level * signal ** (1 / camera_gamma) + NOISE * rng.standard_normal(place.shape)
        images.append(np.clip(np.round(grey), 0, 255).astype(np.uint8))
    layout = read_layouts(content, "capture.json")[0]
    seen = observe(lambda name: images, ("A",), layout, DecodeOptions(), "capture.json", 2)["A"]
    return seen, layout, images


def lit():
    place = positions()
    return (place > 0) & (place < PROJECTOR_PX[0] - 1)


def ripple_rad(phase, steps, period=PERIODS[-1]):
    error, place = (phase.position_px - positions())[lit()], positions()[lit()]
    return [
        2 * abs(np.nanmean(error * np.exp(2j * np.pi * k * steps * place / period))) * 2 * np.pi / period
        for k in (1, 2, 3)
    ]


@pytest.mark.parametrize(
    ("steps", "projector_gamma", "camera_gamma", "expected_rad"),
    # First order: |r_(N-1) - r_(N+1)|, r_k = c_k / c_1 of a cosine to the power p;
    # r_(k+1) / r_k = (p - k) / (p + k + 1).
    [(3, 2.2, 1.0, 0.29), (3, 1.0, 2.2, 0.16), (4, 2.2, 1.0, 0.0107), (4, 1.0, 2.2, 0.0625)],
)  # fmt: skip
def test_the_error_is_found_and_taken_away(steps, projector_gamma, camera_gamma, expected_rad):
    seen, layout, _ = observed(steps, projector_gamma, camera_gamma)
    error = estimate_wave_error(seen.phases["u"], PERIODS[-1], steps)
    assert error.significant
    assert error.amplitude_rad == pytest.approx(expected_rad, rel=0.06)
    straight = straighten(seen, layout.codes, "A")
    assert max(ripple_rad(straight.phases["u"], steps)) < LEFT_RAD
    assert ripple_rad(seen.phases["u"], steps)[0] > 4 * LEFT_RAD
    normalised = ((straight.phases["u"].position_px - positions()) / straight.phases["u"].sigma_px)[lit()]
    assert np.isfinite(normalised).mean() > 0.9999
    assert np.nanstd(normalised) == pytest.approx(1.0, abs=SPREAD)
    assert any("phase error" in finding.quantity and finding.value > 0.01 for finding in straight.findings)


def test_a_pure_cosine_is_left_as_it_is():
    seen, layout, _ = observed(4)
    straight = straighten(seen, layout.codes, "A")
    assert straight.phases["u"].position_px.tobytes() == seen.phases["u"].position_px.tobytes()
    finding = next(finding for finding in straight.findings if "phase error" in finding.quantity)
    assert finding.value < 5 * finding.sigma
    assert "not significant" in finding.source


def test_the_sigma_of_the_amplitude_is_its_scatter():
    values, sigmas = [], []
    for seed in range(12):
        error = estimate_wave_error(observed(4, 1.4, periods=(320, 20), seed=seed)[0].phases["u"], 20, 4)
        values.append(error.coefficients[0, 0])
        sigmas.append(error.amplitude_sigma_rad)
    # Twelve draws: a standard deviation is known within a fifth.
    assert np.std(values, ddof=1) == pytest.approx(np.mean(sigmas), rel=0.6)


def test_no_period_is_lost_with_three_steps_and_a_gamma():
    """Uncorrected, 0.28 rad of 320 px are 14 px: more than the quarter of 40 px that is allowed."""
    seen, _, _ = observed(3, 2.2, periods=(320, 40, 10))
    found = seen.phases["u"]
    error = np.abs(found.position_px - positions())[lit()]
    # Without the correction, half of the pixels are lost.
    assert np.isfinite(error).mean() > 0.995
    assert np.nanmax(error) < 2.5
    assert not found.rejected[lit()].all()


def test_a_slope_along_rows_and_gaps_do_not_matter():
    rng, (v, u) = np.random.default_rng(0), np.mgrid[:300, :240]
    true = 0.9 * v + 0.1 * u + 2e-4 * v**2
    phase = 2 * np.pi * true / 16
    measured = phase - 0.05 * np.sin(4 * phase) + 0.01 * rng.standard_normal(phase.shape)
    position = (measured * 16 / (2 * np.pi)).astype(np.float32)
    position[100:140, 50:90] = np.nan
    known = PhaseMap(
        "v", position, np.full_like(position, 0.01 * 16 / (2 * np.pi)), np.zeros(position.shape, np.uint16)
    )
    error = estimate_wave_error(known, 16, 4)
    fixed = without_wave_error(known, error, 16)
    assert error.coefficients[0] == pytest.approx([0.05, 0.0], abs=2e-3)
    assert np.isnan(fixed.position_px).sum() == 1600
    assert np.nanstd(fixed.position_px - true) < 1.05 * 0.01 * 16 / (2 * np.pi)


def test_nothing_is_said_of_an_empty_map():
    nothing = np.full((60, 80), np.nan, np.float32)
    empty = PhaseMap("u", nothing, nothing, np.ones(nothing.shape, np.uint16))
    assert estimate_wave_error(empty, 20, 4) is None


@pytest.mark.parametrize(("projector", "camera", "expected"), [(1, 1, 1.0), (2.2, 1, 2.2), (1, 2.2, 1 / 2.2)])
def test_gamma_follows_from_white_and_black(projector, camera, expected):
    seen, layout, images = observed(4, projector, camera)
    finding = gamma_finding(images, layout, seen.view.noise, 255.0, "A")
    assert finding.value == pytest.approx(expected, rel=0.02)
    assert finding in seen.findings
    dark = [np.zeros_like(image) for image in images]
    assert gamma_finding(dark, layout, NoiseModel(1.0, 0.0), 255.0, "A").value is None


@pytest.mark.parametrize(("period", "largest_ratio"), [(20, 0.2), (40, 0.06), (80, 0.02)])
def test_between_two_cameras_the_error_cancels_but_for_what_interpolation_smoothes(period, largest_ratio):
    """The ripple of a point's depth, over that of camera and projector: 4, 9 and 17 camera pixels per ripple."""
    rig = small_rig()
    a, b = rig.cameras["A"], rig.cameras["B"]
    places = {name: rig.projector.project(plane_points(camera))[..., 0] for name, camera in rig.cameras.items()}
    bent = {name: rippled(place, period, 3, 0.14) for name, place in places.items()}
    stereo = triangulate(correspond(bent["A"], bent["B"], a, b, 2), a, b, 2).points_sensor
    single = intersect({"u": bent["A"]}, "u", a, rig.projector, 2).points_sensor
    ripples = []
    for points in (stereo, single):
        error = np.linalg.norm(points - a.center_sensor, axis=-1) - np.linalg.norm(
            plane_points(a) - a.center_sensor, axis=-1
        )
        ripples.append(abs(np.nanmean(error * np.exp(6j * np.pi * places["A"] / period))))
    assert ripples[0] < largest_ratio * ripples[1]


def rippled(place, period, steps, amplitude_rad):
    bent = place + period / (2 * np.pi) * amplitude_rad * np.sin(2 * np.pi * steps * place / period)
    bent = bent.astype(np.float32)
    return PhaseMap("u", bent, np.full_like(bent, 0.02), np.zeros(bent.shape, np.uint16))
