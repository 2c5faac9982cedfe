"""The true world: a noisy drive, landmarks around it, a beacon that calls."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float


@dataclass(frozen=True, slots=True, kw_only=True)
class Scenario:
    """A true world. Landmark i (from 0) bears the label i + 1, the beacon the label n + 1.

    Attributes
    ----------
    time : (k + 1) [s]
    path : (k + 1, 3) [m, m, rad]
        True poses, the start first.
    controls : (k, 2)
        Nominal speed [m/s] and steering angle [rad] of each step, as the filters know them.
    landmarks : (n, 2) [m]
    beacon : (2) [m]
    """

    time: Float[np.ndarray, " k+1"]
    path: Float[np.ndarray, "k+1 3"]
    controls: Float[np.ndarray, "k 2"]
    landmarks: Float[np.ndarray, "n 2"]
    beacon: Float[np.ndarray, "2"]
