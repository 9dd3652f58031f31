"""Times of the main job's stages and their ratio to a floor: reading the images and OpenCV's SIFT on each texture.

    python benchmarks/speed.py

Five captures of the door at full resolution, everything in one process, files in the page cache. Each figure is the
median of the runs.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import cv2
import numpy as np

from planish.evaluation.prepared import Prepared
from planish.measurement import Measurement
from planish.options import thread_count
from planish.pipeline import RegisteredRun, measure, register_run
from planish.report import write_report
from planish.sensing.capture.manifest import Capture
from planish.simulation.render import render_capture
from planish.simulation.scenes import make_scene
from planish.simulation.writing import write_scene
from render_tables import save_table
from timing import timed


def report(run: RegisteredRun, out: Path, threads: int) -> None:
    """Write the report and its figures as `planish register` does."""
    out.mkdir(exist_ok=True)
    prepared = {n: Prepared(p.measurement, p.surface, p.contrast) for n, p in run.prepared.items()}
    write_report(run.registration, prepared, list(run.overlaps.values()), out, threads=threads)


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
        measuring, _ = timed(lambda: [measure(capture, threads=threads) for capture in captures], runs)
        registering, _ = timed(lambda: register_run(measurements, threads=threads), runs)
        run = register_run(measurements, threads=threads)
        reporting, _ = timed(lambda: report(run, Path(folder) / "report", threads), runs)
    floor, whole = reading + sift, measuring + registering
    rows = [
        {"what": "render one capture (2 x 14 images, core only)", "seconds": rendering},
        {"what": "floor: read 5 x 28 images", "seconds": reading, "ratio": reading / floor},
        {"what": "floor: OpenCV SIFT on 5 textures", "seconds": sift, "ratio": sift / floor},
        {"what": "measure 5 captures, reading included", "seconds": measuring, "ratio": measuring / floor},
        {"what": "register 5 measurements, overlap evaluation included", "seconds": registering,
         "ratio": registering / floor},
        {"what": "files to registration", "seconds": whole, "ratio": whole / floor},
        {"what": "report and figures", "seconds": reporting, "ratio": reporting / floor},
    ]  # fmt: skip
    for row in rows:
        print(row)
    columns = {"what": "stage", "seconds": "median [s]", "ratio": "over the floor"}
    save_table("speed", columns, rows, f"python benchmarks/speed.py --runs {runs}", {"seconds": ".2f", "ratio": ".2f"})


if __name__ == "__main__":
    main()
