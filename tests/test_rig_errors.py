"""How points move with their rig's errors: against really measuring again with the changed rig."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import sequences
from calibrated_rig import with_calibration
from planish.geometry import exp_se3
from planish.measurement import Measurement
from planish.pipeline import MeasureOptions, measure
from planish.registration.rig_errors import displacements, rig_key
from planish.rig import Rig
from planish.sensing.capture.manifest import Capture
from planish.sensing.decode import PhaseMap
from planish.sensing.points.axes import axis_weights
from planish.sensing.points.locate import locate_between_cameras, locate_by_projector
from planish.sensing.points.reject import RejectOptions
from planish.simulation.scenes import make_scene
from planish.simulation.writing import write_scene

#: The kernels triangulate in single precision (1e-4 px), and directions come from noisy maps: [mm] and share.
MEDIAN_MM, MEDIAN_SHARE = 2e-4, 0.01
#: Exact positions on a plane: the lines across which they are compared are straight within the reach of differences.
EXACT_MM, EXACT_SHARE = 3e-4, 0.01


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    where = tmp_path_factory.mktemp("door")
    write_scene(make_scene("door", 3, 1, scale=0.25), where, true_points=False, threads=2)
    return where / "m1"


def measured(folder, rig, **options):
    rig.save(folder / "rig.json")
    return measure(Capture.load(folder), MeasureOptions(**options), 2)


@pytest.mark.parametrize("options", [{}, {"geometry": "projector"}, {"organise_on": "B"}])
def test_points_move_as_they_do_when_measured_again_with_the_changed_rig(folder, options):
    rig = with_calibration(replace(Rig.load(folder / "rig.json"), covariance=None, covariance_parameters=()))
    m = measured(folder, rig, **options)
    v, u = (i[::37] for i in np.nonzero(m.valid))
    expected = displacements(m, np.stack([u, v], -1))
    modes = rig.modes()
    assert expected.shape == (len(modes), len(u), 3)
    from_cameras = np.zeros(len(u), bool)
    if m.correspondence_px is not None:
        from_cameras = np.isfinite(m.correspondence_px[v, u, 0])
        assert 0.02 < 1 - from_cameras.mean() < 0.5
    for k in range(3, len(modes), 8):
        ends = [measured(folder, rig.changed(s * modes[k]), **options).points_sensor[v, u] for s in (1, -1)]
        moved = (ends[0].astype(float) - ends[1]) / 2
        for which in (from_cameras, ~from_cameras):
            known = which & np.isfinite(moved).all(1)
            assert known.sum() >= 0.9 * which.sum()
            if known.any():
                size = np.sqrt((moved[known] ** 2).sum(1).mean())
                off = np.median(np.linalg.norm(moved - expected[k], axis=1)[known])
                assert off <= MEDIAN_MM + MEDIAN_SHARE * size, k


def rolled_rig():
    """Two cameras and a projector rolled by 0.4 rad: its columns cross the epipolar lines aslant."""
    rig = sequences.small_rig()
    projector = rig.projector
    roll = exp_se3([0, 0, 0.4, 0, 0, 0])
    return with_calibration(
        replace(rig, projector=replace(projector, T_camera_sensor=roll @ projector.T_camera_sensor))
    )


def seen_phases(rig, camera, sigmas):
    """Exact positions per axis of a plane as a camera sees it."""
    place = rig.projector.project(sequences.plane_points(camera))
    shape = place.shape[:2]
    return {
        axis: PhaseMap(
            axis, place[..., i].astype(np.float32), np.full(shape, s, np.float32), np.zeros(shape, np.uint16)
        )
        for i, (axis, s) in enumerate(zip("uv", sigmas, strict=True))
        if s is not None
    }


def as_measurement(rig, located, weights, position=None):
    points = located.points
    return Measurement(
        "plane", "A", rig, points.points_sensor, points.sigma_mm, np.zeros(points.sigma_mm.shape, np.uint16),
        located.correspondence_px, {}, (), False, position_px=position, projector_weights=weights,
    )  # fmt: skip


def check(rig, locate, weights, position=None):
    m = as_measurement(rig, locate(rig), weights, position)
    v, u = (i[::41] for i in np.nonzero(m.valid[12:-12, 12:-12]))
    v, u = v + 12, u + 12
    expected, modes = displacements(m, np.stack([u, v], -1)), rig.modes()
    for k in range(len(modes)):
        ends = [locate(rig.changed(s * modes[k])).points.points_sensor[v, u].astype(float) for s in (1, -1)]
        moved = (ends[0] - ends[1]) / 2
        known = np.isfinite(moved).all(1)
        assert known.sum() > 0.8 * len(u)
        size = np.sqrt((moved[known] ** 2).sum(1).mean())
        off = np.median(np.linalg.norm(moved - expected[k], axis=1)[known])
        assert off <= EXACT_MM + EXACT_SHARE * size, k
    return expected


def test_corresponding_pixels_follow_the_lines_of_equal_position_to_the_new_epipolar_line():
    rig = rolled_rig()
    phases = {name: seen_phases(rig, rig.cameras[name], (0.02, None)) for name in "AB"}
    position = phases["A"]["u"].position_px
    right = check(rig, lambda r: locate_between_cameras(phases, r, "A", "plane", 2), (1.0, 0.0), position)
    m = as_measurement(rig, locate_between_cameras(phases, rig, "A", "plane", 2), (1.0, 0.0))
    v, u = (i[::41] for i in np.nonzero(m.valid[12:-12, 12:-12]))
    without = displacements(m, np.stack([u + 12, v + 12], -1))
    # What the direction is worth: errors across the epipolar lines count here by tan 0.4.
    off, size = (np.sqrt((x**2).sum(2).mean(1)) for x in (without - right, right))
    assert (off / size).max() > 0.2


@pytest.mark.parametrize("sigmas", [(0.02, None), (None, 0.02), (0.02, 0.02), (0.02, 0.05)])
def test_points_of_the_projector_keep_what_it_coded(sigmas):
    rig = rolled_rig()
    phases = seen_phases(rig, rig.cameras["A"], sigmas)
    weights = axis_weights(phases)
    assert sum(weights) == pytest.approx(1)
    options = RejectOptions(projector_px=50)
    check(rig, lambda r: locate_by_projector(phases, r.cameras["A"], r.projector, options, "plane", 2), weights)


def test_a_measurement_knows_what_was_coded(folder):
    m = measured(folder, Rig.load(folder / "rig.json"))
    assert m.projector_weights == (1.0, 0.0)
    both = m.valid & np.isfinite(m.position_px)
    assert both.sum() > 0.99 * m.valid.sum()
    place = m.rig.projector.project(m.points_sensor[both])[:, 0]
    assert np.median(np.abs(place - m.position_px[both])) < 0.1


def test_clouds_of_other_scanners_have_no_such_errors():
    rig = sequences.small_rig()
    alone = with_calibration(Rig({"A": rig.cameras["A"]}))
    points = sequences.plane_points(rig.cameras["A"]).astype(np.float32)
    m = Measurement(
        "cloud", "A", alone, points, points[..., 0], np.zeros(points.shape[:2], np.uint16), None, {}, (), True
    )
    pixels = np.array([[5, 5]])
    assert displacements(m, pixels) is None
    assert displacements(replace(m, rig=rig), pixels) is None


def test_rigs_are_told_apart_by_their_content(tmp_path):
    rig = with_calibration(sequences.small_rig())
    rig.save(tmp_path / "rig.json")
    assert rig_key(Rig.load(tmp_path / "rig.json")) == rig_key(rig)
    others = [
        rig.changed(1e-6 * rig.modes()[0]),
        replace(rig, covariance=rig.covariance * 1.01),
        replace(rig, covariance=None, covariance_parameters=()),
        replace(rig, projector=None),
    ]
    assert len({rig_key(item) for item in [rig, *others]}) == 5
