"""Further rounds of pairs: what the network shows to overlap, and what votes suggest for those left apart."""

from __future__ import annotations

import os
import signal
from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest

import sheets
import synthetic
from planish.execution.executor import Threads
from planish.execution.pool import WorkerPool
from planish.geometry import exp_se3
from planish.measurement import Measurement
from planish.pipeline import add_files, register, register_files
from planish.pipeline.frozen import Frozen
from planish.pipeline.options import RegisterOptions
from planish.registration.candidates.choose import (
    CandidateOptions,
    Choice,
    next_voted_pairs,
    overlapping_pairs,
)
from planish.registration.candidates.footprint import footprint
from planish.registration.candidates.overlaps import Overlaps, find_overlaps
from planish.registration.candidates.votes import Votes
from planish.registration.result import Registration

#: Each measurement votes for its best neighbour alone, so that first rounds leave pairs out.
BEST_ALONE = CandidateOptions(exhaustive_up_to=1, partners=1, min_significance=1e9)
#: 250 x 187 px.
SCALE = 0.18
NAMES = ["far", "left", "middle", "right"]
PLACES = [
    exp_se3([0, 0, 0.1, -170, -60, 0]),
    np.eye(4),
    sheets.T_TRUE,
    sheets.T_TRUE @ exp_se3([0, 0.02, 0.4, 70, 30, 0]),
]
#: Overlaps by cells against those by all points: a row of cells along a rim of some 25.
OVERLAP_TOLERANCE = 0.06
#: Normals are kept as float32.
FLOAT32 = 1e-5


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """Four measurements of one sheet, all of which overlap."""
    folder = tmp_path_factory.mktemp("measurements")
    for seed, (name, T) in enumerate(zip(NAMES, PLACES, strict=True)):
        m = synthetic.measurement(T, sheets.grain(), scale=SCALE, bend=sheets.BENT, seed=seed)
        replace(m, name=name).save(folder / f"{name}.h5")
    return sorted(folder.glob("*.h5"))


def options(**changes):
    return RegisterOptions(candidates=BEST_ALONE.model_copy(update=changes))


@pytest.fixture(scope="module")
def whole(files, tmp_path_factory):
    out = tmp_path_factory.mktemp("whole")
    with Threads(2) as executor:
        run = register_files(files, out, options(), executor=executor)
    return out, run


def content(out):
    return (out / "registration.json").read_bytes()


def test_the_network_shows_which_pairs_the_votes_left_out(files, whole, tmp_path):
    out, run = whole
    assert {(p.a, p.b) for p in run.registration.pairs} == set(combinations(NAMES, 2))
    first = register_files(files, tmp_path, options(rounds=1))
    assert len(first.registration.pairs) < 6
    assert Frozen.load(out / "stages").batches[0].pairs == tuple(combinations(NAMES, 2))


def test_rounds_give_the_same_bytes_by_processes_in_memory_and_after_an_interrupt(files, whole, tmp_path):
    with WorkerPool(2, 2) as pool:
        register_files(files, tmp_path / "pool", options(), executor=pool)
    assert content(tmp_path / "pool") == content(whole[0])
    with Threads(1) as executor:
        with pytest.raises(KeyboardInterrupt):
            register_files(files, tmp_path / "again", options(), executor=executor, progress=_interrupt_late)
        run = register_files(files, tmp_path / "again", options(), executor=executor)
    assert 3 <= run.reused["pairs"][0] < run.reused["pairs"][1] == 6
    assert content(tmp_path / "again") == content(whole[0])
    in_memory = register([Measurement.load(path) for path in files], options(), threads=1)
    assert [(p.a, p.b, p.log10_false_alarms) for p in in_memory.pairs] == [
        (p.a, p.b, p.log10_false_alarms) for p in whole[1].registration.pairs
    ]


def _interrupt_late(stage, done, total, reused):
    """Interrupt in the second round, after one of its pairs."""
    if stage == "pairs" and total == 6 and done > 3:
        raise KeyboardInterrupt


def test_a_second_run_in_rounds_computes_nothing(files, whole):
    before, footprints = content(whole[0]), times_of_footprints(whole[0])
    run = register_files(files, whole[0], options())
    assert {there for there, _ in run.reused.values()} == {total for _, total in run.reused.values()}
    assert content(whole[0]) == before
    assert len(footprints) == 4
    assert times_of_footprints(whole[0]) == footprints


def times_of_footprints(out):
    return {path: path.stat().st_mtime_ns for path in (out / "stages" / "footprints").glob("*.h5")}


def test_a_footprint_that_is_missing_is_made_again_and_nothing_else(files, whole):
    before, footprints = content(whole[0]), times_of_footprints(whole[0])
    missing = min(footprints)
    missing.unlink()
    run = register_files(files, whole[0], options())
    assert run.reused["texture"] == (3, 4)
    assert run.reused["pairs"] == (6, 6)
    after = times_of_footprints(whole[0])
    assert {path for path in after if after[path] != footprints[path]} == {missing}
    assert content(whole[0]) == before


