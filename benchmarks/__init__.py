"""Benchmarks, run by `./dev bench`: rows of a run are compared with each other, never asserted."""
