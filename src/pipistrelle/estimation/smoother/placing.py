r"""Placing by a detour: how far along its bearing a landmark, or a caller, must stand.

Of a landmark of which bearing and detour were heard, and whose caller is in the graph, the range
follows at once, and likewise that of a caller from a landmark in the graph
(`estimation.measurement.range_by_detour`, `caller_range_by_detour`). How sure it is hangs on how
well vehicle and other point are known, together, and on the geometry: between vehicle and caller a
detour says nothing of the range. There slopes deceive, for the range is no more nearly linear than
it is known. So it is asked of the detour, the bearing and the way to the other point, two standard
deviations to either side in each of their four principal directions: the spread of these eight is
the range's (an unscented transform; Julier & Uhlmann 1997), and where one of them has none, or the
detour may be none, nothing is known.
"""

import math
from collections.abc import Collection, Iterable
from dataclasses import dataclass, field

import gtsam
import numpy as np
from jaxtyping import Float

from pipistrelle.estimation.measurement import SOME, caller_range_by_detour, range_by_detour
from pipistrelle.estimation.smoother.crossing import Bearing
from pipistrelle.estimation.smoother.detours import Detour
from pipistrelle.estimation.smoother.graph import pose_key, pose_of
from pipistrelle.estimation.smoother.legs import Leg, carried, turned
from pipistrelle.estimation.smoother.roaming import (
    Chains,
    point_key,
    spread_on,
    velocity_key,
)

SHARE = 0.2
"""Most standard deviations of a range by detour, as a share of it: beyond, it places nothing."""
FAR = 1e6
"""A range beyond this [m] is none."""


@dataclass(frozen=True, kw_only=True)
class Around:
    """What is known of the last pose and of the landmarks about it.

    Attributes
    ----------
    isam : ISAM2
        As it is after the last pose that it has solved.
    node : int
        Number of that pose.
    leg : Leg or None
        The way from it to the last, where that is another.
    pose : (3) [m, m, rad]
        The last, as it is expected.
    chains : mapping of label to Chain
        Callers that move and are in the graph.
    walk_std : float
        How far the velocity of one strays in a second [m/s].
    """

    isam: gtsam.ISAM2
    node: int
    leg: Leg | None
    pose: Float[np.ndarray, "3"]
    chains: Chains = field(default_factory=dict)
    walk_std: float = 0.0

    def place(self, label: int) -> Float[np.ndarray, "2"]:
        """Return where a landmark is, or where a caller that moves is expected."""
        place = np.array(self.isam.calculateEstimatePoint2(self._keys(label)[0]))
        if self.leg and label in self.chains:
            velocity = self.isam.calculateEstimatePoint2(self._keys(label)[1])
            place += self.leg.seconds * velocity
        return place

    def joint(self, label: int) -> Float[np.ndarray, "5 5"]:
        """Return the covariance of the last pose and of a landmark, or of a caller's place."""
        keys = pose_key(self.node), *self._keys(label)
        told, M = self.isam.jointMarginalCovariance(list(keys)), np.eye(2 * len(keys) + 1)
        start = pose_of(self.isam.calculateEstimatePose2(keys[0]))
        M[:3, :3] = turned(start[2])
        P = M @ np.block([[told.at(a, b) for b in keys] for a in keys]) @ M.T
        if self.leg:
            P = carried(start, P, self.leg)
            if label in self.chains:
                P = spread_on(P, self.leg.seconds, self.walk_std)
        return P[:5, :5]

    def _keys(self, label: int) -> tuple[int, ...]:
        """Name a landmark in the graph, or a caller's place and velocity."""
        point = point_key(label, self.node, self.chains)
        if label in self.chains:
            return point, velocity_key(self.chains[label], self.node)
        return (point,)


