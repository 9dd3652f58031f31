"""What a calibration is advised: each fault of the views names itself, a good set of views is left in peace."""

from dataclasses import replace

import numpy as np
import pytest

import drawn_calibration
from planish.geometry import compose, exp_so3
from planish.sensing.calibrate.judge.advice import advice, bad_views, tilt_advice
from planish.sensing.calibrate.judge.coverage import CELLS, coverage
from planish.sensing.calibrate.judge.expected_error import expected_errors
from planish.sensing.calibrate.judge.point_sigmas import point_sigmas
from planish.sensing.calibrate.judge.views import depths_mm, placements


def said(item, *words):
    return [sentence for sentence in advice(item) if all(word in sentence for word in words)]


@pytest.fixture(scope="module")
def good():
    return drawn_calibration.calibration(depth_mm=80.0)


def changed_residuals(item, device, change):
    return replace(item, residuals=tuple(change(r) if r.device == device else r for r in item.residuals))


def test_tilted_boards_all_over_image_and_depth_need_no_other_views(good):
    for words in (("More views",), ("Tilt",), ("Turn",), ("Depth",), ("outliers",), ("again",), ("Only",)):
        assert said(good, *words) == []


def test_few_views_are_said_to_be_few():
    assert "6 were used" in said(drawn_calibration.calibration(views=6), "More views")[0]


def test_boards_parallel_to_the_image_are_to_be_tilted():
    item = drawn_calibration.calibration(tilt_deg=12.0)
    largest = np.degrees(max(place.tilt_rad for place in placements(item)))
    assert largest <= 12
    assert f"within {largest:.0f}°" in said(item, "Tilt more")[0]


def test_boards_tilted_and_turned_one_way_only_are_told_which_way_lacks(good):
    def leaning(axis):
        T = {f"v{i}": compose(exp_so3(np.radians(10 * (i - 4)) * np.array(axis)), [0, 0, 870]) for i in range(9)}
        residuals = tuple(replace(r, view=name) for name, r in zip(T, good.residuals, strict=False))
        return tilt_advice(placements(replace(good, T_A_board=T, residuals=residuals)))

    assert any("lean left and right only" in s for s in leaning([0, 1.0, 0]))
    assert any("lean up and down only" in s for s in leaning([1.0, 0, 0]))
    assert any("Turn the board by 90°" in s for s in leaning([1.0, 0, 0]))


def test_a_shallow_volume_is_told_with_its_depths():
    item = drawn_calibration.calibration(tilt_deg=8.0, depth_mm=5.0)
    near, middle, far = depths_mm(item)
    assert near < middle < far
    assert f"{near:.0f} to {far:.0f} mm" in said(item, "Depth covered")[0]


def test_an_empty_part_of_an_image_is_named_with_its_camera(good):
    def cut(r):
        keep = ~((r.pixel_px[:, 0] < 1388 / 3) & (r.pixel_px[:, 1] < 1038 / 3))
        return replace(r, index=r.index[keep], pixel_px=r.pixel_px[keep], residual_px=r.residual_px[keep],
                       outlier=r.outlier[keep])  # fmt: skip

    (sentence,) = said(changed_residuals(good, "B", cut), "No board", "camera B")
    assert "in the upper left of" in sentence
    assert said(changed_residuals(good, "B", cut), "No board", "camera A") == said(good, "No board", "camera A")


def test_what_no_other_device_sees_needs_no_boards(good):
    item = coverage(good, "projector")
    assert item.useful.shape == CELLS
    assert not item.useful.all()
    alone = replace(good, rig=replace(good.rig, cameras={"A": good.rig.cameras["A"]}, projector=None))
    assert coverage(alone, "A").useful.all()


