"""The shape of the board as findings: ratio of its pitches, shear, bending."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import chi2

from planish.geometry import Array
from planish.measurement import Finding
from planish.sensing.calibrate.adjust.equations import equations, pseudo_inverse
from planish.sensing.calibrate.adjust.linear import linearise
from planish.sensing.calibrate.adjust.problem import Free, State
from planish.sensing.calibrate.adjust.robust import Adjusted
from planish.sensing.capture.board import Board

#: A shape is reported with a warning where chance gives it with less than this probability ...
CHANCE = 1e-4
#: ... and it is worth naming: shear and pitch ratio, and the bending as a share of the board's length.
WORTH = 1e-4


@dataclass(frozen=True)
class Shape:
    """What the boards say about themselves.

    Parameters
    ----------
    findings : tuple of Finding
        Pitch ratio, shear, bending.
    bias : tuple of ndarray (C,)
        How far each shape that is significant, and not adjusted, moves the parameters.
    """

    findings: tuple[Finding, ...]
    bias: tuple[Array, ...]


def shape_of(item: Adjusted, board: Board) -> Shape:
    """Return what one Gauss-Newton step says about pitch ratio, shear and (where no heights are adjusted) bending."""
    centered = item.problem.points_board - item.problem.center
    x, y = centered[:, 0], centered[:, 1]
    modes = np.zeros((2 if item.free.modes else 5, len(x), 3))
    modes[0, :, 0], modes[0, :, 1] = x / 2, -y / 2
    modes[1, :, 0], modes[1, :, 1] = y / 2, x / 2
    half = np.abs(centered[:, :2]).max(0)
    for k, height in enumerate((x * x / half[0] ** 2, x * y / (half[0] * half[1]), y * y / half[1] ** 2)):
        if not item.free.modes:
            modes[2 + k, :, 2] = -height
    value, covariance, bias = _estimate(item, modes)
    findings = [
        _in_plane("pitch ratio x / y of the board", value[0], covariance[0, 0], _ratio_advice(board, value[0])),
        _in_plane(
            "shear of the board", value[1], covariance[1, 1], "its rows and columns are not square to each other"
        ),
    ]
    biases = [bias[k] for k in range(2) if findings[k].warning]
    if not item.free.modes:
        bending = _bending(value[2:], covariance[2:, 2:], half)
        findings.append(bending)
        biases += [value[2:] @ bias_by for bias_by in [bias[2:] / value[2:, None]]] if bending.warning else []
    return Shape(tuple(findings), tuple(biases))


def _estimate(item: Adjusted, modes: Array) -> tuple[Array, Array, Array]:
    """Amplitudes (k,), their covariance, and the change of the parameters (k, C) that each brings."""
    k, state = len(modes), item.state
    base = item.problem.points_board
    if item.free.modes:
        base = base + np.tensordot(state.amplitudes, item.problem.modes, 1)
    problem = replace(item.problem, points_board=base, modes=modes)
    free = Free(item.free.places, k)
    at = State(state.devices, state.T_sensor_board, np.zeros(k))
    lines = [linearise(problem, at, free, block) for block in problem.blocks]
    full = equations(problem, at, free, lines, item.solution.weights)
    S = full.reduced()[0].sum(0) + full.prior
    g = full.reduced()[1].sum(0) + full.prior_g
    C = len(S) - k
    inner = pseudo_inverse(S[:C, :C])
    covariance = pseudo_inverse(S[C:, C:] - S[C:, :C] @ inner @ S[:C, C:])
    value = covariance @ (g[C:] - S[C:, :C] @ inner @ g[:C])
    bias = -(inner @ S[:C, C:]).T * value[:, None]
    return value, covariance, bias


def _in_plane(quantity: str, value: float, variance: float, advice: str) -> Finding:
    sigma = float(np.sqrt(variance))
    sure = value**2 / variance > chi2.isf(CHANCE, 1) and abs(value) > WORTH
    share = 1.0 + value if "ratio" in quantity else float(value)
    told = f"{quantity}: {100 * value:+.4f} +- {100 * sigma:.4f} %"
    warning = f"{told} off the board file: {advice}; it is not corrected" if sure else ""
    return Finding(quantity, float(share), sigma, "", "one further step of the adjustment with it free", warning)


def _ratio_advice(board: Board, ratio: float) -> str:
    x, y = board.pitches_mm
    return (
        f"measure the board along both sides and state both pitches, for example 'pitch_mm': "
        f"[{x * (1 + ratio / 2):.5g}, {y * (1 - ratio / 2):.5g}]"
    )


def _bending(value: Array, covariance: Array, half_mm: Array) -> Finding:
    """Sagitta over the board's length in the direction of its strongest bending, signed: + = middle to the sensor."""
    sagitta, length = _sagitta(value, half_mm)
    gradient = np.array([
        (_sagitta(value + step, half_mm)[0] - _sagitta(value - step, half_mm)[0]) / (2 * np.linalg.norm(step))
        for step in 1e-4 * np.sqrt(np.diag(covariance).max()) * np.eye(3)
    ])  # fmt: skip
    sigma = float(np.sqrt(gradient @ covariance @ gradient))
    chi = float(value @ np.linalg.solve(covariance, value))
    told = f"the board is bent by {abs(sagitta):.3g} +- {sigma:.2g} mm (sagitta over {length:.0f} mm)"
    sure = chi > chi2.isf(CHANCE, 3) and abs(sagitta) > WORTH * length
    warning = (
        f"{told}: use a flatter board, or ask for its flatness to be estimated; it is not corrected" if sure else ""
    )
    source = (
        f"one further step of the adjustment with it free; sagitta over {length:.0f} mm, +: middle towards the sensor"
    )
    return Finding("bending of the board", sagitta, sigma, "mm", source, warning)


def _sagitta(value: Array, half_mm: Array) -> tuple[float, float]:
    # Height h = x' Q x over the plane; along a unit vector e the chord of length L has the sagitta -e' Q e (L / 2)^2.
    a, b, c = value / np.array([half_mm[0] ** 2, half_mm[0] * half_mm[1], half_mm[1] ** 2])
    values, vectors = np.linalg.eigh(np.array([[a, b / 2], [b / 2, c]]))
    reach = 1 / np.abs(vectors / half_mm[:, None]).max(0)
    each = -values * reach**2
    strongest = int(np.abs(each).argmax())
    return float(each[strongest]), float(2 * reach[strongest])
