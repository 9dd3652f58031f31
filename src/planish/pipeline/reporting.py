"""What is shown of a registration of files: cloud and report, one measurement at a time, on any executor."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from planish.evaluation.overlap import signed_distances
from planish.evaluation.prepared import Prepared
from planish.evaluation.result import Evaluation
from planish.execution.executor import Executor
from planish.execution.libraries import serial_linear_algebra
from planish.geometry import Array, invert
from planish.options import thread_count
from planish.pipeline.registering_files import FileRun, OfViews
from planish.pipeline.stages import View
from planish.registration.result import PlacedMeasurement
from planish.report.page import write_scene
from planish.report.scene import Item, Plan, Sample, Scene, draw, plan_scene, sample


def prepared_files(run: FileRun, threads: int | None = None) -> OfViews[Prepared]:
    """Return the measurements of a run by name with surface and texture, each read and computed when asked for."""
    return OfViews(run.views, lambda view: view.surfaced(threads))


@dataclass(frozen=True)
class Neighbour:
    """An accepted pair (a, b) of a drawn measurement, its T_a_b, and the other measurement."""

    a: str
    b: str
    T_a_b: Array
    other: View


@dataclass(frozen=True)
class Drawing:
    """A measurement to be drawn."""

    view: View
    placed: PlacedMeasurement
    index: int
    plan: Plan
    neighbours: tuple[Neighbour, ...]


def sample_view(view: View, threads: int) -> Sample:
    """Return where a measurement lies."""
    return sample(view.surfaced(threads))


def draw_view(drawing: Drawing, threads: int) -> Item:
    """Return what is shown of a measurement."""
    item, name = drawing.view.surfaced(threads), drawing.placed.name
    distances = {}
    for pair in drawing.neighbours:
        other = pair.other.surfaced(threads)
        # Its own points' distance from the other's surface.
        T = pair.T_a_b if name == pair.b else invert(pair.T_a_b)
        distances[pair.a, pair.b], _ = signed_distances(other, item, T, threads=threads)
    return draw(drawing.placed, drawing.index, drawing.plan, item, distances)


@serial_linear_algebra()
def report_files(run: FileRun, out: Path, executor: Executor, truth: Evaluation | None = None) -> Path:
    """Write `report.html` and `figures/*.png` of a registration of files and return the path of the page."""
    registration = run.registration
    largest = max(registration.groups, key=lambda g: (sum(m.group == g.id for m in registration.measurements), -g.id))
    members = [m.name for m in registration.measurements if m.group == largest.id]
    samples = {members[i]: found for i, found in executor.map(sample_view, [run.views[name] for name in members])}
    plan = plan_scene(registration, samples)
    neighbours: dict[str, list[Neighbour]] = {name: [] for name in run.views}
    for pair in registration.pairs:
        if pair.T_a_b is not None:
            T_a_b = np.asarray(pair.T_a_b)
            for name, other in ((pair.a, pair.b), (pair.b, pair.a)):
                neighbours[name].append(Neighbour(pair.a, pair.b, T_a_b, run.views[other]))
    drawings = [
        Drawing(run.views[placed.name], placed, index, plan, tuple(neighbours[placed.name]))
        for index, placed in enumerate(registration.measurements)
    ]
    items = dict(executor.map(draw_view, drawings))
    scene = Scene(registration, plan, tuple(items[index] for index in range(len(drawings))))
    return write_scene(scene, out, truth, min(executor.slots, thread_count()), run.with_pixels)
