"""From the images of a camera to the absolute projector position of every pixel."""

from planish.sensing.decode.phase import DecodeOptions, PhaseMap, decode, position_slope

__all__ = ["DecodeOptions", "PhaseMap", "decode", "position_slope"]
