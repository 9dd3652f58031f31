"""The capture: a manifest that says what each image of a fringe sequence shows (`capture.json`, planish.capture/1)."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field, PositiveFloat, PositiveInt, model_validator

from planish import storage
from planish.errors import InputError
from planish.options import Strict, thread_count
from planish.rig import Rig
from planish.sensing.opencv_rig import read_opencv_rig

SCHEMA = "planish.capture/1"

#: Grey values (H, W) of one image, uint8 or uint16.
GreyImage = NDArray[np.uint8] | NDArray[np.uint16]


class White(Strict):
    """Every projector pixel on."""

    role: Literal["white"]


class Black(Strict):
    """Every projector pixel off."""

    role: Literal["black"]


class Phase(Strict):
    """One step of a phase shift: I = A + B cos(phi - sign 2 pi step / steps), phi = 2 pi u / period_px.

    `wave` "square" is a square wave shifted in equal steps, read as if it were a cosine.
    """

    role: Literal["phase"]
    axis: Literal["u", "v"] = "u"
    period_px: PositiveFloat
    step: int = Field(ge=0)
    steps: int = Field(ge=3)
    sign: Literal[1, -1] = 1
    wave: Literal["sine", "square"] = "sine"

    @model_validator(mode="after")
    def _step_in_range(self) -> Self:
        if self.step >= self.steps:
            raise ValueError(f"step {self.step} must be below steps = {self.steps}")
        return self


class Gray(Strict):
    """One bit of the reflected Gray code of the cell index; bit b has weight 2^b; cell k starts at pixel k cell_px.

    With cells of half a fringe period the lowest bit is what is known as the complementary bit.
    """

    role: Literal["gray"]
    axis: Literal["u", "v"] = "u"
    bit: int = Field(ge=0, le=15)
    inverse: bool = False
    cell_px: PositiveFloat = 1.0


Entry = Annotated[White | Black | Phase | Gray, Field(discriminator="role")]


class Box(Strict):
    """An axis-parallel box in the sensor frame [mm]."""

    min: tuple[float, float, float]
    max: tuple[float, float, float]


class Images(Strict):
    """File names per camera, in the order of the sequence."""

    A: list[str]
    B: list[str] | None = None


class Manifest(Strict):
    """Content of `capture.json`. `rig` names a planish rig.json, or the YAML files of an OpenCV stereo calibration."""

    schema_: Literal["planish.capture/1"] = Field(alias="schema")
    name: str | None = Field(default=None, min_length=1, pattern=r"^[^/\\]+$")
    rig: str | list[str]
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

    def load_rig(self, organise_on: str) -> Rig:
        """Return the rig; one imported from OpenCV files gets the frame of the organising camera as sensor frame."""
        if isinstance(self.manifest.rig, str) and self.manifest.rig.endswith(".json"):
            return Rig.load(self._inside(self.manifest.rig, prefer=self.path.parent))
        names = [self.manifest.rig] if isinstance(self.manifest.rig, str) else self.manifest.rig
        files = [self._inside(name, prefer=self.path.parent) for name in names]
        height, width = self.read_image("A", 0).shape
        rig = read_opencv_rig(files, (width, height))
        return rig.in_frame_of(organise_on)

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
        count = len(self.manifest.sequence)
        with ThreadPoolExecutor(thread_count(threads)) as pool:
            images = list(pool.map(lambda i: self.read_image(camera, i), range(count)))
        for index, image in enumerate(images):
            if image.shape != images[0].shape or image.dtype != images[0].dtype:
                raise InputError(
                    self.image_path(camera, index),
                    f"is {_describe(image)}",
                    f"{_describe(images[0])} like {self.image_path(camera, 0).name}",
                )
        return images

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
            try:
                path = (folder / name).resolve()
                exists = path.is_file()
            except (OSError, ValueError, RuntimeError):  # too long, a zero byte, a circle of links
                raise InputError(self.path, f"'{name[:80]}' is no file name", "a name inside the folder") from None
            # A manifest from outside must not make us read files elsewhere on the machine.
            if not path.is_relative_to(folder.resolve()):
                raise InputError(self.path, f"the name '{name}' leaves the folder {folder}", "a name inside it")
            if exists or folder == self.images_dir:
                return folder / name
        raise AssertionError


def read_grey(path: Path) -> GreyImage:
    """Return a grey image (H, W), uint8 or uint16; errors name the file."""
    if not path.is_file():
        raise InputError(path, "no such file", "an image of the sequence")
    try:
        image: Any = cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_UNCHANGED) if _whole(path) else None
    except (cv2.error, OSError):
        image = None
    if image is None:
        raise InputError(path, "cannot be decoded: truncated or not an image", "a grey image of 8 or 16 bit")
    if image.ndim != 2 or image.dtype not in (np.uint8, np.uint16):
        raise InputError(path, f"is {_describe(image)}", "a grey image of 8 or 16 bit (one channel)")
    return image


def _whole(path: Path) -> bool:
    # Some versions of OpenCV return a truncated PNG with its missing rows black and no error: look for the end chunk.
    with path.open("rb") as file:
        start = file.read(8)
        if start != b"\x89PNG\r\n\x1a\n":
            return len(start) > 0
        file.seek(max(0, path.stat().st_size - 64))
        return b"IEND" in file.read()


def _describe(image: NDArray[Any]) -> str:
    channels = "" if image.ndim == 2 else f", {image.shape[2]} channels"
    return f"{image.shape[1]} x {image.shape[0]} px, {8 * image.dtype.itemsize} bit{channels}"
