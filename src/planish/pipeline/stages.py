"""The stages of a registration as functions of files: each can run in any process, any number of times.

What a stage needs of earlier ones it reads from the store, or computes where it is not there or damaged. Surfaces and
texture images are never stored: they are larger than the measurement. They are made again where they are needed, and
kept for a while (`RECENT`).
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np

from planish import storage
from planish.errors import InputError
from planish.evaluation import prepared as evaluation
from planish.evaluation.overlap import evaluate_overlap
from planish.execution.recent import RECENT
from planish.execution.store import StageStore, content_key
from planish.geometry import Array
from planish.measurement import SCHEMA, Map, Measurement
from planish.options import thread_count
from planish.pipeline.options import RegisterOptions
from planish.registration.candidates.footprint import Footprint, footprint
from planish.registration.keypoints.detect import detect_keypoints
from planish.registration.keypoints.keypoints import Keypoints
from planish.registration.pair import register_pair
from planish.registration.prepared import Prepared, Textured, draw_texture, prepare_textured
from planish.registration.result import OverlapError, PairResult
from planish.registration.surface import fit_surface
from planish.registration.texture.camera_pattern import FixedPattern
from planish.registration.texture.fixed_pattern import PatternSums, add_sums, sensor_key, sum_captures
from planish.registration.texture.photometric import local_contrast
from planish.registration.tiles import ground_sample_distance

#: Names of the stages: folders of the store.
PATTERN, KEYPOINTS, FOOTPRINTS, PAIRS, OVERLAPS = "pattern", "keypoints", "footprints", "pairs", "overlaps"


@dataclass(frozen=True)
class Source:
    """A measurement file and what the run needs of it: one look at it.

    Parameters
    ----------
    name : str
    path : Path
    sha256 : str
        Of the file.
    size_bytes, mtime_ns : int
        Size of the file and time of its last change.
    gsd_mm : float
        Ground sample distance [mm per pixel]; NaN where there are no points.
    sensor : str or None
        The same for all measurements of one sensor; None where nothing is known of its pattern.
    centroid_sensor : ndarray (3,)
        Mean of its points [mm].
    """

    name: str
    path: Path
    sha256: str
    size_bytes: int
    mtime_ns: int
    gsd_mm: float
    sensor: str | None
    centroid_sensor: Array


def look_at(path: Path, threads: int) -> Source:
    """Return what a run needs to know of a measurement file before it starts."""
    if not path.is_file():
        raise InputError(path, "no such file", "a measurement written by `planish measure`")
    # One content for both: what is measured is what is named by its hash.
    found, content = path.stat(), storage.read_content(path, SCHEMA)
    sha256 = hashlib.sha256(content.data).hexdigest()
    m = RECENT.get(("measurement", sha256), lambda: Measurement.of_content(content, path))
    return Source(
        m.name, path, sha256, found.st_size, found.st_mtime_ns, ground_sample_distance(m), sensor_key(m), centroid(m)
    )


def centroid(measurement: Measurement) -> Array:
    """Return the mean (3,) of a measurement's points in its own frame [mm]; zero where it has none."""
    # In double precision, without a copy of the points.
    return np.array(cv2.mean(measurement.points_sensor, measurement.valid.view(np.uint8))[:3])


#: Points of a measurement that a fixed surface is held against.
NODE_POINTS = 4000


