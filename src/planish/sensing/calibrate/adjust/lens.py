"""Which lens model the boards support: cross-validation over the views."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import t as student

from planish.geometry import Array
from planish.rig import Camera
from planish.rig.parameters import DISTORTION, EXTERNAL_PART, INTRINSICS
from planish.sensing.calibrate.adjust.left_out import leave_out
from planish.sensing.calibrate.adjust.lens_models import Model, held_pseudo, ladder
from planish.sensing.calibrate.adjust.problem import Free, Problem, State
from planish.sensing.calibrate.adjust.robust import Adjusted
from planish.sensing.calibrate.adjust.solve import fixed, least_squares
from planish.sensing.calibrate.result import LensModel

#: The ladder is left after this many models that are no better than one before them.
PATIENCE = 3
#: Probability below one standard error of a normal distribution: with few views, Student's is wider.
ONE_SIGMA = 0.8413
#: Pixels at which a model must be one to one: columns and rows over the image.
GRID = (15, 11)
#: Equations (scaled to unit diagonal) worse conditioned than this say nothing about some parameter.
WORST_CONDITION = 1e11


@dataclass(frozen=True)
class Chosen:
    """A device's lens model with the words for the report, and the pseudo-observations that go with it."""

    model: Model
    told: LensModel


def choose_model(item: Adjusted, device: str, forced: str | None) -> Chosen:
    """Return the lens model of one device.

    Parameters
    ----------
    item : Adjusted
        An adjustment in which the device has some lens model; the other devices keep theirs.
    device : str
        Which one.
    forced : str or None
        Name of a model that the user wants.

    Notes
    -----
    Each model is adjusted to all views but one, for each view in turn, and judged by the view left out. The simplest
    model counts whose mean square there is within one standard error of the best (Breiman et al., Classification and
    Regression Trees, 1984, section 3.4.3); the error is that of the differences between the two, view by view.
    """
    views = int(item.problem.seen_by(device).sum())
    steps = ladder(views)
    if forced is not None:
        steps = tuple(step for step in steps if step.name == forced) or (Model(forced),)
    scores: dict[Model, Array] = {}
    for step in steps:
        if (score := _score(item, device, step)) is not None:
            scores[step] = score
        best = min(scores, key=lambda model: scores[model].mean(), default=None)
        if best is not None and steps.index(step) - steps.index(best) >= PATIENCE:
            break
    if not scores:
        told = f"{steps[0].words}: no model is determined by these views"
        return Chosen(steps[0], LensModel(steps[0].label, steps[0].coefficients, {}, told))
    best = min(scores, key=lambda model: scores[model].mean())
    chosen = next(model for model in scores if _within(scores[model], scores[best]))
    return Chosen(chosen, _told(chosen, best, scores, forced))


def with_model(item: Problem, state: State, device: str, model: Model) -> Problem:
    """Return the problem with the pseudo-observations that a model of one device wants, and no others of it."""
    others = tuple(pseudo for pseudo in item.pseudo if pseudo.device != device)
    own = held_pseudo(device, state.devices[device], model.coefficients) if model.held else ()
    return replace(item, pseudo=(*others, *own))


def start_with(state: State, device: str, model: Model) -> State:
    """Return the state with the device's distortion reduced to the coefficients of a model."""
    camera = state.devices[device]
    kept = np.isin(DISTORTION, model.coefficients)
    changed = replace(camera, distortion=np.where(kept, camera.distortion, 0.0))
    return replace(state, devices={**state.devices, device: changed})


def free_with(free: Free, device: str, model: Model) -> Free:
    """Return what is free when one device has this model."""
    lens = range(len(INTRINSICS), EXTERNAL_PART.start)
    own = [place for place in free.places[device] if place not in lens]
    own += [len(INTRINSICS) + DISTORTION.index(name) for name in model.coefficients]
    return replace(free, places={**free.places, device: tuple(sorted(own))})


def one_to_one(camera: Camera) -> bool:
    """Return whether each pixel has a ray, and neighbours have neighbouring ones: no fold of the lens in the image."""
    width, height = camera.size_px
    u, v = np.meshgrid(np.linspace(-0.5, width - 0.5, GRID[0]), np.linspace(-0.5, height - 0.5, GRID[1]))
    own = replace(camera, T_camera_sensor=np.eye(4))
    rays = own.rays_sensor(np.column_stack([u.ravel(), v.ravel()]))
    if not np.isfinite(rays).all():
        return False
    J = own.distortion_jacobian(rays[:, :2])
    return bool((J[0] * J[3] - J[1] * J[2] > 0).all())


def _score(item: Adjusted, device: str, model: Model) -> Array | None:
    """Mean squares [px^2] of the left-out views in the device; None where the model is not determined."""
    problem = with_model(item.problem, item.state, device, model)
    free = free_with(item.free, device, model)
    solution = least_squares(problem, start_with(item.state, device, model), free, fixed(item.solution.weights))
    S = solution.equations.reduced()[0].sum(0) + solution.equations.prior
    scale = 1 / np.sqrt(np.maximum(np.diag(S), 1e-300))
    values = np.linalg.eigvalsh(S * scale[:, None] * scale)
    if values[0] * WORST_CONDITION < values[-1] or not one_to_one(solution.state.devices[device]):
        return None
    tried = replace(item, problem=problem, free=free, solution=solution)
    return leave_out(tried).mean_square(device)


def _within(score: Array, best: Array) -> bool:
    worse = score - best
    if len(worse) < 2:
        return bool(worse.sum() <= 0)
    errors = student.ppf(ONE_SIGMA, len(worse) - 1)
    return bool(worse.mean() <= errors * worse.std(ddof=1) / np.sqrt(len(worse)))


def _told(chosen: Model, best: Model, scores: Mapping[Model, Array], forced: str | None) -> LensModel:
    rms = {model.label: float(np.sqrt(score.mean())) for model, score in scores.items()}
    own = f"{chosen.words}: boards left out of the adjustment fit within {rms[chosen.label]:.3f} px (rms)"
    if forced is not None:
        why = "; the model was prescribed"
    elif chosen == best:
        why = f", the best of {len(scores)} models tried"
    else:
        why = f"; {best.words} gives {rms[best.label]:.3f} px, which is no better beyond one standard error"
    return LensModel(chosen.label, chosen.coefficients, rms, own + why)
