"""Takes the errors of fringes that are no cosine out of what a camera saw (sensing/waveform/gamma.py)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from planish.measurement import Finding
from planish.sensing.capture.sequence import AxisCode
from planish.sensing.observe import Observation
from planish.sensing.waveform.gamma import WaveError, estimate_wave_error, without_wave_error


def straighten(observation: Observation, codes: Sequence[AxisCode], camera: str) -> Observation:
    """Return what a camera saw without the error in its positions, where there is one, and with what was found."""
    phases, findings = dict(observation.phases), list(observation.findings)
    for code in codes:
        if not code.periods or code.axis not in phases:
            continue
        finest = code.periods[-1]
        error = estimate_wave_error(phases[code.axis], finest.period_px, len(finest.images))
        findings.append(_finding(error, camera, code.axis))
        if error is not None and error.significant:
            phases[code.axis] = without_wave_error(phases[code.axis], error, finest.period_px)
    return replace(observation, phases=phases, findings=tuple(findings))


def _finding(error: WaveError | None, camera: str, axis: str) -> Finding:
    """Return what is to be said of the error."""
    quantity = f"phase error by the fringes' wave form in camera {camera}, axis {axis}"
    if error is None:
        return Finding(quantity, None, None, "rad", "too few phases on smooth surfaces")
    use = "corrected" if error.significant else "not significant"
    source = f"ripple of the phases, {error.steps} cycles per period, {use}"
    return Finding(quantity, error.amplitude_rad, error.amplitude_sigma_rad, "rad", source)
