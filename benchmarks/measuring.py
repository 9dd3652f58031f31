"""Time of measuring one capture, from its PNG files to the written HDF5 file, and of its stages.

    python benchmarks/measuring.py --runs 15

One capture of the reference sensor (2 x 14 images of 1388 x 1038, 8 bit), everything in one process, files in the page
cache. The floor is reading the same images with the same threads. Reading and measuring take turns, so that both see
the same machine; each figure is the median of the runs.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median

from planish.options import thread_count
from planish.pipeline import MeasureOptions, measure
from planish.sensing.capture.manifest import Capture, ImageReader
from planish.sensing.capture.sequence import read_layouts
from planish.sensing.observe import observe
from planish.sensing.points.correspond import correspond
from planish.sensing.points.reject import reject_edges
from planish.sensing.points.triangulate import triangulate
from planish.simulation.scenes import make_scene
from planish.simulation.writing import write_scene
from render_tables import save_table


def take_turns(functions: dict[str, Callable[[], object]], runs: int, after: Callable[[], object]) -> dict[str, float]:
    """Median seconds of each function, called in turn, after one round that does not count; `after` is not timed."""
    seconds: dict[str, list[float]] = {name: [] for name in functions}
    for run in range(runs + 1):
        for name, function in functions.items():
            started = time.perf_counter()
            function()
            if run:
                seconds[name].append(time.perf_counter() - started)
            after()
    return {name: median(values) for name, values in seconds.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=15)
    runs, threads = parser.parse_args().runs, thread_count()
    with tempfile.TemporaryDirectory() as folder:
        write_scene(make_scene("door", 1, 1), Path(folder), true_points=False)
        capture = Capture.load(Path(folder) / "m1")
        rig, options = capture.load_rig("A"), MeasureOptions()
        (layout,) = read_layouts(capture.manifest, "capture", rig.projector.size_px)
        images = {name: capture.read_images(name, threads) for name in "AB"}

        def read() -> None:
            with ImageReader(capture, ("A", "B"), threads) as reader:
                for name in "AB":
                    reader.take(name)

        def decode_both() -> dict:
            return observe(images.__getitem__, ("A", "B"), layout, options.decode, "capture", threads)

        phases = {n: reject_edges(o.phases["u"], options.reject, threads) for n, o in decode_both().items()}

        def points() -> object:
            pairs = correspond(phases["A"], phases["B"], rig.cameras["A"], rig.cameras["B"], threads)
            return triangulate(pairs, rig.cameras["A"], rig.cameras["B"], threads)

        file = Path(folder) / "m1.h5"

        def whole() -> None:
            measure(capture, options, threads).save(file)

        seconds = take_turns(
            {"read": read, "decode": decode_both, "points": points, "whole": whole},
            runs,
            # To replace a file costs what it takes to forget the old one.
            lambda: file.unlink(missing_ok=True),
        )
    rows = [
        {"what": "floor: reading 28 PNG", "seconds": seconds["read"], "ratio": 1.0},
        {"what": "both cameras: noise, positions, sigma, texture", "seconds": seconds["decode"],
         "ratio": seconds["decode"] / seconds["read"]},
        {"what": "correspondence and triangulation", "seconds": seconds["points"],
         "ratio": seconds["points"] / seconds["read"], "decode_ratio": seconds["points"] / seconds["decode"]},
        {"what": "measure, from PNG to the written file", "seconds": seconds["whole"],
         "ratio": seconds["whole"] / seconds["read"]},
    ]  # fmt: skip
    for row in rows:
        print(row)
    columns = {
        "what": f"stage, {threads} threads",
        "seconds": "median [s]",
        "ratio": "over reading",
        "decode_ratio": "over decoding both cameras",
    }
    formats = {"seconds": ".3f", "ratio": ".2f", "decode_ratio": ".2f"}
    save_table("measuring", columns, rows, f"python benchmarks/measuring.py --runs {runs}", formats)


if __name__ == "__main__":
    main()
