"""Times of one pair with 5,000 keypoints each, beside named peers in the same process.

    python benchmarks/pair_speed.py

Two captures of the door at full resolution, with marks enough for the keypoints. In one thread, as in a worker:
processor time, median of the runs; what several threads share is timed on the clock with two, too. Freed memory is
kept, as while a registration runs. OpenCV's SIFT and its matcher work on the same texture image and the same
descriptors.
"""

from __future__ import annotations

import argparse
import os
import tempfile
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from time import process_time
from typing import Any, TypeVar

import cv2
import numpy as np

from planish.evaluation import prepared as evaluation
from planish.evaluation.overlap import OverlapEvaluation, evaluate_overlap
from planish.execution.memory import kept_memory
from planish.measurement import Measurement
from planish.pipeline import RegisterOptions
from planish.registration.consensus import find_consensus
from planish.registration.keypoints.detect import detect_keypoints
from planish.registration.match.matching import match
from planish.registration.match.patches import PatchSide
from planish.registration.pair import refine_pair, register_pair
from planish.registration.prepared import Prepared, draw_on_surface, prepare
from planish.registration.result import PairResult
from planish.registration.scales import common_gsd, common_pitch, length_factor
from planish.registration.surface import fit_surface
from planish.registration.texture.charts import plan_charts
from planish.registration.texture.photometric import local_contrast
from planish.registration.texture.resample import TextureImage, texture_images
from planish.simulation.scenes import make_scene
from render_tables import save_table
from shared.rendered import measure_scene
from shared.timing import timed

Row = dict[str, Any]
Value = TypeVar("Value")

KEYPOINTS, DENSITY = 5000, 2.0
#: Grey levels per robust deviation of the texture, and SIFT's contrast threshold, with which it finds most.
GREY_PER_DEVIATION, SIFT_CONTRAST = 22.0, 0.02


def measured_pair() -> tuple[Measurement, Measurement]:
    """Return two captures of the door that overlap by some 40 %."""
    scene = make_scene("door", 1, texture_density=DENSITY)
    return measure_scene(scene, 0), measure_scene(scene, 1)


def grey_image(image: TextureImage) -> np.ndarray:
    """Return the texture image in grey levels for OpenCV, so that SIFT finds as much as it can in it."""
    deviation = 1.4826 * float(np.median(np.abs(image.value[image.mask])))
    grey = np.clip(127.5 + GREY_PER_DEVIATION / deviation * image.value, 0, 255)
    return np.where(image.mask, grey, 127.5).astype(np.uint8)


def peak_mib(files: tuple[Path, Path], options: RegisterOptions, pitch_mm: float) -> float:
    """Return the largest memory [MiB] of a worker that reads, prepares and registers two measurements."""
    first, second = (prepare(Measurement.load(file), pitch_mm, options, 1) for file in files)
    register_pair(first, second, options, 1, 1)
    # Not ru_maxrss: a process inherits that from the one that has started it, here with images and peers in memory.
    status = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
    return int(status["VmHWM"].split()[0]) / 1024


def worker_memory(a: Measurement, b: Measurement, options: RegisterOptions, pitch_mm: float) -> float:
    """Return `peak_mib` of a process that has done nothing else."""
    with tempfile.TemporaryDirectory() as folder:
        files = Path(folder) / "a.h5", Path(folder) / "b.h5"
        a.save(files[0])
        b.save(files[1])
        with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
            return pool.submit(peak_mib, files, options, pitch_mm).result()


def refined_again(a: Prepared, b: Prepared, result: PairResult, options: RegisterOptions, threads: int) -> np.ndarray:
    """Return the refined transform of a pair from its coarse one, as `register_pair` finds it."""
    refined = refine_pair(a, b, result.T_coarse_a_b, options, threads, within_mm=options.verdict.verify.agree_mm)
    assert refined is not None
    return refined.T_a_b


def overlap(a: Prepared, b: Prepared, T_a_b: np.ndarray, threads: int) -> OverlapEvaluation:
    """Return the evaluation of a pair's overlap, as a registration of files does it."""
    sides = (evaluation.Prepared(p.measurement, p.surface, p.contrast, threads) for p in (a, b))
    return evaluate_overlap(*sides, T_a_b, threads=threads)


def on_threads(function: Callable[[int], Value], runs: int) -> tuple[Row, Value]:
    """Return the processor time in one thread, the time on the clock with two, and what the call returned."""
    seconds, found = timed(lambda: function(1), runs, process_time)
    return {"seconds": seconds, "wall": timed(lambda: function(2), runs)[0]}, found


