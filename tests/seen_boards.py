"""What a sensor with a known rig would see of boards: observations with Gaussian noise, without images."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from planish.geometry import Array, transform_points
from planish.rig import Rig
from planish.rig.derivatives import project_with_derivatives
from planish.sensing.calibrate.observations import BoardObservations, BoardPoints, BoardView, CodedPoints
from planish.simulation.board_places import see_board
from planish.simulation.boards import PrintedBoard

#: Points below which a detector would not have taken a view.
FEWEST = 6


def observations(
    rig: Rig,
    board: PrintedBoard,
    places: Sequence[Array],
    noise_px: float = 0.05,
    seed: int = 0,
    devices: Sequence[str] | None = None,
    *,
    code_noise_px: float | None = None,
    spread: float = 0.0,
) -> BoardObservations:
    """Return what is seen of a printed board at the places T_sensor_board (4, 4).

    Parameters
    ----------
    noise_px : float
        Standard deviation of each coordinate of a corner [px], as its root mean square over points; the stated sigma.
    devices : sequence of str, optional
        Default: all of the rig. The projector is coded through every camera.
    code_noise_px : float, optional
        Standard deviation of each coordinate of the projector's position [projector px]; default `noise_px`.
    spread : float
        Logarithmic standard deviation of the single points' sigma about noise_px; sigma is stated rightly.
    """
    rng = np.random.Generator(np.random.Philox(key=[seed, 60]))
    names = tuple(rig.devices) if devices is None else tuple(devices)
    cameras = [name for name in names if name != "projector"]
    code_noise = noise_px if code_noise_px is None else code_noise_px
    views = []
    for number, T in enumerate(places):
        seen = see_board(rig, board, T)
        found: dict[str, BoardPoints] = {}
        code: list[CodedPoints] = []
        for name in cameras:
            index = np.flatnonzero(seen[name].inside)
            if len(index) < FEWEST:
                continue
            sigma = _sigmas(rng, noise_px, spread, len(index))
            noise = sigma[:, None] * rng.standard_normal((len(index), 2))
            found[name] = BoardPoints(index, seen[name].pixel_px[index] + noise, sigma)
        if "projector" in names:
            for name, points in found.items():
                lit = seen["projector"].inside[points.index]
                if lit.sum() >= FEWEST:
                    camera_px = points.pixel_px[lit]
                    code.append(_coded(rig, board, T, name, points.index[lit], camera_px, code_noise, rng))
        images = {name: f"{name}/{number + 1:02d}.png" for name in found}
        if found:
            views.append(BoardView(f"{number + 1:02d}", found, tuple(code), images))
    projector = rig.projector.size_px if rig.projector is not None and "projector" in names else None
    sizes = {name: rig.cameras[name].size_px for name in cameras}
    return BoardObservations(board.board, sizes, projector, tuple(views), {})


def _sigmas(rng: np.random.Generator, rms: float, spread: float, count: int) -> Array:
    shape = np.exp(spread * rng.standard_normal(count)) if spread else np.ones(count)
    return np.asarray(rms * shape / np.sqrt((shape**2).mean()))


def _coded(
    rig: Rig,
    board: PrintedBoard,
    T: Array,
    name: str,
    index: Array,
    camera_px: Array,
    noise_px: float,
    rng: np.random.Generator,
) -> CodedPoints:
    """The code near points of the board, on the board's tangent plane there, at the pixels where they were detected."""
    assert rig.projector is not None
    points = transform_points(T, board.points_board[index])
    normals = board.normals_board[index] @ T[:3, :3].T
    true_px, by_point, _ = project_with_derivatives(rig.cameras[name], points)
    position, code_by_point, _ = project_with_derivatives(rig.projector, points)
    # A step in the image stays on the tangent plane: by_point dx = dp, n dx = 0.
    by_pixel = np.linalg.inv(np.concatenate([by_point, normals[:, None]], axis=1))[:, :, :2]
    jacobian = code_by_point @ by_pixel
    shifted = position + np.einsum("nij,nj->ni", jacobian, camera_px - true_px)
    shifted += noise_px * rng.standard_normal(shifted.shape)
    return CodedPoints(name, index, camera_px, shifted, jacobian, np.full(len(index), noise_px))
