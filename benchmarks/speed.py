"""Times of the main job's stages and their ratio to a floor: reading the images and OpenCV's SIFT on each texture.

    python benchmarks/speed.py

Five captures of the door at full resolution. What `planish measure` and `planish register` do, files to files, and the
floor beside it, each in a process of its own that has done nothing before (its start and imports do not count), files
in the page cache. Both take turns, so that whatever else the machine does meets both; each figure is the median of the
runs. Beside the time on the clock stands the processor time of all threads together, which other work on the machine
changes less.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from multiprocessing import get_context
from pathlib import Path
from statistics import median
from time import perf_counter, process_time

import cv2
import numpy as np

from planish.execution.executor import Threads
from planish.execution.memory import kept_memory
from planish.measurement import Measurement
from planish.options import thread_count
from planish.pipeline import measure, register_files
from planish.pipeline.reporting import report_files
from planish.pipeline.saving import save_each
from planish.sensing.capture.manifest import Capture
from planish.simulation.render import render_capture
from planish.simulation.scenes import make_scene
from planish.simulation.writing import write_scene
from render_tables import save_table

#: What the stages of a registration do.
STAGES = {
    "reading": "read and check the measurement files",
    "pattern": "what is fixed to the sensor, over all captures",
    "texture": "texture images and keypoints",
    "pairs": "match, judge and refine all pairs, evaluate overlaps, adjust the network",
}
READ, SIFT = "read 5 x 28 images", "OpenCV SIFT on 5 textures"
MEASURE, REGISTER, REPORT = "images to measurement files", "measurement files to registration", "report and figures"


@dataclass(frozen=True)
class Seconds:
    """A time on the clock and of the processors, all threads together."""

    clock: float
    processor: float

    def __add__(self, other: Seconds) -> Seconds:
        return Seconds(self.clock + other.clock, self.processor + other.processor)

    def __sub__(self, other: Seconds) -> Seconds:
        return Seconds(self.clock - other.clock, self.processor - other.processor)


def now() -> Seconds:
    """Return both times since some fixed moment."""
    return Seconds(perf_counter(), process_time())


@dataclass
class Stages:
    """When the stages of a registration began."""

    began: list[tuple[str, Seconds]] = field(default_factory=list)

    def say(self, stage: str, done: int, total: int, reused: int) -> None:
        """Take note of a stage that has not been heard of."""
        if not self.began or self.began[-1][0] != stage:
            self.began.append((stage, now()))

    def seconds(self, ended: Seconds) -> dict[str, Seconds]:
        """Return how long each took; the last one includes what follows it."""
        ends = [*(at for _, at in self.began[1:]), ended]
        return {stage: end - at for (stage, at), end in zip(self.began, ends, strict=True)}


class Stopwatch:
    """Times of what is done one after the other."""

    def __init__(self) -> None:
        self.seconds: dict[str, Seconds] = {}
        self._start = now()

    def stop(self, what: str) -> None:
        """Take the time since the start, or since the last stop."""
        at = now()
        self.seconds[what], self._start = at - self._start, at


def floor_run(manifests: Sequence[Path], textures_file: Path, threads: int) -> dict[str, Seconds]:
    """Return how long it takes to read all images, and to find what OpenCV's SIFT finds in each texture."""
    cv2.setNumThreads(threads)
    captures, textures = [Capture.load(f) for f in manifests], np.load(textures_file)
    watch = Stopwatch()
    for capture in captures:
        for camera in capture.cameras:
            capture.read_images(camera, threads)
    watch.stop(READ)
    for texture in textures:
        cv2.SIFT.create().detectAndCompute(texture, None)
    watch.stop(SIFT)
    return watch.seconds


def measure_all(manifests: Sequence[Path], folder: Path, threads: int) -> list[Path]:
    """Measure captures and write them, as `planish measure` does; return the files."""

    def measured(manifest: Path) -> tuple[Measurement, Path, Path]:
        measurement = measure(Capture.load(manifest), threads=threads)
        file = folder / f"{measurement.name}.h5"
        return measurement, file, file

    with kept_memory():
        return list(save_each(measured(manifest) for manifest in manifests))


