"""EKF-SLAM with rays: one Gaussian over the pose and every landmark hypothesis.

The state is the pose and, two numbers each, the members of all landmarks (Eq. (8); the
correspondence is constant and known and stays out of it). A frame is corrected measurement by
measurement (Eq. (11)), each at the current mean: first the landmarks already mapped, in the order
of the scan, then the new ones are placed from the corrected pose.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from pipistrelle.config import RayConfig
from pipistrelle.detection.scans import Scan
from pipistrelle.estimation.beliefs import Gaussian, Landmarks
from pipistrelle.estimation.ekf.gaussian import (
    APPLIED,
    GATED,
    bearing_variance,
    carry,
    correct_active,
    correct_bearing,
    drop_members,
    gaussian_of,
    joint_of,
    place,
    settle,
)
from pipistrelle.estimation.measurement import sight
from pipistrelle.estimation.motion import Motion, motion_numbers
from pipistrelle.estimation.rays import (
    heaviest,
    log_likelihood,
    sensing_of,
    survivors,
    weigh_and_share,
)
from pipistrelle.geometry import wrap_angle
from pipistrelle.jit import kernel, lean


@dataclass(frozen=True, slots=True, kw_only=True)
class EkfBelief:
    """A joint Gaussian over pose and members (Bradley & Abaid, Eqs. (8) and (9)).

    Attributes
    ----------
    mean : (3 + 2h)
        x, y [m], heading [rad]; then x, y [m] of each member.
    covariance : (3 + 2h, 3 + 2h)
    landmark : (h)
        Label of each member; the members of a ray stand together, near to far.
    weight : (h)
        Aggregated likelihood of each member within its landmark.
    gated : int
        Measurements rejected so far.
    """

    mean: Float[np.ndarray, " d"]
    covariance: Float[np.ndarray, "d d"]
    landmark: Int[np.ndarray, " h"]
    weight: Float[np.ndarray, " h"]
    gated: int

    def pose(self) -> Gaussian:
        """Return the vehicle's pose, (3) and (3, 3)."""
        return Gaussian(mean=self.mean[:3].copy(), covariance=self.covariance[:3, :3].copy())

    def landmarks(self) -> Landmarks:
        """Return the map, one row per member."""
        members = self.landmark.size
        blocks = self.covariance[3:, 3:].reshape(members, 2, members, 2)
        rows = np.arange(members)
        return Landmarks(
            landmark=self.landmark.copy(),
            mean=self.mean[3:].reshape(-1, 2).copy(),
            covariance=blocks[rows, :, rows, :],
            weight=self.weight.copy(),
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class EkfSlam:
    """EKF-SLAM (Bradley & Abaid, Sec. III-A) with rays (Sec. III-C).

    Attributes
    ----------
    motion : Motion
    range_std, bearing_std : [m], [rad]
        What the filter assumes of a measurement (R, squared).
    rays : RayConfig
    gate : float
        A measurement outside this share of its predicted distribution (chi-square) is dropped;
        1 drops none.

    Examples
    --------
    >>> from pipistrelle.config import RayConfig
    >>> from pipistrelle.detection.scans import Scan
    >>> motion = Motion(model="bicycle", control_std=(0.1, 0.03), wheelbase=0.2)
    >>> slam = EkfSlam(motion=motion, range_std=0.2, bearing_std=0.15, rays=RayConfig())
    >>> belief = slam.init(Gaussian(mean=np.zeros(3), covariance=np.eye(3) * 1e-4))
    >>> heard = {"landmark": np.array([4, 9]), "bearing": np.array([0.1, 0.2])}
    >>> scan = Scan(time=0.0, range=np.array([2.0, np.nan]), **heard)
    >>> slam.update(belief, scan).landmarks().landmark.tolist()
    [4, 9, 9, 9, 9]
    """

    motion: Motion
    range_std: float
    bearing_std: float
    rays: RayConfig
    gate: float = 1.0

    def init(self, pose: Gaussian) -> EkfBelief:
        """Return the belief that knows a pose, (3) and (3, 3), and no landmark."""
        return EkfBelief(
            mean=pose.mean.astype(float),
            covariance=pose.covariance.astype(float),
            landmark=np.empty(0, dtype=np.int64),
            weight=np.empty(0),
            gated=0,
        )

    def predict(
        self,
        belief: EkfBelief,
        controls: Float[np.ndarray, "k 2"],
        dt: Float[np.ndarray, " k"],
        rng: np.random.Generator | None = None,
    ) -> tuple[EkfBelief, Gaussian]:
        """Carry the belief through the control steps of a frame.

        Parameters
        ----------
        belief : EkfBelief
        controls : (k, 2) [m/s, rad or rad/s]
        dt : (k) [s]
        rng : Generator, optional
            Not used: this filter draws nothing.

        Returns
        -------
        belief : EkfBelief
        poses : Gaussian of (k, 3) and (k, 3, 3)
            After each step.

        Notes
        -----
        Bradley & Abaid, Eq. (10).
        """
        mean, covariance = belief.mean.copy(), belief.covariance.copy()
        poses = Gaussian(mean=np.empty((len(dt), 3)), covariance=np.empty((len(dt), 3, 3)))
        numbers = motion_numbers(self.motion)
        carry(mean, covariance, controls, dt, numbers, poses.mean, poses.covariance)
        moved = EkfBelief(
            mean=mean,
            covariance=covariance,
            landmark=belief.landmark,
            weight=belief.weight,
            gated=belief.gated,
        )
        return moved, poses

    def update(
        self, belief: EkfBelief, scan: Scan, rng: np.random.Generator | None = None
    ) -> EkfBelief:
        """Correct the belief with a frame's measurements.

        Parameters
        ----------
        belief : EkfBelief
        scan : Scan
        rng : Generator, optional
            Not used: this filter draws nothing.

        Returns
        -------
        EkfBelief

        Notes
        -----
        Bradley & Abaid, Eqs. (11) and (16) to (21).
        """
        if scan.landmark.size == 0:
            return belief
        mean, covariance, landmark, weight, gated = _update(
            belief.mean,
            belief.covariance,
            belief.landmark,
            belief.weight,
            scan.landmark,
            scan.bearing,
            scan.range,
            sensing_of(self.range_std, self.bearing_std, self.rays, self.gate),
        )
        return EkfBelief(
            mean=mean,
            covariance=covariance,
            landmark=landmark,
            weight=weight,
            gated=belief.gated + gated,
        )


class _Scratch(NamedTuple):
    """Room to work on the members of one landmark, and on the order of the state's numbers."""

    likelihood: Float[np.ndarray, " m"]
    share: Float[np.ndarray, " m"]
    keep: Bool[np.ndarray, " m"]
    source: Int[np.ndarray, " n"]


@kernel
def _scratch(members):
    """Make room for so many members."""
    return _Scratch(
        np.empty(members),
        np.empty(members),
        np.empty(members, np.bool_),
        np.empty(3 + 2 * members, np.int64),
    )


@lean
def _members_of(landmark, members, label):
    """Index of a landmark's first member and how many it has (0: not mapped)."""
    for first in range(members):
        if landmark[first] == label:
            last = first + 1
            while last < members and landmark[last] == label:
                last += 1
            return first, last - first
    return members, 0


@lean
def _correct_ray(joint, weight, members, first, count, bearing, sensing, scratch):
    """Weigh a ray's members by a bearing and share it among them; GATED when none expected it."""
    mean, size, variance = joint.mean, 3 + 2 * members, sensing.bearing_variance
    outcome = GATED
    for j in range(count):
        i = 3 + 2 * (first + j)
        _, expected, c, s, k = sight(mean[0], mean[1], mean[2], mean[i], mean[i + 1])
        innovation = wrap_angle(bearing - expected)
        S = bearing_variance(joint, size, i, c, s, k) + variance
        scratch.likelihood[j] = log_likelihood(innovation, S)
        if innovation * innovation <= sensing.passive_bound * S:
            outcome = APPLIED
    if outcome == GATED:
        return GATED
    weigh_and_share(
        scratch.likelihood, weight[first:], count, sensing.power, sensing.aggregated, scratch.share
    )
    for j in range(count):
        if scratch.share[j] > 0.0:
            i = 3 + 2 * (first + j)
            correct_bearing(joint, size, i, bearing, variance / scratch.share[j], np.inf)
    return APPLIED


@lean
def _range_for_ray(
    joint, landmark, weight, members, first, count, distance, bearing, sensing, scratch
):
    """Give a partial landmark its range: one member is left. Returns the members left."""
    left = 0 if sensing.reinitialise else heaviest(weight[first:], count)
    for j in range(count):
        scratch.keep[j] = j == left
    members = drop_members(
        joint, landmark, weight, members, first, count, scratch.keep, scratch.source
    )
    weight[first] = 1.0
    mean, size, i = joint.mean, 3 + 2 * members, 3 + 2 * first
    if sensing.reinitialise:
        place(
            mean, joint.covariance, size, i, distance, bearing,
            sensing.range_variance, sensing.bearing_variance,
        )  # fmt: skip
    else:
        _, _, c, s, _ = sight(mean[0], mean[1], mean[2], mean[i], mean[i + 1])
        mean[i], mean[i + 1] = mean[0] + distance * c, mean[1] + distance * s
        correct_bearing(joint, size, i, bearing, sensing.bearing_variance, np.inf)
    return members


@lean
def _correct_known(joint, landmark, weight, members, label, bearing, distance, sensing, scratch):
    """Correct with one measurement of a mapped landmark: the members left, and whether gated."""
    first, count = _members_of(landmark, members, label)
    size, i, passive = 3 + 2 * members, 3 + 2 * first, math.isnan(distance)
    if count == 1 and passive:
        outcome = correct_bearing(
            joint, size, i, bearing, sensing.bearing_variance, sensing.passive_bound
        )
    elif count == 1:
        outcome = correct_active(
            joint, size, i, distance, bearing,
            sensing.range_variance, sensing.bearing_variance, sensing.active_bound,
        )  # fmt: skip
    elif passive:
        outcome = _correct_ray(joint, weight, members, first, count, bearing, sensing, scratch)
        keep, kept = scratch.keep, count
        if outcome == APPLIED:
            kept = survivors(weight[first:], count, sensing.prune, keep)
        if kept < count:
            members = drop_members(
                joint, landmark, weight, members, first, count, keep, scratch.source
            )
    else:
        outcome = APPLIED
        members = _range_for_ray(
            joint, landmark, weight, members, first, count, distance, bearing, sensing, scratch
        )
    return members, outcome


@lean
def _place_new(joint, landmark, weight, members, label, bearing, distance, sensing):
    """Append a landmark, one member or a ray of them (Eqs. (16) to (18)); the members there are."""
    passive = math.isnan(distance)
    count = sensing.ray_ranges.size if passive else 1
    for j in range(count):
        far = sensing.ray_ranges[j] if passive else distance
        spread = sensing.ray_stds[j] ** 2 if passive else sensing.range_variance
        size = 3 + 2 * members
        place(
            joint.mean, joint.covariance, size, size, far, bearing, spread,
            sensing.bearing_variance,
        )  # fmt: skip
        landmark[members], weight[members] = label, 1.0 / count
        members += 1
    return members


@kernel
def _update(old_mean, old_covariance, old_landmark, old_weight, labels, bearings, ranges, sensing):
    """Correct, prune and extend a copy of the belief; returns its arrays and the gated count."""
    members, most = old_landmark.size, old_landmark.size
    known = np.empty(labels.size, dtype=np.bool_)
    for m in range(labels.size):
        known[m] = _members_of(old_landmark, members, labels[m])[1] > 0
        if not known[m]:
            most += sensing.ray_ranges.size if math.isnan(ranges[m]) else 1
    joint, scratch = joint_of(old_mean, old_covariance, 3 + 2 * most), _scratch(most)
    landmark, weight, gated = np.empty(most, dtype=np.int64), np.empty(most), 0
    for member in range(members):
        landmark[member], weight[member] = old_landmark[member], old_weight[member]
    for m in range(labels.size):
        if known[m]:
            members, outcome = _correct_known(
                joint, landmark, weight, members, labels[m], bearings[m], ranges[m], sensing,
                scratch,
            )  # fmt: skip
            gated += outcome
    settle(joint, 3 + 2 * members)
    for m in range(labels.size):
        if not known[m]:
            members = _place_new(
                joint, landmark, weight, members, labels[m], bearings[m], ranges[m], sensing
            )
    joint.mean[2] = wrap_angle(joint.mean[2])
    size = 3 + 2 * members
    mean, covariance = gaussian_of(joint, size)
    return mean, covariance, landmark[:members].copy(), weight[:members].copy(), gated
