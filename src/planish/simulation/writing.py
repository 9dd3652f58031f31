"""The files of a simulated run: per capture a folder that `measure` reads, beside them the truth."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import cv2
import numpy as np

from planish import storage
from planish.errors import InputError
from planish.options import thread_count
from planish.sensing.capture.manifest import SCHEMA as CAPTURE_SCHEMA
from planish.sensing.patterns.entries import Entry
from planish.sensing.patterns.sequences import entry_label
from planish.simulation.render import Images, render_capture, trace_capture
from planish.simulation.scenes import Scene

TRUTH_SCHEMA = "planish.truth/1"


def write_scene(
    scene: Scene, out: Path, *, true_points: bool = True, only: Collection[int] | None = None,
    threads: int | None = None, progress: Callable[[str], None] = lambda name: None,
) -> list[Path]:  # fmt: skip
    """Render and write all captures, or those whose numbers are in `only`; return their folders.

    Writes out/NAME/{capture.json, rig.json, A_00_....png, ...}, out/truth.json and, with `true_points`,
    out/NAME/truth_A.npz and truth_B.npz: `points_sensor` (H, W, 3) float32 [mm], NaN where there is none, and `seen`
    (H, W), the pixels whose point both cameras see and the projector lights.

    Raises
    ------
    InputError
        Where `out` cannot be written.
    """
    out = Path(out)
    folders = []
    for index, name in enumerate(scene.names):
        if only is not None and index not in only:
            continue
        progress(name)
        folder = out / name
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(folder, f"cannot be made ({error.strerror})", "a folder that can be written") from None
        scene.rig.save(folder / "rig.json")
        write_capture(folder, scene, render_capture(scene, index, threads), thread_count(threads), rig="rig.json")
        if true_points:
            for camera in scene.rig.cameras:
                points, seen = trace_capture(scene, index, camera, threads)
                with storage.replacing(folder / f"truth_{camera}.npz") as temporary, temporary.open("wb") as file:
                    np.savez(file, points_sensor=points.astype(np.float32), seen=seen)
        folders.append(folder)
    storage.write_json(out / "truth.json", {"schema": TRUTH_SCHEMA, "measurements": _truth(scene)})
    return folders


def _truth(scene: Scene) -> list[dict[str, object]]:
    return [
        {"name": name, "part": scene.part, "T_object_sensor": T.tolist()}
        for name, T in zip(scene.names, scene.T_object_sensor, strict=True)
    ]


def write_capture(folder: Path, scene: Scene, images: dict[str, Images], threads: int, rig: str | None) -> None:
    """Write the images (N, H, W) of each camera into a folder and their capture.json, which names the file `rig`."""
    names = {camera: _image_names(camera, scene.sequence) for camera in images}
    jobs = [(folder / names[camera][k], stack[k]) for camera, stack in images.items() for k in range(len(stack))]
    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(lambda job: write_png(*job), jobs))
    assert scene.rig.projector is not None
    manifest = {
        "schema": CAPTURE_SCHEMA,
        "name": folder.name,
        **({} if rig is None else {"rig": rig}),
        "images": names,
        "sequence": [entry.model_dump(exclude_none=True) for entry in scene.sequence],
        "projector_px": list(scene.rig.projector.size_px),
    }
    storage.write_json(folder / "capture.json", manifest)


def _image_names(camera: str, sequence: Sequence[Entry]) -> list[str]:
    return [f"{camera}_{k:02d}_{entry_label(entry)}.png" for k, entry in enumerate(sequence)]


def write_png(path: Path, image: Images) -> None:
    """Write one image (H, W); raises InputError where the folder cannot be written."""
    # Noise never repeats: the search for repetitions would cost time and even space.
    options = [cv2.IMWRITE_PNG_COMPRESSION, 1, cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_HUFFMAN_ONLY]
    done, data = cv2.imencode(".png", image, options)
    if not done:
        raise AssertionError(f"{path}: PNG encoding failed")
    try:
        with storage.replacing(path) as temporary:
            data.tofile(temporary)
    except OSError as error:
        raise InputError(path, f"cannot be written ({error.strerror})", "a writable folder") from None
