"""Studies of many worlds: a `plan`, the trials of each `world`, and the `study` that runs them."""
