"""What an adjustment is worth: views left out, shape of the board, scale; covariance and result."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.stats import chi2

from planish.geometry import Array, transform_points
from planish.measurement import Finding
from planish.sensing.calibrate.adjust.geometry_checks import weak_geometry
from planish.sensing.calibrate.adjust.heights import misplaced_points
from planish.sensing.calibrate.adjust.left_out import covariance_factor, leave_out
from planish.sensing.calibrate.adjust.robust import Adjusted
from planish.sensing.calibrate.adjust.scale import scale_of
from planish.sensing.calibrate.adjust.shape import shape_of
from planish.sensing.calibrate.adjust.stages import misfit
from planish.sensing.calibrate.observations import BoardObservations
from planish.sensing.calibrate.result import Calibration, LensModel, Residuals

#: Left-out views are worse than predicted where chance explains them with less than this probability.
CHANCE = 1e-3


def conclude(
    observations: BoardObservations,
    item: Adjusted,
    models: Mapping[str, LensModel],
    findings: tuple[Finding, ...],
    options: dict[str, Any],
) -> Calibration:
    """Return the result of a calibration.

    Parameters
    ----------
    observations : BoardObservations
        What it rests on.
    item : Adjusted
        The adjustment of everything.
    models : mapping of LensModel
        Per device.
    findings : tuple of Finding
        What was found on the way.
    options : dict
        Options of the run, for the result.
    """
    dropped = tuple(
        misfit(observations, item.problem.views[view], item.problem.blocks[block].device)
        for block, view in item.dropped
    )
    left_out = leave_out(item)
    factor, told_factor = _factor(item)
    shape = shape_of(item, observations.board)
    scale = scale_of(observations.board, item.problem.points_board)
    covariance = factor * item.covariance()[: len(item.free.names), : len(item.free.names)]
    translation = _translation(item)
    for change in (*(bias[: len(covariance)] for bias in shape.bias), scale.sigma * translation):
        covariance = covariance + np.outer(change, change)
    state = item.state
    rig = replace(
        state.rig.changed(scale.value * translation, item.free.names),
        covariance=covariance, covariance_parameters=item.free.names,
    )  # fmt: skip
    views = np.flatnonzero(item.problem.covered)
    places = state.T_sensor_board.copy()
    places[:, :3, 3] += scale.value * places[:, :3, 3]
    return Calibration(
        rig=rig,
        observations=observations,
        T_A_board={item.problem.views[v]: places[v] for v in views},
        residuals=residuals_of(item),
        noise_px={name: float(item.noise[name]) * _stated(item, name) for name in item.problem.devices},
        models=dict(models),
        left_out_rms_px={name: left_out.rms_px(name) for name in item.problem.devices},
        scale=(scale.value, scale.sigma),
        height_mm=_heights(item),
        findings=(
            *findings,
            *dropped,
            *weak_geometry(item),
            told_factor,
            misplaced_points(item, observations.board),
            *shape.findings,
            *scale.findings,
        ),
        options=options,
    )


def residuals_of(item: Adjusted) -> tuple[Residuals, ...]:
    """Return the residuals per view and device."""
    found = []
    points = item.problem.points_board
    if item.free.modes:
        points = points + np.tensordot(item.state.amplitudes, item.problem.modes, 1)
    for block, line, outlier in zip(item.problem.blocks, item.solution.lines, item.outlier, strict=True):
        for row, v in enumerate(line.rows):
            index = np.flatnonzero(block.seen[v])
            adjusted = item.state.devices[block.device].project(
                transform_points(item.state.T_sensor_board[v], points[index])
            )
            found.append(Residuals(
                item.problem.views[v], block.device, block.through, index, adjusted,
                line.residual_px[row, index], outlier[v, index],
            ))  # fmt: skip
    return tuple(sorted(found, key=lambda r: (item.problem.views.index(r.view), r.device, r.through or "")))


def _factor(item: Adjusted) -> tuple[float, Finding]:
    """Factor on the covariance by what left-out views say, at least 1."""
    factor, dof = covariance_factor(item.solution)
    sure = chi2.sf(factor * dof, dof) < CHANCE and factor > 1
    told = (
        f"left-out boards are {np.sqrt(factor):.2f} times as far off as noise explains: the covariance is enlarged by "
        f"{factor:.2f}. "
        "Causes are a board that is not flat, rigid or as stated, one that moved, or a lens model that is too simple"
    )
    source = f"chi-square over degrees of freedom ({dof}) of each view against the adjustment without it"
    finding = Finding(
        "misfit of left-out boards against the covariance", factor, float(np.sqrt(2 / max(dof, 1))), "", source
    )
    return (factor, replace(finding, warning=told)) if sure else (1.0, finding)


def _translation(item: Adjusted) -> Array:
    """Change (n,) of the parameters per relative change of all lengths."""
    change = np.zeros(len(item.free.names))
    for k, name in enumerate(item.free.names):
        device, _, parameter = name.partition(".")
        if parameter.startswith("translation_"):
            change[k] = item.state.devices[device].T_camera_sensor["xyz".index(parameter[-1]), 3]
    return change


def _stated(item: Adjusted, device: str) -> float:
    """Root mean square of the stated sigma [px]."""
    sigma = np.concatenate([block.sigma_px[block.seen] for block in item.problem.blocks_of(device)])
    return float(np.sqrt((sigma**2).mean()))


def _heights(item: Adjusted) -> Array | None:
    if not item.free.modes:
        return None
    return -np.tensordot(item.state.amplitudes, item.problem.modes, 1)[:, 2]
