"""A drive: what a filter is told of it, simulated or recorded, and the truth to score it by.

No filter is handed a `Truth`: a trial takes it from the drive when the estimate is made.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float, Int

from pipistrelle.estimation.beliefs import Gaussian, Landmarks, no_landmarks
from pipistrelle.estimation.motion import Motion

LabelledPoints = tuple[Int[np.ndarray, " n"], Float[np.ndarray, "n 2"]]
"""Labels and positions [m] of landmarks."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Truth:
    """What is known of the truth of a drive, for scoring and drawing alone.

    Attributes
    ----------
    time : (k) [s]
        Times of the track: the start, then the end of each step.
    path : (k, 3) [m, m, rad] or None
        True poses; NaN where they are not known.
    landmarks : labels (n) and positions (n, 2) [m], or None
    callers : dict of label to (k, 2) [m]
        Paths of the callers that move.
    """

    time: Float[np.ndarray, " k"]
    path: Float[np.ndarray, "k 3"] | None = None
    landmarks: LabelledPoints | None = None
    callers: Mapping[int, Float[np.ndarray, "k 2"]] = field(default_factory=dict)


NO_TRUTH = Truth(time=np.empty(0))
"""Nothing is known of the truth."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Drive:
    """What a filter is told of a drive, simulated or recorded, and the truth to score it by.

    Attributes
    ----------
    motion : Motion
    start : Gaussian of (3) and (3, 3)
    time : (k + 1) [s]
        Of the start and of the end of each step.
    controls : (k, c)
        Of each step, as the motion model has them.
    truth : Truth
        At the same times; nothing of it, by default. Its landmarks are those that stand.
    known : Landmarks
        Where landmarks stand that are known beforehand, and how surely.
    moving : dict of label to str
        Names of the callers that move: no landmarks, though heard.
    """

    motion: Motion
    start: Gaussian
    time: Float[np.ndarray, " t"]
    controls: Float[np.ndarray, "t-1 c"]
    truth: Truth = NO_TRUTH
    known: Landmarks = field(default_factory=no_landmarks)
    moving: Mapping[int, str] = field(default_factory=dict)
