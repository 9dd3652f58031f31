"""The statistics' own tools: cells that can be taken up again, planned overlaps, the plain peer."""

import json

import numpy as np
import pytest

from coarse_pairs import parts, sift, tables
from planish.geometry import compose, exp_so3, fit_rigid, transform_points
from shared import cells


def rows_of(value):
    return [{"value": value}]


def failing(value):
    raise AssertionError(f"cell {value} was there already")


def test_a_cell_that_is_there_is_kept_and_read_again(tmp_path, monkeypatch):
    monkeypatch.setattr(cells, "RESULTS", tmp_path)
    cells.run_cells("folder", {"one": (1,), "two": (2,)}, rows_of, 1)
    cells.run_cells("folder", {"one": (1,), "two": (2,)}, failing, 1)
    assert cells.read_rows("folder") == [{"value": 1}, {"value": 2}]
    assert json.loads((tmp_path / "folder" / "one.json").read_text())["peak_mib"] > 0


def test_a_cell_is_computed_again_on_request(tmp_path, monkeypatch):
    monkeypatch.setattr(cells, "RESULTS", tmp_path)
    cells.run_cells("folder", {"one": (1,)}, rows_of, 1)
    cells.run_cells("folder", {"one": (3,)}, rows_of, 1, again=True)
    assert cells.read_rows("folder") == [{"value": 3}]


@pytest.mark.parametrize("number", [0, 3])
def test_a_part_is_drawn_from_its_number_alone(number):
    part, cases = parts.draw_part(number)
    again, same = parts.draw_part(number)
    assert (part, cases) == (again, same)
    assert len(cases) >= 10
    low, high = parts.OVERLAPS
    assert all(low - parts.PLAN_ERROR <= case.planned_overlap <= high + parts.PLAN_ERROR for case in cases)


def test_a_sensor_overlaps_wholly_with_itself_and_not_at_all_with_one_far_away():
    part, _ = parts.draw_part(1)
    scene = part.scene()
    near, same, far = (
        parts.Seen.of(
            scene.surface, scene.rig, parts.Stand(s, 0, 0, (0, 0), 0).place(scene.surface)
        )
        for s in (-300.0, -300.0, 300.0)
    )  # fmt: skip
    assert parts.seen_overlap(near, same) == pytest.approx(1)
    assert parts.seen_overlap(near, far) == 0


def test_three_points_fix_the_transform_of_the_plain_peer():
    rng = np.random.default_rng(3)
    T = compose(exp_so3([0.3, -1.2, 2.0]), [30.0, -40.0, 5.0])
    b = rng.uniform(-100, 100, (20, 3, 3))
    a = transform_points(T, b.reshape(-1, 3)).reshape(b.shape) + 0.01 * rng.standard_normal(b.shape)
    R, t = sift._fit_many(a, b)
    for k in range(len(a)):
        expected = fit_rigid(a[k], b[k])
        assert np.allclose(R[k], expected[:3, :3], atol=1e-9)
        assert np.allclose(t[k], expected[:3, 3], atol=1e-6)


def test_an_accepted_transform_that_refinement_left_wrong_counts_as_wrong_and_one_it_mended_does_not():
    row = {"status": "accepted", "coarse_mm": 1.4, "refined_mm": 0.02}
    assert not tables.is_right(row)
    assert not tables.is_wrong(row)
    assert tables.is_wrong(row | {"refined_mm": 3.0})
    assert tables.is_right(row | {"coarse_mm": 0.4})
    assert not tables.is_right(row | {"status": "refused", "coarse_mm": 0.4})
