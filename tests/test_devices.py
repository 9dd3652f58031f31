"""Which devices give the points: one camera and the projector, two cameras, and the projector where one is blind."""

import json
import shutil
from dataclasses import replace

import cv2
import numpy as np
import pytest

from command_line import planish
from planish.errors import InputError
from planish.geometry import compose, exp_so3, invert
from planish.measurement import Measurement
from planish.pipeline import MeasureOptions, measure, register
from planish.rig import Rig
from planish.sensing.capture.manifest import Capture
from planish.simulation.scenes import make_scene
from planish.simulation.writing import write_scene
from spread import robust_spread

#: What the issue asks for.
SEEN_SHARE, SPREAD, FAR_SHARE = 0.95, 0.10, 1e-4
SCALE = 0.4


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    where = tmp_path_factory.mktemp("door")
    write_scene(make_scene("door", 3, 1, scale=SCALE), where)
    return where / "m1"


def capture(folder, tmp_path, cameras="AB", rig=None):
    """The capture with the images of some cameras and, if given, another rig."""
    content = json.loads((folder / "capture.json").read_text())
    content["images"] = {name: content["images"][name] for name in cameras}
    if rig is not None:
        rig.save(tmp_path / "rig.json")
    elif not (tmp_path / "rig.json").exists():
        Rig.load(folder / "rig.json").save(tmp_path / "rig.json")
    (tmp_path / "capture.json").write_text(json.dumps(content))
    return Capture.load(tmp_path / "capture.json", folder)


def turned_projector(folder, angle_rad):
    rig = Rig.load(folder / "rig.json")
    turn = compose(exp_so3([0, angle_rad, 0]), [0, 0, 0])
    return replace(rig, projector=replace(rig.projector, T_camera_sensor=turn @ rig.projector.T_camera_sensor))


def truth(folder, name="A"):
    return np.load(folder / f"truth_{name}.npz")["points_sensor"].astype(float)


def lit(folder, name="A"):
    rig = Rig.load(folder / "rig.json")
    place = rig.projector.project(truth(folder, name))
    return (place > 0).all(-1) & (place < np.array(rig.projector.size_px) - 1).all(-1)


def normalised(m, folder):
    center = m.camera.center_sensor
    true = truth(folder, m.organised_on)
    error = np.linalg.norm(m.points_sensor - center, axis=-1) - np.linalg.norm(true - center, axis=-1)
    return error / m.sigma_mm


def check(m, folder, where=True):
    z = normalised(m, folder)
    z = z[np.isfinite(z) & where]
    assert robust_spread(z) == pytest.approx(1.0, abs=SPREAD)
    assert np.std(z) == pytest.approx(1.0, abs=SPREAD)
    assert (np.abs(z) > 10).mean() <= FAR_SHARE


def test_one_camera_and_the_projector_measure_what_both_see(folder, tmp_path):
    m = measure(capture(folder, tmp_path, "A"), None, 2)
    assert (m.valid & lit(folder)).sum() >= SEEN_SHARE * lit(folder).sum()
    assert m.correspondence_px is None
    assert (set(m.views), m.texture_views) == ({"A"}, ("A",))
    check(m, folder)


def test_either_camera_can_be_the_one(folder, tmp_path):
    m = measure(capture(folder, tmp_path), MeasureOptions(organise_on="B", geometry="projector"), 2)
    assert (m.valid & lit(folder, "B")).sum() >= SEEN_SHARE * lit(folder, "B").sum()
    assert (set(m.views), m.texture_views) == ({"B"}, ("B",))
    check(m, folder)


def test_the_projector_fills_what_the_other_camera_does_not_see(folder, tmp_path):
    both = measure(capture(folder, tmp_path), None, 2)
    stereo = measure(capture(folder, tmp_path), MeasureOptions(geometry="stereo"), 2)
    filled = both.valid & np.isnan(both.correspondence_px[..., 0])
    assert not (stereo.valid & np.isnan(stereo.correspondence_px[..., 0])).any()
    assert filled.sum() > 0.1 * stereo.valid.sum()
    assert (both.valid & lit(folder)).sum() >= SEEN_SHARE * lit(folder).sum()
    kept = stereo.valid & both.valid
    assert kept.sum() > 0.999 * stereo.valid.sum()
    assert both.points_sensor[kept].tobytes() == stereo.points_sensor[kept].tobytes()
    check(both, folder)
    check(both, folder, filled)


