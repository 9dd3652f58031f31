"""The Measurement: one textured 3D view of a part on one camera's own pixel grid, and its HDF5 file."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from planish import storage
from planish.errors import InputError
from planish.rig import Camera, Rig

SCHEMA = "planish.measurement/1"

Map = NDArray[np.float32]

#: Why a pixel has no point: bit i of `Measurement.rejected` is the i-th name. 0 = a valid point.
REJECTIONS = (
    "masked",  # excluded by the capture's mask or volume
    "dark",  # modulation below what its noise allows to decode
    "saturated",  # fewer than three unsaturated phase steps
    "slip",  # the whole periods contradict each other: Gray code, coarser and finer fringes
    "interreflection",  # coarse and fine fringes disagree by less than a period: light came by two ways
    "mixed",  # beside a jump of the projector position: the pixel sees two surfaces
    "unmatched",  # no point of equal position on the epipolar line: hidden from the other device
    "mismatch",  # the rays miss each other, or the third device's ray contradicts the point
    "edge",  # beside the rim of what is lit, or seen at grazing incidence
    "isolated",  # a small island without support from its neighbours
    "ambiguous",  # two places on the epipolar line fit alike
)


def rejection_bit(reason: str) -> np.uint16:
    """Return the bit of `Measurement.rejected` that stands for a reason of REJECTIONS."""
    return np.uint16(1 << REJECTIONS.index(reason))


def count_reasons(rejected: NDArray[np.uint16]) -> dict[str, int]:
    """Return how many pixels (H, W) each of REJECTIONS decided about: the first of a pixel's reasons."""
    # A table of all values instead of a pass per reason.
    table = np.bincount(rejected.ravel(), minlength=1 << len(REJECTIONS))
    counts = dict.fromkeys(REJECTIONS, 0)
    for value in np.flatnonzero(table[1:]) + 1:
        counts[REJECTIONS[int(value & -value).bit_length() - 1]] += int(table[value])
    return counts


@dataclass(frozen=True)
class Finding:
    """What a capture says about itself: a quantity with its standard deviation, or that it cannot be observed.

    Parameters
    ----------
    quantity : str
        What was asked, for example "movement in camera A".
    value : float or None
        Answer in `unit`; None = not observable.
    sigma : float or None
        Its standard deviation; None where unknown.
    unit : str
        "" = a pure number.
    source : str
        How it was found, or why it is not observable.
    warning : str
        What the user should know; empty where all is well.
    """

    quantity: str
    value: float | None
    sigma: float | None
    unit: str
    source: str
    warning: str = ""

    def __str__(self) -> str:
        """Return one line of text."""
        if self.value is None:
            return f"{self.quantity}: not observable ({self.source})"
        sigma = "" if self.sigma is None else f" +- {self.sigma:.2g}"
        unit = f" {self.unit}" if self.unit else ""
        return f"{self.quantity}: {self.value:.3g}{sigma}{unit} ({self.source})"


@dataclass(frozen=True)
class NoiseModel:
    """Variance of one image's grey value I: `offset` + `slope` * I [grey levels squared]."""

    offset: float
    slope: float

    def variance(self, image: Map) -> Map:
        """Return the variance (H, W) [grey levels squared] of a single image with grey values (H, W)."""
        return np.maximum(np.float32(self.offset) + np.float32(self.slope) * image, np.float32(1e-12))


@dataclass(frozen=True)
class View:
    """What one camera saw, on its own pixel grid, in grey levels of the original images.

    Parameters
    ----------
    white : ndarray (H, W) or None
        Image under blank projection, dark image subtracted where the sequence has one.
    mean : ndarray (H, W) or None
        Mean of the images whose patterns cancel in it (the texture with the least noise).
    modulation : ndarray (H, W) or None
        Amplitude of the fringes (texture under projector light alone).
    mean_images : int
        Number of images behind `mean`.
    noise : NoiseModel
        Noise of a single image; that of `mean` is `mean_images` times less in variance.
    saturation : float
        Grey level at and above which a pixel counts as saturated.
    """

    white: Map | None = field(metadata={"unit": "grey level"})
    mean: Map | None = field(metadata={"unit": "grey level"})
    modulation: Map | None = field(metadata={"unit": "grey level"})
    mean_images: int
    noise: NoiseModel
    saturation: float


