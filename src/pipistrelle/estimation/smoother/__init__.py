"""The smoother: `filter` is the method, `elimination` the solver, `belief` what it answers."""
