"""`planish calibrate`: what it writes and prints of a calibration, and how it refuses what it cannot use."""

from __future__ import annotations

import contextlib
import io
import json

import pytest

import drawn_calibration
from command_line import planish
from planish.cli.calibrate import print_calibration, read_options, write_calibration
from planish.errors import InputError
from planish.rig import Rig
from planish.sensing.calibrate.judge.expected_error import expected_errors


@pytest.fixture(scope="module")
def item():
    return drawn_calibration.calibration(devices=("A", "B"), views=8, tilt_deg=10.0)


def test_rig_record_and_report_lie_beside_each_other_under_one_name(item, tmp_path):
    written = write_calibration(item, item.rig, expected_errors(item), tmp_path / "left.json")
    assert [path.name for path in written] == ["left.json", "left_calibration.json", "left_report.html"]
    assert Rig.load(written[0]).covariance_parameters == item.rig.covariance_parameters
    assert json.loads(written[1].read_text())["schema"] == "planish.calibration/1"
    assert (tmp_path / "figures" / "left_residuals_A.png").is_file()


def test_without_report_only_rig_and_record_are_written(item, tmp_path):
    write_calibration(item, item.rig, (), tmp_path / "rig.json", report=False)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["rig.json", "rig_calibration.json"]


def test_the_summary_names_devices_errors_scale_advice_missed_images_and_warnings(item):
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        print_calibration(item, expected_errors(item))
    for words in ("camera A", "camera B", "radial + tangential", "mm rms of form", "over 300 mm",
                  "advice: Tilt more", "A/21.png: no board found"):  # fmt: skip
        assert words in out.getvalue()
    assert "view_03 <fits badly>: was the board moved?" in err.getvalue()


def test_a_result_that_is_no_json_file_is_refused_before_anything_is_read(tmp_path):
    outcome = planish("calibrate", tmp_path, "--out", tmp_path / "rig")
    assert outcome.code == 2
    assert ".json" in outcome.err


def test_a_folder_without_boards_is_named(tmp_path):
    (tmp_path / "empty").mkdir()
    outcome = planish("calibrate", tmp_path / "empty", "--out", tmp_path / "rig.json")
    assert outcome.code == 2
    assert "empty" in outcome.err
    assert "Traceback" not in outcome.err


def test_the_command_line_overrules_the_file_of_options(tmp_path):
    (tmp_path / "options.json").write_text('{"model": "rational"}')
    assert read_options(tmp_path / "options.json", "auto", False).model == "rational"
    assert read_options(tmp_path / "options.json", "radial", True).model == "radial"
    assert read_options(None, "auto", True).flatness
    with pytest.raises(InputError, match="model"):
        read_options(None, "fisheye", False)
