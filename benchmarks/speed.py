"""Times of the main job's stages and their ratio to a floor: reading the images and OpenCV's SIFT on each texture.

    python benchmarks/speed.py

Five captures of the door at full resolution. What `planish measure` and `planish register` do, files to files, in one
process, files in the page cache, nothing kept from run to run. Each figure is the median of the runs.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from statistics import median

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
from shared.timing import timed


@dataclass
class Stages:
    """When the stages of a registration began."""

    began: list[tuple[str, float]] = field(default_factory=list)

    def say(self, stage: str, done: int, total: int, reused: int) -> None:
        """Take note of a stage that has not been heard of."""
        if not self.began or self.began[-1][0] != stage:
            self.began.append((stage, time.perf_counter()))

    def seconds(self, ended: float) -> dict[str, float]:
        """Return how long each took; the last one includes what follows it."""
        ends = [*(at for _, at in self.began[1:]), ended]
        return {stage: end - at for (stage, at), end in zip(self.began, ends, strict=True)}


def measure_files(captures: Sequence[Capture], folder: Path, threads: int) -> list[Path]:
    """Measure captures and write them, as `planish measure` does."""
    files = []
    for capture in captures:
        measurement = measure(capture, threads=threads)
        files.append(folder / f"{measurement.name}.h5")
        measurement.save(files[-1])
    return files


def register_anew(files: Sequence[Path], folder: Path, executor: Threads) -> tuple[FileRun, Path, dict[str, float]]:
    """Register files as `planish register` does, with nothing there yet: run, its folder, seconds of each stage."""
    RECENT.clear()
    out, stages = Path(tempfile.mkdtemp(dir=folder)), Stages()
    run = register_files(files, out, executor=executor, progress=stages.say)
    return run, out, stages.seconds(time.perf_counter())


def time_register(files: Sequence[Path], folder: Path, runs: int, threads: int) -> tuple[dict[str, float], float]:
    """Return the median seconds of each stage and of the report, after a run that does not count."""
    stages: list[dict[str, float]] = []
    reports: list[float] = []
    with Threads(threads) as executor:
        for _ in range(runs + 1):
            run, out, seconds = register_anew(files, folder, executor)
            started = time.perf_counter()
            report_files(run, out, executor)
            reports.append(time.perf_counter() - started)
            stages.append(seconds)
    return {stage: median(s[stage] for s in stages[1:]) for stage in stages[0]}, median(reports[1:])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=3)
    runs = parser.parse_args().runs
    threads = thread_count()
    scene = make_scene("door", 1)
    with tempfile.TemporaryDirectory() as folder:
        captures = [Capture.load(f) for f in write_scene(scene, Path(folder), true_points=False)]
        rendering, _ = timed(lambda: render_capture(scene, 0, threads), runs)

        def read() -> None:
            for capture in captures:
                for camera in capture.cameras:
                    capture.read_images(camera, threads)

        reading, _ = timed(read, runs)
        measurements: list[Measurement] = [measure(capture, threads=threads) for capture in captures]
        textures = [np.clip(np.nan_to_num(m.views["A"].mean), 0, 255).astype(np.uint8) for m in measurements]
        cv2.setNumThreads(threads)
        sift, _ = timed(lambda: [cv2.SIFT.create().detectAndCompute(t, None) for t in textures], runs)
        measuring, files = timed(lambda: measure_files(captures, Path(folder), threads), runs)
        stages, reporting = time_register(files, Path(folder), runs, threads)
    floor, registering = reading + sift, sum(stages.values())
    rows = [
        {"what": "render one capture (2 x 14 images, core only)", "seconds": rendering},
        {"what": "floor: read 5 x 28 images", "seconds": reading, "ratio": reading / floor},
        {"what": "floor: OpenCV SIFT on 5 textures", "seconds": sift, "ratio": sift / floor},
        {"what": "images to measurement files", "seconds": measuring, "ratio": measuring / floor},
        {"what": "measurement files to registration, overlap evaluation included", "seconds": registering,
         "ratio": registering / floor},
        *({"what": f"of it {stage}", "seconds": s, "ratio": s / floor} for stage, s in stages.items()),
        {"what": "images to registration", "seconds": measuring + registering,
         "ratio": (measuring + registering) / floor},
        {"what": "report and figures", "seconds": reporting, "ratio": reporting / floor},
    ]  # fmt: skip
    for row in rows:
        print(row)
    columns = {"what": "stage", "seconds": "median [s]", "ratio": "over the floor"}
    save_table("speed", columns, rows, f"python benchmarks/speed.py --runs {runs}", {"seconds": ".2f", "ratio": ".2f"})


if __name__ == "__main__":
    main()
