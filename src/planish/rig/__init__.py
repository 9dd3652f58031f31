"""The calibration: cameras and projector, the covariance of their parameters, and its files."""

from planish.rig.camera import Camera
from planish.rig.files import read_rig, write_rig
from planish.rig.rig import Rig

__all__ = ["Camera", "Rig", "read_rig", "write_rig"]
