"""The texture of a measurement: photometric compensation, charts, metric orthographic texture images."""
