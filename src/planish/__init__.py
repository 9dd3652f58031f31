"""Registers fringe-projection measurements of feature-poor parts by their surface texture."""

from importlib.metadata import version

from planish.errors import InputError
from planish.measurement import Measurement
from planish.pipeline import (
    CalibrateOptions,
    MeasureOptions,
    RegisterOptions,
    add_files,
    calibrate,
    measure,
    register,
    register_files,
)
from planish.registration.result import PairResult, Registration
from planish.rig import Camera, Rig, read_rig, write_rig
from planish.sensing.calibrate.result import Calibration
from planish.sensing.capture.manifest import Capture

__all__ = [
    "CalibrateOptions",
    "Calibration",
    "Camera",
    "Capture",
    "InputError",
    "MeasureOptions",
    "Measurement",
    "PairResult",
    "RegisterOptions",
    "Registration",
    "Rig",
    "__version__",
    "add_files",
    "calibrate",
    "measure",
    "read_rig",
    "register",
    "register_files",
    "write_rig",
]

__version__ = version("planish")