def texture_rows(a: Measurement, options: RegisterOptions, pitch_mm: float, runs: int) -> Iterator[Row]:
    """Yield the times from a measurement with its surface to keypoints."""
    surface = fit_surface(a, options.surface, 1)
    contrast_s, contrast = timed(lambda: local_contrast(a, options.photometric, surface, threads=1), runs, process_time)
    drawing_s, images = timed(
        lambda: texture_images(a, surface, contrast, pitch_mm, plan_charts(a, surface, options.charts)),
        runs, process_time,
    )  # fmt: skip
    both_wall_s, _ = timed(lambda: draw_on_surface(a, surface, pitch_mm, options, 2), runs)
    yield {"what": "local contrast", "seconds": contrast_s}
    yield {"what": "texture images", "seconds": drawing_s}
    yield {"what": "both (a texture from a measurement)", "seconds": contrast_s + drawing_s, "wall": both_wall_s,
           "limit": 0.08}  # fmt: skip
    keypoints_s, _ = timed(lambda: detect_keypoints(images, options.keypoints), runs, process_time)
    greys = [grey_image(image) for image in images]
    sift = cv2.SIFT.create(KEYPOINTS, contrastThreshold=SIFT_CONTRAST)
    sift_s, _ = timed(lambda: [sift.detectAndCompute(g, None) for g in greys], runs, process_time)
    yield {"what": "keypoints", "seconds": keypoints_s, "peer": "OpenCV SIFT, same images",
           "ratio": keypoints_s / sift_s}  # fmt: skip


def matching_rows(first: Prepared, second: Prepared, options: RegisterOptions, runs: int) -> Iterator[Row]:
    """Yield the times from keypoints to a coarse transform."""
    sides = [PatchSide(p.keypoints, p.images, p.patches) for p in (first, second)]
    matching_s, matches = timed(lambda: match(*sides, options.match, 1), runs, process_time)
    consensus_s, _ = timed(lambda: find_consensus(matches, options.consensus, 1), runs, process_time)
    wall_s, _ = timed(lambda: find_consensus(match(*sides, options.match, 2), options.consensus, 2), runs)
    words = [np.asarray(p.keypoints.descriptors, np.float32) for p in (first, second)]
    matcher = cv2.BFMatcher(cv2.NORM_L2)
    brute_s, _ = timed(lambda: matcher.knnMatch(*words, k=2), runs, process_time)
    n = min(len(first.keypoints), len(second.keypoints))
    yield {"what": f"matching ({n} keypoints)", "seconds": matching_s, "peer": "OpenCV brute force, ratio test only",
           "ratio": matching_s / brute_s}  # fmt: skip
    yield {"what": f"consensus ({len(matches)} matches)", "seconds": consensus_s}
    yield {"what": "matching and consensus", "seconds": matching_s + consensus_s, "wall": wall_s, "limit": 0.15}


def pair_rows(first: Prepared, second: Prepared, options: RegisterOptions, runs: int) -> Iterator[Row]:
    """Yield the times of refinement and evaluation, and of the whole pair."""
    pair, result = on_threads(lambda threads: register_pair(first, second, options, 1, threads), runs)
    refinement, T_a_b = on_threads(lambda threads: refined_again(first, second, result, options, threads), runs)
    evaluated, _ = on_threads(lambda threads: overlap(first, second, T_a_b, threads), runs)
    yield {"what": "refinement"} | refinement
    yield {"what": "evaluation of the overlap"} | evaluated
    yield {"what": "both", "limit": 0.1} | {key: refinement[key] + evaluated[key] for key in refinement}
    yield {"what": f"the whole pair, refinement included ({result.status})"} | pair


@kept_memory()
def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=5)
    runs = parser.parse_args().runs
    os.environ["PLANISH_THREADS"] = "1"
    cv2.setNumThreads(1)
    a, b = measured_pair()
    options = RegisterOptions.model_validate({"keypoints": {"max_keypoints": KEYPOINTS}})
    options, pitch = options.scaled(length_factor(common_gsd([a, b]))), common_pitch([a, b])
    rows = list(texture_rows(a, options, pitch, runs))
    first, second = (prepare(m, pitch, options, 1) for m in (a, b))
    rows += [*matching_rows(first, second, options, runs), *pair_rows(first, second, options, runs)]
    memory = worker_memory(a, b, options, pitch)
    rows.append({"what": "peak memory of a worker that registers the pair", "memory": memory, "limit": 1024.0})
    print(*rows, sep="\n")
    columns = {
        "what": "stage, one thread", "seconds": "processor time [s]",
        "wall": "elapsed, two threads [s]", "memory": "[MiB]", "limit": "to reach",
        "peer": "peer", "ratio": "over the peer",
    }  # fmt: skip
    formats = {"seconds": ".3f", "wall": ".3f", "memory": ".0f", "ratio": ".2f"}
    save_table("pair-speed", columns, rows, f"python benchmarks/pair_speed.py --runs {runs}", formats)


if __name__ == "__main__":
    main()