def test_a_view_that_moved_is_to_be_taken_again(good):
    item = changed_residuals(
        good, "A", lambda r: replace(r, residual_px=3.5 * r.residual_px) if r.view == "view_04" else r
    )
    assert list(bad_views(item, "A")) == ["view_04"]
    (sentence,) = said(item, "again")
    assert "view_04 (A/04.png)" in sentence
    rms = {r.view: r.rms_px for r in item.residuals if r.device == "A"}
    assert f"{rms['view_04'] / np.median(list(rms.values())):.1f} times in camera A" in sentence


def test_many_outliers_are_told_with_their_view(good):
    item = changed_residuals(good, "B", lambda r: replace(r, outlier=r.index % 2 == 0) if r.view == "view_07" else r)
    assert "in view_07" in said(item, "outliers", "camera B")[0]


def test_residuals_that_agree_over_the_views_show_a_wrong_model(good):
    def bent(r):
        x = r.pixel_px[:, 0] / 700 - 1
        return replace(r, residual_px=r.residual_px + 0.06 * np.stack([np.sin(3 * x), np.cos(4 * x)], -1))

    assert said(good, "point the same way") == []
    (sentence,) = said(changed_residuals(good, "A", bent), "point the same way")
    assert "camera A" in sentence
    assert "--flatness" in sentence
    assert coverage(changed_residuals(good, "A", bent), "A").systematic_px == pytest.approx(0.06, rel=0.15)


def test_left_out_views_that_fit_badly_ask_for_more_views(good):
    item = replace(good, left_out_rms_px={**good.left_out_rms_px, "B": 0.4})
    assert "0.400 px in camera B" in said(item, "left out")[0]


def test_devices_that_share_few_views_are_named():
    item = drawn_calibration.calibration(devices=("A", "B"))
    few = {f"view_{i:02d}" for i in range(3)}
    item = replace(item, residuals=tuple(r for r in item.residuals if r.device == "A" or r.view in few))
    assert len(said(item, "Only 3 views")) == 2


def test_a_dominant_scale_asks_for_a_known_length(good):
    sigma = 3e-3
    rig = good.rig
    scale = np.zeros(len(rig.covariance_parameters))
    for device in ("B", "projector"):
        places = [rig.covariance_parameters.index(f"{device}.translation_{a}") for a in "xyz"]
        scale[places] = sigma * rig.devices[device].T_camera_sensor[:3, 3]
    rig = replace(rig, covariance=rig.covariance + np.outer(scale, scale))
    item = replace(good, rig=rig, scale=(0.0, sigma))
    assert said(replace(good, rig=rig), "known_length") == []
    assert len(said(item, "known_length")) == 2
    assert expected_errors(item)[0].scale_sigma == pytest.approx(sigma, rel=0.02)


def test_placements_are_those_the_boards_were_put_at(good):
    for place, (name, T) in zip(placements(good), good.T_A_board.items(), strict=True):
        assert place.view == name
        assert place.near_mm <= place.far_mm
        assert np.isclose(np.cos(place.tilt_rad), abs(T[2, 2]))


def test_points_whose_detection_says_so_count_as_better_than_others(good):
    """Half of the points three times as noisy, and stated to be: over their sigmas all residuals are alike."""
    worse = 1 + 2 * (np.arange(140) % 2)
    views = tuple(
        replace(v, cameras={c: replace(p, sigma_px=p.sigma_px * worse[p.index]) for c, p in v.cameras.items()})
        for v in good.observations.views
    )
    item = changed_residuals(good, "A", lambda r: replace(r, residual_px=r.residual_px * worse[r.index][:, None]))
    item = replace(item, observations=replace(item.observations, views=views))
    pairs = point_sigmas(item, "A")
    for k in (1, 3):
        kept = [(r.residual_px / s[:, None])[(worse[r.index] == k) & ~r.outlier] for r, s in pairs]
        # 1400 points and more know a standard deviation to 1.3 %.
        assert np.sqrt((np.concatenate(kept) ** 2).mean()) == pytest.approx(1, abs=0.06)
    assert coverage(item, "A").significance < 5
