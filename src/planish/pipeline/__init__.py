"""The chains a user runs, one line per stage: calibrate(), measure() and register()."""

from planish.pipeline.calibrating import calibrate
from planish.pipeline.measuring import MeasureOptions, measure
from planish.pipeline.options import RegisterOptions
from planish.pipeline.registering import Progress, RegisteredRun, prepare_run, register, register_run
from planish.pipeline.registering_files import FileProgress, FileRun, add_files, register_files
from planish.pipeline.versions import versions
from planish.sensing.calibrate.calibrate import CalibrateOptions

__all__ = [
    "CalibrateOptions",
    "FileProgress",
    "FileRun",
    "MeasureOptions",
    "Progress",
    "RegisterOptions",
    "RegisteredRun",
    "add_files",
    "calibrate",
    "measure",
    "prepare_run",
    "register",
    "register_files",
    "register_run",
    "versions",
]
