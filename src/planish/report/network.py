"""What the report and the command line say of the network: loops, drift, weak ties, what was given from outside."""

from __future__ import annotations

from html import escape

from planish.evaluation.table import NONE, number
from planish.registration.network.summary import Loop, NetworkSummary
from planish.report.html import html_table
from planish.report.text import count

#: Rows of a table in the report; the rest is in registration.json.
MOST_ROWS = 12
#: Standard deviations beyond which a closure is remarkable.
FAR = 3.0
#: Names of a loop that are written out.
MOST_NAMES = 5


def network_lines(network: NetworkSummary) -> list[str]:
    """Return the sentences of the command line: loops, drift, and all that must not be overlooked."""
    return [*_closures(network), *_drifts(network), *network.warnings]


def network_section(network: NetworkSummary) -> str:
    """Return the section on the network, or nothing where no two measurements are tied together."""
    if not network.ties and not network.advice:
        return ""
    sentences = "".join(f"<p>{escape(s)}</p>" for s in [*_closures(network), *_drifts(network)])
    warnings = "".join(f'<p class="warn">{escape(s)}</p>' for s in network.warnings)
    return (
        "<h2>Network</h2>" + sentences + warnings + _loop_table(network) + _tie_table(network) + _given_table(network)
    )


def _closures(network: NetworkSummary) -> list[str]:
    if not network.loops:
        return ["No loop of pairs: nothing checks them against each other."] if network.ties else []
    worst = max(network.loops, key=lambda loop: loop.closure_mm)
    beyond = sum(loop.sigma > FAR for loop in network.loops)
    return [
        f"Closure of {count(len(network.loops), 'loop')}: at most {worst.closure_mm:.4f} mm (predicted "
        f"{worst.predicted_mm:.4f} mm: {_walk(worst)}); {beyond or 'none'} beyond {FAR:g} standard deviations. The "
        f"adjustment leaves at most {max(loop.adjusted_mm for loop in network.loops):.4f} mm in a pair."
    ]


def _drifts(network: NetworkSummary) -> list[str]:
    far = [place for place in network.places if place.pairs_from_reference]
    if not far:
        return []
    last = max(far, key=lambda place: (place.chain_sigma_mm, place.name))
    return [
        f"Drift: a chain of pairs alone puts {last.name}, {last.pairs_from_reference} from the reference, "
        f"{last.chain_mm:.4f} mm from its adjusted place (predicted {last.chain_sigma_mm:.4f} mm); adjusted, its "
        f"standard deviation is {last.sigma_mm:.4f} mm."
    ]


def _walk(loop: Loop) -> str:
    names = loop.measurements
    if len(names) <= MOST_NAMES:
        return " - ".join(names)
    return " - ".join((*names[: MOST_NAMES - 1], "...", names[-1])) + f" ({len(names)} measurements)"


def _loop_table(network: NetworkSummary) -> str:
    if not network.loops:
        return ""
    worst = sorted(network.loops, key=lambda loop: (-loop.sigma, loop.measurements))[:MOST_ROWS]
    rows = [
        (
            _walk(loop), number(loop.closure_mm, 4), number(loop.predicted_mm, 4), number(loop.closure_rad, 4, 1000),
            number(loop.sigma, 2), number(loop.adjusted_mm, 4),
        )
        for loop in worst
    ]  # fmt: skip
    columns = (
        ("loop", ""), ("closure", "mm"), ("predicted", "mm"), ("closure", "mrad"), ("sigma", ""),
        ("largest residual after adjustment", "mm"),
    )  # fmt: skip
    return f"<h3>Loops, worst of {len(network.loops)}</h3>" + html_table(columns, rows)


def _tie_table(network: NetworkSummary) -> str:
    weak = sorted(network.ties, key=lambda tie: (tie.redundancy, tie.a, tie.b))[:MOST_ROWS]
    if not weak:
        return ""
    rows = [
        (
            f"{tie.a}, {tie.b}", number(tie.redundancy, 0, 100),
            NONE if tie.detectable_mm is None else number(tie.detectable_mm), number(tie.residual_mm, 4),
        )
        for tie in weak
    ]  # fmt: skip
    columns = (("pair", ""), ("checked by others", "%"), ("least error noticed", "mm"), ("residual", "mm"))
    return f"<h3>Pairs, least checked of {len(network.ties)}</h3>" + html_table(columns, rows)


def _given_table(network: NetworkSummary) -> str:
    if not network.given:
        return ""
    chosen = sorted(network.given, key=lambda t: (t.used, -t.sigma, t.kind, t.measurement, t.target or ""))[:MOST_ROWS]
    rows = [
        (
            t.kind, t.measurement, t.target or "", number(t.residual_mm), number(t.sigma, 2),
            number(t.redundancy, 0, 100), "used" if t.used else t.reason or "",
        )
        for t in chosen
    ]  # fmt: skip
    columns = (
        ("given", ""), ("measurement", ""), ("target", ""), ("against all others", "mm"), ("sigma", ""),
        ("checked by others", "%"), ("", ""),
    )  # fmt: skip
    return f"<h3>Given from outside, most contradicting of {len(network.given)}</h3>" + html_table(columns, rows)
