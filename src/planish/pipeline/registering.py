"""From measurements to one frame: register(), one line per stage."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np

from planish.errors import InputError
from planish.evaluation import prepared as evaluation
from planish.evaluation.overlap import OverlapEvaluation, evaluate_overlap
from planish.execution.executor import Threads
from planish.execution.libraries import serial_linear_algebra
from planish.measurement import Measurement
from planish.options import thread_count
from planish.pipeline.options import RegisterOptions
from planish.pipeline.rounds import register_in_rounds
from planish.pipeline.stages import centroid, some_points
from planish.pipeline.versions import versions
from planish.registration.candidates.choose import Pair, choose_pairs, possible_pairs
from planish.registration.candidates.footprint import Footprint, footprint
from planish.registration.network.build import Node, build_network
from planish.registration.network.given import Given
from planish.registration.options import PairOptions
from planish.registration.pair import register_pair
from planish.registration.pair_costs import pair_costs
from planish.registration.prepared import Prepared, prepare
from planish.registration.result import PairResult, Registration
from planish.registration.scales import common_gsd, common_pitch, length_factor
from planish.registration.texture.camera_pattern import FixedPattern
from planish.registration.texture.fixed_pattern import estimate_fixed_patterns

Item = TypeVar("Item")
Value = TypeVar("Value")

#: Called with the name of a stage, what is done and what is to do.
Progress = Callable[[str, int, int], None]


@dataclass(frozen=True)
class RegisteredRun:
    """A registration with what the report shows of it: texture images per measurement and evaluation per pair."""

    registration: Registration
    prepared: Mapping[str, Prepared]
    overlaps: Mapping[tuple[str, str], OverlapEvaluation]


def register(
    measurements: Sequence[Measurement],
    options: RegisterOptions | None = None,
    *,
    reference: str | None = None,
    given: Given | None = None,
    threads: int | None = None,
    progress: Progress | None = None,
) -> Registration:
    """Register measurements by their texture: no start value, no neighbour hints, any order.

    Parameters
    ----------
    measurements : sequence of Measurement
        With different names; their order does not matter.
    options : RegisterOptions, optional
    reference : str, optional
        Measurement whose frame becomes the world of its group; default the most central one.
    given : Given, optional
        Known points, a robot's transforms, a surface of the part: tested, then used.
    threads : int, optional
        Default: all processors. The result does not depend on it.
    progress : callable, optional
        Called with stage, done, to do.

    Returns
    -------
    Registration
        Transforms with covariances, verdicts and groups. "Cannot be registered" is a result, never an exception.

    Raises
    ------
    InputError
        Where there is no measurement, a name stands twice, or `reference` is none of them.
    """
    run = register_run(
        measurements, options, reference=reference, given=given, threads=threads, progress=progress
    )  # fmt: skip
    return run.registration


@serial_linear_algebra()
def register_run(
    measurements: Sequence[Measurement],
    options: RegisterOptions | None = None,
    *,
    reference: str | None = None,
    files: Mapping[str, tuple[str, str]] | None = None,
    given: Given | None = None,
    threads: int | None = None,
    progress: Progress | None = None,
) -> RegisteredRun:
    """Do what `register` does and keep what reports and clouds are made of.

    `files` gives per name the file name and SHA-256 to be kept in the result; the rest is as in `register`.
    """
    options, count, say = options or RegisterOptions(), thread_count(threads), progress or (lambda *_: None)
    ordered = _checked(measurements, reference)
    options, prepared = prepare_run(ordered, options, threads=count, progress=say)
    nodes = [_node(m, *(files or {}).get(m.name, ("", ""))) for m in ordered]
    pairs = _register_pairs(prepared, nodes, options, count, say)
    overlaps = _evaluate_pairs(prepared, pairs, count, say)
    pairs = [_with_overlap(pair, overlaps.get((pair.a, pair.b))) for pair in pairs]
    registration = build_network(
        nodes, pairs, options.network, reference=reference, record=options.model_dump(mode="json"), versions=versions(),
        given=given, normal_equations=pair_costs(prepared, options, count),
    )  # fmt: skip
    return RegisteredRun(registration, prepared, overlaps)


def prepare_run(
    measurements: Sequence[Measurement],
    options: RegisterOptions | None = None,
    *,
    threads: int | None = None,
    progress: Progress | None = None,
) -> tuple[RegisterOptions, dict[str, Prepared]]:
    """Return the options at the run's resolution, and by name what `register_pair` needs of each measurement."""
    options, count, say = options or RegisterOptions(), thread_count(threads), progress or (lambda *_: None)
    # Lengths that the user did not set follow the resolution of the data.
    options, pitch = options.scaled(length_factor(common_gsd(measurements))), common_pitch(measurements)
    fixed = estimate_fixed_patterns(measurements, options.photometric, count)
    return options, _prepare_all(measurements, fixed, pitch, options, count, say)


