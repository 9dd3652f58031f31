"""The chains a user runs, one line per stage: calibrate(), measure() and register()."""

from planish.pipeline.calibrating import calibrate
from planish.pipeline.measuring import MeasureOptions, measure
from planish.pipeline.registering import (
    Progress,
    RegisteredRun,
    RegisterOptions,
    prepare_run,
    register,
    register_run,
    versions,
)
from planish.sensing.calibrate.calibrate import CalibrateOptions

__all__ = [
    "CalibrateOptions",
    "MeasureOptions",
    "Progress",
    "RegisterOptions",
    "RegisteredRun",
    "calibrate",
    "measure",
    "prepare_run",
    "register",
    "register_run",
    "versions",
]
