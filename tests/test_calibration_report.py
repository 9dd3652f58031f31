"""The report and the file of a calibration: self-contained, complete, escaped, the same for the same calibration."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

import drawn_calibration
from planish.errors import InputError
from planish.report.calibration.numbers import prose, significant, with_sigma
from planish.report.calibration.page import write_calibration_report
from planish.report.calibration.parameters import derived_sigma, place_of
from planish.report.calibration.text import scale_sentence, verdict
from planish.sensing.calibrate.files import CalibrationFile
from planish.sensing.calibrate.judge.expected_error import expected_errors, map_rms
from planish.sensing.capture.board import KnownLength

#: Far below what goes by mail.
MAX_BYTES = 5e6
VERSIONS = {"planish": "0.0.0"}


@pytest.fixture(scope="module")
def item():
    return drawn_calibration.calibration(height=True)


@pytest.fixture(scope="module")
def page(item, tmp_path_factory):
    return write_calibration_report(item, tmp_path_factory.mktemp("calibration") / "left_report.html", VERSIONS)


def test_the_page_needs_nothing_from_outside_and_holds_no_script(page):
    text = page.read_text(encoding="utf-8")
    assert not re.findall(r'(?:src|href)="(?!data:)', text)
    assert "<script" not in text
    assert "@import" not in text
    assert page.stat().st_size < MAX_BYTES


def test_figures_lie_beside_the_page_under_its_name(page):
    names = {p.name for p in (page.parent / "figures").iterdir()}
    expected = {f"residuals_{device}" for device in ("A", "B", "projector")}
    expected |= {"expected_error_A_B", "expected_error_A_projector"}
    expected |= {"coverage", "placement", "views", "distortion", "height"}
    assert names == {f"left_{name}.png" for name in expected}
    assert page.read_text(encoding="utf-8").count("data:image/png;base64,") == len(expected)


def test_the_same_calibration_gives_the_same_page(tmp_path):
    alone = drawn_calibration.calibration(devices=("A",), views=6)
    first, again = (write_calibration_report(alone, tmp_path / name / "rig_report.html", VERSIONS) for name in "ab")
    assert again.read_bytes() == first.read_bytes()


def test_names_reasons_and_warnings_are_escaped(page):
    text = page.read_text(encoding="utf-8")
    assert "view_03 &lt;fits badly&gt;" in text
    assert "<fits badly>" not in text


def test_the_page_names_views_outliers_missed_images_models_and_parameters(item, page):
    text = page.read_text(encoding="utf-8")
    for view in item.T_A_board:
        assert f"<td>{view}</td>" in text
    for image, reason in item.observations.missed.items():
        assert image in text
        assert reason in text
    outliers = sum(int(r.outlier.sum()) for r in item.residuals)
    assert f"{outliers} of " in text
    assert "radial + tangential leaves boards out" in text
    assert "distance from that of camera A [mm]" in text
    assert "pitch ratio y / x" in text


def test_a_calibration_of_one_camera_has_a_report_without_expected_error(tmp_path):
    alone = drawn_calibration.calibration(devices=("A",), views=6)
    assert expected_errors(alone) == ()
    text = write_calibration_report(alone, tmp_path / "rig_report.html").read_text(encoding="utf-8")
    assert "Camera A calibrated from 6 views" in text
    assert "<h2>Expected 3D error</h2>" not in text


def test_a_projector_that_shows_nothing_in_some_views_does_not_hinder_the_report(tmp_path):
    item = drawn_calibration.calibration(devices=("A", "projector"))
    few = tuple(r for r in item.residuals if r.device != "projector" or r.view in ("view_00", "view_01"))
    text = write_calibration_report(replace(item, residuals=few), tmp_path / "rig_report.html").read_text()
    assert "Only 2 views are shared by projector" in text


def test_the_verdict_states_errors_and_what_the_scale_rests_on(item):
    errors = expected_errors(item)
    kind, sentences = verdict(item, errors)
    assert kind == "partial"
    assert sentences[0].startswith("Camera A, camera B and projector calibrated from 20 views of a chessboard")
    assert any(f"{significant(map_rms(errors[0].form_mm))} mm rms of form" in s for s in sentences)
    assert "not observable from boards" in scale_sentence(item)
    assert "0.010 %, that is 0.030 mm over 300 mm" in scale_sentence(item)
    assert verdict(replace(item, findings=()), errors)[0] == ""


def test_a_known_length_is_named_as_what_the_scale_rests_on(item):
    known = KnownLength(first=(0, 0), second=(13, 0), length_mm=195.02, sigma_mm=0.004)
    board = item.observations.board.model_copy(update={"known_length": known})
    measured = replace(item, observations=replace(item.observations, board=board), scale=(1e-4, 2e-5))
    sentence = scale_sentence(measured)
    assert "195.02 mm ± 0.004 mm" in sentence
    assert "+0.0100 % off the pitch" in sentence
    assert "0.0060 mm over 300 mm" in sentence


def test_the_sigma_of_a_derived_quantity_is_that_of_drawn_rigs(item):
    rng, modes = np.random.default_rng(3), item.rig.modes()
    drawn = [place_of(item.rig.changed(rng.standard_normal(len(modes)) @ modes).devices["B"]) for _ in range(2000)]
    predicted = derived_sigma(item.rig, lambda rig: place_of(rig.devices["B"]))
    # 2000 draws know a standard deviation to 1.6 %.
    np.testing.assert_allclose(np.std(drawn, axis=0), predicted, rtol=0.07)


def test_numbers_have_the_digits_of_their_sigma():
    assert with_sigma(2725.8012, 0.293) == ("2725.80", "0.29")
    assert with_sigma(71.8466, None) == ("71.85", "")
    assert significant(0.01634) == "0.016"
    assert significant(float("nan")) == "-"
    assert significant(123.4) == "123"
    assert prose("0.3 mm < 4 px") == "0.3&nbsp;mm &lt; 4&nbsp;px"


def test_the_file_holds_what_the_calibration_says_and_is_read_back(item, tmp_path):
    content = CalibrationFile.of(item, VERSIONS)
    content.save(tmp_path / "rig_calibration.json")
    assert CalibrationFile.load(tmp_path / "rig_calibration.json") == content
    assert [view.name for view in content.views] == list(item.T_A_board)
    assert content.devices["B"].rms_px == item.rms_px("B")
    assert content.devices["B"].points + content.devices["B"].outliers == sum(
        len(r.index) for r in item.residuals if r.device == "B"
    )
    assert content.board == item.observations.board
    assert len(content.height_mm) == len(item.height_mm)
    assert {m.image for m in content.missed} == set(item.observations.missed)


def test_the_file_names_no_path_and_refuses_unknown_keys(item, tmp_path):
    path = tmp_path / "rig_calibration.json"
    CalibrationFile.of(item).save(path)
    text = path.read_text()
    assert str(tmp_path) not in text
    path.write_text(text.replace('"units"', '"unit"', 1))
    with pytest.raises(InputError, match="unit"):
        CalibrationFile.load(path)
