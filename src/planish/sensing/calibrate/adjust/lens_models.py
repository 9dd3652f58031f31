"""The ladder of lens models, from the simplest to the richest, and what holds a device that few views see."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from planish.rig import Camera
from planish.rig.parameters import PROJECTOR
from planish.sensing.calibrate.adjust.problem import Pseudo

#: Distortion coefficients of the models, simplest first; "radial" is that of the starting paper.
COEFFICIENTS: Mapping[str, tuple[str, ...]] = {
    "none": (),
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
    "radial": "radial distortion k1 k2",
    "radial 3": "radial distortion k1 k2 k3",
    "tangential": "radial and tangential distortion k1 k2 p1 p2",
    "tangential 3": "radial and tangential distortion k1 k2 k3 p1 p2",
    "rational": "rational and tangential distortion k1 ... k6 p1 p2",
    "prism": "rational, tangential and thin-prism distortion",
}
#: Below this number of views the principal point and the form of the pixels may be held.
FEW_VIEWS = 6
#: Standard deviations of what holds them: fy / fx - 1, and the principal point's distance from the middle as a share of
#: the image's size; many projectors look past their middle on purpose, so that theirs is free by a whole image.
ASPECT_SIGMA, MIDDLE_SIGMA, PROJECTOR_SIGMA = 0.002, 0.03, 1.0
#: Standard deviation of each term of a held model's distortion in the image's corners, as a share of their distance.
DISTORTION_SIGMA = 0.05
#: Powers of that distance to which the coefficients of held models go.
POWERS = {"k1": 2, "k2": 4, "p1": 1, "p2": 1}


@dataclass(frozen=True, order=True)
class Model:
    """A step of the ladder: `held` models have square pixels and the principal point near the middle, weakly."""

    name: str
    held: bool = False

    @property
    def coefficients(self) -> tuple[str, ...]:
        """Names of the free distortion coefficients."""
        return COEFFICIENTS[self.name]

    @property
    def words(self) -> str:
        """The model in words."""
        held = f", square pixels (within {ASPECT_SIGMA:.1%}) and a weakly held principal point" if self.held else ""
        return WORDS[self.name] + held

    @property
    def label(self) -> str:
        """Name of the model in results."""
        return f"{self.name}, held" if self.held else self.name


def ladder(views: int) -> tuple[Model, ...]:
    """Return the models to try, simplest first; held ones come with few views only.

    "none" is for those who ask for it: a distortion too small to be seen still moves focal length and places of the
    devices by many of the standard deviations that would be stated without it.
    """
    if views >= FEW_VIEWS:
        return tuple(Model(name) for name in COEFFICIENTS if name != "none")
    return tuple(Model(name, held) for held in (True, False) for name in ("radial", "tangential"))


def held_pseudo(device: str, camera: Camera, coefficients: Sequence[str]) -> tuple[Pseudo, ...]:
    """Return pseudo-observations of square pixels, a principal point near the middle, and distortion near none."""
    width, height = camera.size_px
    ratio = camera.K[1, 1] / camera.K[0, 0]
    # A projector with mirrors on a diamond has pixels of 2 : 1; the start has told which.
    aspect = min((1.0, 2.0, 0.5), key=lambda value: abs(ratio / value - 1))
    middle = (PROJECTOR_SIGMA if device == PROJECTOR else MIDDLE_SIGMA) * width
    corner = 0.5 * float(np.hypot(width / camera.K[0, 0], height / camera.K[1, 1]))
    lens = (Pseudo(device, {name: 1.0}, 0.0, DISTORTION_SIGMA / corner ** POWERS[name]) for name in coefficients)
    return (
        Pseudo(device, {"fy": 1.0, "fx": -aspect}, 0.0, ASPECT_SIGMA * camera.K[1, 1]),
        Pseudo(device, {"cx": 1.0}, (width - 1) / 2, middle),
        Pseudo(device, {"cy": 1.0}, (height - 1) / 2, middle),
        *lens,
    )
