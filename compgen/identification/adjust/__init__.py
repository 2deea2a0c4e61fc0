"""The adjustment of tracer lengths: problem, start values, solver, gross errors, rank and covariance."""
