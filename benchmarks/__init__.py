"""The timings: `./dev bench`. Rows of one run are compared with each other, never asserted."""
