"""Which rig a capture is measured with: that of its manifest, of any kind, or one given instead."""

import json
import shutil

import numpy as np
import pytest

from command_line import planish
from planish import Capture, MeasureOptions, measure, write_rig
from planish.errors import InputError
from planish.measurement import Measurement
from planish.rig import Camera, Rig
from sequences import phase_entries, small_rig
from test_measure_command import edit, write_capture

#: Triangulation computes in single precision, about 0.9 m before the cameras [mm]; a rig's way through a file and into
#: another sensor frame costs its rounding.
TOLERANCE_MM = 1e-3


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    folder = tmp_path_factory.mktemp("capture") / "part"
    write_capture(folder, small_rig(), [*phase_entries([320, 40]), {"role": "white"}, {"role": "black"}])
    return folder


@pytest.fixture(scope="module")
def expected(good):
    """Points in the frame of either camera."""
    return {
        name: measure(Capture.load(good), MeasureOptions(organise_on=name), 1, pair().in_frame_of(name))
        for name in "AB"
    }


def pair():
    return small_rig(with_projector=False)


@pytest.fixture
def capture(good, tmp_path):
    return shutil.copytree(good, tmp_path / "part")


@pytest.mark.parametrize("name", ["rig.yml", "rig.xml", "rig.mat"])
@pytest.mark.parametrize("organise_on", ["A", "B"])
def test_a_manifest_may_name_a_calibration_of_any_kind(capture, expected, name, organise_on):
    write_rig(pair(), capture / name)
    edit(capture, lambda m: m.update(rig=name))
    m = measure(Capture.load(capture), MeasureOptions(organise_on=organise_on), 1)
    np.testing.assert_array_equal(m.rig.cameras[organise_on].T_camera_sensor, np.eye(4))
    both = m.valid & expected[organise_on].valid
    assert both.sum() >= 0.99 * expected[organise_on].valid.sum()
    np.testing.assert_allclose(m.points_sensor[both], expected[organise_on].points_sensor[both], atol=TOLERANCE_MM)


def test_a_capture_without_a_rig_asks_for_one_and_takes_it(capture, tmp_path, expected):
    edit(capture, lambda m: m.pop("rig"))
    refused = planish("measure", capture, "--out", tmp_path / "out")
    assert refused.code == 2
    assert "names no rig; expected 'rig', the file of the calibration, or --rig FILE" in " ".join(refused.err.split())
    write_rig(pair(), tmp_path / "fresh.yml")
    assert planish("measure", capture, "--out", tmp_path / "out", "--rig", tmp_path / "fresh.yml").code == 0
    m = Measurement.load(tmp_path / "out" / "part.h5")
    np.testing.assert_allclose(m.points_sensor, expected["A"].points_sensor, atol=TOLERANCE_MM)


def test_a_given_rig_goes_before_that_of_the_manifest(capture, tmp_path):
    content = json.loads((capture / "rig.json").read_text())
    content["projector"] = None
    (tmp_path / "fresh.json").write_text(json.dumps(content))
    assert planish("measure", capture, "--out", tmp_path / "out", "--rig", tmp_path / "fresh.json").code == 0
    assert Measurement.load(tmp_path / "out" / "part.h5").rig.projector is None
    assert measure(Capture.load(capture), None, 1).rig.projector is not None


def test_a_rig_for_other_images_is_refused(capture, tmp_path):
    large = {
        name: Camera.make(camera.K, camera.distortion, (400, 300), camera.T_camera_sensor)
        for name, camera in pair().cameras.items()
    }
    for name, words in (
        ("large.json", "is 200 x 150 px; expected 400 x 300 px, as camera A of the rig"),
        ("large.yml", "calibrated with 400 x 300 px; expected 200 x 150 px, the size in use"),
        ("large.mat", "calibrated with 400 x 300 px; expected 200 x 150 px, the size in use"),
    ):
        write_rig(Rig(large), tmp_path / name)
        refused = planish("measure", capture, "--out", tmp_path / "out", "--rig", tmp_path / name)
        assert refused.code == 2
        assert words in " ".join(refused.err.split())


def test_a_calibration_in_several_files_is_given_by_repeating_the_option(capture, tmp_path, expected):
    write_rig(pair(), tmp_path / "all.yml")
    text = (tmp_path / "all.yml").read_text()
    head, _, tail = text.partition("R: ")
    (tmp_path / "in.yml").write_text(head)
    (tmp_path / "ex.yml").write_text(head.split("M1:")[0] + "R: " + tail)
    options = ("--rig", tmp_path / "in.yml", "--rig", tmp_path / "ex.yml")
    assert planish("measure", capture, "--out", tmp_path / "out", *options).code == 0
    m = Measurement.load(tmp_path / "out" / "part.h5")
    np.testing.assert_allclose(m.points_sensor, expected["A"].points_sensor, atol=TOLERANCE_MM)


@pytest.mark.parametrize("name", ["one.json", "one.yml"])
def test_a_rig_without_the_organising_camera_is_refused(capture, name):
    write_rig(Rig({"A": pair().in_frame_of("A").cameras["A"]}), capture / name)
    edit(capture, lambda m: m.update(rig=name))
    with pytest.raises(InputError, match="calibration of A; expected those of camera B"):
        measure(Capture.load(capture), MeasureOptions(organise_on="B"), 1)