def clues_of(label: int, heard: Iterable[Detour], mapped: Collection[int]) -> tuple[Detour, ...]:
    """Return the detours that tell of a landmark, or of a caller: the other end is in the graph.

    Parameters
    ----------
    label : int
    heard : iterable of Detour
    mapped : collection of int
        Landmarks in the graph.

    Returns
    -------
    tuple of Detour

    Examples
    --------
    >>> heard = [Detour(0, 4, 9, 3.0, 0.5), Detour(0, 5, 9, 2.0, 0.5)]
    >>> [[one.landmark for one in clues_of(label, heard, {4})] for label in (4, 5, 9)]
    [[], [], [4]]
    """
    return tuple(
        one
        for one in heard
        if (one.landmark == label and one.caller in mapped)
        or (one.caller == label and one.landmark in mapped)
    )


def placed_by(
    around: Around, heard: Bearing, label: int, clues: Iterable[Detour]
) -> Float[np.ndarray, "2"] | None:
    """Return where a landmark or a caller stands by its bearing and the surest of its detours.

    Parameters
    ----------
    around : Around
    heard : Bearing
        From the last pose.
    label : int
    clues : iterable of Detour
        One or more of `clues_of`.

    Returns
    -------
    (2) [m], or None
        Where none is sure.
    """
    angle, found = around.pose[2] + heard.bearing, []
    for clue in clues:
        caller = clue.caller == label
        other = clue.landmark if caller else clue.caller
        own = np.diag([0.0, 0.0, heard.std**2, clue.std**2])
        way = np.array([*(around.place(other) - around.pose[:2]), angle, clue.detour])
        _, share = sure_range(way, own, caller=caller)
        found.append((share, other, caller, way, own))
    share, other, caller, way, own = min(found, key=lambda one: one[:2])
    if share > SHARE:
        return None
    G = np.zeros((4, 5))
    G[:2, :2], G[:2, 3:], G[2, 2] = -np.eye(2), np.eye(2), 1.0
    distance, share = sure_range(way, own + G @ around.joint(other) @ G.T, caller=caller)
    if share > SHARE:
        return None
    return around.pose[:2] + distance * np.array([math.cos(angle), math.sin(angle)])


def sure_range(
    way: Float[np.ndarray, "4"], spread: Float[np.ndarray, "4 4"], *, caller: bool
) -> tuple[float, float]:
    """Return a range by detour with its standard deviation, as a share of it.

    Parameters
    ----------
    way : (4) [m, m, rad, m]
        To the other point (2), direction of the one whose range is asked, and detour.
    spread : (4, 4)
        Covariance of these.
    caller : bool
        Whether the range of the caller is asked and the other is the landmark, not the reverse.

    Returns
    -------
    range : [m]
    share : float
        Infinite where nothing is known.

    Examples
    --------
    The landmark is at (3, 4), the caller at (6, 0).

    >>> way, spread = np.array([6.0, 0.0, np.arctan2(4.0, 3.0), 4.0]), np.diag([0, 0, 0, 0.01])
    >>> [round(float(number), 3) for number in sure_range(way, spread, caller=False)]
    [5.0, 0.016]

    Were it midway between the two:

    >>> sure_range(np.array([6.0, 0.0, 0.0, 0.0]), spread, caller=False)[1]
    inf
    """
    if way[3] <= SOME * math.sqrt(spread[3, 3]):
        return math.nan, math.inf
    size, axes = np.linalg.eigh(spread)
    off = 2.0 * np.sqrt(np.maximum(size, 0.0)) * axes
    by_detour = caller_range_by_detour if caller else range_by_detour
    ranges = [
        by_detour(e, dx, dy, math.cos(angle), math.sin(angle))
        for dx, dy, angle, e in (way, *(way + off.T), *(way - off.T))
    ]
    if not all(0.0 < one < FAR for one in ranges):
        return math.nan, math.inf
    first, *others = ranges
    return first, math.sqrt(sum((one - first) ** 2 for one in others) / 8.0) / first
