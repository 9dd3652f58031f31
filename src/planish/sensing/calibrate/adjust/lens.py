"""Which lens model the boards support: cross-validation over the views."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import chi2
from scipy.stats import t as student

from planish.geometry import Array
from planish.rig import Camera
from planish.rig.parameters import DISTORTION, EXTERNAL_PART, INTRINSICS
from planish.sensing.calibrate.adjust.left_out import covariance_factor, leave_out
from planish.sensing.calibrate.adjust.lens_models import Model, held_pseudo, ladder
from planish.sensing.calibrate.adjust.problem import Free, Problem, State
from planish.sensing.calibrate.adjust.robust import Adjusted
from planish.sensing.calibrate.adjust.solve import fixed, least_squares
from planish.sensing.calibrate.result import LensModel

#: The ladder is left after this many models that are no better than one before them.
PATIENCE = 2
#: Probability below one standard error of a normal distribution: with few views, Student's is wider.
ONE_SIGMA = 0.8413
#: Probability with which chance gives coefficients that count as needed.
SIGNIFICANT = 0.01
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
    Regression Trees, 1984, section 3.4.3); the error is that of the differences between the two, view by view. What it
    leaves out must not be significant in the best, else the covariance would claim too much.
    """
    views = int(item.problem.seen_by(device).sum())
    steps = ladder(views)
    if forced is not None:
        steps = tuple(step for step in steps if step.name == forced) or (Model(forced),)
    tried: dict[Model, _Tried] = {}
    for step in steps:
        if (found := _try(item, device, step)) is not None:
            tried[step] = found
        best = min(tried, key=lambda model: tried[model].mean_square, default=None)
        if best is not None and steps.index(step) - steps.index(best) >= PATIENCE:
            break
    if not tried:
        told = f"{steps[0].words}: no model is determined by these views"
        return Chosen(steps[0], LensModel(steps[0].label, steps[0].coefficients, {}, told))
    best = min(tried, key=lambda model: tried[model].mean_square)
    chosen = next(
        model
        for model in tried
        if _within(tried[model].score, tried[best].score) and not tried[best].needs(device, best, model)
    )
    return Chosen(chosen, _told(chosen, best, tried, forced))


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


@dataclass(frozen=True)
class _Tried:
    """An adjustment with one of the models, and mean squares [px^2] of the left-out views (n,) in the device."""

    item: Adjusted
    score: Array

    @property
    def mean_square(self) -> float:
        return float(self.score.mean())

    def needs(self, device: str, own: Model, other: Model) -> bool:
        """Whether coefficients of this model that the other one lacks are significantly not zero (Wald's test)."""
        beyond = [name for name in own.coefficients if name not in other.coefficients]
        if not beyond:
            return False
        names = self.item.free.names
        at = [names.index(f"{device}.{name}") for name in beyond]
        value = self.item.state.devices[device].distortion[[DISTORTION.index(name) for name in beyond]]
        covariance = self.item.covariance()[np.ix_(at, at)] * max(1.0, covariance_factor(self.item.solution)[0])
        chi = float(value @ np.linalg.solve(covariance, value))
        return bool(chi2.sf(chi, len(beyond)) < SIGNIFICANT)


def _try(item: Adjusted, device: str, model: Model) -> _Tried | None:
    """The adjustment with a model of the device; None where the model is not determined."""
    problem = with_model(item.problem, item.state, device, model)
    free = free_with(item.free, device, model)
    solution = least_squares(problem, start_with(item.state, device, model), free, fixed(item.solution.weights))
    S = solution.equations.reduced()[0].sum(0) + solution.equations.prior
    scale = 1 / np.sqrt(np.maximum(np.diag(S), 1e-300))
    values = np.linalg.eigvalsh(S * scale[:, None] * scale)
    if values[0] * WORST_CONDITION < values[-1] or not one_to_one(solution.state.devices[device]):
        return None
    changed = replace(item, problem=problem, free=free, solution=solution)
    return _Tried(changed, leave_out(changed).mean_square(device))


def _within(score: Array, best: Array) -> bool:
    worse = score - best
    if len(worse) < 2:
        return bool(worse.sum() <= 0)
    errors = student.ppf(ONE_SIGMA, len(worse) - 1)
    return bool(worse.mean() <= errors * worse.std(ddof=1) / np.sqrt(len(worse)))


def _told(chosen: Model, best: Model, tried: Mapping[Model, _Tried], forced: str | None) -> LensModel:
    rms = {model.label: float(np.sqrt(found.mean_square)) for model, found in tried.items()}
    own = f"{chosen.words}: boards left out of the adjustment fit within {rms[chosen.label]:.4f} px (rms)"
    if forced is not None:
        why = "; the model was prescribed"
    elif chosen == best:
        why = f", the best of {len(tried)} models tried"
    else:
        why = f"; {best.words} gives {rms[best.label]:.4f} px, which is no better beyond one standard error"
    return LensModel(chosen.label, chosen.coefficients, rms, own + why)
