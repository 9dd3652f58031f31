"""The whole measurement against the simulator's truth, at the reference sensor; no spatial filter anywhere."""

import json
from dataclasses import replace

import numpy as np
import pytest

from planish.geometry import transform_points
from planish.measurement import Measurement
from planish.pipeline import MeasureOptions, measure
from planish.sensing.capture.manifest import Capture
from planish.simulation.scenes import make_scene
from planish.simulation.writing import write_scene
from spread import robust_spread

#: What the issue asks for.
SEEN_SHARE = 0.90
SIGMA_MM, SIGMA_OVER_FORMULA = 0.05, 1.1
OUTLIER_MM, OUTLIER_SHARE = 0.5, 1e-4
STEP_WIDTH_PX = 3.0
#: A million points give the spread within 0.1 %; what is left is the error of the noise model and of the local slope.
NORMALISED_SPREAD = 0.03


def simulate(folder, scene, **options):
    write_scene(make_scene(scene, 3, 1, **options), folder)
    truth = np.load(folder / "m1" / "truth_A.npz")
    return Capture.load(folder / "m1"), truth["points_sensor"].astype(float), truth["seen"]


def along_ray(measurement: Measurement, truth):
    center = measurement.camera.center_sensor
    return np.linalg.norm(measurement.points_sensor - center, axis=-1) - np.linalg.norm(truth - center, axis=-1)


@pytest.fixture(scope="module")
def door(tmp_path_factory):
    capture, truth, seen = simulate(tmp_path_factory.mktemp("door"), "door")
    return measure(capture, None, 2), truth, seen


def test_nine_tenths_of_what_all_three_devices_see_is_measured(door):
    measurement, _, seen = door
    assert (measurement.valid & seen).sum() >= SEEN_SHARE * seen.sum()


def test_the_scatter_along_the_ray_is_that_of_the_formula(door):
    """docs/measure.md: sigma = Z^2 / (c b) sqrt(2) p / (2 pi) sqrt(2 / N) sigma_I / B."""
    m, truth, seen = door
    error = along_ray(m, truth)[m.valid & seen]
    a, b = m.rig.cameras["A"], m.rig.cameras["B"]
    Z = np.median(truth[seen] @ a.T_camera_sensor[2, :3] + a.T_camera_sensor[2, 3])
    baseline = np.linalg.norm(a.center_sensor - b.center_sensor)
    position = np.where(seen, m.rig.projector.project(truth)[..., 0], np.nan)
    period_px = 20 / np.nanmedian(np.abs(np.diff(position, axis=1)))
    view = m.views["A"]
    noise = np.median(np.sqrt(view.noise.variance(view.mean))[seen])
    amplitude = np.median(view.modulation[seen])
    formula = Z**2 / (a.K[0, 0] * baseline) * np.sqrt(2) * period_px / (2 * np.pi) * np.sqrt(2 / 4) * noise / amplitude
    assert robust_spread(error) <= SIGMA_OVER_FORMULA * formula
    assert robust_spread(error) <= SIGMA_MM
    # Only as far off as the interpolation between the pixels of the other camera takes noise away.
    assert robust_spread(error) >= 0.7 * formula


def test_outliers_are_rare_and_there_is_no_bias(door):
    m, truth, seen = door
    error = along_ray(m, truth)[m.valid & seen]
    assert (np.abs(error) > OUTLIER_MM).mean() <= OUTLIER_SHARE
    # A thousandth of a millimetre: ten times the standard error of the median.
    assert abs(np.median(error)) < 1e-3


def test_sigma_states_the_scatter(door):
    m, truth, seen = door
    ok = m.valid & seen
    normalised = along_ray(m, truth)[ok] / m.sigma_mm[ok]
    assert robust_spread(normalised) == pytest.approx(1.0, abs=NORMALISED_SPREAD)
    assert np.std(normalised[np.abs(normalised) < 6]) == pytest.approx(1.0, abs=NORMALISED_SPREAD)


def test_no_ripple_of_the_fringe_period_is_left(door):
    m, truth, seen = door
    ok = m.valid & seen
    position = m.rig.projector.project(truth[ok])[:, 0]
    error = along_ray(m, truth)[ok]
    for harmonic in (1, 2, 4):
        ripple = 2 * np.abs((error * np.exp(2j * np.pi * harmonic * position / 20)).mean())
        # Noise of 0.045 mm over a million points makes 0.00009 mm.
        assert ripple < 0.001


def test_the_views_hold_what_each_camera_saw(door):
    m, *_ = door
    assert m.texture_views == ("A", "B")
    for view in m.views.values():
        assert view.mean_images == 12
        assert view.white.shape == view.mean.shape == view.modulation.shape == m.shape
    # White less black is twice the fringes' amplitude, less what the projector's blur takes.
    ratio = np.median(2 * m.views["A"].modulation[m.valid] / m.views["A"].white[m.valid])
    assert 0.85 < ratio < 1.0


