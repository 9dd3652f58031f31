"""The light: the projector's highlights and fall-off, room light fixed to the part, another lamp."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from planish.geometry import Array
from planish.rig import Rig


@dataclass(frozen=True)
class Lamp:
    """A distant lamp: irradiance as a share of the projector's, direction from the part to the lamp, and its frame."""

    strength: float
    direction: tuple[float, float, float]
    frame: Literal["object", "sensor"] = "object"


@dataclass(frozen=True)
class Light:
    """How the part is lit.

    Parameters
    ----------
    specular : float
        Strength of the GGX microfacet lobe (0 = matt).
    roughness : float
        GGX alpha.
    ambient : float
        Room light that falls on every point, as a share of the projector's irradiance at the sensor frame's origin.
    ambient_gradient_per_mm : tuple of float
        Relative change of the room light per mm in the object frame: the light stays with the part.
    lamp : Lamp or None
        Another lamp.
    """

    specular: float = 0.03
    roughness: float = 0.35
    ambient: float = 0.03
    ambient_gradient_per_mm: tuple[float, float, float] = (6e-4, -4e-4, 0.0)
    lamp: Lamp | None = None


def kernel_light(light: Light, rig: Rig, T_object_sensor: Array) -> dict[str, Any]:
    """Return the light for the core, in the object frame."""
    assert rig.projector is not None
    direction, strength = np.array([0.0, 0.0, 1.0]), 0.0
    if light.lamp is not None:
        direction, strength = np.asarray(light.lamp.direction, float), light.lamp.strength
        if light.lamp.frame == "sensor":
            direction = T_object_sensor[:3, :3] @ direction
    return {
        "reference_distance": float(np.linalg.norm(rig.projector.center_sensor)),
        "specular": float(light.specular),
        "roughness": float(light.roughness),
        "ambient": float(light.ambient),
        "ambient_gradient": np.asarray(light.ambient_gradient_per_mm, float),
        "lamp": float(strength),
        "lamp_direction": direction / np.linalg.norm(direction),
    }
