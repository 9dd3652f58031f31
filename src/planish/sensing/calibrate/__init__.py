"""From images of a board to a rig with the covariance of its parameters."""
