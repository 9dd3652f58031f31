"""Simulated captures measured straight from memory: the same path as from files, without writing and reading them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from planish import _core
from planish.measurement import Measurement
from planish.pipeline import measure
from planish.rig import Rig
from planish.sensing.capture.images import GreyImage
from planish.sensing.capture.manifest import SCHEMA, Capture, Images, Manifest
from planish.simulation.render import render_capture
from planish.simulation.scenes import Scene


@dataclass(frozen=True)
class RenderedCapture(Capture):
    """A capture whose images and rig are in memory."""

    rendered: Mapping[str, GreyImage]
    rig: Rig

    def read_image(self, camera: str, index: int) -> GreyImage:
        """Return one image (H, W)."""
        return self.rendered[camera][index]

    def load_rig(self, organise_on: str, files: object = None) -> Rig:
        """Return the true rig."""
        return self.rig


def measure_scene(scene: Scene, index: int, name: str | None = None) -> Measurement:
    """Render capture `index` of a scene and measure it; errors are those of `measure`."""
    return measure_rendered(render_scene(scene, index, name))


def render_scene(scene: Scene, index: int, name: str | None = None) -> RenderedCapture:
    """Return capture `index` of a scene, with the true rig."""
    images = render_capture(scene, index, 1)
    name = name or scene.names[index]
    files = {camera: [f"{camera}_{k}" for k in range(len(stack))] for camera, stack in images.items()}
    assert scene.rig.projector is not None
    manifest = Manifest(
        schema=SCHEMA, name=name, images=Images(**files), sequence=list(scene.sequence),
        projector_px=scene.rig.projector.size_px,
    )  # fmt: skip
    return RenderedCapture(name, Path(f"{scene.part}.json"), Path(), manifest, images, scene.rig)


def measure_rendered(capture: RenderedCapture, rig: Rig | None = None) -> Measurement:
    """Measure a rendered capture, with another rig than the true one where it is given."""
    # Over many parts, what the allocator keeps of freed maps would add up to gigabytes.
    _core.release_memory()
    capture = capture if rig is None else replace(capture, rig=rig)
    return replace(measure(capture, threads=1), name=capture.name)