def _checked(measurements: Sequence[Measurement], reference: str | None) -> list[Measurement]:
    names = [m.name for m in measurements]
    if not names:
        raise InputError("measurements", "found none", "at least one measurement")
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise InputError("measurements", f"the name '{twice[0]}' stands {names.count(twice[0])} times", "unique names")
    if reference is not None and reference not in names:
        raise InputError("reference", f"found '{reference}'", f"one of {sorted(names)}")
    return sorted(measurements, key=lambda m: m.name)


def _parallel(
    items: Sequence[Item], function: Callable[[Item, int], Value], stage: str, threads: int, say: Progress
) -> list[Value]:
    """Apply function(item, threads of its own) to all items, in order of the items, several at a time."""
    values: dict[int, Value] = {}
    say(stage, 0, len(items))
    for index, value in Threads(threads).map(function, items):
        values[index] = value
        say(stage, len(values), len(items))
    return [values[index] for index in range(len(items))]


def _prepare_all(
    measurements: Sequence[Measurement],
    fixed: Mapping[str, FixedPattern],
    pitch_mm: float,
    options: PairOptions,
    threads: int,
    say: Progress,
) -> dict[str, Prepared]:
    def one(measurement: Measurement, own: int) -> Prepared:
        return prepare(measurement, pitch_mm, options, own, fixed.get(measurement.name))

    found = _parallel(measurements, one, "texture", threads, say)
    return {p.measurement.name: p for p in found}


def _register_pairs(
    prepared: Mapping[str, Prepared], nodes: Sequence[Node], options: RegisterOptions, threads: int, say: Progress
) -> list[PairResult]:
    choice = choose_pairs({name: item.keypoints for name, item in prepared.items()}, options.candidates)
    in_run = possible_pairs(len(prepared))

    def one(pair: Pair, own: int) -> PairResult:
        return register_pair(prepared[pair[0]], prepared[pair[1]], options, in_run, own)

    def register_all(pairs: Sequence[Pair]) -> list[PairResult]:
        return _parallel(pairs, one, "pairs", threads, say)

    def footprints() -> dict[str, Footprint]:
        return {name: footprint(item.measurement) for name, item in prepared.items()}

    return register_in_rounds(choice, [], nodes, options, register_all, footprints)[1]


def _evaluate_pairs(
    prepared: Mapping[str, Prepared], pairs: Sequence[PairResult], threads: int, say: Progress
) -> dict[tuple[str, str], OverlapEvaluation]:
    accepted = [pair for pair in pairs if pair.T_a_b is not None]
    names = {name for pair in accepted for name in (pair.a, pair.b)}
    sides = {
        name: evaluation.Prepared(p.measurement, p.surface, p.contrast) for name, p in prepared.items() if name in names
    }

    def one(pair: PairResult, own: int) -> OverlapEvaluation:
        return evaluate_overlap(sides[pair.a], sides[pair.b], np.asarray(pair.T_a_b), threads=own)

    found = _parallel(accepted, one, "overlap", threads, say)
    return {(pair.a, pair.b): overlap for pair, overlap in zip(accepted, found, strict=True)}


def _with_overlap(pair: PairResult, overlap: OverlapEvaluation | None) -> PairResult:
    return pair if overlap is None else replace(pair, overlap=overlap.overlap, overlap_error=overlap.error)


def _node(measurement: Measurement, file: str, sha256: str) -> Node:
    return Node(measurement.name, file, sha256, centroid(measurement), some_points(measurement))
