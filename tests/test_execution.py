"""Executors, the store of stage results, and what a process keeps."""

from __future__ import annotations

import os
import platform
import threading
from dataclasses import dataclass, replace
from pathlib import Path

import h5py
import numpy as np
import pytest

import tasks
from planish import _core
from planish.errors import InputError
from planish.execution.cluster import DaskCluster, call_if_same_code
from planish.execution.executor import Threads
from planish.execution.memory import kept_memory
from planish.execution.pool import Stretches, WorkerLostError, WorkerPool
from planish.execution.recent import Recent, arrays_of
from planish.execution.store import StageStore, code_version, content_key
from planish.geometry import Array


@pytest.fixture(scope="module")
def pool():
    with WorkerPool(2, 2) as workers:
        yield workers


@pytest.mark.parametrize("threads", [1, 3])
def test_threads_do_every_item_once(threads):
    with Threads(threads) as executor:
        assert sorted(executor.map(tasks.square, range(7))) == [(i, i * i) for i in range(7)]


def test_the_last_items_share_the_threads_that_are_left():
    with Threads(4) as executor:
        assert dict(executor.map(tasks.threads_given, range(6))) == {0: 1, 1: 1, 2: 1, 3: 1, 4: 2, 5: 4}
        assert dict(executor.map(tasks.threads_given, range(2))) == {0: 2, 1: 2}


def test_worker_processes_do_every_item_once(pool):
    assert sorted(pool.map(tasks.square, range(20))) == [(i, i * i) for i in range(20)]
    assert len(pool.pids) == 2


def test_an_error_in_a_worker_is_raised_as_it_is_and_the_pool_goes_on(pool):
    with pytest.raises(InputError, match=r"item: found \d; expected another one"):
        list(pool.map(tasks.refuse, range(9)))
    assert sorted(pool.map(tasks.square, range(4))) == [(i, i * i) for i in range(4)]


def test_what_a_function_prints_does_not_disturb_the_answers(pool):
    assert list(pool.map(tasks.print_much, ["value"])) == [(0, "value")]


def test_what_a_killed_worker_was_at_is_done_by_another_one(pool, tmp_path):
    items = [(str(tmp_path / str(i)), i) for i in range(2)]
    (tmp_path / "1").touch()
    assert sorted(pool.map(tasks.die_first, items)) == [(0, 0), (1, 1)]
    assert (tmp_path / "0").exists()


def test_an_item_that_kills_every_worker_is_given_up(pool, monkeypatch):
    monkeypatch.setattr("planish.execution.pool.MAX_ATTEMPTS", 2)
    with pytest.raises(WorkerLostError, match="exit code -9"):
        list(pool.map(tasks.die_always, [0]))


def test_bad_numbers_of_workers_and_missing_clusters_are_refused(monkeypatch):
    with pytest.raises(InputError, match="workers: found 0"):
        WorkerPool(0)
    monkeypatch.setitem(__import__("sys").modules, "distributed", None)
    with pytest.raises(InputError, match=r"pip install 'planish\[cluster\]'"):
        DaskCluster("tcp://127.0.0.1:1")


def test_a_worker_of_a_cluster_with_another_planish_refuses():
    assert call_if_same_code(tasks.square, 3, code_version()) == 9
    with pytest.raises(InputError, match="a worker runs another planish"):
        call_if_same_code(tasks.square, 3, "0" * 64)


@dataclass(frozen=True)
class Result:
    values: Array
    name: str


RESULT = Result(np.arange(1000.0), "a")


@pytest.fixture
def store(tmp_path):
    made = StageStore(tmp_path)
    made.write("stage", content_key("stage", 1), RESULT)
    return made


def stored(store):
    return store.read("stage", content_key("stage", 1), Result)


def test_a_stored_result_comes_back_and_is_not_made_again(store):
    found, was_there = store.read_or_make("stage", content_key("stage", 1), Result, lambda: pytest.fail("made again"))
    assert was_there
    assert found.name == "a"
    assert np.array_equal(found.values, RESULT.values)
    # Any program for HDF5 reads it.
    with h5py.File(store.path("stage", content_key("stage", 1))) as file:
        assert file["values"].shape == (1000,)


@pytest.mark.parametrize("damage", ["cut", "flipped", "empty", "grown"])
def test_a_damaged_file_is_not_trusted(store, damage):
    path = store.path("stage", content_key("stage", 1))
    content = path.read_bytes()
    middle = len(content) // 2
    flipped = content[:middle] + bytes([content[middle] ^ 1]) + content[middle + 1 :]
    path.write_bytes({"cut": content[:-1], "flipped": flipped, "empty": b"", "grown": content + b"\0"}[damage])
    assert stored(store) is None
    found, was_there = store.read_or_make("stage", content_key("stage", 1), Result, lambda: RESULT)
    assert not was_there
    assert found.name == "a"
    assert path.read_bytes()[:512] == content[:512]


