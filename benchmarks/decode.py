"""Decoding of 12 phase images of 1388 x 1038 against copying them and against the package `fringes`, in one run.

    pip install fringes
    python benchmarks/decode.py

`fringes` (PyPI, GPL) is not needed otherwise; where it is not installed, its row says so. It decodes what it encodes
itself, with the same number of images, steps and pixels; the first call, which compiles it, does not count. Several
stacks take turns, so that none is still in a cache. Processor time counts the work of all threads.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from statistics import median
from typing import Any

import numpy as np

from planish.options import thread_count
from planish.sensing.capture.manifest import Manifest
from planish.sensing.capture.sequence import read_layouts
from planish.sensing.decode import DecodeOptions, decode
from planish.sensing.noise.estimate import estimate_noise
from planish.sensing.observe import observe
from planish.sensing.patterns.encode import encode
from planish.sensing.patterns.sequences import REFERENCE_PERIODS_PX, reference_sequence
from render_tables import save_table

HEIGHT, WIDTH = 1038, 1388
STACKS = 4
#: Phase steps of each period of the reference sequence.
STEPS = 4
OFFSET, AMPLITUDE, NOISE = 20.0, 160.0, (1.44, 0.025)

Times = tuple[float, float]


def timed(function: Callable[[Any], object], stacks: Sequence[Any], runs: int) -> Times:
    """Median wall and processor seconds of calls with the stacks in turn, after one call that does not count."""
    function(stacks[-1])
    wall, processor = [], []
    for run in range(runs):
        started, started_processor = time.perf_counter(), time.process_time()
        function(stacks[run % len(stacks)])
        wall.append(time.perf_counter() - started)
        processor.append(time.process_time() - started_processor)
    return median(wall), median(processor)


def render(seed: int) -> list[np.ndarray]:
    """All images of the reference sequence for a plane, with noise."""
    rng = np.random.default_rng(seed)
    positions = np.linspace(0, 1278, WIDTH)[None, :] + np.linspace(0, 1, HEIGHT)[:, None]
    images = []
    for entry in reference_sequence():
        grey = OFFSET + AMPLITUDE * encode(entry, positions)
        grey += rng.standard_normal(grey.shape) * np.sqrt(NOISE[0] + NOISE[1] * grey)
        images.append(np.clip(np.round(grey), 0, 255).astype(np.uint8))
    return images


def numpy_floor(images: Sequence[np.ndarray]) -> np.ndarray:
    """Positions by whole-array NumPy: no saturation, no limits, no noise model."""
    position = np.full((HEIGHT, WIDTH), 0.5 * REFERENCE_PERIODS_PX[0], np.float32)
    for k, period in enumerate(REFERENCE_PERIODS_PX):
        i0, i1, i2, i3 = (image.astype(np.float32) for image in images[STEPS * k : STEPS * (k + 1)])
        c, s = i0 - i2, i1 - i3
        x = np.arctan2(s, c) * np.float32(period / (2 * np.pi))
        position = x + np.float32(period) * np.rint((position - x) / np.float32(period))
        np.hypot(c, s)
    return position


def fringes_times(runs: int) -> Times | None:
    """Times of `fringes` with three sets of four images of the same size; None where it is not installed."""
    try:
        from fringes import Fringes  # type: ignore[import-not-found, import-untyped, unused-ignore]
    except ImportError:
        return None
    other = Fringes()
    other.X, other.Y, other.D, other.N = WIDTH, HEIGHT, 1, STEPS
    other.l = [WIDTH, WIDTH / 8, WIDTH / 64]
    stack = other.encode()
    return timed(other.decode, [stack.copy() for _ in range(STACKS)], runs)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=31)
    parser.add_argument("--threads", type=int, default=thread_count())
    arguments = parser.parse_args()
    threads, runs = arguments.threads, arguments.runs
    shown = [entry.model_dump() for entry in reference_sequence()]
    content = {"schema": "planish.capture/1", "rig": "rig.json", "images": {"A": ["-"] * len(shown)},
               "sequence": shown, "projector_px": [1280, 800]}  # fmt: skip
    (layout,) = read_layouts(Manifest.parse(content, "benchmark"), "benchmark")
    code, options = layout.codes[0], DecodeOptions()
    stacks = [render(seed) for seed in range(STACKS)]
    noise = estimate_noise(stacks[0], layout, 255.0)
    copies = np.empty((12, HEIGHT, WIDTH), np.uint8)
    with ThreadPoolExecutor(threads) as pool:
        copying = timed(lambda s: list(pool.map(lambda k: np.copyto(copies[k], s[k]), range(12))), stacks, runs)
    decoding = timed(lambda s: decode(s, code, noise, 255.0, options, threads), stacks, runs)
    cameras = [dict(zip("AB", (stacks[i], stacks[i - 1]), strict=True)) for i in range(STACKS)]
    observing = timed(lambda s: observe(s.__getitem__, ("A", "B"), layout, options, "-", threads), cameras, runs)
    whole_arrays = timed(numpy_floor, stacks, max(3, runs // 4))
    os.environ["NUMBA_NUM_THREADS"] = str(threads)
    other = fringes_times(max(3, runs // 4))
    rows = [
        ("copying the 12 images", copying),
        ("planish: position, sigma, modulation, mean, rejections", decoding),
        ("planish, two cameras: noise, decoding, white image", observing),
        ("NumPy, whole arrays: position and modulation, no limits", whole_arrays),
        ("fringes: position, modulation, mean" + ("" if other else " (not installed)"), other),
    ]
    table = [
        {"what": what, "wall": 1e3 * times[0], "processor": 1e3 * times[1], "ratio": times[0] / copying[0],
         "slower": times[0] / decoding[0]} if times else {"what": what}
        for what, times in rows
    ]  # fmt: skip
    for row in table:
        print(row)
    columns = {"what": "of 1388 x 1038 px, 3 periods of 4 steps, 8 bit", "wall": "median [ms]",
               "processor": "processor time [ms]", "ratio": "over copying", "slower": "over planish"}  # fmt: skip
    save_table("decode", columns, table, f"python benchmarks/decode.py --runs {runs} --threads {threads}",
               {"wall": ".1f", "processor": ".1f", "ratio": ".1f", "slower": ".1f"})  # fmt: skip


if __name__ == "__main__":
    main()
