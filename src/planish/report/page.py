"""`report.html`: verdict, 3D view, tables and pictures in one file that needs no network."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from html import escape
from pathlib import Path

from plotly.offline import get_plotlyjs

from planish.evaluation.overlap import OverlapEvaluation
from planish.evaluation.prepared import Prepared
from planish.evaluation.result import Evaluation
from planish.measurement import Measurement
from planish.options import thread_count
from planish.registration.result import PairResult, Registration
from planish.report import text
from planish.report.figures import matches_png
from planish.report.histogram import histogram_png
from planish.report.html import asset, details, figure, figure_name, html_page
from planish.report.network import network_section
from planish.report.overview import overview_png
from planish.report.pairs import pairs_section, pictures_inside
from planish.report.scene import Scene, draw, plan_scene, sample
from planish.report.sections import (
    measurements_section,
    overlap_section,
    refused_section,
    truth_section,
    view_section,
)
from planish.report.style import save_bytes
from planish.report.view3d import view_data


def write_report(
    registration: Registration,
    measurements: Mapping[str, Measurement | Prepared],
    evaluations: Sequence[OverlapEvaluation],
    out: Path,
    truth: Evaluation | None = None,
    threads: int | None = None,
) -> Path:
    """Write `report.html` and `figures/*.png` to the folder `out` and return the path of the page.

    Parameters
    ----------
    registration : Registration
        The result; its pairs carry the matches to be drawn (`matches_px`, `consensus_px`).
    measurements : mapping of Measurement or Prepared
        All measurements by name.
    evaluations : sequence of OverlapEvaluation
        One per accepted pair.
    out : Path
        Folder; made where it is missing.
    truth : Evaluation or None
        Errors against truth, shown where given.
    threads : int or None
        Number of threads.
    """
    prepared = {name: Prepared.of(item, threads) for name, item in measurements.items()}
    plan = plan_scene(registration, {name: sample(item) for name, item in prepared.items()})
    items = []
    for index, placed in enumerate(registration.measurements):
        name = placed.name
        distances = {(e.a, e.b): e.distance_mm for e in evaluations if e.b == name}
        distances |= {(e.a, e.b): e.distance_of_a_mm for e in evaluations if e.a == name}
        items.append(draw(placed, index, plan, prepared[name], distances))
    return write_scene(Scene(registration, plan, tuple(items)), out, truth, threads)


def write_scene(
    scene: Scene,
    out: Path,
    truth: Evaluation | None = None,
    threads: int | None = None,
    with_matches: Callable[[PairResult], PairResult] = lambda pair: pair,
) -> Path:
    """Write `report.html` and `figures/*.png` of what has been drawn.

    `with_matches` returns a pair with the matches to be drawn; the rest is as in `write_report`.
    """
    shown = _write_pictures(scene, Path(out) / "figures", thread_count(threads), with_matches)
    path = Path(out) / "report.html"
    save_bytes(path, _page(scene, shown, truth).encode("utf-8"))
    return path


def _write_pictures(
    scene: Scene, folder: Path, threads: int, with_matches: Callable[[PairResult], PairResult]
) -> dict[str, bytes]:
    """Write all pictures and return those that the page shows."""
    items = {item.name: item for item in scene.items}
    jobs: dict[str, Callable[[], bytes]] = {"overview.png": partial(overview_png, scene)}

    def matches(pair: PairResult) -> bytes:
        return matches_png(with_matches(pair), items[pair.a], items[pair.b])

    for pair in scene.registration.pairs:
        # Of a refused pair only a consensus is worth a picture.
        if pair.status != "refused" or pair.T_coarse_a_b is not None:
            jobs[figure_name("matches", pair)] = partial(matches, pair)
        if pair.a in items[pair.b].histograms:
            histogram = items[pair.b].histograms[pair.a]
            jobs[figure_name("histogram", pair)] = partial(histogram_png, histogram, items[pair.b].index)
    inside = {"overview.png", *pictures_inside(scene.registration)}
    shown: dict[str, bytes] = {}

    def write(name: str) -> None:
        content = jobs[name]()
        save_bytes(folder / name, content)
        if name in inside:
            shown[name] = content

    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(write, jobs))
    return shown


def _page(scene: Scene, pictures: Mapping[str, bytes], truth: Evaluation | None) -> str:
    registration = scene.registration
    kind, sentences = text.verdict(registration)
    summary = "".join(f"<p>{escape(s)}</p>" for s in sentences)
    body = [
        "<h1>Registration report</h1>",
        f'<p class="muted">{escape(_subtitle(registration))}</p>',
        f'<div class="summary {kind}">{summary}</div>',
        '<h2>Overview</h2>',
        figure(pictures["overview.png"], "The largest group, seen orthographically.", 860),
        measurements_section(scene),
        "<h2>3D view</h2>",
        view_section(registration),
        "<h2>Overlap error</h2>",
        overlap_section(registration),
        truth_section(truth) if truth is not None else "",
        "<h2>Pairs</h2>",
        pairs_section(registration, pictures),
        refused_section(registration),
        network_section(registration.network),
        "<h2>Options and versions</h2>",
        details("options of this run", registration.options),
        details("versions", registration.versions),
    ]  # fmt: skip
    data = json.dumps(view_data(scene), separators=(",", ":"), allow_nan=False).replace("</", "<\\/")
    scripts = (
        f'<script type="application/json" id="view-data">{data}</script>',
        f"<script>{get_plotlyjs()}</script>",
        f"<script>{asset('view.js')}</script>",
    )
    return html_page("Registration report", body, scripts)


def _subtitle(registration: Registration) -> str:
    version = registration.versions.get("planish")
    return f"planish {version}, all lengths in millimetres" if version else "planish, all lengths in millimetres"
