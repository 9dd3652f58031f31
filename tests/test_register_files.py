"""Registration of files: same bytes by any executor, after any interrupt, and for measurements added later."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from dataclasses import replace

import numpy as np
import pytest

import sheets
import synthetic
from command_line import planish
from planish.errors import InputError
from planish.execution.executor import Threads
from planish.execution.pool import WorkerPool
from planish.geometry import difference, exp_se3, invert
from planish.measurement import Measurement
from planish.pipeline import add_files, register, register_files, registering_files
from planish.pipeline.options import RegisterOptions
from planish.registration.candidates.choose import CandidateOptions
from planish.registration.result import Registration
from planish.registration.texture import fixed_pattern

PLACES = {"left": np.eye(4), "middle": sheets.T_TRUE, "right": sheets.T_TRUE @ exp_se3([0, 0.02, 0.4, 70, 30, 0])}
#: Two ways to the same transforms whose textures lack patterns that are estimated from fewer or from more captures: a
#: fiftieth of a pixel of 1.3 mm.
FROZEN_PATTERN_MM = 0.03
#: Sums of three float32 in another order, relative.
FLOAT32_SUMS = 1e-5


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """Three measurements of one sheet."""
    folder = tmp_path_factory.mktemp("measurements")
    found = [sheets.noisy(sheets.quiet("a"), 1), sheets.noisy(sheets.quiet("b"), 2)]
    found.append(synthetic.measurement(PLACES["right"], sheets.grain(), scale=sheets.SCALE, bend=sheets.BENT, seed=3))
    for m, name in zip(found, PLACES, strict=True):
        replace(m, name=name).save(folder / f"{name}.h5")
    return sorted(folder.glob("*.h5"))


@pytest.fixture(scope="module")
def whole(files, tmp_path_factory):
    """The folder of a run without interrupt."""
    out = tmp_path_factory.mktemp("whole")
    with Threads(2) as executor:
        register_files(files, out, executor=executor)
    return out


def content(out):
    return (out / "registration.json").read_bytes()


def stage_files(out):
    return {path: path.stat().st_mtime_ns for path in (out / "stages").glob("*/[!.]*.h5")}


def test_all_measurements_are_tied_together(whole):
    assert [g.id for g in Registration.load(whole / "registration.json").groups] == [0]


def test_files_and_measurements_in_memory_give_the_same_bytes(files, whole, tmp_path):
    there = Registration.load(whole / "registration.json")
    found = register([Measurement.load(path) for path in files], threads=1)
    named = [
        replace(m, file=f.file, sha256=f.sha256) for m, f in zip(found.measurements, there.measurements, strict=True)
    ]
    replace(found, measurements=tuple(named)).save(tmp_path / "registration.json")
    assert content(tmp_path) == content(whole)


def test_a_second_run_computes_nothing_and_gives_the_same_bytes(files, whole):
    before, bytes_before = stage_files(whole), content(whole)
    run = register_files(files[::-1], whole)
    assert run.reused == {"pattern": (1, 1), "texture": (3, 3), "pairs": (3, 3)}
    assert stage_files(whole) == before
    assert content(whole) == bytes_before


def test_another_choice_of_pairs_registers_no_pair_again(files, whole, tmp_path):
    out = tmp_path / "out"
    subprocess.run(["cp", "-rp", whole, out], check=True)
    voted = RegisterOptions(candidates=CandidateOptions(exhaustive_up_to=1))
    run = register_files(files, out, voted)
    # Overlapping measurements are voted for.
    assert run.reused["pairs"] == (3, 3)
    assert content(out) != content(whole)  # the options stand in it


def test_worker_processes_give_the_same_bytes_even_if_one_is_killed(files, whole, tmp_path):
    killed = []
    with WorkerPool(2, 2) as pool:

        def kill_one(stage, done, total, reused):
            if stage == "pairs" and done == 1 and not killed:
                killed.append(pool.pids[0])
                os.kill(killed[0], signal.SIGKILL)

        register_files(files, tmp_path, executor=pool, progress=kill_one)
    assert len(killed) == 1
    assert content(tmp_path) == content(whole)


def test_a_dask_cluster_gives_the_same_bytes(files, whole, tmp_path):
    distributed = pytest.importorskip("distributed", reason="dask.distributed is not installed: no cluster is tried")
    from planish.execution.cluster import DaskCluster

    with (
        distributed.LocalCluster(n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None) as cluster,
        DaskCluster(cluster.scheduler_address) as executor,
    ):
        assert executor.slots == 2
        register_files(files, tmp_path, executor=executor)
    assert content(tmp_path) == content(whole)


def test_a_damaged_stage_file_is_computed_again_and_nothing_else(files, whole, tmp_path):
    out = tmp_path / "out"
    subprocess.run(["cp", "-rp", whole, out], check=True)
    before = stage_files(out)
    damaged = [next(path for path in sorted(before) if path.parent.name == stage) for stage in ("pairs", "keypoints")]
    for path in damaged:
        path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    run = register_files(files, out)
    assert run.reused == {"pattern": (1, 1), "texture": (2, 3), "pairs": (2, 3)}
    after = stage_files(out)
    assert {path for path in before if before[path] != after[path]} == set(damaged)
    assert content(out) == content(whole)


def start(files, out, *more):
    command = [sys.executable, "-c", "from planish.cli import main; main()", "register", *map(str, files)]
    command += ["--out", str(out), "--no-report", "--no-cloud", *more]
    return subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True)


def wait_for(condition, process, seconds=120.0):
    end = time.monotonic() + seconds
    while not condition() and process.poll() is None and time.monotonic() < end:
        time.sleep(0.005)


def test_a_killed_run_goes_on_where_it_was(files, whole, tmp_path):
    first = start(files, tmp_path, "--threads", "1")
    wait_for(lambda: list(tmp_path.glob("stages/overlaps/[!.]*.h5")), first)
    first.kill()
    assert first.wait() == -signal.SIGKILL
    finished = stage_files(tmp_path)
    assert not (tmp_path / "registration.json").exists()
    run = register_files(files, tmp_path)
    assert run.reused["texture"] == (3, 3)
    assert 1 <= run.reused["pairs"][0] < 3
    after = stage_files(tmp_path)
    assert {path: after[path] for path in finished} == finished
    assert content(tmp_path) == content(whole)


def test_ctrl_c_ends_with_130_and_leaves_no_worker(files, whole, tmp_path):
    process = start(files, tmp_path, "--workers", "1")
    wait_for(lambda: list(tmp_path.glob("stages/keypoints/[!.]*.h5")), process)
    # As a terminal does it: to all processes of the group.
    os.killpg(process.pid, signal.SIGINT)
    assert process.wait(60) == 130
    with pytest.raises(ProcessLookupError):
        os.killpg(process.pid, 0)
    register_files(files, tmp_path)
    assert content(tmp_path) == content(whole)


@pytest.mark.slow
def test_a_run_killed_at_ten_random_moments_gives_the_same_bytes_and_computes_nothing_twice(files, whole, tmp_path):
    rng, finished = np.random.default_rng(1), {}
    started = time.monotonic()
    start(files, tmp_path / "time", "--threads", "1").wait()
    seconds = time.monotonic() - started
    for _ in range(10):
        process = start(files, tmp_path / "out", "--threads", "1")
        time.sleep(rng.uniform(0.1, 0.9) * seconds)
        process.kill()
        process.wait()
        now = stage_files(tmp_path / "out")
        assert {path: now[path] for path in finished} == finished
        finished = now
    register_files(files, tmp_path / "out")
    after = stage_files(tmp_path / "out")
    assert {path: after[path] for path in finished} == finished
    assert content(tmp_path / "out") == content(whole)


@pytest.fixture(scope="module")
def grown(files, tmp_path_factory):
    """A registration of two to which the third has been added: its folder, its stage files before, the run."""
    out = tmp_path_factory.mktemp("grown")
    with Threads(2) as executor:
        register_files(files[:2], out, executor=executor)
        before = stage_files(out)
        run = add_files(files[2:], out, executor=executor)
    return out, before, run


def test_an_added_measurement_costs_its_own_stages_and_lands_where_a_fresh_run_puts_it(whole, grown):
    out, before, run = grown
    assert run.reused["texture"] == (2, 3)
    assert run.reused["pairs"] == (1, 3)
    after = stage_files(out)
    assert {path: after[path] for path in before} == before
    fresh = {m.name: m for m in Registration.load(whole / "registration.json").measurements}
    reference = run.registration.groups[0].reference
    for placed in run.registration.measurements:
        expected = invert(fresh[reference].T_world_measurement) @ fresh[placed.name].T_world_measurement
        error = difference(expected, placed.T_world_measurement, placed.covariance_point_mm)
        assert np.linalg.norm(error[3:]) < FROZEN_PATTERN_MM


def test_an_addition_gives_the_same_bytes_after_an_interrupt(files, grown, tmp_path):
    with Threads(2) as executor:
        register_files(files[:2], tmp_path, executor=executor)
        with pytest.raises(KeyboardInterrupt):
            add_files(files[2:], tmp_path, executor=executor, progress=_interrupt_after_a_pair)
        assert not content(tmp_path).count(b'"right"')
        add_files(files[2:], tmp_path, executor=executor)
    assert content(tmp_path) == content(grown[0])


def _interrupt_after_a_pair(stage, done, total, reused):
    if stage == "pairs" and done > reused:
        raise KeyboardInterrupt


def test_patterns_of_many_captures_are_summed_in_parts_alike_in_memory_and_in_files(files, tmp_path, monkeypatch):
    for module in (fixed_pattern, registering_files):
        monkeypatch.setattr(module, "CAPTURES_PER_SUM", 2)
    measurements = [Measurement.load(path) for path in files]
    run = register_files(files, tmp_path)
    options = run.views["left"].options.photometric
    in_memory = fixed_pattern.estimate_fixed_patterns(measurements, options, threads=1)["left"]
    # Two parts, and both together.
    assert run.reused["pattern"] == (0, 3)
    stages = {view.pattern.key: view.pattern for view in run.views.values()}
    assert len(stages) == 1
    (stage,) = stages.values()
    of_files = stage.pattern(1)
    assert of_files.members == in_memory.members == set(PLACES)
    together = fixed_pattern.sum_captures(measurements, options, threads=1).pattern(PLACES)
    for expected, same, near in zip(*(bands(p) for p in (in_memory, of_files, together)), strict=True):
        assert np.array_equal(same, expected)
        assert np.allclose(near, expected, rtol=0, atol=FLOAT32_SUMS * np.abs(expected).max())


def bands(pattern):
    names = ("weighted_sum", "weight", "prior", "still", "gain")
    return [getattr(band, name) for _, c in sorted(pattern.cameras.items()) for band in c.bands for name in names]


def test_what_is_added_to_a_well_known_pattern_is_corrected_by_it_and_takes_no_part(files, tmp_path, monkeypatch):
    monkeypatch.setattr(registering_files, "CAPTURES_PER_SUM", 2)
    register_files(files[:2], tmp_path)
    run = add_files(files[2:], tmp_path)
    assert run.reused["pattern"] == (1, 1)
    assert list(run.views["right"].pattern.members) == ["left", "middle"]


def test_what_cannot_be_added_is_named(files, tmp_path):
    out, moved = tmp_path / "out", tmp_path / "moved.h5"
    with pytest.raises(InputError, match="holds no finished registration"):
        add_files(files[:1], out)
    moved.write_bytes(files[0].read_bytes())
    register_files([moved], out)
    with pytest.raises(InputError, match="holds 'left', which is registered in"):
        add_files([files[0]], out)
    replace(Measurement.load(moved), sigma_mm=np.zeros((260, 347), np.float32)).save(moved)
    with pytest.raises(InputError, match=r"moved\.h5: has changed since 'left' was registered"):
        add_files([files[1]], out)
    moved.unlink()
    with pytest.raises(InputError, match=r"moved\.h5: no such file; expected the measurement 'left'"):
        add_files([files[1]], out)


def test_the_command_adds_and_says_what_is_missing(files, tmp_path):
    out = tmp_path / "out"
    assert planish("register", *files[:2], "--out", out, "--no-report", "--no-cloud").code == 0
    added = planish("register", "--add", files[2], "--to", out, "--threads", 2, "--no-report")
    assert added.code == 0
    assert "3 measurements" in added.out
    assert "not computed again" in added.err
    assert (out / "registered.ply").is_file()
    for arguments, words in (
        (["--add", files[2]], "--to"),
        (["--add", files[2], "--to", out, "--out", out], "--add NEW.h5 --to DIR"),
        ([files[0]], "--out is missing"),
        ([files[0], "--out", out, "--workers", 0], "workers"),
        ([files[0], "--out", out, "--workers", 1, "--cluster", "tcp://127.0.0.1:1"], "--cluster"),
    ):
        outcome = planish("register", *arguments)
        assert outcome.code == 2
        assert words in outcome.err
