"""Which pairs of measurements are tried."""
