"""The answer to whether a calibration still holds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from planish.geometry import Array
from planish.measurement import Finding

Status = Literal["holds", "does not hold", "not observable"]


@dataclass(frozen=True)
class MeasurementRows:
    """Row errors of one measurement.

    Parameters
    ----------
    name, source : str
        The measurement, and what its row errors come from.
    device : str
        Device in whose pixels they count.
    searched : int
        Number of places that were looked at.
    mean_px, sigma_px, variation_px : float or None
        Mean row error, its standard deviation, robust standard deviation over the places; None = not observable.
        Positive where camera B, or the projector, has the point at larger rows than the rig says.
    own_px : ndarray (n, 2)
        Pixels of the organising camera at which a row error is known.
    error_px, error_sigma_px : ndarray (n,)
        Row errors [px] there.
    stored : tuple of Finding
        What the measurement's file says about its rig by other evidence.
    """

    name: str
    source: str
    device: str
    searched: int
    mean_px: float | None
    sigma_px: float | None
    variation_px: float | None
    own_px: Array
    error_px: Array
    error_sigma_px: Array
    stored: tuple[Finding, ...]


@dataclass(frozen=True)
class OrientationError:
    """What the relative orientation would have to change by to explain the row errors.

    Parameters
    ----------
    moved, fixed : str
        Device whose orientation is in question, and the one it stands against.
    names : tuple of str
        The five changes (planish.sensing.rigcheck.orientation.CHANGES).
    change_rad : ndarray (5,)
        Estimate from the row errors alone.
    covariance : ndarray (5, 5)
        Its covariance by noise and by what the check itself may be wrong.
    sigmas : float
        Its significance against noise and the patterns that lenses make.
    moves_mm : float
        Root mean square of what this change moves the points by [mm].
    unseen_mm : float
        The same of its covariance: what row errors cannot tell.
    unseen_name : str
        The change that contributes most to it.
    """

    moved: str
    fixed: str
    names: tuple[str, ...]
    change_rad: Array
    covariance: Array
    sigmas: float
    moves_mm: float
    unseen_mm: float
    unseen_name: str


@dataclass(frozen=True)
class RigCheck:
    """Whether a calibration still holds, by all measurements together.

    Parameters
    ----------
    status : "holds", "does not hold" or "not observable"
        The verdict.
    reason : str
        Why, in one sentence.
    measurements : tuple of MeasurementRows
        One per measurement.
    mean_px, sigma_px : float or None
        Mean row error over all places and its standard deviation; None where row errors are not observable.
    variation_px : float or None
        Standard deviation of its slow pattern over the image.
    rms_px, rms_sigma_px : float or None
        Root mean square of that pattern, and its standard deviation.
    noise_sigmas : float or None
        Significance against noise.
    rig_sigmas : float or None
        Significance against noise and what the rig's covariance allows; None where the rig states none.
    allowed_px : float
        Row error (rms) that the rig's covariance allows, or the limit for rigs without one.
    row_mm : float or None
        What a pixel of row error is at the points' distance [mm / px].
    distance_mm : float or None
        Median distance of the points from the organising camera.
    orientation : OrientationError or None
        None where row errors are not observable.
    unexplained_px, unexplained_sigmas : float or None
        Root mean square of the pattern that no orientation explains, and its significance.
    not_observable : tuple of str
        What these measurements cannot tell at all.
    advice : tuple of str
        What to do.
    """

    status: Status
    reason: str
    measurements: tuple[MeasurementRows, ...]
    mean_px: float | None
    sigma_px: float | None
    variation_px: float | None
    rms_px: float | None
    rms_sigma_px: float | None
    noise_sigmas: float | None
    rig_sigmas: float | None
    allowed_px: float
    row_mm: float | None
    distance_mm: float | None
    orientation: OrientationError | None
    unexplained_px: float | None
    unexplained_sigmas: float | None
    not_observable: Sequence[str]
    advice: Sequence[str]
