"""The way of the adjustment: each camera alone, all in one frame, the projector, everything at once."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from planish.errors import InputError
from planish.geometry import Array
from planish.measurement import Finding
from planish.rig import Camera
from planish.rig.parameters import PROJECTOR
from planish.sensing.calibrate.adjust.geometry_checks import require_tilt, require_views, words
from planish.sensing.calibrate.adjust.lens import Chosen, choose_model, free_with, start_with, with_model
from planish.sensing.calibrate.adjust.lens_models import Model
from planish.sensing.calibrate.adjust.orient import orient, upside_down_image, without_images
from planish.sensing.calibrate.adjust.problem import Block, Free, Mask, Problem, State, placed
from planish.sensing.calibrate.adjust.robust import Adjusted, adjust_robustly
from planish.sensing.calibrate.adjust.single import adjust_single, as_camera
from planish.sensing.calibrate.adjust.start import place_boards, place_errors, upside_down
from planish.sensing.calibrate.observations import BoardObservations
from planish.sensing.calibrate.symmetry import turns

#: An image that does not fit was saved upside down where it fits so much better when turned.
BETTER_TURNED = 0.3
#: The device whose frame is the sensor frame.
REFERENCE = "A"


@dataclass(frozen=True)
class Started:
    """Devices in the sensor frame and the boards before them.

    Parameters
    ----------
    problem : Problem
        What is still used of the observations.
    devices : mapping of Camera
        Those placed so far, in the sensor frame.
    models : mapping of Chosen
        Their lens models.
    T_sensor_board : ndarray (V, 4, 4)
        NaN where no placed device sees the board.
    findings : tuple of Finding
        What was left out on the way.
    """

    problem: Problem
    devices: Mapping[str, Camera]
    models: Mapping[str, Chosen]
    T_sensor_board: Array
    findings: tuple[Finding, ...]


def start_device(
    problem: Problem, block: Block, size_px: tuple[int, int], forced: str | None, share: float
) -> tuple[Adjusted, Chosen]:
    """Return one device alone, with its lens model.

    Raises
    ------
    InputError
        Where its boards are too few or all parallel.
    """
    item = adjust_single(problem, block, size_px, share)
    require_views(item.problem, (block.device,))
    require_tilt(item, block.device)
    chosen = choose_model(item, block.device, forced)
    return change_model(item, block.device, chosen.model, share), chosen


def change_model(item: Adjusted, device: str, model: Model, share: float) -> Adjusted:
    """Return the adjustment anew with another lens model of one device."""
    problem = with_model(item.problem, item.state, device, model)
    state = start_with(item.state, device, model)
    return adjust_robustly(problem, state, free_with(item.free, device, model), share)


def join_cameras(
    problem: Problem, observations: BoardObservations, started: Mapping[str, tuple[Adjusted, Chosen]]
) -> Started:
    """Return the cameras in the frame of camera A.

    Raises
    ------
    InputError
        Where no view is seen by both cameras.
    """
    findings: list[Finding] = []
    for name, (item, _) in started.items():
        turned = _turned(problem, name, item)
        for _, view in item.dropped:
            label, image = problem.views[view], observations.views[view].images.get(name, name)
            findings.append(upside_down_image(label, image) if turned[view] else misfit(observations, label, name))
            problem = without_images(problem, view, (name,))
    reference = started[REFERENCE][0]
    places = reference.state.T_sensor_board.copy()
    places[~reference.problem.seen_by(REFERENCE)] = np.nan
    models = {name: chosen for name, (_, chosen) in started.items()}
    now = Started(problem, {REFERENCE: reference.state.devices[REFERENCE]}, models, places, tuple(findings))
    for name in (name for name in started if name != REFERENCE):
        now = _join(now, observations, problem.blocks_of(name)[0], started[name][0].state.devices[name])
    return now


def join_projector(now: Started, observations: BoardObservations, forced: str | None, share: float) -> Started:
    """Return the projector joined to the cameras, with its lens model."""
    assert observations.projector_px is not None
    require_views(now.problem, (PROJECTOR,))
    block = as_camera(now.problem)
    item = adjust_single(now.problem, block, observations.projector_px, share)
    for _, view in item.dropped:
        told = misfit(observations, now.problem.views[view], PROJECTOR)
        problem = without_images(now.problem, view, (PROJECTOR,))
        now = replace(now, problem=problem, findings=(*now.findings, told))
        block = block.without(np.arange(len(problem.views))[:, None] == view)
    require_views(now.problem, (PROJECTOR,))
    now = _join(now, observations, block, item.state.devices[PROJECTOR])
    coefficients = {name: chosen.model.coefficients for name, chosen in now.models.items()}
    coefficients[PROJECTOR] = tuple(c for c in ("k1", "k2", "p1", "p2", "k3") if c in _names(item.free))
    joint = adjust_everything(
        replace(now, problem=replace(now.problem, pseudo=item.problem.pseudo)), coefficients, share
    )
    return replace(now, models={**now.models, PROJECTOR: choose_model(joint, PROJECTOR, forced)})


def adjust_everything(now: Started, coefficients: Mapping[str, tuple[str, ...]], share: float) -> Adjusted:
    """Return the adjustment of all devices and boards at once, with these distortion coefficients per device."""
    places = now.T_sensor_board.copy()
    unplaced = ~placed(places)
    places[unplaced] = np.eye(4)
    blocks = tuple(block.without(unplaced[:, None]) for block in now.problem.blocks if block.device in coefficients)
    problem = replace(now.problem, blocks=blocks)
    modes = len(problem.modes)
    state = State({name: now.devices[name] for name in coefficients}, places, np.zeros(modes))
    return adjust_robustly(problem, state, Free.of(coefficients, REFERENCE, modes), share)


def adjust_chosen(now: Started, share: float) -> Adjusted:
    """Return the adjustment of everything with the chosen lens models."""
    state = State(now.devices, now.T_sensor_board, np.empty(0))
    problem = now.problem
    for device, chosen in now.models.items():
        problem = with_model(problem, state, device, chosen.model)
        state = start_with(state, device, chosen.model)
    coefficients = {device: chosen.model.coefficients for device, chosen in now.models.items()}
    return adjust_everything(replace(now, problem=problem, devices=state.devices), coefficients, share)


def misfit(observations: BoardObservations, view: str, device: str) -> Finding:
    """Return the finding that an image does not fit."""
    images = next(item.images for item in observations.views if item.name == view)
    what = f"image {images[device]}" if device in images else f"the code of {words(device)}"
    told = f"view {view}: {what} does not fit the other views"
    return Finding(f"view {view}, {what}", None, None, "", told, f"{told}; it is left out")


def _turned(problem: Problem, name: str, item: Adjusted) -> Mask:
    """Which views (V,) of a camera fit much better when their image is turned by 180 degrees."""
    camera, block = item.state.devices[name], problem.blocks_of(name)[0]
    errors = []
    for tried in (block, upside_down(block, camera)):
        places = place_boards(tried, problem.points_board, camera, block.views)
        errors.append(place_errors(tried, problem.points_board, camera, places))
    return np.asarray(errors[1] < BETTER_TURNED * errors[0])


def _names(free: Free) -> set[str]:
    return {name.partition(".")[2] for name in free.names}


def _join(now: Started, observations: BoardObservations, block: Block, camera: Camera) -> Started:
    known = placed(now.T_sensor_board)
    if not (known & block.views).any():
        raise InputError(
            f"boards of {words(block.device)}",
            f"found no view that {words(block.device)} and {' or '.join(map(words, now.devices))} both see",
            "views of the board that both see at the same time: they tell how the devices lie to each other",
        )
    images = tuple(view.images for view in observations.views)
    numberings = turns(observations.board)
    found = orient(now.problem, block, camera, now.devices, now.T_sensor_board, numberings, images)
    return replace(
        now,
        problem=found.problem,
        devices={**now.devices, block.device: found.camera},
        T_sensor_board=found.T_sensor_board,
        findings=(*now.findings, *found.findings),
    )
