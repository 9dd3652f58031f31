"""Times of the main job's stages and their ratio to a floor: reading the images and OpenCV's SIFT on each texture.

    python benchmarks/speed.py

Five captures of the door at full resolution. What `planish measure` and `planish register` do, files to files, in one
process, files in the page cache, nothing kept from run to run. All parts take turns, run after run, so that whatever
else the machine does meets all of them; each figure is the median of the runs. Beside the time on the clock stands the
processor time of all threads together, which other work on the machine changes less.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from statistics import median
from time import perf_counter, process_time

import cv2
import numpy as np

from planish.execution.executor import Threads
from planish.execution.recent import RECENT
from planish.measurement import Measurement
from planish.options import thread_count
from planish.pipeline import FileRun, measure, register_files
from planish.pipeline.reporting import report_files
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


@dataclass(frozen=True)
class Job:
    """The captures in files, and where what is made of them goes."""

    captures: Sequence[Capture]
    folder: Path
    executor: Threads
    threads: int

    def read(self) -> None:
        """Read all images."""
        for capture in self.captures:
            for camera in capture.cameras:
                capture.read_images(camera, self.threads)

    def measure(self) -> list[Path]:
        """Measure captures and write them, as `planish measure` does."""
        files = []
        for capture in self.captures:
            measurement = measure(capture, threads=self.threads)
            files.append(self.folder / f"{measurement.name}.h5")
            measurement.save(files[-1])
        return files

    def register(self, files: Sequence[Path], say: Callable[[str, int, int, int], None]) -> tuple[FileRun, Path]:
        """Register files as `planish register` does, with nothing there yet; return the run and its folder."""
        RECENT.clear()
        out = Path(tempfile.mkdtemp(dir=self.folder))
        return register_files(files, out, executor=self.executor, progress=say), out


def find_sift(textures: Sequence[np.ndarray]) -> None:
    """Find what OpenCV's SIFT finds in each texture."""
    for texture in textures:
        cv2.SIFT.create().detectAndCompute(texture, None)


def one_run(job: Job, textures: Sequence[np.ndarray]) -> dict[str, Seconds]:
    """Return how long everything took, once."""
    seconds: dict[str, Seconds] = {}

    def timed(what: str, start: Seconds) -> None:
        seconds[what] = now() - start

    cv2.setNumThreads(job.threads)
    start = now()
    job.read()
    timed(READ, start)
    start = now()
    find_sift(textures)
    timed(SIFT, start)
    start = now()
    files = job.measure()
    timed(MEASURE, start)
    stages, start = Stages(), now()
    run, out = job.register(files, stages.say)
    timed(REGISTER, start)
    seconds |= stages.seconds(now())
    start = now()
    report_files(run, out, job.executor)
    timed(REPORT, start)
    return seconds


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
    parser.add_argument("--runs", type=int, default=3)
    runs = parser.parse_args().runs
    threads = thread_count()
    scene = make_scene("door", 1)
    with tempfile.TemporaryDirectory() as folder, Threads(threads) as executor:
        captures = [Capture.load(f) for f in write_scene(scene, Path(folder), true_points=False)]
        start = now()
        render_capture(scene, 0, threads)
        rendering = (now() - start).clock
        job = Job(captures, Path(folder), executor, threads)
        measurements = [Measurement.load(file) for file in job.measure()]
        textures = [np.clip(np.nan_to_num(m.views["A"].mean), 0, 255).astype(np.uint8) for m in measurements]
        del measurements
        # The first run does not count: libraries start their threads, memory is asked for.
        seconds = medians([one_run(job, textures) for _ in range(runs + 1)][1:])
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
