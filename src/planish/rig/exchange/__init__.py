"""Calibrations of other programs: OpenCV, MATLAB."""