def test_a_step_of_a_fifth_of_a_millimetre_keeps_its_edge(tmp_path):
    capture, truth, seen = simulate(tmp_path, "step", scale=0.5)
    m = measure(capture, None, 2)
    T_object_sensor = np.array(json.loads((tmp_path / "truth.json").read_text())["measurements"][0]["T_object_sensor"])
    across = transform_points(T_object_sensor, truth)[..., 0] / np.nanmedian(
        np.linalg.norm(np.diff(truth, axis=1), axis=-1)
    )
    height = transform_points(T_object_sensor, m.points_sensor.astype(float))[..., 2]
    bins = np.arange(-10, 10.01, 0.25)
    centers = 0.5 * (bins[1:] + bins[:-1])
    which = np.digitize(across, bins)
    profile = np.array([np.mean(height[m.valid & (which == k)]) for k in range(1, len(bins))])
    low, high = profile[centers < -5].mean(), profile[centers > 5].mean()
    assert high - low == pytest.approx(0.2, abs=0.003)
    rise = np.maximum.accumulate((profile - low) / (high - low))
    assert np.interp(0.9, rise, centers) - np.interp(0.1, rise, centers) <= STEP_WIDTH_PX
    near = seen & (np.abs(across) < 4)
    assert (m.valid & near).sum() >= 0.99 * near.sum()


def test_bytes_do_not_depend_on_the_number_of_threads(tmp_path):
    capture, *_ = simulate(tmp_path, "door", scale=0.25)
    results = [measure(capture, None, threads) for threads in (1, 2, 8)]
    for other in results[1:]:
        for name in ("points_sensor", "sigma_mm", "rejected", "correspondence_px"):
            assert getattr(results[0], name).tobytes() == getattr(other, name).tobytes()


def test_either_camera_can_organise_and_both_agree(tmp_path):
    capture, *_ = simulate(tmp_path, "door", scale=0.25)
    a = measure(capture, MeasureOptions(organise_on="A"), 2)
    b = measure(capture, MeasureOptions(organise_on="B", texture_views=("B",)), 2)
    truth = np.load(tmp_path / "m1" / "truth_B.npz")
    assert (b.organised_on, b.texture_views) == ("B", ("B",))
    error = along_ray(b, truth["points_sensor"])[b.valid & truth["seen"]]
    sigma = b.sigma_mm[b.valid & truth["seen"]]
    assert robust_spread(error / sigma) == pytest.approx(1.0, abs=2 * NORMALISED_SPREAD)
    # What A found in B is what B found in A, to the nearest pixel.
    v, u = (x[::37] for x in np.nonzero(np.isfinite(a.correspondence_px[..., 0])))
    there = np.round(a.correspondence_px[v, u]).astype(int)
    back = b.correspondence_px[there[:, 1], there[:, 0]]
    known = np.isfinite(back[:, 0])
    assert known.mean() > 0.98
    assert np.median(np.abs(back[known] - np.stack([u, v], -1)[known])) < 0.6


def test_a_measurement_survives_its_file(tmp_path):
    capture, *_ = simulate(tmp_path, "plate", scale=0.2)
    m = measure(capture, None, 2)
    m.save(tmp_path / "m.h5")
    again = Measurement.load(tmp_path / "m.h5")
    assert again.points_sensor.tobytes() == m.points_sensor.tobytes()
    assert again.views["B"].noise == m.views["B"].noise
    assert again.texture_views == m.texture_views


@pytest.mark.slow
@pytest.mark.parametrize("scene", ["plate", "cylinder", "pipe", "waves"])
@pytest.mark.parametrize("noise", [0.5, 1.0, 2.0])
def test_every_surface_and_noise_keeps_its_promise(tmp_path, scene, noise):
    what = make_scene(scene, 8, 1)
    what = replace(what, sensor=replace(what.sensor, noise_factor=noise))
    write_scene(what, tmp_path)
    truth = np.load(tmp_path / "m1" / "truth_A.npz")
    m = measure(Capture.load(tmp_path / "m1"), None, 2)
    ok = m.valid & truth["seen"]
    error = along_ray(m, truth["points_sensor"].astype(float))[ok]
    assert ok.sum() >= SEEN_SHARE * truth["seen"].sum()
    assert robust_spread(error / m.sigma_mm[ok]) == pytest.approx(1.0, abs=0.05)
    # The limit is for the reference noise: where the points scatter twice as much, so may they be off.
    assert (np.abs(error) > OUTLIER_MM * max(noise, 1.0)).mean() <= OUTLIER_SHARE
