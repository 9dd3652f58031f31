"""All that the images of one camera say about themselves, before they are decoded."""

from __future__ import annotations

from collections.abc import Sequence

from planish.measurement import Finding, NoiseModel
from planish.sensing.capture.images import GreyImage
from planish.sensing.capture.sequence import Layout
from planish.sensing.checks.movement import check_movement
from planish.sensing.checks.order import check_order


def check_images(
    images: Sequence[GreyImage], layouts: Sequence[Layout], noise: NoiseModel, saturation: float, camera: str,
    subject: str, threads: int,
) -> tuple[Finding, ...]:  # fmt: skip
    """Return the findings about the images (H, W) of a camera.

    Raises
    ------
    InputError
        Where they are in another order than declared, show no fringes, are saturated, or something moved.
    """
    # Images in the wrong order look as if something had moved: ask for the order first.
    order = check_order(images, layouts, noise, saturation, camera, subject)
    return (*order, *check_movement(images, layouts, noise, saturation, camera, subject, threads))
