"""A drive, simulated or recorded: what a filter is given, and the truth to score it by.

No filter is handed a `Truth`: a trial takes it from the drive when the estimate is made.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float, Int

from pipistrelle.estimation.beliefs import Gaussian, Landmarks, no_landmarks
from pipistrelle.estimation.motion import Motion, relative_motions
from pipistrelle.geometry import path_at, points_at

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
    """What a filter is given of a drive, simulated or recorded, and the truth to score it by.

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


def split_at(drive: Drive, times: Sequence[float]) -> tuple[Drive, Int[np.ndarray, " t"]]:
    r"""Split the steps of a drive in which something happened between their ends.

    A part of a step goes that share :math:`\lambda` of its way, in a straight line, turning
    evenly, with the share :math:`\lambda` of its covariance. Controls are then motions from pose to
    pose (`pipistrelle.estimation.motion`).

    Parameters
    ----------
    drive : Drive
    times : sequence of [s]

    Returns
    -------
    Drive
        The same where nothing happened between the steps' ends.
    (t)
        Where the times of the drive stand among those of the result.
    """
    time, controls, inside = drive.time, drive.controls, np.array(times, dtype=float)
    inside = inside[(inside > time[0]) & (inside < time[-1])]
    if np.isin(inside, time).all():
        return drive, np.arange(time.size)
    fine = np.union1d(time, inside)
    step = np.searchsorted(time, fine[1:]) - 1
    length = np.diff(time)[step]
    begin, end = (fine[:-1] - time[step]) / length, (fine[1:] - time[step]) / length
    way, covariance = relative_motions(drive.motion, controls, np.diff(time))
    before, after = begin[:, np.newaxis] * way[step], end[:, np.newaxis] * way[step]
    c, s = np.cos(before[:, 2]), np.sin(before[:, 2])
    turn = np.zeros((step.size, 3, 3))  # into the axes at the part's begin
    turn[:, 0, 0], turn[:, 0, 1], turn[:, 1, 0], turn[:, 1, 1], turn[:, 2, 2] = c, s, -s, c, 1.0
    moved = np.einsum("kij,kj->ki", turn, after - before)
    share = (end - begin)[:, np.newaxis, np.newaxis]
    spread = share * turn @ covariance[step] @ turn.transpose(0, 2, 1)
    rows, columns = np.triu_indices(3)
    path = drive.truth.path
    callers = {
        label: points_at(fine, time, places) for label, places in drive.truth.callers.items()
    }
    path = None if path is None else path_at(fine, time, path)
    truth = replace(drive.truth, time=fine, path=path, callers=callers)
    motion = Motion(model="poses", control_std=(0.0, 0.0, 0.0))
    parts = np.column_stack((moved, spread[:, rows, columns]))
    split = replace(drive, motion=motion, time=fine, controls=parts, truth=truth)
    return split, np.searchsorted(fine, time)
