"""The result of a calibration: the rig with its covariance, and everything a reader needs to judge it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from planish.geometry import Array
from planish.measurement import Finding
from planish.rig import Rig
from planish.sensing.calibrate.observations import BoardObservations, Index


@dataclass(frozen=True)
class Residuals:
    """Observed less adjusted position of the points of one view in one device.

    Parameters
    ----------
    view, device : str
        Names; device "A", "B" or "projector".
    through : str or None
        For the projector: the camera through whose image it was decoded.
    index : ndarray (n,) int
        Which points of the board.
    pixel_px : ndarray (n, 2)
        Adjusted position in the device [px].
    residual_px : ndarray (n, 2)
        Observed less adjusted [px].
    outlier : ndarray (n,) bool
        Points that the adjustment left out.
    """

    view: str
    device: str
    through: str | None
    index: Index
    pixel_px: Array
    residual_px: Array
    outlier: NDArray[np.bool_]

    @property
    def rms_px(self) -> float:
        """Root mean square of the length of the residuals (2-D) that count [px]; NaN without any."""
        kept = self.residual_px[~self.outlier]
        return float(np.sqrt((kept**2).sum(1).mean())) if len(kept) else float("nan")


@dataclass(frozen=True)
class LensModel:
    """The distortion model of one device and how it was chosen.

    Parameters
    ----------
    name : str
        "none", "radial", "radial + tangential", ...
    coefficients : tuple of str
        Names of the free ones (planish.rig.parameters.DISTORTION).
    left_out_rms_px : mapping of float
        Per model tried: rms (2-D) of boards that were left out of the fit [px].
    sentence : str
        Why this one.
    """

    name: str
    coefficients: tuple[str, ...]
    left_out_rms_px: Mapping[str, float]
    sentence: str


@dataclass(frozen=True)
class Calibration:
    """A rig with its covariance, and what it rests on.

    Parameters
    ----------
    rig : Rig
        In the frame of camera A; its covariance includes the uniform scale.
    observations : BoardObservations
        What it was adjusted to.
    T_A_board : mapping of ndarray (4, 4)
        Per view, the board in the frame of camera A [mm].
    residuals : tuple of Residuals
        Per view and device.
    noise_px : mapping of float
        Per device, the standard deviation of one coordinate of one point [px], found by the adjustment.
    models : mapping of LensModel
        Per device.
    left_out_rms_px : mapping of float
        Per device, rms (2-D) over all views, each seen by a rig adjusted without it (only its place was fitted) [px].
    scale : tuple of float
        Uniform scale against the board file's pitch, and its standard deviation (both as a share of 1).
    height_mm : ndarray (N,) or None
        Estimated height of the board's points out of their plane [mm] (+: towards the sensor), where asked for.
    findings : tuple of Finding
        What the boards say about themselves: pitch ratio, bending, scale, left-out boards, ...
    options : dict
        Options of the run.
    """

    rig: Rig
    observations: BoardObservations
    T_A_board: Mapping[str, Array]
    residuals: tuple[Residuals, ...]
    noise_px: Mapping[str, float]
    models: Mapping[str, LensModel]
    left_out_rms_px: Mapping[str, float]
    scale: tuple[float, float]
    height_mm: Array | None
    findings: tuple[Finding, ...]
    options: dict[str, Any] = field(default_factory=dict)

    def rms_px(self, device: str) -> float:
        """Root mean square (2-D) of a device's residuals that count [px]."""
        squares = [(r.residual_px[~r.outlier] ** 2).sum(1) for r in self.residuals if r.device == device]
        return float(np.sqrt(np.concatenate(squares).mean()))
