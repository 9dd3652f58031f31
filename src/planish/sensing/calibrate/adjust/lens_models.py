"""The ladder of lens models, from the simplest to the richest, and what holds a device that few views see."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from planish.rig import Camera
from planish.rig.parameters import PROJECTOR
from planish.sensing.calibrate.adjust.problem import Pseudo

#: Distortion coefficients of the models, simplest first; "radial" is that of the starting paper.
COEFFICIENTS: Mapping[str, tuple[str, ...]] = {
    "none": (),
    "radial 1": ("k1",),
    "radial": ("k1", "k2"),
    "radial 3": ("k1", "k2", "k3"),
    "tangential": ("k1", "k2", "p1", "p2"),
    "tangential 3": ("k1", "k2", "p1", "p2", "k3"),
    "rational": ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    "prism": ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4"),
}
#: In words, for sentences and reports.
WORDS: Mapping[str, str] = {
    "none": "no distortion",
    "radial 1": "radial distortion k1",
    "radial": "radial distortion k1 k2",
    "radial 3": "radial distortion k1 k2 k3",
    "tangential": "radial and tangential distortion k1 k2 p1 p2",
    "tangential 3": "radial and tangential distortion k1 k2 k3 p1 p2",
    "rational": "rational and tangential distortion k1 ... k6 p1 p2",
    "prism": "rational, tangential and thin-prism distortion",
}
#: Below this number of views the principal point and the form of the pixels may be held.
FEW_VIEWS = 6
#: Standard deviations of what holds them: fy / fx - 1, and the principal point's distance from the middle as a share
#: of the image's width; a projector looks upwards or downwards, so that its middle is free by a whole height.
ASPECT_SIGMA, MIDDLE_SIGMA, HEIGHT_SIGMA = 0.002, 0.03, 1.0


@dataclass(frozen=True, order=True)
class Model:
    """A step of the ladder: `held` models have square pixels and the principal point near the middle."""

    name: str
    held: bool = False

    @property
    def coefficients(self) -> tuple[str, ...]:
        """Names of the free distortion coefficients."""
        return COEFFICIENTS[self.name]

    @property
    def words(self) -> str:
        """The model in words."""
        held = f", square pixels (within {ASPECT_SIGMA:.1%}) and a middle principal point" if self.held else ""
        return WORDS[self.name] + held

    @property
    def label(self) -> str:
        """Name of the model in results."""
        return f"{self.name}, held" if self.held else self.name


def ladder(views: int) -> tuple[Model, ...]:
    """Return the models to try, simplest first; held ones come with few views only."""
    if views >= FEW_VIEWS:
        # A k2 that the boards hardly show is still a k2: without it the covariance would claim too much.
        return tuple(Model(name) for name in COEFFICIENTS if name != "radial 1")
    return (*(Model(name, True) for name in ("none", "radial 1", "radial")), *(Model(name) for name in COEFFICIENTS))


def held_pseudo(device: str, camera: Camera) -> tuple[Pseudo, ...]:
    """Return pseudo-observations of square pixels and a principal point near the middle of the image."""
    width, height = camera.size_px
    ratio = camera.K[1, 1] / camera.K[0, 0]
    # A projector with mirrors on a diamond has pixels of 2 : 1; the start has told which.
    aspect = min((1.0, 2.0, 0.5), key=lambda value: abs(ratio / value - 1))
    vertical = HEIGHT_SIGMA * height if device == PROJECTOR else MIDDLE_SIGMA * width
    return (
        Pseudo(device, {"fy": 1.0, "fx": -aspect}, 0.0, ASPECT_SIGMA * camera.K[1, 1]),
        Pseudo(device, {"cx": 1.0}, (width - 1) / 2, MIDDLE_SIGMA * width),
        Pseudo(device, {"cy": 1.0}, (height - 1) / 2, vertical),
    )
