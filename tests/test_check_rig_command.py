"""`planish check-rig` on rendered captures: intact and changed rigs, adjusting, blank plates, both axes, bad input."""

from dataclasses import replace

import numpy as np
import pytest

from command_line import planish
from planish.errors import InputError
from planish.geometry import exp_se3
from planish.measurement import Finding, Measurement
from planish.pipeline import MeasureOptions, measure
from planish.pipeline.checking import check_calibration
from planish.rig import Rig
from planish.sensing.capture.manifest import Capture
from planish.sensing.patterns.sequences import named_sequence
from planish.sensing.rigcheck.result import MeasurementRows
from planish.sensing.rigcheck.same_rig import common_rig
from planish.sensing.rigcheck.verdict import judge
from planish.simulation.scenes import make_scene
from planish.simulation.writing import write_scene

#: Row error that is left after adjusting [px], and what a hundred tiles tell at this resolution [px].
LEFT_PX, ROW_PX = 0.05, 0.05
SCALE = 0.4


@pytest.fixture(scope="module")
def door(tmp_path_factory):
    out = tmp_path_factory.mktemp("door")
    return write_scene(make_scene("door", 5, 1, scale=SCALE), out, true_points=False)[0]


@pytest.fixture(scope="module")
def blank(tmp_path_factory):
    scene = replace(make_scene("blank", 5, 1, scale=0.3), sequence=tuple(named_sequence("reference", axes=("u", "v"))))
    return write_scene(scene, tmp_path_factory.mktemp("blank"), true_points=False)[0]


def with_rig(folder, rig):
    """The capture with another rig."""
    rig.save(folder / "other.json")
    capture = Capture.load(folder)
    return replace(capture, manifest=capture.manifest.model_copy(update={"rig": "other.json"}))


def turned(rig, xi_deg, device="B"):
    """The rig with one device turned in its own frame; two cameras alone unless it is the projector."""
    T = exp_se3([*np.deg2rad(xi_deg), 0, 0, 0])
    if device == "projector":
        return replace(rig, projector=replace(rig.projector, T_camera_sensor=T @ rig.projector.T_camera_sensor))
    camera = rig.cameras[device]
    cameras = {**rig.cameras, device: replace(camera, T_camera_sensor=T @ camera.T_camera_sensor)}
    return replace(rig, cameras=cameras, projector=None)


@pytest.fixture(scope="module")
def intact(door):
    return measure(Capture.load(door), None, 2)


def test_an_intact_rig_holds_and_says_what_it_cannot_see(intact):
    check = check_calibration({"m": intact}).check
    assert check.status == "holds"
    assert abs(check.mean_px) < ROW_PX
    assert check.noise_sigmas < 4
    assert any("length of the baseline" in text for text in check.not_observable)
    assert any("convergence" in text for text in check.not_observable)
    assert any("projector against cameras" in text for text in check.not_observable)


@pytest.mark.parametrize("xi_deg", [(0.2, 0, 0), (0, 0.3, 0), (0, 0, -0.2)])
def test_a_turned_camera_is_found_and_after_adjusting_and_measuring_again_nothing_is_left(door, xi_deg):
    rig = turned(Capture.load(door).load_rig("A"), xi_deg)
    found = check_calibration({"m": measure(with_rig(door, rig), None, 2)}, adjust=True)
    assert found.check.status == "does not hold"
    assert found.check.noise_sigmas > 10
    assert found.adjustment.refusal == ""
    again = check_calibration({"m": measure(with_rig(door, found.adjustment.rig), None, 2)}).check
    assert again.status == "holds"
    assert again.rms_px < LEFT_PX


def test_the_row_error_is_that_of_the_moved_rows(door):
    rig = Capture.load(door).load_rig("A")
    K = rig.cameras["B"].K.copy()
    K[1, 2] += 12.0
    moved = replace(rig, cameras={**rig.cameras, "B": replace(rig.cameras["B"], K=K)}, projector=None)
    check = check_calibration({"m": measure(with_rig(door, moved), None, 2)}).check
    assert check.mean_px == pytest.approx(-12.0, abs=2 * ROW_PX)


def test_organised_on_either_camera_the_same_camera_is_moved(door):
    rig = turned(Capture.load(door).load_rig("A"), (0.2, 0, 0))
    capture = with_rig(door, rig)
    both = {name: measure(capture, MeasureOptions(organise_on=name), 2) for name in "AB"}
    found = check_calibration(both, adjust=True)
    assert len(found.check.measurements) == 2
    assert np.array_equal(found.adjustment.rig.cameras["A"].T_camera_sensor, rig.cameras["A"].T_camera_sensor)
    alone = check_calibration({"m": both["A"]}).check
    assert found.check.mean_px == pytest.approx(alone.mean_px, abs=0.1)
    assert found.check.sigma_px < alone.sigma_px


