"""The parameters of a calibrated rig with their standard deviations, as tables."""

from __future__ import annotations

from collections.abc import Callable
from html import escape

import numpy as np

from planish.geometry import Array, log_so3
from planish.report.calibration.numbers import significant, with_sigma
from planish.report.html import html_table
from planish.rig import Camera, Rig
from planish.rig.parameters import DEVICE_PARAMETERS, DISTORTION, INTRINSICS
from planish.sensing.calibrate.judge.advice import device_title
from planish.sensing.calibrate.judge.views import depths_mm
from planish.sensing.calibrate.result import Calibration

#: Quantities of the place of one device, in the order of `place_of`, with their units.
PLACE = (
    ("projection centre x", "mm"), ("projection centre y", "mm"), ("projection centre z", "mm"),
    ("distance from that of camera A", "mm"), ("angle between the axes", "°"),
    ("rotation about x", "°"), ("rotation about y", "°"), ("rotation about z", "°"),
)  # fmt: skip


def parameter_tables(calibration: Calibration) -> str:
    """Return inner parameters and places of the devices as tables."""
    rig = calibration.rig
    parts = [inner_table(rig), _field_table(calibration)]
    if len(rig.devices) > 1:
        parts.append(place_table(rig))
    return "".join(parts)


def inner_table(rig: Rig) -> str:
    """Return the inner parameters of all devices: those that were estimated or differ from zero."""
    sigma = {}
    if rig.covariance is not None:
        sigma = dict(zip(rig.covariance_parameters, np.sqrt(np.diag(rig.covariance)), strict=True))
    rows = []
    for k, name in enumerate((*INTRINSICS, *DISTORTION)):
        values = {device: inner_values(camera)[k] for device, camera in rig.devices.items()}
        known = {device: sigma.get(f"{device}.{name}", 0.0) for device in values}
        if any(known.values()) or any(values.values()):
            cells = [with_sigma(values[d], known[d]) if values[d] or known[d] else ("0", "") for d in values]
            rows.append((f"{name} [px]" if name in INTRINSICS else name, *(c for pair in cells for c in pair)))
    return _grouped("parameter", list(rig.devices), ("value", "sigma"), rows)


def inner_values(camera: Camera) -> Array:
    """Return fx fy cx cy skew and the distortion (17,) of a device."""
    return camera.kernel_parameters[: len(INTRINSICS) + len(DISTORTION)]


def _field_table(calibration: Calibration) -> str:
    depth = depths_mm(calibration)[1]
    rows = []
    for name, camera in calibration.rig.devices.items():
        width, height = camera.size_px
        middle = (np.array([width, height]) - 1) / 2
        ends = np.array([[-0.5, middle[1]], [width - 0.5, middle[1]], [middle[0], -0.5], [middle[0], height - 0.5]])
        rays = camera.rays_sensor(ends)
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        angles = [np.degrees(np.arccos(np.clip(rays[i] @ rays[i + 1], -1, 1))) for i in (0, 2)]
        rows.append((device_title(name), f"{width} x {height}", f"{angles[0]:.1f} x {angles[1]:.1f}",
                     significant(depth / camera.K[0, 0], 3)))  # fmt: skip
    return html_table((("device", ""), ("image", "px"), ("field", "°"), (f"one pixel at {depth:.0f} mm", "mm")), rows)


def place_of(camera: Camera) -> Array:
    """Return the place (8,) of a device in the frame of camera A, in the order and units of PLACE."""
    R, centre = camera.T_camera_sensor[:3, :3], camera.center_sensor
    angle = np.degrees(np.arctan2(np.hypot(R[2, 0], R[2, 1]), R[2, 2]))
    return np.concatenate([centre, [np.linalg.norm(centre), angle], np.degrees(log_so3(R))])


def place_table(rig: Rig) -> str:
    """Return where the other devices are in the frame of camera A, with standard deviations."""
    others = [name for name in rig.devices if name != "A"]
    value = np.array([place_of(rig.devices[name]) for name in others])
    sigma = derived_sigma(rig, lambda item: np.array([place_of(item.devices[name]) for name in others]))
    rows = [
        (f"{name} [{unit}]", *(cell for i in range(len(others)) for cell in with_sigma(value[i, k], sigma[i, k])))
        for k, (name, unit) in enumerate(PLACE)
    ]
    return _grouped("place in the frame of camera A", others, ("value", "sigma"), rows)


def derived_sigma(rig: Rig, quantity: Callable[[Rig], Array]) -> Array:
    """Return the standard deviation of what is computed from a rig, by central differences along the modes."""
    shape = quantity(rig).shape
    squares = [((quantity(rig.changed(mode)) - quantity(rig.changed(-mode))) / 2) ** 2 for mode in rig.modes()]
    return np.sqrt(np.sum(squares, axis=0)) if squares else np.zeros(shape)


def covered_parameters(rig: Rig) -> str:
    """Return in words how many parameters the covariance holds."""
    return f"{len(rig.covariance_parameters)} of {len(DEVICE_PARAMETERS) * len(rig.devices)}"


def _grouped(first: str, groups: list[str], columns: tuple[str, ...], rows: list[tuple[str, ...]]) -> str:
    """Return a table whose columns stand in groups, one per device."""
    top = "".join(f'<th colspan="{len(columns)}" class="group">{escape(device_title(g))}</th>' for g in groups)
    below = "".join(f"<th>{escape(c)}</th>" for _ in groups for c in columns)
    body = "".join("<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in row) + "</tr>" for row in rows)
    return (
        f'<table><thead><tr><th rowspan="2">{escape(first)}</th>{top}</tr><tr>{below}</tr></thead>'
        f"<tbody>{body}</tbody></table>"
    )
