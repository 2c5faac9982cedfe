"""Beliefs to numbers: how far from the truth, and whether the filter knows how far."""
