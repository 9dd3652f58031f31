"""Networks of measurements: drawn, rendered, with faults, growing."""
