"""Does a calibration still hold, by what measurements show; and the relative orientation that they ask for."""
