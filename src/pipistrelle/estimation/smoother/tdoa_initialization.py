"""Initialization by an excess path: the range of a landmark, or of a caller, along its bearing.

The range of a landmark follows from its bearing and an excess path over a caller in the graph; that
of a caller from an excess path over a landmark in the graph
(`estimation.measurement.range_by_excess_path`, `caller_range_by_excess_path`). Its uncertainty
depends on vehicle and other point together, and on the geometry: between vehicle and caller an
excess path says nothing of the range, and close to that line the range is far from linear, so that
slopes would deceive. So the range is evaluated at eight sigma points, two standard deviations to
either side along the principal axes of (offset, bearing, excess path): their spread is that of the
range (an unscented transform; Julier & Uhlmann 1997). Where one of them has no range, or the excess
path may be 0, nothing is known.
"""

import math
from collections.abc import Collection, Iterable
from dataclasses import dataclass, field

import gtsam
import numpy as np
from jaxtyping import Float

from pipistrelle.estimation.measurement import (
    MIN_TDOA_SIGMAS,
    caller_range_by_excess_path,
    range_by_excess_path,
)
from pipistrelle.estimation.smoother.caller_motion import (
    Chains,
    point_key,
    propagated_covariance,
    velocity_key,
)
from pipistrelle.estimation.smoother.delayed_initialization import Bearing
from pipistrelle.estimation.smoother.graph import joint_covariance, pose_key, pose_of
from pipistrelle.estimation.smoother.preintegration import Odometry, propagated, turned
from pipistrelle.estimation.smoother.tdoa import ExcessPath

MAX_RELATIVE_RANGE_STD = 0.2
"""An excess path places a point if the range has at most this standard deviation, divided by the
range."""
MAX_RANGE = 1e6
"""A larger range [m] counts as none."""


@dataclass(frozen=True, kw_only=True)
class LastPose:
    """The last pose, and the landmarks and callers relative to it."""

    isam: gtsam.ISAM2  # after the last pose that it has solved
    node: int  # number of that pose
    odometry: Odometry | None  # from there to the last pose, where that is another
    pose: Float[np.ndarray, "3"]  # the last, as predicted [m, m, rad]
    chains: Chains = field(default_factory=dict)  # moving callers in the graph, by label
    walk_std: float = 0.0  # of a caller's velocity after 1 s [m/s]

    def place(self, label: int) -> Float[np.ndarray, "2"]:
        """Return the place of a landmark, or the predicted place of a moving caller."""
        place = np.array(self.isam.calculateEstimatePoint2(self._keys(label)[0]))
        if self.odometry and label in self.chains:
            velocity = self.isam.calculateEstimatePoint2(self._keys(label)[1])
            place += self.odometry.seconds * velocity
        return place

    def joint(self, label: int) -> Float[np.ndarray, "5 5"]:
        """Return the covariance of the last pose and a landmark's, or a caller's, place."""
        keys = pose_key(self.node), *self._keys(label)
        M = np.eye(2 * len(keys) + 1)
        start = pose_of(self.isam.calculateEstimatePose2(keys[0]))
        M[:3, :3] = turned(start[2])
        P = M @ joint_covariance(self.isam, *keys) @ M.T
        if self.odometry:
            P = propagated(start, P, self.odometry)
            if label in self.chains:
                P = propagated_covariance(P, self.odometry.seconds, self.walk_std)
        return P[:5, :5]

    def _keys(self, label: int) -> tuple[int, ...]:
        """Return the key of a landmark, or the keys of a caller's place and velocity."""
        point = point_key(label, self.node, self.chains)
        if label in self.chains:
            return point, velocity_key(self.chains[label], self.node)
        return (point,)


def usable_excess_paths(
    label: int, heard: Iterable[ExcessPath], mapped: Collection[int]
) -> tuple[ExcessPath, ...]:
    """Return the excess paths of a landmark, or of a caller, whose other end is in the graph.

    >>> heard = [ExcessPath(0, 4, 9, 3.0, 0.5), ExcessPath(0, 5, 9, 2.0, 0.5)]
    >>> [[one.landmark for one in usable_excess_paths(label, heard, {4})] for label in (4, 5, 9)]
    [[], [], [4]]
    """
    return tuple(
        one
        for one in heard
        if (one.landmark == label and one.caller in mapped)
        or (one.caller == label and one.landmark in mapped)
    )


def place_by_excess_paths(
    last: LastPose, heard: Bearing, label: int, usable: Iterable[ExcessPath]
) -> Float[np.ndarray, "2"] | None:
    """Return where a landmark or a caller is by bearing and surest excess path; None if unsure.

    The bearing is from the last pose, ``excess_paths`` are one or more of `usable_excess_paths`.
    """
    angle, found = last.pose[2] + heard.bearing, []
    for clue in usable:
        caller = clue.caller == label
        other = clue.landmark if caller else clue.caller
        own = np.diag([0.0, 0.0, heard.std**2, clue.std**2])
        way = np.array([*(last.place(other) - last.pose[:2]), angle, clue.excess_path])
        _, share = unscented_range(way, own, caller=caller)
        found.append((share, other, caller, way, own))
    share, other, caller, way, own = min(found, key=lambda one: one[:2])
    if share > MAX_RELATIVE_RANGE_STD:
        return None
    G = np.zeros((4, 5))
    G[:2, :2], G[:2, 3:], G[2, 2] = -np.eye(2), np.eye(2), 1.0
    distance, share = unscented_range(way, own + G @ last.joint(other) @ G.T, caller=caller)
    if share > MAX_RELATIVE_RANGE_STD:
        return None
    return last.pose[:2] + distance * np.array([math.cos(angle), math.sin(angle)])


def unscented_range(
    way: Float[np.ndarray, "4"], spread: Float[np.ndarray, "4 4"], *, caller: bool
) -> tuple[float, float]:
    """Return a range by excess path and its relative standard deviation, infinite where unknown.

    ``way`` (4) is the offset to the other point (2), the direction of the asked one, and the
    excess path; ``spread`` (4, 4) is their covariance. With ``caller`` the range of the caller is
    asked.

    The landmark is at (3, 4), the caller at (6, 0).

    >>> way, spread = np.array([6.0, 0.0, np.arctan2(4.0, 3.0), 4.0]), np.diag([0, 0, 0, 0.01])
    >>> [round(float(number), 3) for number in unscented_range(way, spread, caller=False)]
    [5.0, 0.016]

    Were it midway between the two:

    >>> unscented_range(np.array([6.0, 0.0, 0.0, 0.0]), spread, caller=False)[1]
    inf
    """
    if way[3] <= MIN_TDOA_SIGMAS * math.sqrt(spread[3, 3]):
        return math.nan, math.inf
    size, axes = np.linalg.eigh(spread)
    off = 2.0 * np.sqrt(np.maximum(size, 0.0)) * axes
    by_excess_path = caller_range_by_excess_path if caller else range_by_excess_path
    ranges = [
        by_excess_path(e, dx, dy, math.cos(angle), math.sin(angle))
        for dx, dy, angle, e in (way, *(way + off.T), *(way - off.T))
    ]
    if not all(0.0 < one < MAX_RANGE for one in ranges):
        return math.nan, math.inf
    first, *others = ranges
    return first, math.sqrt(sum((one - first) ** 2 for one in others) / 8.0) / first