def job_run(manifests: Sequence[Path], folder: Path, threads: int) -> dict[str, Seconds]:
    """Return how long `planish measure` and `planish register` take, the latter with nothing there yet."""
    cv2.setNumThreads(threads)
    watch, stages = Stopwatch(), Stages()
    with tempfile.TemporaryDirectory(dir=folder) as out, Threads(threads) as executor:
        files = measure_all(manifests, folder, threads)
        watch.stop(MEASURE)
        run = register_files(files, Path(out), executor=executor, progress=stages.say)
        watch.stop(REGISTER)
        seconds = stages.seconds(now())
        report_files(run, Path(out), executor)
        watch.stop(REPORT)
    return watch.seconds | seconds


def alone(function: Callable[..., dict[str, Seconds]], *arguments: object) -> dict[str, Seconds]:
    """Return what a function returns in a process of its own."""
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        return pool.submit(function, *arguments).result()


def medians(runs: Sequence[dict[str, Seconds]]) -> dict[str, Seconds]:
    """Return the median of each time over the runs."""
    return {
        what: Seconds(median(r[what].clock for r in runs), median(r[what].processor for r in runs)) for what in runs[0]
    }


def table(rendering: float, seconds: dict[str, Seconds]) -> list[dict[str, object]]:
    """Return the rows: the floor, the whole way, and what it consists of."""
    floor, whole = seconds[READ] + seconds[SIFT], seconds[MEASURE] + seconds[REGISTER]

    def row(what: str, s: Seconds) -> dict[str, object]:
        return {
            "what": what, "seconds": s.clock, "ratio": s.clock / floor.clock,
            "processor": s.processor, "processor_ratio": s.processor / floor.processor,
        }  # fmt: skip

    return [
        row("floor", floor),
        row(f"floor: {READ}", seconds[READ]),
        row(f"floor: {SIFT}", seconds[SIFT]),
        row("images to registration", whole),
        row(MEASURE, seconds[MEASURE]),
        row(REGISTER, seconds[REGISTER]),
        *(row(f"registration: {text}", seconds[stage]) for stage, text in STAGES.items()),
        row(REPORT, seconds[REPORT]),
        {"what": "render one capture (2 x 14 images, core only)", "seconds": rendering},
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=5)
    runs = parser.parse_args().runs
    threads = thread_count()
    scene = make_scene("door", 1)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        manifests = write_scene(scene, folder, true_points=False)
        start = now()
        render_capture(scene, 0, threads)
        rendering = (now() - start).clock
        means = [Measurement.load(file).views["A"].mean for file in measure_all(manifests, folder, threads)]
        np.save(folder / "textures.npy", np.clip(np.nan_to_num(np.stack(means)), 0, 255).astype(np.uint8))
        del means
        seconds = medians([
            alone(floor_run, manifests, folder / "textures.npy", threads) | alone(job_run, manifests, folder, threads)
            for _ in range(runs)
        ])  # fmt: skip
    rows = table(rendering, seconds)
    columns = {
        "what": "stage", "seconds": "clock [s]", "ratio": "over the floor", "processor": "processors [s]",
        "processor_ratio": "over the floor's",
    }  # fmt: skip
    print("  ".join(f"{text:>17}" for key, text in columns.items() if key != "what"), " stage")
    for row in rows:
        figures = (f"{row[key]:17.2f}" if key in row else " " * 17 for key in columns if key != "what")
        print("  ".join(figures), f" {row['what']}")
    formats = dict.fromkeys(("seconds", "ratio", "processor", "processor_ratio"), ".2f")
    save_table("speed", columns, rows, f"python benchmarks/speed.py --runs {runs}", formats)


if __name__ == "__main__":
    main()
