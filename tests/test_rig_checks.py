"""A wrong rig, exchanged cameras and empty measurements are noticed; a right rig is left in peace."""

from dataclasses import replace

import numpy as np
import pytest

from planish.errors import InputError
from planish.geometry import exp_so3
from planish.measurement import rejection_bit
from planish.pipeline import MeasureOptions, measure
from planish.rig import Rig
from planish.sensing.capture.manifest import Capture
from planish.sensing.checks.coverage import check_coverage
from planish.simulation.scenes import make_scene
from planish.simulation.writing import write_scene

#: What forty tiles on grain of 3 % contrast tell [px], and the limit of the warning.
ROW_PX, WARN_PX = 0.05, 0.5
#: The projector fills nothing in: its ray is a check only.
STEREO = MeasureOptions(geometry="stereo")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    out = tmp_path_factory.mktemp("rig")
    write_scene(make_scene("door", 3, 1, scale=0.5), out, true_points=False)
    return out / "m1"


def with_rig(folder, change, projector=False):
    """The capture with a changed camera B, and without the projector's calibration unless wanted."""
    capture = Capture.load(folder)
    rig = capture.load_rig("A")
    cameras = {**rig.cameras, "B": change(rig.cameras["B"])}
    Rig(cameras, rig.projector if projector else None).save(folder / "other.json")
    return replace(capture, manifest=capture.manifest.model_copy(update={"rig": "other.json"}))


def moved_rows(by_px):
    def change(camera):
        K = camera.K.copy()
        K[1, 2] += by_px
        return replace(camera, K=K)

    return change


def finding(measurement, name):
    (found,) = [item for item in measurement.findings if item.quantity.startswith(name)]
    return found


def test_a_right_rig_has_no_row_error_and_no_warning(folder):
    m = measure(Capture.load(folder), None, 2)
    assert [item.warning for item in m.findings if item.warning] == []
    rows = finding(m, "row error")
    assert abs(rows.value) < ROW_PX
    assert rows.sigma < ROW_PX
    alone = measure(Capture.load(folder), STEREO, 2)
    assert abs(finding(alone, "miss of the projector").value) < ROW_PX


@pytest.mark.parametrize("by_px", [-4.0, -1.0, 1.0, 3.0])
def test_rows_that_are_off_are_measured_and_warned_of(folder, by_px):
    rows = finding(measure(with_rig(folder, moved_rows(by_px)), None, 2), "row error")
    assert rows.value == pytest.approx(-by_px, abs=ROW_PX)
    assert "does not fit" in rows.warning


def test_a_rolled_camera_shows_as_variation_over_the_image(folder):
    def roll(camera):
        T = camera.T_camera_sensor.copy()
        T[:3, :3] = exp_so3([0, 0, 0.012]) @ T[:3, :3]
        return replace(camera, T_camera_sensor=T)

    assert "varying by" in finding(measure(with_rig(folder, roll), None, 2), "row error").warning
    assert "does not fit" in finding(measure(with_rig(folder, roll, True), STEREO, 2), "miss of the projector").warning


@pytest.mark.parametrize("projector", [True, False])
def test_exchanged_cameras_are_named(folder, projector):
    capture = with_rig(folder, lambda camera: camera, projector)
    images = capture.manifest.images
    swapped = images.model_copy(update={"A": images.B, "B": images.A})
    capture = replace(capture, manifest=capture.manifest.model_copy(update={"images": swapped}))
    with pytest.raises(InputError, match="the images of A and B are exchanged"):
        measure(capture, None, 2)


def rejected(**shares):
    """A mask (100, 100) whose pixels are rejected for these reasons, in per cent."""
    mask = np.zeros(10_000, np.uint16)
    start = 0
    for reason, share in shares.items():
        mask[start : start + 100 * share] = rejection_bit(reason)
        start += 100 * share
    return mask.reshape(100, 100)


def test_coverage_counts_the_lit_pixels():
    found = check_coverage(rejected(dark=50, unmatched=10), "capture.json")
    assert (found.value, found.warning) == (pytest.approx(80.0), "")
    assert found.source == "dark 50.0 %, unmatched 10.0 %"


def test_few_points_are_warned_of_with_the_likely_cause():
    found = check_coverage(rejected(dark=50, unmatched=45), "capture.json")
    assert "only 10.0 % of the lit pixels became points" in found.warning
    assert "cameras exchanged" in found.warning


def test_no_point_at_all_is_refused_with_counts():
    with pytest.raises(InputError, match=r"no point could be measured .*dark 100.0 %.*too little light"):
        check_coverage(rejected(dark=100), "capture.json")
