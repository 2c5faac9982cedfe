"""Smoother: `filter` is the estimator, `elimination` the solver, `belief` the result."""
