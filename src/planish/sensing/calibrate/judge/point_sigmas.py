"""The standard deviation of each observed point, as its detection stated it and the adjustment scaled it."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from planish.geometry import Array
from planish.sensing.calibrate.observations import BoardPoints, BoardView, CodedPoints
from planish.sensing.calibrate.result import Calibration, Residuals


def point_sigmas(calibration: Calibration, device: str) -> list[tuple[Residuals, Array]]:
    """Return the residuals of a device, view by view, each with the standard deviation (n,) of one coordinate [px].

    The detection knows which points are better than others, the residuals how good they are on the whole: so one
    factor per device makes the mean square of residuals over standard deviations 1.
    """
    views = {view.name: view for view in calibration.observations.views}
    own = [r for r in calibration.residuals if r.device == device]
    stated = [_stated(views, r) for r in own]
    kept = [(r.residual_px[~r.outlier] / sigma[~r.outlier, None]).ravel() for r, sigma in zip(own, stated, strict=True)]
    squares = np.concatenate(kept) ** 2 if kept else np.empty(0)
    factor = float(np.sqrt(squares.mean())) if squares.any() else 1.0
    return [(r, factor * sigma) for r, sigma in zip(own, stated, strict=True)]


def _stated(views: Mapping[str, BoardView], r: Residuals) -> Array:
    view = views[r.view]
    seen: BoardPoints | CodedPoints
    if r.through is None:
        seen = view.cameras[r.device]
    else:
        seen = next(code for code in view.code if code.camera == r.through)
    # A board that was seen turned has its points renumbered by the adjustment.
    sigma = np.full(1 + max(seen.index.max(initial=0), r.index.max(initial=0)), np.median(seen.sigma_px))
    sigma[seen.index] = seen.sigma_px
    return sigma[r.index]
