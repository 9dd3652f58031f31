"""The two chains a user runs, one line per stage: measure() and register()."""

from planish.pipeline.measuring import MeasureOptions, measure
from planish.pipeline.registering import (
    Progress,
    RegisteredRun,
    RegisterOptions,
    register,
    register_run,
    versions,
)

__all__ = [
    "MeasureOptions",
    "Progress",
    "RegisterOptions",
    "RegisteredRun",
    "measure",
    "register",
    "register_run",
    "versions",
]
