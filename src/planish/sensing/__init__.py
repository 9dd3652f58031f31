"""From raw fringe images to a Measurement, one module per step of the data flow."""
