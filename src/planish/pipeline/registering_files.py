"""From measurement files to one frame: register_files() and add_files(), stage by stage, on any executor.

No process holds all measurements: each stage reads what it needs. What stages have computed lies in `stages/` of the
output folder, by what it depends on; whatever is there is not computed again, be it after an interrupt or for one
measurement more.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TypeVar

from planish.errors import InputError
from planish.execution.executor import Executor, Threads
from planish.execution.libraries import serial_linear_algebra
from planish.execution.recent import MAX_NUMBER, RECENT, WORKER_BYTES
from planish.execution.store import StageStore
from planish.files.given import GivenFiles, read_given
from planish.pipeline.frozen import Batch, Frozen, FrozenMeasurement
from planish.pipeline.options import RegisterOptions
from planish.pipeline.rounds import register_in_rounds
from planish.pipeline.schedule import MAX_BLOCK, blocks, kept_in
from planish.pipeline.stages import (
    PairStage,
    PatternStage,
    Source,
    View,
    estimate_pattern,
    find_keypoints,
    find_keypoints_and_footprint,
    look_at,
    points_of,
    recent_views,
    register_pairs,
    sum_pattern,
    without_pixels,
)
from planish.pipeline.versions import versions
from planish.registration.candidates.choose import Pair, choose_pairs, goes_in_rounds, possible_pairs
from planish.registration.candidates.footprint import Footprint
from planish.registration.network.build import Node, build_network
from planish.registration.pair_costs import pair_costs
from planish.registration.result import PairResult, Registration
from planish.registration.scales import length_factor, median_gsd, texture_pitch
from planish.registration.texture.fixed_pattern import CAPTURES_PER_SUM

Item = TypeVar("Item")
Value = TypeVar("Value")

#: Called with the name of a stage, what is done, what is to do, and how much of it was there already.
FileProgress = Callable[[str, int, int, int], None]


@serial_linear_algebra()
def register_files(
    paths: Sequence[Path],
    out: Path,
    options: RegisterOptions | None = None,
    *,
    reference: str | None = None,
    given: GivenFiles | None = None,
    executor: Executor | None = None,
    progress: FileProgress | None = None,
) -> FileRun:
    """Register measurement files by their texture and write `registration.json`; the same bytes by any executor.

    Parameters
    ----------
    paths : sequence of Path
        Measurements with different names; their order does not matter.
    out : Path
        Folder for `registration.json`, and for `stages/`: what each stage has computed.
    options : RegisterOptions, optional
    reference : str, optional
        Measurement whose frame becomes the world of its group; default the most central one.
    given : GivenFiles, optional
        Files of known points, a robot's transforms, a surface of the part: tested, then used.
    executor : Executor, optional
        Default: threads of this process.
    progress : callable, optional
        Called with stage, done, to do, reused.

    Raises
    ------
    InputError
        Where a file is unusable, there is none, a name stands twice, or `reference` is none of them.
    """
    if executor is None:
        with Threads() as threads:
            return register_files(
                paths, out, options, reference=reference, given=given, executor=threads, progress=progress
            )  # fmt: skip
    say = progress or (lambda *_: None)
    sources = _look(paths, executor, say)
    if reference is not None and reference not in sources:
        raise InputError("reference", f"found '{reference}'", f"one of {sorted(sources)}")
    gsd = median_gsd(source.gsd_mm for source in sources.values())
    start = Frozen(gsd, options or RegisterOptions(), reference, given or GivenFiles(), ())
    return _Run(Path(out), start, executor, say).go(sources, [list(sources)])


@serial_linear_algebra()
def add_files(
    paths: Sequence[Path],
    to: Path,
    *,
    reference: str | None = None,
    given: GivenFiles | None = None,
    executor: Executor | None = None,
    progress: FileProgress | None = None,
) -> FileRun:
    """Add measurement files to the registration in the folder `to`: only their own stages and pairs are computed.

    Resolution and options are those of the first run; the pattern of a sensor is summed up further, for what is new.
    The network is adjusted anew. What was given beside the measurements holds on, unless `given` replaces it.

    Raises
    ------
    InputError
        Where `to` holds no registration of files, a measurement is in it already, or one of its files has moved or
        changed.
    """
    if executor is None:
        with Threads() as threads:
            return add_files(paths, to, reference=reference, given=given, executor=threads, progress=progress)
    say = progress or (lambda *_: None)
    frozen = Frozen.load(Path(to) / STAGES)
    old = {m.name: m for batch in frozen.batches for m in batch.measurements}
    for item in old.values():
        if not Path(item.path).is_file():
            raise InputError(item.path, "no such file", f"the measurement '{item.name}' that was registered")
    new = _look(paths, executor, say)
    twice = sorted(set(new) & set(old))
    if twice:
        raise InputError(new[twice[0]].path, f"holds '{twice[0]}', which is registered in {to}", "a new measurement")
    sources = {name: source for name, item in old.items() if (source := item.source()) is not None}
    touched = [Path(item.path) for name, item in old.items() if name not in sources]
    sources |= new | (_look(touched, executor, say) if touched else {})
    for item in old.values():
        if item.name not in sources or sources[item.name].sha256 != item.sha256:
            raise InputError(item.path, f"has changed since '{item.name}' was registered", "the same content")
    names = [*sources]
    if reference is not None and reference not in names:
        raise InputError("reference", f"found '{reference}'", f"one of {sorted(names)}")
    batches = [[m.name for m in batch.measurements] for batch in frozen.batches]
    start = replace(frozen, reference=reference or frozen.reference, given=frozen.given.replaced_by(given))
    return _Run(Path(to), start, executor, say).go(sources, [*batches, list(new)])


#: Folder of the stage files in the output folder.
STAGES = "stages"


@dataclass(frozen=True)
class FileRun:
    """A registration of files, with the way back to each measurement and pair.

    Parameters
    ----------
    registration : Registration
        Without the pixels of matches, which `with_pixels` reads.
    views : dict of View
        By the name of the measurement.
    pairs : dict of PairStage
        By the names (a, b).
    reused : dict of (int, int)
        Per stage how many results were there already, and how many there are.
    """

    registration: Registration
    views: Mapping[str, View]
    pairs: Mapping[tuple[str, str], PairStage]
    reused: Mapping[str, tuple[int, int]]

    def with_pixels(self, pair: PairResult) -> PairResult:
        """Return a pair of the registration with the pixels of its matches, read now."""
        seen = self.pairs[pair.a, pair.b].result()
        return pair if seen is None else replace(pair, matches_px=seen.matches_px, consensus_px=seen.consensus_px)


class OfViews(Mapping[str, Value]):
    """Something of each measurement by its name, read or made when it is asked for."""

    def __init__(self, views: Mapping[str, View], of: Callable[[View], Value]) -> None:
        self._views, self._of = views, of

    def __getitem__(self, name: str) -> Value:
        return self._of(self._views[name])

    def __iter__(self) -> Iterator[str]:
        return iter(self._views)

    def __len__(self) -> int:
        return len(self._views)


@dataclass
class _Run:
    out: Path
    frozen: Frozen
    executor: Executor
    say: FileProgress
    reused: dict[str, tuple[int, int]] = field(default_factory=dict)

    def go(self, sources: Mapping[str, Source], batches: Sequence[Sequence[str]]) -> FileRun:
        """Run all stages, one line per stage; `batches` are the names that came together, those not yet tried last."""
        # Before anything is computed: what is wrong in a file is said at once.
        given = read_given(self.frozen.given, sorted(sources))
        store = StageStore(self.out / STAGES)
        store.remove_unfinished()
        # Lengths that the user did not set follow the resolution of the data.
        options = self.frozen.options.scaled(length_factor(self.frozen.gsd_mm))
        patterns = self._patterns(store, sources, batches, options)
        pitch = texture_pitch(self.frozen.gsd_mm)
        views = {name: View.of(store, sources[name], pitch, options, patterns.get(name)) for name in sorted(sources)}
        rounds = goes_in_rounds(len(views), options.candidates)
        self._count("texture", find_keypoints_and_footprint if rounds else find_keypoints, list(views.values()))
        nodes = self._nodes([sources[name] for name in views], given.surface is not None)
        pairs = self._known_pairs(views, options)
        tried, results = self._try_pairs(views, batches[-1], nodes, options, pairs)
        count = self.executor.slots
        costs = pair_costs(OfViews(views, lambda view: view.prepared(count)), options, count)
        registration = build_network(
            nodes, results, options.network, reference=self.frozen.reference, record=options.model_dump(mode="json"),
            versions=versions(), given=given, normal_equations=costs,
        )  # fmt: skip
        registration.save(self.out / "registration.json")
        if registration.joint is not None:
            registration.joint.save(self.out / "network.h5")
        entries = [[FrozenMeasurement.of(sources[name]) for name in batch] for batch in batches]
        all_tried = [*(batch.pairs for batch in self.frozen.batches), tried]
        record = tuple(Batch(measurements=tuple(e), pairs=tuple(p)) for e, p in zip(entries, all_tried, strict=True))
        replace(self.frozen, batches=record).save(store.folder)
        return FileRun(registration, views, pairs, self.reused)

    def _patterns(
        self,
        store: StageStore,
        sources: Mapping[str, Source],
        batches: Sequence[Sequence[str]],
        options: RegisterOptions,
    ) -> dict[str, PatternStage]:
        """Return by name the pattern of its sensor, by all batches up to its own; its sums are made now."""
        sums: dict[str, PatternStage] = {}
        captures: dict[str, int] = {}
        found: dict[str, PatternStage] = {}
        for batch in batches:
            taken: dict[str, list[Source]] = {}
            for name in sorted(batch):
                sensor = sources[name].sensor
                if sensor is not None:
                    taken.setdefault(sensor, []).append(sources[name])
            for sensor, items in taken.items():
                if captures.get(sensor, 0) >= CAPTURES_PER_SUM:
                    # It is well known, and tells what it is without the new captures' own texture.
                    found |= {item.name: sums[sensor] for item in items}
                    continue
                groups = [tuple(items[i : i + CAPTURES_PER_SUM]) for i in range(0, len(items), CAPTURES_PER_SUM)]
                captures[sensor] = captures.get(sensor, 0) + len(items)
                # Of one capture, nobody can tell pattern from texture.
                make = estimate_pattern if captures[sensor] > 1 else sum_pattern
                new = [PatternStage(store, options, group) for group in groups]
                parts = [sums[sensor], *new] if sensor in sums else new
                whole = parts[0]
                if len(parts) > 1:
                    self._count("pattern", sum_pattern, new)
                    whole = PatternStage(store, options, parts=tuple(parts))
                self._count("pattern", make, [whole])
                sums[sensor] = whole
                if captures[sensor] > 1:
                    found |= {item.name: whole for item in items}
        return found

    def _nodes(self, sources: Sequence[Source], with_points: bool) -> list[Node]:
        """Return what the network knows of measurements, with some of their points where a surface is given."""
        points = dict(self.executor.map(points_of, sources)) if with_points else {}
        return [Node(s.name, s.path.name, s.sha256, s.centroid_sensor, points.get(i)) for i, s in enumerate(sources)]

    def _known_pairs(self, views: Mapping[str, View], options: RegisterOptions) -> dict[Pair, PairStage]:
        """Return the pairs of earlier batches; their chance of false alarms counts the possible pairs as they were."""
        pairs: dict[Pair, PairStage] = {}
        measurements = 0
        for batch in self.frozen.batches:
            measurements += len(batch.measurements)
            in_run = possible_pairs(measurements)
            pairs |= {(a, b): PairStage.of(views[a], views[b], options, in_run) for a, b in batch.pairs}
        return pairs

    def _try_pairs(
        self,
        views: Mapping[str, View],
        last: Collection[str],
        nodes: Sequence[Node],
        options: RegisterOptions,
        pairs: dict[Pair, PairStage],
    ) -> tuple[list[Pair], list[PairResult]]:
        """Add to the known pairs those that are tried because of the last batch; return these and all results."""
        new = last if self.frozen.batches else None
        choice = choose_pairs(OfViews(views, lambda view: view.keypoints(1)[0]), options.candidates, new)
        in_run = possible_pairs(len(views))

        def register(names: Sequence[Pair]) -> list[PairResult]:
            for a, b in names:
                pairs.setdefault((a, b), PairStage.of(views[a], views[b], options, in_run))
            return self._register({name: pairs[name] for name in names})

        def footprints() -> dict[str, Footprint]:
            return {name: view.footprint()[0] for name, view in views.items()}

        return register_in_rounds(choice, list(pairs), nodes, options, register, footprints, new)

    def _register(self, pairs: Mapping[Pair, PairStage]) -> list[PairResult]:
        """Register the pairs that are not registered, and return all, without their pixels."""
        results = {
            names: without_pixels(found) for names, pair in pairs.items() if (found := pair.result()) is not None
        }
        there, total = self.reused.get("pairs", (0, 0))
        done = total + len(results)
        there, total = there + len(results), total + len(pairs)
        self.say("pairs", done, total, there)
        self.reused["pairs"] = (there, total)
        groups = self._blocks([pair for names, pair in pairs.items() if names not in results])
        for index, registered in self.executor.map(register_pairs, groups):
            for pair, result in zip(groups[index], registered, strict=True):
                if not pair.is_done():
                    path, names = pair.store.folder, (result.a, result.b)
                    raise InputError(path, f"the result of {names} is not here", "a folder that all workers share")
                results[result.a, result.b] = result
            done += len(registered)
            self.say("pairs", done, total, there)
        return [results[names] for names in sorted(results)]

    def _blocks(self, pairs: Sequence[PairStage]) -> list[tuple[PairStage, ...]]:
        """Return pairs in an order in which few measurements are prepared more than once."""
        shared = self.executor.shares_memory
        views = {view.source.name: view for pair in pairs for view in (pair.a, pair.b)}
        sizes = [view.source.size_bytes for view in views.values()]
        kept = kept_in(RECENT.max_bytes if shared else WORKER_BYTES, MAX_NUMBER, sizes)
        names = {view.key: name for name, view in views.items()}
        there = [names[key] for key in recent_views() if key in names] if shared else []
        by_name = {(pair.a.source.name, pair.b.source.name): pair for pair in pairs}
        most = 1 if shared else MAX_BLOCK
        ordered = blocks(list(by_name), self.executor.slots, kept, most, there)
        return [tuple(by_name[names] for names in block) for block in ordered]

    def _count(self, stage: str, function: Callable[[Item, int], bool], items: Sequence[Item]) -> None:
        """Run a stage whose function says whether the result was there."""
        reused, before = self.reused.get(stage, (0, 0))
        total = before + len(items)
        self.say(stage, before, total, reused)
        for done, (_, was_there) in enumerate(self.executor.map(function, items), before + 1):
            reused += was_there
            self.say(stage, done, total, reused)
        self.reused[stage] = (reused, total)


def _look(paths: Sequence[Path], executor: Executor, say: FileProgress) -> dict[str, Source]:
    """Return what the files hold, by name, sorted."""
    if not paths:
        raise InputError("measurements", "found none", "at least one measurement")
    found: dict[int, Source] = {}
    say("reading", 0, len(paths), 0)
    for index, source in executor.map(look_at, [Path(p).resolve() for p in paths]):
        found[index] = source
        say("reading", len(found), len(paths), 0)
    sources: dict[str, Source] = {}
    for source in (found[index] for index in range(len(paths))):
        if source.name in sources:
            first = sources[source.name].path
            raise InputError(
                source.path, f"holds the measurement '{source.name}' that {first} holds too", "different names"
            )
        sources[source.name] = source
    return dict(sorted(sources.items()))
