"""Does the calibration still hold? From measurements and captures to the verdict, one line per stage."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from planish.measurement import Measurement
from planish.pipeline.measuring import MeasureOptions, measure, observe_capture
from planish.sensing.capture.manifest import Capture
from planish.sensing.patterns.encode import axis_of
from planish.sensing.rigcheck.adjust import Adjustment, adjust_orientation
from planish.sensing.rigcheck.check import check_rig_by, collect_pairs, usable
from planish.sensing.rigcheck.pairs import PixelPairs
from planish.sensing.rigcheck.positions import pairs_between_cameras, pairs_to_projector
from planish.sensing.rigcheck.result import RigCheck
from planish.sensing.rigcheck.same_rig import common_rig


@dataclass(frozen=True)
class CheckedRig:
    """The verdict about a calibration, and on request another orientation.

    Parameters
    ----------
    check : RigCheck
        The verdict.
    adjustment : Adjustment or None
        None where it was not asked for or no row errors are observable.
    """

    check: RigCheck
    adjustment: Adjustment | None


def check_calibration(
    inputs: Mapping[str, Measurement | Capture],
    adjust: bool = False,
    threads: int | None = None,
    rig_files: Sequence[Path] | None = None,
) -> CheckedRig:
    """Return whether the calibration of one sensor still holds, by all measurements together.

    Parameters
    ----------
    inputs : mapping of Measurement or Capture
        By the names that messages shall use. A capture is measured first; where both projector axes were projected, it
        tells more than its measurement: without texture, everywhere.
    adjust : bool
        Whether to estimate the relative orientation again.
    threads : int or None
        Number of threads; the result does not depend on it.
    rig_files : sequence of Path or None
        Calibration for the captures instead of their own.

    Raises
    ------
    InputError
        Where the inputs are not of one rig, or a capture cannot be measured.
    """
    measurements, known = {}, {}
    for name, item in inputs.items():
        if isinstance(item, Measurement):
            measurements[name] = item
            continue
        options = MeasureOptions()
        measurements[name] = measure(item, options, threads, item.load_rig(options.organise_on, rig_files))
        pairs = _by_both_axes(item, measurements[name], options, threads)
        if pairs is not None:
            known[name] = pairs
    pairs_by_name = collect_pairs(measurements, known)
    check = check_rig_by(measurements, pairs_by_name)
    together = usable(pairs_by_name)
    if not adjust or not together or check.status == "not observable":
        return CheckedRig(check, None)
    return CheckedRig(check, adjust_orientation(together, common_rig(measurements)))


def _by_both_axes(
    capture: Capture, measurement: Measurement, options: MeasureOptions, threads: int | None
) -> PixelPairs | None:
    if {axis_of(entry) for entry in capture.manifest.sequence} != {"u", "v"}:
        return None
    seen = observe_capture(capture, options, threads, measurement.rig)
    own = measurement.organised_on
    other = next((name for name in seen if name != own), None)
    if other is None:
        return pairs_to_projector(measurement, seen[own].phases)
    return pairs_between_cameras(measurement, seen[own].phases, seen[other].phases)