@dataclass(frozen=True)
class Measurement:
    """A textured 3D measurement, organised on the pixel grid of one camera: one pixel = one point = one grey value.

    Parameters
    ----------
    name : str
        Unique name within a run.
    organised_on : "A" or "B"
        The camera whose pixel grid (H, W) organises the maps.
    rig : Rig
        Calibration; `points_sensor` are in its sensor frame.
    points_sensor : ndarray (H, W, 3) float32
        Points [mm]; NaN where there is none.
    sigma_mm : ndarray (H, W) float32
        Standard deviation along the organising camera's ray [mm]; NaN where there is no point.
    rejected : ndarray (H, W) uint16
        Bit mask of the names in REJECTIONS; 0 = valid.
    correspondence_px : ndarray (H, W, 2) float32 or None
        Pixel (u, v) of the same point in the other camera [px]; NaN where the point comes from camera and projector.
    views : dict of View
        Per camera name.
    texture_views : tuple of str
        Cameras whose images may serve as texture.
    resampled : bool
        True where an unorganised cloud was rendered onto the pixel grid.
    findings : tuple of Finding
        What the capture says about itself: movement, row error of the rig, gamma, ...
    position_px : ndarray (H, W) float32 or None
        Projector position that the organising camera decoded, along the axis that corresponding pixels were found by
        [projector px]: these lie where the other camera decoded the same. None where the points are not by fringes or
        Gray code.
    projector_weights : tuple of float or None
        By how much the projector's columns and rows count in points of camera and projector: inverse variances of the
        decoded positions, their sum 1; (1, 0): columns alone. None where no positions were decoded.
    """

    name: str
    organised_on: Literal["A", "B"]
    rig: Rig
    points_sensor: Map = field(metadata={"unit": "mm"})
    sigma_mm: Map = field(metadata={"unit": "mm"})
    rejected: NDArray[np.uint16] = field(metadata={"unit": "bit mask of REJECTIONS"})
    correspondence_px: Map | None = field(metadata={"unit": "px"})
    views: dict[str, View]
    texture_views: tuple[str, ...]
    resampled: bool
    findings: tuple[Finding, ...] = ()
    position_px: Map | None = field(default=None, metadata={"unit": "projector px"})
    projector_weights: tuple[float, float] | None = None

    @property
    def camera(self) -> Camera:
        """The organising camera."""
        return self.rig.cameras[self.organised_on]

    @cached_property
    def valid(self) -> NDArray[np.bool_]:
        """Pixels (H, W) that hold a point."""
        return np.asarray(np.isfinite(self.points_sensor[..., 2]))

    @cached_property
    def sample_distance_mm(self) -> float:
        """Median distance on the surface between neighbouring pixels [mm per pixel]; NaN where there are none."""
        steps = np.diff(self.points_sensor[::4].astype(np.float64), axis=1)
        lengths = np.sqrt(np.einsum("hwi,hwi->hw", steps, steps))
        lengths = lengths[np.isfinite(lengths)]
        return float(np.median(lengths)) if lengths.size else float("nan")

    @property
    def shape(self) -> tuple[int, int]:
        """(H, W) of the pixel grid."""
        return (self.points_sensor.shape[0], self.points_sensor.shape[1])

    def save(self, path: Path) -> None:
        """Write one HDF5 file (schema planish.measurement/1)."""
        storage.save(Path(path), self, SCHEMA)

    @classmethod
    def load(cls, path: Path) -> Measurement:
        """Read a file written by `save`; errors name the file."""
        return cls.of_content(storage.read_content(Path(path), SCHEMA), Path(path))

    @classmethod
    def of_content(cls, content: storage.Content, path: Path) -> Measurement:
        """Return the measurement of a file that has been read; its maps lie in `content`."""
        measurement = storage.load_content(content, path, cls, SCHEMA)
        measurement._check(str(path))
        return measurement

    def _check(self, subject: str) -> None:
        if self.organised_on not in self.rig.cameras:
            raise InputError(
                f"{subject}: organised_on", f"found {self.organised_on!r}", f"one of {[*self.rig.cameras]}"
            )
        width, height = self.camera.size_px
        maps: dict[str, tuple[Any, tuple[int, ...]]] = {
            "points_sensor": (self.points_sensor, (height, width, 3)),
            "sigma_mm": (self.sigma_mm, (height, width)),
            "rejected": (self.rejected, (height, width)),
            "correspondence_px": (self.correspondence_px, (height, width, 2)),
            "position_px": (self.position_px, (height, width)),
        }
        for name, view in self.views.items():
            if name not in self.rig.cameras:
                raise InputError(f"{subject}: views", f"found {name!r}", f"cameras of the rig: {[*self.rig.cameras]}")
            width, height = self.rig.cameras[name].size_px
            for key in ("white", "mean", "modulation"):
                maps[f"views/{name}/{key}"] = (getattr(view, key), (height, width))
        for name, (array, shape) in maps.items():
            if array is not None and np.shape(array) != shape:
                raise InputError(f"{subject}: {name}", f"shape {np.shape(array)}", f"{shape} like the camera's size_px")
        if not set(self.texture_views) <= set(self.views):
            raise InputError(f"{subject}: texture_views", f"found {self.texture_views}", f"some of {[*self.views]}")
