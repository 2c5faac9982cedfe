"""Scans: what one frame measured, as the filters see it."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int


@dataclass(frozen=True, slots=True, kw_only=True)
class Scan:
    """Bearings and ranges of labelled landmarks at one time.

    Attributes
    ----------
    time : [s]
    landmark : (m)
        Label of each measurement, each at most once.
    bearing : (m) [rad]
        Relative to the heading, counter-clockwise, in [-pi, pi).
    range : (m) [m]
        NaN where passive.
    """

    time: float
    landmark: Int[np.ndarray, " m"]
    bearing: Float[np.ndarray, " m"]
    range: Float[np.ndarray, " m"]
