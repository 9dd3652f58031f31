"""The main job from the shell: captures in, one registered part out. Half the sensor's resolution, three captures."""

import json
import re
import runpy
import shutil
from pathlib import Path

import numpy as np
import pytest

from command_line import planish
from planish.files import cloud
from planish.measurement import Measurement
from planish.pipeline import register
from planish.registration.result import Registration

ROOT = Path(__file__).resolve().parents[1]

#: At half resolution the pixel is 0.65 mm: errors along the surface stay below a tenth of it.
ALONG_MM = 0.06
#: Normal errors average over some 100,000 points of 0.05 mm noise; systematic ones at bent edges are a few micrometres.
NORMAL_MM = 0.01


@pytest.fixture(scope="module")
def job(tmp_path_factory):
    folder = tmp_path_factory.mktemp("job")
    assert planish("simulate", "door", "--out", folder / "captures", "--seed", 4, "--captures", 3,
                   "--width-scale", 0.5, "--no-true-points").code == 0  # fmt: skip
    measured = planish("measure", folder / "captures", "--out", folder / "measurements")
    assert measured.code == 0
    assert measured.out.count(" points, ") == 3
    registered = planish("register", folder / "measurements", "--out", folder / "out")
    assert registered.code == 0
    return folder, registered


def test_neighbours_are_accepted_and_all_are_tied_into_one_group(job):
    folder, registered = job
    registration = Registration.load(folder / "out" / "registration.json")
    assert registration.pair("m1", "m2").status == "accepted"
    assert registration.pair("m2", "m3").status == "accepted"
    assert [g.id for g in registration.groups] == [0]
    assert "3 measurements" in registered.out
    assert "min / max:" in registered.out


def test_errors_against_truth_stay_far_below_a_pixel(job):
    folder, _ = job
    outcome = planish("evaluate", folder / "out", "--truth", folder / "captures" / "truth.json")
    assert outcome.code == 0
    assert "nothing wrong, nothing missing" in outcome.out
    evaluation = json.loads((folder / "out" / "evaluation.json").read_text())
    assert {"m1", "m2", "m3"} == {m["name"] for m in evaluation["measurements"]}
    for item in evaluation["pairs"] + evaluation["measurements"]:
        assert item["tangential_rms_mm"] < ALONG_MM
        assert item["normal_rms_mm"] < NORMAL_MM


def test_registration_json_holds_exactly_the_keys_of_its_contract(job):
    folder, _ = job
    content = json.loads((folder / "out" / "registration.json").read_text())
    assert set(content) == {"schema", "units", "versions", "options", "groups", "measurements", "pairs", "network"}
    assert content["schema"] == "planish.registration/1"
    assert set(content["groups"][0]) == {"id", "reference"}
    assert set(content["measurements"][0]) == {
        "name", "file", "sha256", "group", "T_world_measurement", "covariance_noise", "covariance_calibration",
        "covariance_point_mm",
    }  # fmt: skip
    assert set(content["pairs"][0]) == {
        "a", "b", "status", "reason", "used", "removed_reason", "T_a_b", "covariance_noise", "covariance_calibration",
        "covariance_point_mm", "covariance_factor", "matches", "consensus", "log10_false_alarms", "windows",
        "windows_agreeing", "runner_up", "motions", "observability", "overlap",
        "overlap_error",
    }  # fmt: skip
    assert set(content["pairs"][0]["overlap_error"]) == {
        "points", "min_mm", "max_mm", "rms_normal_mm", "rms_tangential_mm", "sigma_tangential_mm",
    }  # fmt: skip
    text = json.dumps(content)
    assert str(folder) not in text


def test_the_bytes_are_the_same_for_1_2_and_8_threads_and_any_order_of_the_files(job):
    folder, _ = job
    files = sorted((folder / "measurements").glob("*.h5"))
    expected = (folder / "out" / "registration.json").read_bytes()
    for threads, order in ((1, files), (2, files[::-1]), (8, [files[1], files[2], files[0]])):
        out = folder / f"threads_{threads}"
        outcome = planish("register", *order, "--out", out, "--threads", threads, "--no-report", "--no-cloud")
        assert outcome.code == 0
        assert (out / "registration.json").read_bytes() == expected


