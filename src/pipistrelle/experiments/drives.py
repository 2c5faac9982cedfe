"""A drive: what a filter is told of it, simulated or recorded, and the truth to score it by."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from pipistrelle.estimation.beliefs import Gaussian
from pipistrelle.estimation.motion import Motion

LabelledPoints = tuple[Int[np.ndarray, " n"], Float[np.ndarray, "n 2"]]
"""Labels and positions [m] of landmarks."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Drive:
    """What a filter is told of a drive, simulated or recorded, and the truth to score it by.

    Attributes
    ----------
    motion : Motion
    start : Gaussian of (3) and (3, 3)
    time : (k + 1) [s]
        Of the start and of the end of each step.
    controls : (k, 2)
        Of each step.
    true_path : (k + 1, 3) [m, m, rad] or None
    true_landmarks : labels (n) and positions (n, 2) [m], or None
    """

    motion: Motion
    start: Gaussian
    time: Float[np.ndarray, " t"]
    controls: Float[np.ndarray, "t-1 2"]
    true_path: Float[np.ndarray, "t 3"] | None
    true_landmarks: LabelledPoints | None
