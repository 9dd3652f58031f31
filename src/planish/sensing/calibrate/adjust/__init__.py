"""The adjustment: start values, robust least squares, choice of the lens model, tests of the board, covariance."""
