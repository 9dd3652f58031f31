"""All that the rig says about a capture, and whether the images of its cameras were exchanged."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from planish.errors import InputError
from planish.measurement import Finding
from planish.rig import Rig
from planish.sensing.checks.rig import check_projector_ray, describe_row_error, row_error_of_positions
from planish.sensing.checks.texture_rows import row_error_of_textures
from planish.sensing.checks.tiles import TILE_PX, TILES, RowError, choose_tiles
from planish.sensing.correspond import correspond
from planish.sensing.decode import PhaseMap
from planish.sensing.entries import Axis
from planish.sensing.locate import Located
from planish.sensing.observe import Observation
from planish.sensing.triangulate import triangulate


@dataclass(frozen=True)
class RigEvidence:
    """What speaks for or against an assignment of images to cameras."""

    rows: RowError
    row_source: str
    ray: Finding | None

    @property
    def doubtful(self) -> bool:
        """Whether anything contradicts, or nothing confirms."""
        return self.contradicted or not self.confirmed

    @property
    def contradicted(self) -> bool:
        """Whether row errors or the projector's ray are too large."""
        return self.rows.bad or (self.ray is not None and bool(self.ray.warning))

    @property
    def confirmed(self) -> bool:
        """Whether row errors or the projector's ray are seen, and small."""
        return not self.contradicted and (self.rows.observable or (self.ray is not None and self.ray.value is not None))


def check_rig(
    seen: Mapping[str, Observation], located: Located, rig: Rig, own: str, subject: str, threads: int
) -> tuple[Finding, ...]:
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

    Raises
    ------
    InputError
        Where the images fit the rig only with the cameras exchanged.
    """
    names = (own, next(name for name in seen if name != own))
    evidence = _evidence(seen, located, rig, names, threads)
    if evidence.doubtful and _fits_exchanged(seen, located, rig, names, threads):
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


def _fits_exchanged(
    seen: Mapping[str, Observation], located: Located, rig: Rig, names: tuple[str, str], threads: int
) -> bool:
    """Return whether the rig is confirmed with the cameras' images exchanged."""
    own, other = names
    axis = located.phase.axis
    if rig.cameras[own].size_px != rig.cameras[other].size_px or axis not in seen[other].phases:
        return False
    exchanged = {own: seen[other], other: seen[own]}
    few = _thinned(exchanged[own].phases[axis])
    pairs = correspond(few, exchanged[other].phases[axis], rig.cameras[own], rig.cameras[other], threads)
    found = triangulate(pairs, rig.cameras[own], rig.cameras[other], threads)
    return _evidence(exchanged, Located(found, few, pairs.pixel_px, None), rig, names, threads).confirmed


def _thinned(phase: PhaseMap) -> PhaseMap:
    """Return the positions at the tiles alone: the search takes a tenth of the time."""
    height, width = phase.position_px.shape
    keep = np.zeros((height, width), np.bool_)
    for v in np.linspace(0, height - TILE_PX, TILES[1] + 2)[1:-1].astype(int):
        keep[v : v + TILE_PX] = True
    return phase.without(~keep, "masked")
