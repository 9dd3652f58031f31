"""`planish evaluate`: tables, evaluation.json, and clear errors for files that are missing or have changed."""

from __future__ import annotations

import json
import sys

import pytest

import registered
from planish.cli import main


@pytest.fixture
def folder(tmp_path):
    registered.write_run(tmp_path)
    return tmp_path


def run(monkeypatch, capsys, *arguments):
    """Run the command line; return exit code, stdout and stderr."""
    monkeypatch.setattr(sys, "argv", ["planish", "evaluate", *map(str, arguments)])
    with pytest.raises(SystemExit) as exit_:
        main()
    out, err = capsys.readouterr()
    return exit_.value.code or 0, out, err


def test_the_table_stands_on_stdout_with_its_definition(folder, monkeypatch, capsys):
    code, out, _ = run(monkeypatch, capsys, folder)
    assert code == 0
    for text in ("left, middle", "matches", "consensus", "min [mm]", "rms normal [mm]", "rms along (noise) [mm]"):
        assert text in out
    assert "positive where b is nearer to the sensor than a" in out
    assert "5 of 143 matches agree: <as many as chance gives> [no consensus]" in " ".join(out.split())
    content = json.loads((folder / "evaluation.json").read_text())
    assert [p["a"] for p in content["pairs"]] == ["left", "middle"]
    assert all(p["overlap"] > 0.3 and p["nees"] is None for p in content["pairs"])


def test_with_truth_errors_are_printed_and_written(folder, monkeypatch, capsys):
    code, out, _ = run(monkeypatch, capsys, folder, "--truth", folder / "truth.json")
    assert code == 0
    assert "Pairs against truth" in out
    assert "nothing wrong, nothing missing" in out
    content = json.loads((folder / "evaluation.json").read_text())
    assert all(p["nees"] > 0 for p in content["pairs"])


def test_measurements_that_have_moved_are_found_in_the_given_folder(folder, monkeypatch, capsys):
    (folder / "moved").mkdir()
    for path in folder.glob("*.h5"):
        path.rename(folder / "moved" / path.name)
    code, _, err = run(monkeypatch, capsys, folder)
    assert code == 2
    assert "no such file" in err
    assert "--measurements" in err
    assert run(monkeypatch, capsys, folder, "--measurements", folder / "moved")[0] == 0


def test_a_measurement_that_has_changed_is_refused(folder, monkeypatch, capsys):
    (folder / "measurement_1.h5").write_bytes((folder / "measurement_0.h5").read_bytes())
    code, _, err = run(monkeypatch, capsys, folder)
    assert code == 2
    assert "has changed since it was registered" in " ".join(err.split())


def test_a_folder_without_a_registration_is_refused(tmp_path, monkeypatch, capsys):
    code, _, err = run(monkeypatch, capsys, tmp_path)
    assert code == 2
    assert "registration.json" in "".join(err.split())
    assert "Traceback" not in err


def test_a_run_file_that_does_not_name_the_measurements_is_refused(folder, monkeypatch, capsys):
    (folder / "run.json").write_text('{"measurements": {"left": 3}}')
    code, _, err = run(monkeypatch, capsys, folder)
    assert code == 2
    assert "names no file for the measurement 'left'" in " ".join(err.split())


def test_truth_of_other_measurements_is_refused(folder, monkeypatch, capsys):
    content = json.loads((folder / "truth.json").read_text())
    content["measurements"][0]["name"] = "someone else"
    (folder / "truth.json").write_text(json.dumps(content))
    code, _, err = run(monkeypatch, capsys, folder, "--truth", folder / "truth.json")
    assert code == 2
    assert "left" in err
