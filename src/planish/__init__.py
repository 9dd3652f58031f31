"""planish: registers fringe-projection measurements of feature-poor parts by their surface texture."""

__version__ = "0.1.0"

from planish.errors import InputError
from planish.measurement import Measurement
from planish.pipeline import MeasureOptions, RegisterOptions, measure, register
from planish.registration.result import PairResult, Registration
from planish.rig import Camera, Rig
from planish.sensing.capture import Capture

__all__ = [
    "Camera",
    "Capture",
    "InputError",
    "MeasureOptions",
    "Measurement",
    "PairResult",
    "RegisterOptions",
    "Registration",
    "Rig",
    "measure",
    "register",
]
