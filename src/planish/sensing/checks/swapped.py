"""All that the rig says about a capture, and whether the images of its cameras were exchanged."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from planish.errors import InputError
from planish.measurement import Finding
from planish.rig import Rig
from planish.sensing.checks.rig import check_projector_ray, describe_row_error, row_error_of_positions
from planish.sensing.checks.texture_rows import row_error_of_textures
from planish.sensing.checks.tiles import TILE_PX, TILES, RowError, choose_tiles
from planish.sensing.observe import Observation
from planish.sensing.patterns.entries import Axis
from planish.sensing.points.correspond import correspond
from planish.sensing.points.locate import Located
from planish.sensing.points.triangulate import triangulate

#: Where a smaller share of the tiles tells, the other way round is tried; it has to be told by that many more.
FEW_TILES = 0.5


@dataclass(frozen=True)
class RigEvidence:
    """What speaks for or against an assignment of images to cameras."""

    rows: RowError
    row_source: str
    ray: Finding | None

    @property
    def doubtful(self) -> bool:
        """Whether anything contradicts, nothing confirms, or only few tiles do: chance, or what is left of patterns."""
        few = self.ray is None and self.tiles < FEW_TILES * self.rows.searched
        return self.contradicted or not self.confirmed or few

    @property
    def tiles(self) -> int:
        """Number of tiles that tell."""
        return len(self.rows.value_px)

    def better_than(self, other: RigEvidence) -> bool:
        """Whether this confirms the rig, and where `other` seems to, by far more tiles."""
        return self.confirmed and (not other.confirmed or FEW_TILES * self.tiles > other.tiles)

    @property
    def contradicted(self) -> bool:
        """Whether row errors or the projector's ray are too large."""
        return self.rows.bad or (self.ray is not None and bool(self.ray.warning))

    @property
    def confirmed(self) -> bool:
        """Whether row errors or the projector's ray are seen, and small."""
        return not self.contradicted and (self.rows.observable or (self.ray is not None and self.ray.value is not None))


def check_rig(
    seen: Mapping[str, Observation], located: Located, rig: Rig, own: str, subject: str, threads: int,
    locate: Callable[[Mapping[str, Observation]], Located] | None = None,
) -> tuple[Finding, ...]:  # fmt: skip
    """Return the row error of a measurement by two cameras and, with a calibrated projector, the miss of its ray.

    Parameters
    ----------
    seen : dict of Observation
        Of both cameras.
    located : Located
        Their points, before any is rejected for what the rig says.
    rig : Rig
        Calibration.
    own : str
        The organising camera.
    subject : str
        Named in errors.
    threads : int
        Number of threads.
    locate : callable, optional
        Finds the points of observations without positions, as `located` was found: by statistical patterns.

    Raises
    ------
    InputError
        Where the images fit the rig only with the cameras exchanged.
    """
    names = (own, next(name for name in seen if name != own))
    evidence = _evidence(seen, located, rig, names, threads)
    exchanged = _exchanged(seen, located, rig, names, threads, locate) if evidence.doubtful else None
    if exchanged is not None and exchanged.better_than(evidence):
        raise InputError(
            subject,
            f"the images of {names[0]} and {names[1]} are exchanged: only the other way round do they fit the rig",
            "images.A from camera A of the rig and images.B from camera B",
        )
    rows = describe_row_error(evidence.rows, evidence.row_source, names[1])
    return (rows,) if evidence.ray is None else (rows, evidence.ray)


def _evidence(
    seen: Mapping[str, Observation], located: Located, rig: Rig, names: tuple[str, str], threads: int
) -> RigEvidence:
    own, other = names
    axis = located.phase.axis
    across: Axis = "v" if axis == "u" else "u"
    assert located.correspondence_px is not None
    tiles = choose_tiles(located.correspondence_px, located.points, rig.cameras[own], rig.cameras[other])
    both = all(across in seen[name].phases for name in names)
    source = "the projector's second axis" if both else "the cameras' textures"
    if tiles is None:
        rows = RowError(np.empty(0), np.empty(0), 0)
    elif both:
        rows = row_error_of_positions(tiles, seen[own].phases[across], seen[other].phases[across])
    else:
        rows = row_error_of_textures(tiles, seen[own].view, seen[other].view)
    ray = None
    if rig.projector is not None and axis in seen[own].phases:
        ray = check_projector_ray(located.points, seen[own].phases[axis], rig.cameras[own], rig.projector, threads)
    return RigEvidence(rows, source, ray)


def _exchanged(
    seen: Mapping[str, Observation], located: Located, rig: Rig, names: tuple[str, str], threads: int,
    locate: Callable[[Mapping[str, Observation]], Located] | None,
) -> RigEvidence | None:  # fmt: skip
    """Return what speaks for or against the cameras' images exchanged, by the points at the tiles alone."""
    own, other = names
    axis = located.phase.axis
    if rig.cameras[own].size_px != rig.cameras[other].size_px:
        return None
    exchanged = {own: seen[other], other: seen[own]}
    height, width = located.phase.position_px.shape
    away = _away_from_tiles(height, width)
    if axis in seen[other].phases:
        few = exchanged[own].phases[axis].without(away, "masked")
        pairs = correspond(few, exchanged[other].phases[axis], rig.cameras[own], rig.cameras[other], threads)
        found = Located(triangulate(pairs, rig.cameras[own], rig.cameras[other], threads), few, pairs.pixel_px, None)
    elif locate is not None:
        found = locate({**exchanged, own: exchanged[own].without(away)})
    else:
        return None
    return _evidence(exchanged, found, rig, names, threads)


def _away_from_tiles(height: int, width: int) -> NDArray[np.bool_]:
    """Return the pixels (H, W) outside the rows of the tiles: without them the search takes a fraction of the time."""
    away = np.ones((height, width), np.bool_)
    for v in np.linspace(0, height - TILE_PX, TILES[1] + 2)[1:-1].astype(int):
        away[v : v + TILE_PX] = False
    return away