def some_points(measurement: Measurement) -> Array:
    """Return some of a measurement's points (N, 3), spread evenly over its pixels [mm]."""
    points = measurement.points_sensor[measurement.valid].astype(float)
    step = max(1, len(points) // NODE_POINTS)
    return points[step // 2 :: step]


def points_of(source: Source, threads: int) -> Array:
    """Return some of the points (N, 3) of a measurement file [mm]."""
    return some_points(load(source))


@dataclass(frozen=True)
class PatternStage:
    """Sums over captures of one sensor: of `sources`, or of the sums of `parts`, in their order."""

    store: StageStore
    options: RegisterOptions
    sources: tuple[Source, ...] = ()
    parts: tuple[PatternStage, ...] = ()

    @property
    def key(self) -> str:
        """Key of the result."""
        inputs = [part.key for part in self.parts] or [source.sha256 for source in self.sources]
        return content_key(PATTERN, inputs, bool(self.parts), self.options.photometric.model_dump(mode="json"))

    @property
    def members(self) -> Iterator[str]:
        """Names of the captures."""
        for part in self.parts:
            yield from part.members
        yield from (source.name for source in self.sources)

    def sums(self, threads: int) -> tuple[PatternSums, bool]:
        """Return the sums, and whether they were there."""
        return self.store.read_or_make(PATTERN, self.key, PatternSums, lambda: self._sum(threads))

    def _sum(self, threads: int) -> PatternSums:
        if self.parts:
            return add_sums(part.sums(threads)[0] for part in self.parts)
        captures = (load(source) for source in self.sources)
        return sum_captures(captures, self.options.photometric, threads)

    def pattern(self, threads: int) -> FixedPattern:
        """Return the pattern, kept for the next ones of the sensor."""
        return self._estimate(lambda: self.sums(threads)[0], threads)

    def make(self, threads: int) -> bool:
        """Make sums and pattern for the texture images that come next; return whether the sums were there."""
        sums, there = self.sums(threads)
        if not there:
            self._estimate(lambda: sums, threads)
        return there

    def _estimate(self, sums: Callable[[], PatternSums], threads: int) -> FixedPattern:
        return RECENT.get(("pattern", self.key), lambda: sums().pattern(self.members, threads))


@dataclass(frozen=True)
class View:
    """A measurement in its run: all that its texture and keypoints depend on; `options` are those of its resolution."""

    store: StageStore
    source: Source
    pitch_mm: float
    options: RegisterOptions
    pattern: PatternStage | None
    key: str

    @classmethod
    def of(
        cls,
        store: StageStore,
        source: Source,
        pitch_mm: float,
        options: RegisterOptions,
        pattern: PatternStage | None,
    ) -> View:
        """Return the view with the key of its keypoints."""
        stages = ("surface", "photometric", "charts", "keypoints")
        read = {name: getattr(options, name).model_dump(mode="json") for name in stages}
        key = content_key(KEYPOINTS, source.sha256, pitch_mm, read, None if pattern is None else pattern.key)
        return cls(store, source, pitch_mm, options, pattern, key)

    def textured(self, threads: int) -> Textured:
        """Return surface and texture images, kept for a while."""
        return RECENT.get(("textured", self.key), lambda: self._draw(threads))

    def _draw(self, threads: int) -> Textured:
        fixed = None if self.pattern is None else self.pattern.pattern(threads)
        textured = draw_texture(load(self.source), self.pitch_mm, self.options, threads, fixed)
        # It holds the measurement.
        RECENT.forget(("measurement", self.source.sha256))
        return textured

    def keypoints(self, threads: int) -> tuple[Keypoints, bool]:
        """Return the keypoints, and whether they were there."""
        return self.store.read_or_make(
            KEYPOINTS, self.key, Keypoints,
            lambda: detect_keypoints(self.textured(threads).images, self.options.keypoints),
        )  # fmt: skip

    def footprint(self) -> tuple[Footprint, bool]:
        """Return some points of the surface, and whether they were there."""
        key = content_key(FOOTPRINTS, self.source.sha256)
        return self.store.read_or_make(FOOTPRINTS, key, Footprint, lambda: footprint(self._measurement()))

    def _measurement(self) -> Measurement:
        textured: Textured | None = RECENT.peek(("textured", self.key))
        return load(self.source) if textured is None else textured.measurement

    def prepared(self, threads: int) -> Prepared:
        """Return all that pairs need, kept for a while."""
        return RECENT.get(("prepared", self.key), lambda: self._prepare(threads))

    def _prepare(self, threads: int) -> Prepared:
        keypoints = self.keypoints(threads)[0]
        prepared = prepare_textured(self.textured(threads), keypoints, self.options, threads)
        # It holds the same maps.
        RECENT.forget(("textured", self.key))
        return prepared

    def surfaced(self, threads: int | None = None) -> evaluation.Prepared:
        """Return what evaluation and pictures need, kept for a while; its contrast is computed when it is asked for."""
        for kind in ("prepared", "textured"):
            item: Prepared | Textured | None = RECENT.peek((kind, self.key))
            if item is not None:
                return evaluation.Prepared(item.measurement, item.surface, item.contrast, threads)
        return RECENT.get(("surfaced", self.key), lambda: Surfaced(self, load(self.source), threads))


def recent_views() -> list[str]:
    """Return the keys of the views that this process keeps ready for pairs or drawn, those used last at the end."""
    return [key[1] for key in RECENT.used() if isinstance(key, tuple) and key[0] in ("prepared", "textured")]


class Surfaced(evaluation.Prepared):
    """A measurement of a run, whose surface and contrast are those of the run's options and pattern."""

    def __init__(self, view: View, measurement: Measurement, threads: int | None) -> None:
        super().__init__(measurement, fit_surface(measurement, view.options.surface, threads), threads=threads)
        self._view = view

    @cached_property
    def contrast(self) -> tuple[Map, Map]:
        """Local contrast of the texture and its standard deviation, each (H, W) float32; NaN where unknown."""
        pattern, count = self._view.pattern, thread_count(self._threads)
        fixed = None if pattern is None else pattern.pattern(count)
        return local_contrast(self.measurement, self._view.options.photometric, self.surface, fixed, count)


def load(source: Source) -> Measurement:
    """Return the measurement of a source, kept for a while; an error where it is not the one that was looked at."""
    measurement = RECENT.get(("measurement", source.sha256), lambda: Measurement.load(source.path))
    if measurement.name != source.name:
        raise InputError(source.path, f"has changed: it holds '{measurement.name}'", f"'{source.name}'")
    return measurement


def sum_pattern(stage: PatternStage, threads: int) -> bool:
    """Make the sums over captures of a sensor; return whether they were there."""
    return stage.sums(threads)[1]


def estimate_pattern(stage: PatternStage, threads: int) -> bool:
    """Make the pattern of a sensor, from all its captures; return whether their sums were there."""
    return stage.make(threads)


def find_keypoints(view: View, threads: int) -> bool:
    """Find the keypoints of a measurement; return whether they were there."""
    return view.keypoints(threads)[1]


def find_keypoints_and_footprint(view: View, threads: int) -> bool:
    """Find the keypoints of a measurement and some points of its surface; return whether they were there."""
    keypoints_there = view.keypoints(threads)[1]
    return view.footprint()[1] and keypoints_there


@dataclass(frozen=True)
class Overlap:
    """What of an OverlapEvaluation is kept: figures; the maps are made again where they are drawn."""

    overlap: float
    error: OverlapError | None


@dataclass(frozen=True)
class PairStage:
    """A pair to be tried, in a run whose measurements have `pairs_in_run` pairs."""

    a: View
    b: View
    options: RegisterOptions
    pairs_in_run: int
    key: str

    @classmethod
    def of(cls, a: View, b: View, options: RegisterOptions, pairs_in_run: int) -> PairStage:
        """Return the pair with the key of its result."""
        read = options.model_dump(mode="json", exclude={"candidates", "network"})
        return cls(a, b, options, pairs_in_run, content_key(PAIRS, a.key, b.key, read, pairs_in_run))

    @property
    def store(self) -> StageStore:
        """Where its result is kept."""
        return self.a.store

    def result(self) -> PairResult | None:
        """Return the result with the figures of its overlap; None where one of them is not there."""
        pair = self.store.read(PAIRS, self.key, PairResult)
        if pair is None or pair.T_a_b is None:
            return pair
        found = self.store.read(OVERLAPS, self.key, Overlap)
        return None if found is None else replace(pair, overlap=found.overlap, overlap_error=found.error)

    def is_done(self) -> bool:
        """Return whether the file of the result is there."""
        return self.store.path(PAIRS, self.key).is_file()

    def run(self, threads: int) -> PairResult:
        """Register the pair and evaluate its overlap, as far as that has not been done; return what `result` does."""
        pair, _ = self.store.read_or_make(PAIRS, self.key, PairResult, lambda: self._register(threads))
        if pair.T_a_b is None:
            return pair
        found, _ = self.store.read_or_make(OVERLAPS, self.key, Overlap, lambda: self._evaluate(pair, threads))
        return replace(pair, overlap=found.overlap, overlap_error=found.error)

    def _register(self, threads: int) -> PairResult:
        a, b = self.a.prepared(threads), self.b.prepared(threads)
        return register_pair(a, b, self.options, self.pairs_in_run, threads)

    def _evaluate(self, pair: PairResult, threads: int) -> Overlap:
        assert pair.T_a_b is not None
        found = evaluate_overlap(self.a.surfaced(threads), self.b.surfaced(threads), pair.T_a_b, threads=threads)
        return Overlap(found.overlap, found.error)


def register_pairs(pairs: tuple[PairStage, ...], threads: int) -> list[PairResult]:
    """Try pairs one after the other; return their results without pixels."""
    return [without_pixels(pair.run(threads)) for pair in pairs]


def without_pixels(pair: PairResult) -> PairResult:
    """Return a result as the network needs it: the pixels of all pairs of a large run are too many."""
    return replace(pair, matches_px=_NO_PIXELS, consensus_px=_NO_PIXELS)


_NO_PIXELS = np.empty((0, 4))