@pytest.mark.slow
def test_rounds_on_a_dask_cluster_give_the_same_bytes_even_if_a_worker_is_killed(files, whole, tmp_path):
    distributed = pytest.importorskip("distributed", reason="dask.distributed is not installed: no cluster is tried")
    from planish.execution.cluster import DaskCluster

    killed = []
    with (
        distributed.LocalCluster(n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None) as cluster,
        DaskCluster(cluster.scheduler_address) as executor,
    ):
        run = register_files(files, tmp_path / "two", options(), executor=executor)
        assert run.reused["pairs"] == (0, 6)
        assert content(tmp_path / "two") == content(whole[0])

        def kill_one(stage, done, total, reused):
            # In the second round.
            if stage == "pairs" and total == 6 and not killed:
                killed.append(next(iter(cluster.workers.values())).pid)
                os.kill(killed[0], signal.SIGKILL)

        register_files(files, tmp_path / "one", options(), executor=executor, progress=kill_one)
    assert len(killed) == 1
    assert content(tmp_path / "one") == content(whole[0])


def test_an_added_measurement_is_tried_with_all_it_overlaps(files, tmp_path):
    register_files(files[1:], tmp_path, options())
    known = {(p.a, p.b) for p in Registration.load(tmp_path / "registration.json").pairs}
    run = add_files(files[:1], tmp_path)
    assert {(p.a, p.b) for p in run.registration.pairs} == known | {("far", name) for name in NAMES[1:]}
    assert run.reused["pairs"][0] == len(known)


def test_overlaps_by_cells_are_those_of_the_surfaces(files, whole):
    found = find_overlaps([footprint(Measurement.load(p)) for p in files], np.array(PLACES), np.zeros(4, np.int64))
    by_points = {(p.a, p.b): p.overlap for p in whole[1].registration.pairs}
    assert len(found.share) == 6
    for a, b, share in zip(found.index_a, found.index_b, found.share, strict=True):
        assert share == pytest.approx(by_points[NAMES[a], NAMES[b]], abs=OVERLAP_TOLERANCE)


def test_groups_and_the_two_sides_of_a_sheet_do_not_overlap():
    m = synthetic.measurement(np.eye(4), sheets.grain(), scale=0.1)
    one = footprint(m)
    assert one.normals_sensor[:, 2].min() > 0.9  # towards the sensor
    turned = replace(one, normals_sensor=-one.normals_sensor)
    T = np.array([np.eye(4)] * 3)
    together = np.zeros(3, np.int64)
    shares = find_overlaps([one, one, turned], T, together).share.tolist()
    assert shares == pytest.approx([1.0, -1.0, -1.0], abs=FLOAT32)
    assert len(find_overlaps([one, one, turned], T, np.arange(3)).share) == 0
    nothing = footprint(replace(m, points_sensor=np.full_like(m.points_sensor, np.nan)))
    assert len(find_overlaps([nothing, nothing, nothing], T, together).share) == 0
    assert find_overlaps([one, nothing, one], T, together).share.tolist() == pytest.approx([1.0], abs=FLOAT32)


def test_a_plate_that_lies_where_cells_divide_is_seen_all_the_same():
    one = footprint(synthetic.measurement(np.eye(4), sheets.grain(), scale=0.1))
    assert np.abs(one.points_sensor[:, 2]).max() < 0.2
    # The network puts one a little below zero, the other one a little above.
    T = np.array([exp_se3([0, 0, 0, 0, 0, z]) for z in (-0.4, 0.4)])
    found = find_overlaps([one, one], T, np.zeros(2, np.int64))
    assert found.share.tolist() == pytest.approx([1.0], abs=OVERLAP_TOLERANCE)


def test_small_overlaps_are_left_out_and_a_crowded_place_does_not_try_all_pairs():
    names = [f"m{k:02d}" for k in range(30)]
    a, b = np.array(list(combinations(range(30), 2))).T
    share = np.linspace(1, 0.2, len(a))
    chosen = overlapping_pairs(names, Overlaps(a, b, share), CandidateOptions(most_partners=4))
    assert len(chosen) <= 30 * 4
    assert (names[0], names[1]) in chosen
    assert overlapping_pairs(names, Overlaps(a, b, share / 20), CandidateOptions()) == set()


def test_what_stays_apart_gets_the_next_voted_pairs_a_whole_group_no_more_than_a_single_one():
    names = [f"m{k:02d}" for k in range(12)]
    a, b = np.array(list(combinations(range(12), 2))).T
    votes = Votes(a, b, np.arange(len(a), 0, -1.0))
    group = np.repeat([0, 1, 2], [6, 5, 1])
    choice = Choice(names, [], votes)
    tried = [(names[0], names[6])]
    chosen = next_voted_pairs(choice, group, tried, CandidateOptions(partners=3))
    assert tried[0] not in chosen
    numbers = [(int(x[1:]), int(y[1:])) for x, y in chosen]
    assert all(group[x] != group[y] for x, y in numbers)
    out_of = {g: sum(g in (group[x], group[y]) for x, y in numbers) for g in (1, 2)}
    assert len(chosen) == 6
    assert min(out_of.values()) == 3
    assert (names[0], names[7]) in chosen  # the most votes
    only_new = next_voted_pairs(choice, group, tried, CandidateOptions(partners=3), ["m11"])
    assert {y for _, y in only_new} == {"m11"}