def test_a_blank_plate_is_not_observable_from_its_measurement_and_holds_by_the_second_axis_of_its_capture(blank):
    capture = Capture.load(blank)
    from_file = replace(measure(capture, None, 2), findings=())
    check = check_calibration({"m": from_file}, adjust=True)
    assert check.check.status == "not observable"
    assert check.adjustment is None
    by_axes = check_calibration({"c": capture}).check
    assert by_axes.status == "holds"
    assert by_axes.measurements[0].source == "the projector's second axis"
    # What the measurement itself stored of the second axis counts, too.
    assert check_calibration({"m": measure(capture, None, 2)}).check.status == "holds"


def test_a_turned_projector_is_found_against_one_camera_and_adjusted(blank):
    capture = Capture.load(blank)
    rig = turned(capture.load_rig("A"), (0.2, 0, 0), "projector")
    rig = Rig({"A": rig.cameras["A"]}, rig.projector)
    images = capture.manifest.images.model_copy(update={"B": None})

    def one_camera(rig):
        item = with_rig(blank, rig)
        return replace(item, manifest=item.manifest.model_copy(update={"images": images}))

    found = check_calibration({"c": one_camera(rig)}, adjust=True)
    assert found.check.status == "does not hold"
    assert found.check.orientation.moved == "projector"
    again = check_calibration({"c": one_camera(found.adjustment.rig)}).check
    assert again.rms_px < LEFT_PX
    # Its measurement alone knows by what was found when it was measured.
    assert check_calibration({"m": measure(one_camera(rig), None, 2)}).check.status == "does not hold"


def test_stripes_that_agree_say_nothing_of_rows_but_contradict():
    rows = check_rows(Finding("projector against cameras", 0.01, 0.001, "projector px", "points"))
    assert judge(rows, None).status == "not observable"
    rows = check_rows(Finding("projector against cameras", 3.0, 0.01, "projector px", "points"))
    assert judge(rows, None).status == "does not hold"


def check_rows(finding):
    empty = np.empty(0)
    return [MeasurementRows("m", "none", "B", 0, None, None, None, np.empty((0, 2)), empty, empty, (finding,))]


def test_measurements_of_two_rigs_are_refused_by_name(intact):
    other = replace(intact, rig=turned(intact.rig, (0.01, 0, 0)))
    with pytest.raises(InputError, match=r"b\.h5.*not that of a\.h5"):
        check_calibration({"a.h5": intact, "b.h5": other})
    camera = replace(intact.rig.cameras["B"], K=intact.rig.cameras["B"].K + np.diag([1e-3, 0, 0]))
    lens = replace(intact, rig=replace(intact.rig, cameras={**intact.rig.cameras, "B": camera}))
    with pytest.raises(InputError, match=r"B\.K differs"):
        common_rig({"a.h5": intact, "b.h5": lens})


def test_one_rig_in_two_frames_is_one_rig(intact):
    other = replace(intact, rig=intact.rig.in_frame_of("B"))
    assert common_rig({"a": intact, "b": other}) is intact.rig


def test_the_command_prints_the_verdict_and_writes_the_adjusted_rig(door, tmp_path, intact):
    path, out = tmp_path / "m.h5", tmp_path / "adjusted.json"
    intact.save(path)
    run = planish("check-rig", path, "--require-holds")
    assert run.code == 0, run.err
    assert "The calibration holds." in run.out
    rig = turned(Capture.load(door).load_rig("A"), (0.2, 0, 0))
    measure(with_rig(door, rig), None, 2).save(path)
    run = planish("check-rig", path, "--adjust", out, "--require-holds")
    assert run.code == 3
    assert "The calibration does not hold." in run.out
    assert "measure again with the new rig" in run.out
    assert "not observable    the length of the baseline" in run.out
    assert Rig.load(out).covariance is not None
    run = planish("check-rig", door, "--rig", out)
    assert run.code == 0
    assert "The calibration holds." in run.out


def test_bad_input_ends_with_2_and_one_line(intact, tmp_path):
    path = tmp_path / "m.h5"
    intact.save(path)
    for arguments, words in (
        ((tmp_path / "none.h5",), "no such file"),
        ((path, path), "given twice"),
        ((tmp_path,), "no capture in this folder"),
        ((path, "--rig", path), "a measurement was made with its own rig"),
    ):
        run = planish("check-rig", *arguments)
        assert run.code == 2, arguments
        assert words in " ".join(run.err.split())
        assert "Traceback" not in run.err


def test_an_imported_measurement_of_one_camera_is_not_observable(intact, tmp_path):
    alone = replace(intact, correspondence_px=None, findings=(), rig=Rig({"A": intact.rig.cameras["A"]}, None))
    alone = replace(alone, views={"A": intact.views["A"]}, texture_views=("A",))
    path, out = tmp_path / "m.h5", tmp_path / "o.json"
    alone.save(path)
    assert isinstance(Measurement.load(path), Measurement)
    run = planish("check-rig", path, "--adjust", out)
    assert run.code == 0
    assert "is not observable" in run.out
    assert f"{out} not written" in run.out.replace("\n", " ")
    assert not out.exists()
