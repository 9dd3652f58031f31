"""Boards for the tests of the calibration, and calibrations against the truth."""

from dataclasses import replace
from functools import lru_cache

import numpy as np

from planish.geometry import invert, log_se3
from planish.rig.parameters import DEVICE_PARAMETERS
from planish.sensing.capture.board import parse_board
from planish.simulation.board_places import board_places
from planish.simulation.boards import PrintedBoard
from planish.simulation.sensor import reference_rig
from seen_boards import observations

#: Noise of the corners [px], as the issue's figures are stated for.
NOISE_PX = 0.05
AB = ("A", "B")
STATED = {"schema": "planish.board/1", "kind": "chessboard", "corners": (11, 8), "pitch_mm": 20.0}


def made(stated=None, **changes):
    """A board whose file says `stated` besides STATED, made with `changes`."""
    return PrintedBoard(parse_board({**STATED, **(stated or {})}, "board"), **changes)


@lru_cache
def places(views=12, devices=AB, seed=0):
    return board_places(reference_rig(), made(), views, seed, devices=devices, seen_share=0.8)


def seen(views=12, devices=AB, board=None, seed=0, rig=None, noise_px=NOISE_PX):
    rig = reference_rig() if rig is None else rig
    return observations(rig, made() if board is None else board, places(views, devices), noise_px, seed, devices)


def errors(found, rig=None):
    """What has to be added to each parameter of the covariance to get the true one (n,)."""
    true = (reference_rig() if rig is None else rig).in_frame_of("A")
    each = {}
    for name, device in found.rig.devices.items():
        K = true.devices[name].K - device.K
        external = log_se3(true.devices[name].T_camera_sensor @ invert(device.T_camera_sensor))
        lens = true.devices[name].distortion - device.distortion
        each[name] = np.r_[K[0, 0], K[1, 1], K[0, 2], K[1, 2], K[0, 1], lens, external]
    split = [name.partition(".") for name in found.rig.covariance_parameters]
    return np.array([each[device][DEVICE_PARAMETERS.index(name)] for device, _, name in split])


def nees(found, rig=None):
    """Normalised estimation error squared over its degrees of freedom."""
    error = errors(found, rig)
    return float(error @ np.linalg.solve(found.rig.covariance, error)) / len(error)


def altered(item, view, camera, change):
    """Observations with the points of one image replaced by `change` of them."""
    views = list(item.views)
    points = views[view].cameras[camera]
    views[view] = replace(views[view], cameras={**views[view].cameras, camera: change(points)})
    return replace(item, views=tuple(views))


def warnings(found):
    return [finding.warning for finding in found.findings if finding.warning]


def finding(found, quantity):
    return next(item for item in found.findings if item.quantity == quantity)