def test_measurements_have_the_same_bytes_for_any_number_of_threads(job):
    folder, _ = job
    expected = Measurement.load(folder / "measurements" / "m1.h5")
    for threads in (1, 8):
        out = folder / f"measured_{threads}"
        assert planish("measure", folder / "captures" / "m1", "--out", out, "--threads", threads).code == 0
        found = Measurement.load(out / "m1.h5")
        assert np.array_equal(found.points_sensor, expected.points_sensor, equal_nan=True)
        assert np.array_equal(found.sigma_mm, expected.sigma_mm, equal_nan=True)


def test_worker_processes_measure_the_same_bytes_and_speak_in_order(job):
    folder, _ = job
    out = folder / "measured_by_workers"
    outcome = planish("measure", folder / "captures", "--out", out, "--workers", 2)
    assert outcome.code == 0
    assert re.findall(r"^(m\d): \d+ points", outcome.out, re.MULTILINE) == ["m1", "m2", "m3"]
    for name in ("m1.h5", "m2.h5", "m3.h5"):
        assert (out / name).read_bytes() == (folder / "measurements" / name).read_bytes()


def test_the_cloud_holds_every_valid_point(job):
    folder, _ = job
    header = (folder / "out" / "registered.ply").read_bytes()[:2000].decode("ascii", "ignore")
    points = sum(int(Measurement.load(p).valid.sum()) for p in (folder / "measurements").glob("*.h5"))
    found = int(header.split("element vertex ")[1].split("\n")[0])
    # Points without a normal (at the rim) are left out.
    assert 0.98 * points <= found <= points
    assert all(f"property float {name}" in header for name in ("x", "y", "z", "nx", "ny", "nz"))
    assert cloud.__doc__


def test_any_measurement_can_be_the_world(job):
    folder, _ = job
    measurements = [Measurement.load(p) for p in sorted((folder / "measurements").glob("*.h5"))]
    registration = register(measurements, reference="m3")
    assert registration.groups[0].reference == "m3"
    placed = {m.name: m for m in registration.measurements}
    assert np.array_equal(placed["m3"].T_world_measurement, np.eye(4))
    assert not placed["m3"].covariance_noise.any()
    # Positive definite: every direction of the others is uncertain.
    assert np.linalg.eigvalsh(placed["m1"].covariance_noise).min() > 0


def test_require_all_ends_with_3_where_something_is_not_tied_in(job, tmp_path):
    folder, _ = job
    for name in ("m1", "m3"):
        shutil.copy(folder / "measurements" / f"{name}.h5", tmp_path / f"{name}.h5")
    registration = Registration.load(folder / "out" / "registration.json")
    outcome = planish("register", tmp_path, "--out", tmp_path / "out", "--require-all", "--no-report", "--no-cloud")
    tied = registration.pair("m1", "m3").status == "accepted"
    assert outcome.code == (0 if tied else 3)


def test_the_python_of_the_readme_and_the_example_run_as_they_stand(job, tmp_path, monkeypatch, capsys):
    folder, _ = job
    (tmp_path / "demo-out").symlink_to(folder)
    monkeypatch.chdir(tmp_path)
    readme = (ROOT / "README.md").read_text()
    code = readme.split("```python\n")[1].split("```")[0]
    exec(compile(code, "README.md", "exec"), {})
    assert "m1 m2 accepted" in capsys.readouterr().out
    monkeypatch.setattr("sys.argv", ["register_captures.py", "demo-out/captures"])
    runpy.run_path(str(ROOT / "examples" / "register_captures.py"), run_name="__main__")
    assert "m1, m2: accepted" in capsys.readouterr().out
