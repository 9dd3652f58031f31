"""Bad input of `planish register`: clear words, exit code 2, no traceback."""

import h5py
import numpy as np
import pytest

import synthetic
from command_line import planish


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    folder = tmp_path_factory.mktemp("good")
    item = synthetic.measurement(np.eye(4), synthetic.raster(1, 0.02), scale=0.2, name="good")
    item.save(folder / "good.h5")
    return folder / "good.h5"


def assert_refused(outcome, *words):
    assert outcome.code == 2
    assert "Traceback" not in outcome.err
    for word in words:
        assert word in outcome.err


def test_a_file_cut_in_half_is_named(good, tmp_path):
    content = good.read_bytes()
    (tmp_path / "half.h5").write_bytes(content[: len(content) // 2])
    assert_refused(planish("register", tmp_path / "half.h5", "--out", tmp_path / "out"), "half.h5", "damaged")


def test_a_file_that_is_no_measurement_is_named(tmp_path):
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file["x"] = 1
    assert_refused(planish("register", tmp_path / "other.h5", "--out", tmp_path / "out"), "other.h5", "schema")
    (tmp_path / "text.h5").write_text("no HDF5")
    assert_refused(planish("register", tmp_path / "text.h5", "--out", tmp_path / "out"), "text.h5")


def test_an_empty_folder_and_a_missing_file_are_named(tmp_path):
    (tmp_path / "empty").mkdir()
    assert_refused(planish("register", tmp_path / "empty", "--out", tmp_path / "out"), "empty", "no .h5 file")
    assert_refused(planish("register", tmp_path / "gone.h5", "--out", tmp_path / "out"), "gone.h5", "no such file")


def test_the_same_name_twice_is_refused_before_anything_is_computed(good, tmp_path):
    (tmp_path / "copy.h5").write_bytes(good.read_bytes())
    outcome = planish("register", good, tmp_path / "copy.h5", "--out", tmp_path / "out")
    assert_refused(outcome, "copy.h5", "'good'")
    assert not (tmp_path / "out").exists()


def test_an_unknown_reference_names_what_there_is(good, tmp_path):
    assert_refused(planish("register", good, "--out", tmp_path / "out", "--reference", "x"), "reference", "'good'")


def test_unknown_options_are_refused_with_their_key(good, tmp_path):
    (tmp_path / "options.json").write_text('{"consensus": {"tolerance": 2}}')
    outcome = planish("register", good, "--out", tmp_path / "out", "--options", tmp_path / "options.json")
    assert_refused(outcome, "options.json", "consensus.tolerance")


def test_a_single_measurement_is_a_group_of_its_own(good, tmp_path):
    outcome = planish("register", good, "--out", tmp_path / "out", "--no-report", "--no-cloud")
    assert outcome.code == 0
    assert "group 0: alone: good" in outcome.out
