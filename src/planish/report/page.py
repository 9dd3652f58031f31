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
from planish.registration.result import Registration
from planish.report import text
from planish.report.figures import histogram_png, matches_png
from planish.report.html import asset, details, figure, figure_name, html_page
from planish.report.network import network_section
from planish.report.overview import overview_png
from planish.report.pairs import pairs_section
from planish.report.scene import Scene, build_scene
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
    scene = build_scene(registration, prepared, evaluations)
    pictures = _pictures(registration, prepared, evaluations, scene, thread_count(threads))
    for name, content in pictures.items():
        save_bytes(Path(out) / "figures" / name, content)
    path = Path(out) / "report.html"
    save_bytes(path, _page(registration, prepared, scene, pictures, truth).encode("utf-8"))
    return path


def _pictures(
    registration: Registration,
    prepared: Mapping[str, Prepared],
    evaluations: Sequence[OverlapEvaluation],
    scene: Scene,
    threads: int,
) -> dict[str, bytes]:
    by_pair = {(e.a, e.b): e for e in evaluations}
    index = {m.name: i for i, m in enumerate(registration.measurements)}
    jobs: dict[str, Callable[[], bytes]] = {"overview.png": partial(overview_png, scene)}
    for pair in registration.pairs:
        if pair.status != "refused" or len(pair.consensus_px):
            jobs[figure_name("matches", pair)] = partial(matches_png, pair, prepared[pair.a], prepared[pair.b])
        if (pair.a, pair.b) in by_pair:
            jobs[figure_name("histogram", pair)] = partial(histogram_png, by_pair[pair.a, pair.b], index[pair.b])
    for item in prepared.values():
        _ = item.contrast  # computed once here: two threads must not both do it
    with ThreadPoolExecutor(threads) as pool:
        return dict(zip(jobs, pool.map(lambda job: job(), jobs.values()), strict=True))


def _page(
    registration: Registration,
    prepared: Mapping[str, Prepared],
    scene: Scene,
    pictures: Mapping[str, bytes],
    truth: Evaluation | None,
) -> str:
    kind, sentences = text.verdict(registration)
    summary = "".join(f"<p>{escape(s)}</p>" for s in sentences)
    body = [
        "<h1>Registration report</h1>",
        f'<p class="muted">{escape(_subtitle(registration))}</p>',
        f'<div class="summary {kind}">{summary}</div>',
        '<h2>Overview</h2>',
        figure(pictures["overview.png"], "The largest group, seen orthographically.", 860),
        measurements_section(registration, prepared),
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
