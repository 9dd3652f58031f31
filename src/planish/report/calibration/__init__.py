"""The report of a calibration: one HTML file that opens offline, and its figures as PNG files."""
