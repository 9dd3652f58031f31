"""What a calibration is worth: coverage, expected error, advice."""
