"""The report: self-contained, complete, escaped, and drawn by a real browser."""

from __future__ import annotations

import re
import shutil
import subprocess
from dataclasses import replace

import numpy as np
import pytest

import registered
from planish.registration.result import Registration
from planish.report import write_report
from planish.report.scene import MAX_POINTS, grid_step
from planish.report.style import nice_limit
from planish.report.text import verdict

#: A report of five full-size measurements must still go by mail; this small one must stay far below.
MAX_BYTES = 12e6
BROWSER = next((p for p in map(shutil.which, ("chromium", "chromium-browser", "google-chrome")) if p), None)


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    items, _ = registered.prepared()
    result, evaluations = registered.registration()
    return write_report(result, items, evaluations, tmp_path_factory.mktemp("report"))


def test_the_page_needs_nothing_from_outside(page):
    text = page.read_text(encoding="utf-8")
    head = text[: text.index('<script type="application/json"')]
    assert not re.findall(r'(?:src|href)="(?!data:)', head)
    assert "@import" not in head
    assert not re.findall(r"<script[^>]+src=", text)
    assert page.stat().st_size < MAX_BYTES


def test_the_page_says_what_was_accepted_and_why_not(page):
    text = page.read_text(encoding="utf-8")
    assert "3 of 4 measurements are tied together." in text
    assert "2 pairs accepted, 4 refused." in text
    assert "positive where b is nearer" in text
    assert text.count("5 of 143 matches agree") == 4


def test_names_and_reasons_are_escaped(page):
    text = page.read_text(encoding="utf-8")
    assert "other &lt;part&gt;" in text
    assert "<as many" not in text
    head = text[: text.index('<script type="application/json"')]
    assert "other <part>" not in head


def test_figures_are_png_files(page):
    figures = sorted(p.name for p in (page.parent / "figures").iterdir())
    pairs = ("left_middle", "middle_right")
    assert figures == sorted(["overview.png", *[f"{k}_{p}.png" for k in ("histogram", "matches") for p in pairs]])
    assert all((page.parent / "figures" / n).read_bytes().startswith(b"\x89PNG\r\n") for n in figures)


def test_the_same_run_gives_the_same_page_for_any_number_of_threads(page, tmp_path):
    items, _ = registered.prepared()
    result, evaluations = registered.registration()
    assert write_report(result, items, evaluations, tmp_path, threads=1).read_bytes() == page.read_bytes()


def test_a_run_in_which_nothing_was_accepted_has_a_report_too(tmp_path):
    items, _ = registered.prepared()
    result, _ = registered.registration()
    name = registered.NAMES[3]
    alone = Registration(result.groups[1:], result.measurements[3:], (), {}, {})
    text = write_report(alone, {name: items[name]}, [], tmp_path).read_text(encoding="utf-8")
    assert "No measurement could be tied to another one." in text
    assert "No pair was accepted." in text


def test_the_verdict_names_what_stands_alone():
    result, _ = registered.registration()
    kind, sentences = verdict(result)
    assert kind == "partial"
    assert "Not tied in: other <part>." in sentences
    whole = replace(result, groups=result.groups[:1], measurements=result.measurements[:3])
    assert verdict(whole)[1][0] == "All 3 measurements are tied into one part."


@pytest.mark.parametrize("shape", [(1038, 1388), (2048, 2448), (10, 10), (1, 90_000)])
def test_the_grid_of_the_view_is_as_fine_as_its_limit_allows(shape):
    def points(step):
        return -(-shape[0] // step) * -(-shape[1] // step)

    step = grid_step(shape)
    assert points(step) <= MAX_POINTS
    assert step == 1 or points(step - 1) > MAX_POINTS


def test_limits_of_colour_scales_are_round_numbers():
    assert [nice_limit([v]) for v in (0.011, 0.05, 0.31, 1.2, float("nan"))] == [0.02, 0.05, 0.5, 2.0, 0.01]
    assert np.isclose(nice_limit([0.0, -3.0]), 0.01)


@pytest.mark.skipif(BROWSER is None, reason="no Chromium found: the 3D view is not tried in a browser")
def test_a_browser_draws_the_view_without_errors(page, tmp_path):
    command = [
        BROWSER, "--headless", "--no-sandbox", "--disable-quic", "--no-first-run", "--disable-background-networking",
        "--disable-component-update", "--disable-sync", f"--user-data-dir={tmp_path}", "--use-gl=angle",
        "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--enable-logging=stderr", "--v=0",
        "--virtual-time-budget=4000", "--window-size=900,900", "--dump-dom", page.as_uri(),
    ]  # fmt: skip
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr
    console = [line for line in done.stderr.splitlines() if "CONSOLE" in line]
    assert not [line for line in console if "rror" in line]
    assert 'data-ready="yes"' in done.stdout
    assert "gl-canvas" in done.stdout or "gl-container" in done.stdout
    assert done.stdout.count("data-measurement=") == 4
