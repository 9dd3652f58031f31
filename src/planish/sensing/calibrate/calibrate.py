"""From boards seen to a calibrated rig: start, choice of the lens models, one adjustment of everything, its tests."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import Literal

from pydantic import Field

from planish.errors import InputError
from planish.options import Options, thread_count
from planish.rig.parameters import PROJECTOR
from planish.sensing.calibrate.adjust.conclude import conclude
from planish.sensing.calibrate.adjust.geometry_checks import require_views
from planish.sensing.calibrate.adjust.heights import choose_heights, with_heights
from planish.sensing.calibrate.adjust.lens import Chosen
from planish.sensing.calibrate.adjust.problem import problem_of
from planish.sensing.calibrate.adjust.robust import Adjusted
from planish.sensing.calibrate.adjust.stages import (
    REFERENCE,
    adjust_chosen,
    join_cameras,
    join_projector,
    start_device,
)
from planish.sensing.calibrate.adjust.usable import only_usable
from planish.sensing.calibrate.observations import BoardObservations
from planish.sensing.calibrate.result import Calibration

ModelName = Literal["none", "radial", "radial 3", "tangential", "tangential 3", "rational", "prism"]
#: Stage, how much of it is done, how much there is.
Progress = Callable[[str, int, int], None]
#: Stages as `progress` names them.
STAGES = ("cameras", "orientation", "projector", "adjustment")


class CalibrateOptions(Options):
    """Options of the calibration."""

    #: Lens model of all devices; None: what the boards support, by cross-validation.
    model: ModelName | None = None
    #: Lens model of single devices ("A", "B", "projector"), before `model`.
    models: dict[Literal["A", "B", "projector"], ModelName] = Field(default_factory=dict)
    #: Whether the heights of the board's points are estimated: by a polynomial or one by one, what the views support.
    flatness: bool = False
    #: Probability that boards without any outlier lose a point.
    outlier_probability: float = Field(default=0.05, gt=0, lt=1)

    def forced(self, device: str) -> str | None:
        """Return the model that a device must have."""
        named: Mapping[str, ModelName] = dict(self.models.items())
        return named.get(device, self.model)


def calibrate(
    observations: BoardObservations,
    options: CalibrateOptions | None = None,
    progress: Progress | None = None,
    threads: int | None = None,
) -> Calibration:
    """Return the rig that the boards determine, in the frame of camera A, with its covariance.

    Parameters
    ----------
    observations : BoardObservations
        What the devices saw of the board.
    options : CalibrateOptions, optional
        Lens models, flatness.
    progress : callable, optional
        Called with stage, number done and number of stages.
    threads : int, optional
        Devices that are started at the same time; the result does not depend on it.

    Raises
    ------
    InputError
        Where the boards do not determine the devices: too few views, all parallel, nothing seen in common.
    """
    options, count, say = options or CalibrateOptions(), thread_count(threads), progress or (lambda *_: None)
    if REFERENCE not in observations.size_px:
        raise InputError("cameras", f"found {', '.join(observations.devices) or 'none'}", "camera A among them")
    share = options.outlier_probability
    problem, unused = only_usable(problem_of(observations), observations)
    require_views(problem, observations.devices)
    if options.flatness:
        problem = with_heights(problem)

    def start(name: str) -> tuple[Adjusted, Chosen]:
        block = problem.blocks_of(name)[0]
        return start_device(problem, block, observations.size_px[name], options.forced(name), share)

    say(STAGES[0], 0, len(STAGES))
    cameras = sorted(observations.size_px)
    with ThreadPoolExecutor(count) as pool:
        started = dict(zip(cameras, pool.map(start, cameras), strict=True))
    say(STAGES[1], 1, len(STAGES))
    now = join_cameras(problem, observations, started)
    say(STAGES[2], 2, len(STAGES))
    if PROJECTOR in observations.devices:
        now = join_projector(now, observations, options.forced(PROJECTOR), share)
    say(STAGES[3], 3, len(STAGES))
    item, told = adjust_chosen(now, share), unused + now.findings
    if options.flatness:
        item, heights = choose_heights(now, item, share)
        told = (*told, heights)
    require_views(item.problem, item.problem.devices)
    models = {device: chosen.told for device, chosen in now.models.items()}
    result = conclude(observations, item, models, told, options.model_dump())
    say(STAGES[3], 4, len(STAGES))
    return result
