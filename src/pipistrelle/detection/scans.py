"""Scans: what one frame measured, as the filters see it.

Labelled detections become a scan in two steps: the faces that heard the same landmark are
averaged per tone, then a sensing strategy takes one tone, the other, or both.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

UNLABELLED = -1
"""Label of a detection that belongs to no landmark."""


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
