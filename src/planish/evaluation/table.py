"""The result tables, in the form of the starting paper's, as rows of text for the command line and the report."""

from __future__ import annotations

from planish.evaluation.result import Evaluation
from planish.registration.result import PairResult, Registration

#: Columns of `pair_rows`: name and unit.
PAIR_COLUMNS = (
    ("pair", ""),
    ("matches", ""),
    ("consensus", ""),
    ("overlap", "%"),
    ("min", "mm"),
    ("max", "mm"),
    ("rms normal", "mm"),
    ("rms along (noise)", "mm"),
)

#: Columns of `truth_pair_rows`.
TRUTH_PAIR_COLUMNS = (
    ("pair", ""),
    ("true overlap", "%"),
    ("rotation", "mrad"),
    ("along", "mm"),
    ("normal", "mm"),
    ("NEES / 6", ""),
)

#: Columns of `truth_measurement_rows`.
TRUTH_MEASUREMENT_COLUMNS = (("measurement", ""), ("along", "mm"), ("normal", "mm"), ("NEES / 6", ""))

NONE = "–"


def number(value: float | None, digits: int = 3, scale: float = 1.0, sign: bool = False) -> str:
    """Return a number with fixed digits, or a dash."""
    return NONE if value is None else f"{value * scale:{'+' if sign else ''}.{digits}f}"


def pair_rows(registration: Registration) -> list[tuple[str, ...]]:
    """Return the rows of the accepted pairs (PAIR_COLUMNS)."""
    return [_pair_row(pair) for pair in registration.pairs if pair.status == "accepted"]


def _pair_row(pair: PairResult) -> tuple[str, ...]:
    error = pair.overlap_error
    head = (f"{pair.a}, {pair.b}", str(pair.matches), str(pair.consensus), number(pair.overlap, 0, 100))
    if error is None:
        return (*head, NONE, NONE, NONE, NONE)
    along = number(error.rms_tangential_mm)
    if error.sigma_tangential_mm is not None:
        along += f" ({number(error.sigma_tangential_mm)})"
    return (
        *head,
        number(error.min_mm, sign=True),
        number(error.max_mm, sign=True),
        number(error.rms_normal_mm),
        along,
    )


def truth_pair_rows(evaluation: Evaluation) -> list[tuple[str, ...]]:
    """Return the errors of the pairs against truth (TRUTH_PAIR_COLUMNS)."""
    return [
        (
            f"{p.a}, {p.b}",
            number(p.overlap, 0, 100),
            number(p.rotation_error_rad, 3, 1000),
            number(p.tangential_rms_mm, 4),
            number(p.normal_rms_mm, 4),
            number(p.nees, 2, 1 / 6),
        )
        for p in evaluation.pairs
    ]


def truth_measurement_rows(evaluation: Evaluation) -> list[tuple[str, ...]]:
    """Return the errors of the measurements' places against truth (TRUTH_MEASUREMENT_COLUMNS)."""
    return [
        (m.name, number(m.tangential_rms_mm, 4), number(m.normal_rms_mm, 4), number(m.nees, 2, 1 / 6))
        for m in evaluation.measurements
    ]
