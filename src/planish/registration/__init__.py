"""From Measurements to a Registration, one module per step of the data flow."""
