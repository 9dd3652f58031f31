"""Joint refinement of geometry and texture: residuals, solver, covariance."""