def test_what_is_saturated_in_the_other_camera_comes_from_the_projector(folder, tmp_path):
    """A highlight burns out a disc of camera B in every image."""
    for path in folder.glob("B_*.png"):
        image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        cv2.circle(image, (image.shape[1] // 2, image.shape[0] // 2), 40, 255, -1)
        cv2.imwrite(str(tmp_path / path.name), image)
    for path in folder.glob("A_*.png"):
        shutil.copy(path, tmp_path)
    capture(folder, tmp_path)
    m = measure(Capture.load(tmp_path / "capture.json"), None, 2)
    pixel = m.rig.cameras["B"].project(truth(folder))
    hidden = np.hypot(*(pixel - np.array([m.shape[1] // 2, m.shape[0] // 2])).transpose(2, 0, 1)) < 38
    inside = hidden & lit(folder)
    assert inside.sum() > 3000
    assert m.valid[inside].mean() > 0.99
    assert np.isnan(m.correspondence_px[inside]).all()
    check(m, folder, inside)


def test_a_projector_that_contradicts_the_cameras_is_left_out_with_a_warning(folder, tmp_path):
    # 2 mrad are 4 projector px.
    m = measure(capture(folder, tmp_path, rig=turned_projector(folder, 2e-3)), None, 2)
    right = measure(capture(folder, tmp_path, rig=Rig.load(folder / "rig.json")), MeasureOptions(geometry="stereo"), 2)
    finding = next(f for f in m.findings if f.quantity == "projector against cameras")
    assert finding.value == pytest.approx(4.0, rel=0.1)
    assert "contradict each other" in finding.warning
    assert not (m.valid & np.isnan(m.correspondence_px[..., 0])).any()
    assert m.valid.sum() > 0.99 * right.valid.sum()
    check(m, folder)


def test_a_small_error_of_the_projector_is_in_the_sigma_of_what_it_fills(folder, tmp_path):
    # 0.15 mrad are 0.3 projector px, ten times the noise.
    m = measure(capture(folder, tmp_path, rig=turned_projector(folder, 1.5e-4)), None, 2)
    finding = next(f for f in m.findings if f.quantity == "projector against cameras")
    assert (finding.value, finding.warning) == (pytest.approx(0.3, rel=0.1), "")
    filled = m.valid & np.isnan(m.correspondence_px[..., 0])
    z = normalised(m, folder)[filled]
    # The error is common to all filled points: one standard deviation of theirs, as a bias.
    assert 0.7 < np.sqrt(np.mean(z**2)) < 1.4


@pytest.mark.parametrize(
    ("cameras", "options", "message"),
    [
        ("A", {"geometry": "stereo"}, "expected images and calibration of A and B"),
        ("A", {"organise_on": "B"}, "expected those of camera B"),
        ("A", {"texture_views": ("B",)}, "texture views: B"),
    ],
)
def test_what_is_missing_is_named(folder, tmp_path, cameras, options, message):
    with pytest.raises(InputError, match=message):
        measure(capture(folder, tmp_path, cameras), MeasureOptions(**options), 1)


def test_one_camera_without_a_projector_is_refused(folder, tmp_path):
    rig = replace(Rig.load(folder / "rig.json"), projector=None)
    with pytest.raises(InputError, match="or of the projector"):
        measure(capture(folder, tmp_path, "A", rig), None, 1)


def test_bytes_do_not_depend_on_the_number_of_threads(folder, tmp_path):
    results = [measure(capture(folder, tmp_path), None, threads) for threads in (1, 3)]
    for name in ("points_sensor", "sigma_mm", "rejected", "correspondence_px"):
        assert getattr(results[0], name).tobytes() == getattr(results[1], name).tobytes()


def test_the_command_line_chooses_the_devices(folder, tmp_path):
    capture(folder, tmp_path)
    outcome = planish("measure", tmp_path, "--images", folder, "--out", tmp_path / "out", "--geometry", "projector")
    assert outcome.code == 0
    assert Measurement.load(tmp_path / "out" / "m1.h5").correspondence_px is None
    outcome = planish("measure", tmp_path, "--images", folder, "--out", tmp_path / "out", "--geometry", "laser")
    assert outcome.code == 2
    assert "geometry" in outcome.err


@pytest.mark.parametrize("geometry", ["auto", "projector"])
def test_measurements_by_the_projector_register(tmp_path, geometry):
    scene = make_scene("plate", 4, 2, scale=SCALE)
    write_scene(scene, tmp_path, true_points=False)
    options = MeasureOptions(geometry=geometry)
    measurements = [measure(Capture.load(tmp_path / name), options, 2) for name in scene.names]
    pair = register(measurements, threads=2).pairs[0]
    T_true = invert(scene.T_object_sensor[0]) @ scene.T_object_sensor[1]
    assert pair.status == "accepted"
    # A tenth of a camera pixel at this scale.
    assert np.abs(pair.T_a_b - T_true)[:3].max() < 0.08
