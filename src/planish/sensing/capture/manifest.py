"""The capture: a manifest that says what each image of a fringe sequence shows (`capture.json`, planish.capture/1)."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, PositiveInt

from planish import storage
from planish.errors import InputError
from planish.options import Strict, thread_count
from planish.rig import Rig
from planish.rig.files import import_rig, rig_format
from planish.sensing.capture.images import GreyImage, describe, read_grey
from planish.sensing.patterns.entries import Entry

SCHEMA = "planish.capture/1"


class Box(Strict):
    """An axis-parallel box in the sensor frame [mm]."""

    min: tuple[float, float, float]
    max: tuple[float, float, float]


class Images(Strict):
    """File names per camera, in the order of the sequence."""

    A: list[str]
    B: list[str] | None = None


class Manifest(Strict):
    """Content of `capture.json`.

    `rig` names a planish rig.json, the YAML or XML files of an OpenCV calibration, or a MAT-file with MATLAB's struct.
    Captures that are to calibrate have none yet.
    """

    schema_: Literal["planish.capture/1"] = Field(alias="schema")
    name: str | None = Field(default=None, min_length=1, pattern=r"^[^/\\]+$")
    rig: str | list[str] | None = None
    images: Images
    sequence: list[Entry] = Field(min_length=1)
    projector_px: tuple[PositiveInt, PositiveInt] | None = None
    mask: dict[Literal["A", "B"], str] | None = None
    volume_mm: Box | None = None


@dataclass(frozen=True)
class Capture:
    """A checked manifest with the folders its names are relative to."""

    name: str
    path: Path
    images_dir: Path
    manifest: Manifest

    @property
    def cameras(self) -> tuple[str, ...]:
        """Names of the cameras that took images."""
        return ("A",) if self.manifest.images.B is None else ("A", "B")

    @classmethod
    def load(cls, path: Path, images_dir: Path | None = None) -> Capture:
        """Read `capture.json` (or the folder that holds it); images lie in `images_dir`, default its folder."""
        path = Path(path)
        if path.is_dir():
            path = path / "capture.json"
        manifest = Manifest.parse(storage.read_json(path), str(path))
        for camera, names in (("A", manifest.images.A), ("B", manifest.images.B)):
            if names is not None and len(names) != len(manifest.sequence):
                raise InputError(
                    path,
                    f"images.{camera} names {len(names)} images",
                    f"{len(manifest.sequence)}, one per entry of 'sequence'",
                )
        folder = path.parent if images_dir is None else Path(images_dir)
        return cls(manifest.name or path.resolve().parent.name, path, folder, manifest)

    def load_rig(self, organise_on: str, files: Sequence[Path] | None = None) -> Rig:
        """Return the rig of the manifest, or of the `files` given instead.

        One imported from OpenCV or MATLAB gets the frame of the organising camera as sensor frame.

        Raises
        ------
        InputError
            Where there is none, or it cannot be read or is of another image size.
        """
        if files is None:
            if self.manifest.rig is None:
                raise InputError(self.path, "names no rig", "'rig', the file of the calibration, or --rig FILE")
            names = [self.manifest.rig] if isinstance(self.manifest.rig, str) else self.manifest.rig
            files = [self._inside(name, prefer=self.path.parent) for name in names]
        if all(rig_format(path) == "planish" for path in files):
            return import_rig(files).rig
        height, width = self.read_image("A", 0).shape
        rig = import_rig(files, (width, height), self.manifest.projector_px).rig
        return rig.in_frame_of(organise_on) if organise_on in rig.cameras else rig

    def image_path(self, camera: str, index: int) -> Path:
        """Return the path of one image."""
        names = self.manifest.images.A if camera == "A" else self.manifest.images.B
        assert names is not None
        return self._inside(names[index])

    def read_image(self, camera: str, index: int) -> GreyImage:
        """Return one image (H, W), uint8 or uint16."""
        return read_grey(self.image_path(camera, index))

    def read_images(self, camera: str, threads: int | None = None) -> list[GreyImage]:
        """Return all images of a camera (each (H, W), one type and size), read in parallel."""
        with ImageReader(self, (camera,), thread_count(threads)) as reader:
            return reader.take(camera)

    def read_mask(self, camera: str) -> NDArray[np.bool_] | None:
        """Return the mask (H, W) of a camera, True where the image counts, or None."""
        for name, file in (self.manifest.mask or {}).items():
            if name == camera:
                return read_grey(self._inside(file)) > 0
        return None

    def _inside(self, name: str, prefer: Path | None = None) -> Path:
        for folder in (prefer, self.images_dir):
            if folder is None:
                continue
            exists = inside_folder(folder, name, self.path).is_file()
            if exists or folder == self.images_dir:
                return folder / name
        raise AssertionError


def inside_folder(folder: Path, name: str, subject: Path) -> Path:
    """Return the path of a name inside a folder.

    Raises
    ------
    InputError
        Where the name leaves the folder or is none; it names `subject`, the manifest.
    """
    try:
        path = (folder / name).resolve()
        path.is_file()
    except (OSError, ValueError, RuntimeError):  # too long, a zero byte, a circle of links
        raise InputError(subject, f"'{name[:80]}' is no file name", "a name inside the folder") from None
    # A manifest from outside must not make us read files elsewhere on the machine.
    if not path.is_relative_to(folder.resolve()):
        raise InputError(subject, f"the name '{name}' leaves the folder {folder}", "a name inside it")
    return folder / name


class ImageReader:
    """Reads all images of a capture side by side, in the order of the cameras, while those that came are used.

    Parameters
    ----------
    capture : Capture
        What to read.
    cameras : sequence of str
        Names; the first is wanted first.
    threads : int
        Images read at a time.
    """

    def __init__(self, capture: Capture, cameras: Sequence[str], threads: int) -> None:
        self._capture = capture
        self._pool = ThreadPoolExecutor(threads)
        self._images: dict[str, list[Future[GreyImage]]] = {
            camera: [self._pool.submit(capture.read_image, camera, k) for k in range(len(capture.manifest.sequence))]
            for camera in cameras
        }

    def take(self, camera: str) -> list[GreyImage]:
        """Wait for the images (each (H, W), one type and size) of a camera, and forget them.

        Raises
        ------
        InputError
            Where one cannot be read, or differs in size or type; the message names the file.
        """
        images = [future.result() for future in self._images.pop(camera)]
        for index, image in enumerate(images):
            if image.shape != images[0].shape or image.dtype != images[0].dtype:
                raise InputError(
                    self._capture.image_path(camera, index),
                    f"is {describe(image)}",
                    f"{describe(images[0])} like {self._capture.image_path(camera, 0).name}",
                )
        return images

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        # An error or an interrupt must not wait for images that nobody will use.
        self._pool.shutdown(cancel_futures=True)