def test_a_file_under_the_name_of_another_result_is_not_trusted(store):
    other = content_key("stage", 2)
    store.path("stage", content_key("stage", 1)).rename(store.path("stage", other))
    assert store.read("stage", other, Result) is None


def test_keys_differ_by_stage_and_by_every_input():
    keys = {content_key("a", 1.0, "x"), content_key("b", 1.0, "x"), content_key("a", 1.0 + 1e-15, "x"),
            content_key("a", 1.0, "y"), content_key("a", 1.0, "x", None)}  # fmt: skip
    assert len(keys) == 5


def test_what_a_killed_process_was_writing_is_removed(store):
    (store.folder / "stage" / ".x.h5.123.part").touch()
    store.remove_unfinished()
    assert [path.name for path in (store.folder / "stage").iterdir()] == [
        store.path("stage", content_key("stage", 1)).name
    ]


def test_the_oldest_objects_go_when_memory_or_number_is_reached():
    recent = Recent(max_bytes=3 * 8000, max_number=10)
    for key in "abcd":
        recent.get(key, lambda: np.zeros(1000))
    assert [recent.peek(key) is not None for key in "abcd"] == [False, True, True, True]
    recent.max_number = 2
    recent.get("b", lambda: pytest.fail("made again"))
    assert [recent.peek(key) is not None for key in "abcd"] == [False, True, False, True]


def test_an_object_is_made_once_whatever_number_of_threads_ask():
    recent, made, start = Recent(10**6), [], threading.Barrier(4)

    def ask():
        start.wait()
        recent.get("key", lambda: made.append(1) or made)

    threads = [threading.Thread(target=ask) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert made == [1]


def test_shared_arrays_count_once():
    result = replace(RESULT, values=np.zeros(100))
    assert sum(arrays_of([result, {"x": result.values[10:]}, (result.values,)]).values()) == 800


def test_objects_that_grow_while_they_are_used_make_others_go():
    recent, grown = Recent(max_bytes=3 * 8000, max_number=10), []
    recent.get("old", lambda: np.zeros(1000))
    recent.get("growing", lambda: grown)
    grown.append(np.zeros(2500))
    recent.get("new", lambda: np.zeros(100))
    assert [recent.peek(key) is not None for key in ("old", "growing", "new")] == [False, True, True]
    # What two objects share goes when both have gone.
    both = np.zeros(2000)
    for key in "ab":
        recent.get(key, lambda: both)
    assert [recent.peek(key) is not None for key in ("growing", "new", "a", "b")] == [False, True, True, True]


def test_workers_go_through_neighbouring_items_and_take_over_from_the_end_of_others():
    waiting = Stretches(7, 2)
    assert [waiting.take(slot) for slot in (0, 1, 0, 0)] == [(0, 1), (3, 1), (1, 1), (2, 1)]
    assert waiting.take(0) == (6, 1)
    waiting.give_back(1, 3, 2)
    assert [waiting.take(1) for _ in range(4)] == [(3, 2), (4, 1), (5, 1), None]


def resident_mib():
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 2**20


ONLY_GLIBC = pytest.mark.skipif(
    platform.libc_ver()[0] != "glibc", reason="only its allocator can be told what to do with freed memory"
)


@ONLY_GLIBC
def test_threads_keep_freed_memory_for_what_comes_next_and_give_it_back():
    size_mib = 200
    with Threads(1):
        before = resident_mib()
        maps = [np.ones(2**20) for _ in range(size_mib // 8)]
        assert len(maps) * 8 == size_mib
        del maps
        assert resident_mib() - before > 0.9 * size_mib
    assert resident_mib() - before < 0.1 * size_mib


@ONLY_GLIBC
def test_kept_memory_of_overlapping_blocks_goes_back_after_the_last_one():
    size_mib = 200
    with Threads(1):
        before = resident_mib()
        with kept_memory():
            maps = [np.ones(2**20) for _ in range(size_mib // 8)]
            assert len(maps) * 8 == size_mib
        del maps
        assert resident_mib() - before > 0.9 * size_mib
    assert resident_mib() - before < 0.1 * size_mib


@pytest.mark.parametrize("allowed", [True, False])
def test_huge_pages_are_afterwards_what_they_were_before(allowed):
    before = _core.allow_huge_pages(False)
    try:
        # Where the system knows no such setting, they are always allowed.
        can_be_refused = not _core.allow_huge_pages(allowed)
        with kept_memory():
            pass
        assert _core.allow_huge_pages(True) == (allowed or not can_be_refused)
    finally:
        _core.allow_huge_pages(before)


@ONLY_GLIBC
def test_what_lies_free_between_kept_arrays_goes_back_to_the_system():
    size_mib = 300
    # So small that they do not get pages of their own.
    arrays = [np.ones(2**14) for _ in range(size_mib * 8)]
    kept = arrays[::50]
    full = resident_mib()
    del arrays
    _core.release_memory()
    assert len(kept) > 0
    assert full - resident_mib() > 0.8 * size_mib
