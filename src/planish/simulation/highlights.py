"""Highlights that saturate a given share of the image."""

from __future__ import annotations

from dataclasses import replace

from planish.errors import InputError
from planish.sensing.patterns.entries import White
from planish.simulation.render import render_capture
from planish.simulation.scenes import Scene
from planish.simulation.sensor import reference_rig

#: Microfacet roughness of the highlights: machined metal.
ROUGHNESS = 0.12
#: The strength is found in white images of this resolution, by so many bisections of its logarithm between these.
SCALE, BISECTIONS, WEAKEST, STRONGEST = 0.08, 10, 1e-3, 30.0


def with_highlights(scene: Scene, share: float, threads: int | None = None) -> Scene:
    """Return the scene with a shininess that saturates about `share` of camera A's pixels in the first white image.

    Raises
    ------
    InputError
        Where the share is out of range or no shininess reaches it.
    """
    if not 0 < share < 0.5:
        raise InputError("highlights", f"found {share:g}", "a share of the pixels above 0 and below 0.5")
    coarse = replace(
        scene, sequence=(White(role="white"),), rig=reference_rig(SCALE), background=None,
        sensor=replace(scene.sensor, bits=8, samples_per_px=2),
    )  # fmt: skip

    def shiny(item: Scene, strength: float) -> Scene:
        return replace(item, light=replace(item.light, specular=strength, roughness=ROUGHNESS))

    def saturated(strength: float) -> float:
        image = render_capture(shiny(coarse, strength), 0, threads)["A"][0]
        return float((image >= min(scene.sensor.saturation, 255)).sum() / (image > 0.15 * 255).sum())

    low, high = WEAKEST, STRONGEST
    if not saturated(low) < share <= saturated(high):
        raise InputError("highlights", f"no shininess saturates {share:.0%} of '{scene.part}'", "another share")
    for _ in range(BISECTIONS):
        middle = (low * high) ** 0.5
        low, high = (low, middle) if saturated(middle) >= share else (middle, high)
    return shiny(scene, high)
