r"""Right-invariant EKF-SLAM with rays: what is seen never tells which way is north.

EKF-SLAM's covariance is that of true state minus mean. Linearised about means that change from
frame to frame, its corrections learn a little of the heading of everything, vehicle and map
together, though nothing that is heard can tell it: the filter grows sure of what it cannot know
(Julier & Uhlmann, 2001; Huang et al., 2010). Here the covariance is that of the right-invariant
error :math:`\xi`,

.. math:: \theta = \hat\theta + \xi_\theta, \quad
          p = R(\xi_\theta)\,\hat p + V(\xi_\theta)\,\xi_p, \quad
          l = R(\xi_\theta)\,\hat l + V(\xi_\theta)\,\xi_l

for vehicle and every member of every landmark. Then

- nothing moves it but noise: F = I, and a control's noise (:math:`w_p, w_\theta` in x, y and
  heading) enters the positions through the heading it turns,
  :math:`\xi_p \mathrel{+}= w_p - J\hat p\,w_\theta`,
  :math:`\xi_l \mathrel{-}= J\hat l\,w_\theta`, with J a quarter turn; what the steps of a frame
  bring is gathered;
- a measurement's Jacobian has no column of the heading, wherever it is linearised;
- a new landmark has the row of the vehicle's position, and noise of its own;
- a correction moves the whole mean by the exponential of its step.

The velocity of a caller that moves is turned as points are (`estimation.ekf.roaming`).

Rays are members as before. The frame's origin is the start, so that levers are as short as the
drive and no number is lost to coordinates far from zero.

Sources: Barrau & Bonnabel, arXiv:1510.06263 (2015); Zhang, Wu, Song, Huang & Dissanayake, IEEE
Robotics and Automation Letters 2 (2017).
"""

import math
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from pipistrelle.config import RayConfig
from pipistrelle.detection.scans import Scan
from pipistrelle.estimation.beliefs import Gaussian, Landmarks
from pipistrelle.estimation.checking import (
    check_belief,
    check_gate,
    usable_controls,
    usable_known,
    usable_pose,
    usable_scan,
)
from pipistrelle.estimation.ekf.filter import (
    EkfBelief,
    map_rows,
    numbers_of,
    taken_in,
    with_points,
    with_velocities,
)
from pipistrelle.estimation.ekf.gaussian import INVARIANT
from pipistrelle.estimation.ekf.roaming import roam, roams
from pipistrelle.estimation.motion import Motion, MotionNumbers, motion_numbers, propagate_pose
from pipistrelle.estimation.rays import sensing_of
from pipistrelle.jit import kernel, no_alloc


@dataclass(frozen=True, slots=True, kw_only=True)
class InvariantBelief(EkfBelief):
    r"""A mean about the start, and the joint Gaussian of its right-invariant error.

    Attributes
    ----------
    mean : (3 + 2h)
        x, y [m] from the origin, heading [rad]; then x, y [m] of each member.
    covariance : (3 + 2h, 3 + 2h)
        Of :math:`\xi`: x, y, heading; then x, y of each member.
    origin : (2) [m]
        Where the vehicle started.
    """

    origin: Float[np.ndarray, "2"]

    def pose(self) -> Gaussian:
        """Return the vehicle's pose, (3) and (3, 3), its covariance that of the linear error."""
        x, y, _ = self.mean[:3]
        covariance = np.empty((3, 3))
        _about(self.covariance[:3, :3].copy(), x, y, covariance)
        placed = _placed(self.mean[:3], self.origin)
        return Gaussian(mean=placed, covariance=covariance, invariant=True)

    def rows(self, kept: Bool[np.ndarray, " h"]) -> Landmarks:
        """Return some members that are points by the linear error, those of a landmark together."""
        at = numbers_of(kept)
        mean = self.mean[at].reshape(-1, 2)
        turned = (mean @ np.array([[0.0, 1.0], [-1.0, 0.0]])).ravel()  # (-y, x): J l
        lever = np.outer(turned, self.covariance[2, at])
        square = np.outer(turned, turned) * self.covariance[2, 2]
        linear = self.covariance[np.ix_(at, at)] + (lever + lever.T) + square
        return map_rows(self.landmark[kept], self.weight[kept], mean + self.origin, linear)


@dataclass(frozen=True, slots=True, kw_only=True)
class InvariantEkfSlam:
    """Right-invariant EKF-SLAM with rays.

    Attributes
    ----------
    motion : Motion
    rays : RayConfig
    gate : float
        A measurement outside this share of its predicted distribution (chi-square) is dropped;
        1 drops none.
    robust : bool
        Whether a measurement that surprises counts less (`estimation.ekf.huber`).
    speed_std, walk_std : float
        Of callers that move: the velocity [m/s] along an axis before anything is known of it, and
        how far it strays in a second (`estimation.ekf.roaming`).

    Examples
    --------
    A vehicle that stands, unsure of its heading, learns nothing of it from what it sees.

    >>> from pipistrelle.config import RayConfig
    >>> from pipistrelle.detection.scans import make_scan
    >>> motion = Motion(model="bicycle", control_std=(0.1, 0.03), wheelbase=0.2)
    >>> slam = InvariantEkfSlam(motion=motion, rays=RayConfig())
    >>> belief = slam.init(Gaussian(mean=np.zeros(3), covariance=np.eye(3) * 1e-2))
    >>> known = {"range": np.array([2.0, 9.0]), "range_std": 0.2, "bearing_std": 0.15}
    >>> scan = make_scan(0.0, np.array([4, 9]), np.array([0.1, 0.7]), **known)
    >>> for _ in range(100):
    ...     belief = slam.update(belief, scan)
    >>> belief.pose().covariance[2, 2]
    np.float64(0.01)
    """

    motion: Motion
    rays: RayConfig
    gate: float = 1.0
    robust: bool = False
    speed_std: float = 1.0
    walk_std: float = 0.2

    def __post_init__(self) -> None:
        """Refuse a gate that is no share."""
        check_gate(self.gate)

    def init(self, pose: Gaussian) -> InvariantBelief:
        """Return the belief that knows a pose, (3) and (3, 3), and no landmark."""
        pose = usable_pose(pose)
        return InvariantBelief(
            mean=np.array([0.0, 0.0, pose.mean[2]]),
            covariance=pose.covariance,
            landmark=np.empty(0, dtype=np.int64),
            weight=np.empty(0),
            gated=0,
            origin=pose.mean[:2],
        )

    def knowing(self, belief: InvariantBelief, known: Landmarks) -> InvariantBelief:
        r"""Return a first belief that has landmarks in its map.

        That they stand where they do, whichever way the vehicle looks, is
        :math:`\xi_l = e_l - J\hat l\,\xi_\theta`, with their own errors e.

        Parameters
        ----------
        belief : InvariantBelief
            Without landmarks.
        known : Landmarks
            One row each.

        Returns
        -------
        InvariantBelief
        """
        check_belief(belief, InvariantBelief)
        known = usable_known(known)
        mean = known.mean - belief.origin
        by_pose = np.zeros((mean.size, 3))
        by_pose[:, 2] = -(mean @ np.array([[0.0, 1.0], [-1.0, 0.0]])).ravel()  # (y, -x)
        return with_points(belief, replace(known, mean=mean), by_pose)

    def predict(
        self,
        belief: InvariantBelief,
        controls: Float[np.ndarray, "k c"],
        dt: Float[np.ndarray, " k"],
        rng: np.random.Generator | None = None,
    ) -> tuple[InvariantBelief, Gaussian]:
        """Carry the belief through the control steps of a frame.

        Parameters
        ----------
        belief : InvariantBelief
        controls : (k, c)
            As the motion model has them.
        dt : (k) [s]
        rng : Generator, optional
            Not used: this filter draws nothing.

        Returns
        -------
        belief : InvariantBelief
        poses : Gaussian of (k, 3) and (k, 3, 3)
            After each step, their covariances those of the linear error.
        """
        check_belief(belief, InvariantBelief)
        controls, dt = usable_controls(self.motion, controls, dt)
        mean, covariance = belief.mean.copy(), belief.covariance.copy()
        poses = Gaussian(mean=np.empty((len(dt), 3)), covariance=np.empty((len(dt), 3, 3)))
        numbers = tuple(motion_numbers(self.motion))
        _propagate(mean, covariance, controls, dt, numbers, poses.mean, poses.covariance)
        if roams(belief.landmark):
            roam(mean, covariance, belief.landmark, dt.sum(), self.walk_std)
        placed = replace(poses, mean=_placed(poses.mean, belief.origin), invariant=True)
        return replace(belief, mean=mean, covariance=covariance), placed

    def update(
        self, belief: InvariantBelief, scan: Scan, rng: np.random.Generator | None = None
    ) -> InvariantBelief:
        """Correct the belief with a frame's measurements.

        Parameters
        ----------
        belief : InvariantBelief
        scan : Scan
        rng : Generator, optional
            Not used: this filter draws nothing.

        Returns
        -------
        InvariantBelief
        """
        check_belief(belief, InvariantBelief)
        scan = usable_scan(scan)
        if scan.landmark.size == 0:
            return belief
        sensing = sensing_of(self.rays, self.gate, robust=self.robust)
        fields = taken_in(belief, scan, sensing, INVARIANT)
        corrected = InvariantBelief(origin=belief.origin, **fields)
        return with_velocities(corrected, scan.moving, self.speed_std)


def _placed(
    pose: Float[np.ndarray, "*k 3"], origin: Float[np.ndarray, "2"]
) -> Float[np.ndarray, "*k 3"]:
    """Return poses about the origin where they are in the world."""
    return np.concatenate([pose[..., :2] + origin, pose[..., 2:]], axis=-1)


@no_alloc
def _about(
    P: Float[np.ndarray, "d d"], x: float, y: float, shifted: Float[np.ndarray, "3 3"]
) -> None:
    """Write M P M^T of the first three, M = [[1, 0, -y], [0, 1, x], [0, 0, 1]].

    It makes of the covariance of the invariant error that of the linear error of a pose at (x, y);
    with (-x, -y), the other way.
    """
    xh, yh, hh = P[0, 2], P[1, 2], P[2, 2]
    shifted[0, 0] = P[0, 0] - 2.0 * y * xh + y * y * hh
    shifted[1, 1] = P[1, 1] + 2.0 * x * yh + x * x * hh
    shifted[0, 1] = shifted[1, 0] = P[0, 1] + x * xh - y * yh - x * y * hh
    shifted[0, 2] = shifted[2, 0] = xh - y * hh
    shifted[1, 2] = shifted[2, 1] = yh + x * hh
    shifted[2, 2] = hh


@kernel
def _propagate(
    mean: Float[np.ndarray, " d"],
    covariance: Float[np.ndarray, "d d"],
    controls: Float[np.ndarray, "k c"],
    dt: Float[np.ndarray, " k"],
    motion: tuple[int, float, float, float, float, bool],
    pose_means: Float[np.ndarray, "k 3"],
    pose_covariances: Float[np.ndarray, "k 3 3"],
) -> None:
    """Advance mean and covariance in place; the noise of all steps enters the landmarks once.

    The motion is `MotionNumbers` as a plain tuple.
    """
    pose, P, numbers = mean[:3], covariance[:3, :3].copy(), MotionNumbers(*motion)
    noise, gathered = np.zeros((3, 3)), np.empty((3, 3))
    for k in range(controls.shape[0]):
        propagate_pose(pose, noise, controls[k], dt[k], numbers)
        _about(P, pose[0], pose[1], pose_covariances[k])
        for a in range(3):
            pose_means[k, a] = pose[a]
            for b in range(3):
                pose_covariances[k, a, b] += noise[a, b]
    _about(noise, -pose[0], -pose[1], gathered)
    turned, root = np.empty(mean.size), math.sqrt(gathered[2, 2])
    for i in range(3, mean.size, 2):  # J l of each member
        turned[i], turned[i + 1] = -mean[i + 1], mean[i]
    for a in range(3):
        for b in range(3):
            covariance[a, b] += gathered[a, b]
        for j in range(3, mean.size):
            covariance[a, j] -= gathered[a, 2] * turned[j]
            covariance[j, a] = covariance[a, j]
    if controls.shape[0]:
        _about(covariance, pose[0], pose[1], pose_covariances[-1])  # to the bit what `pose` says
    for i in range(3, mean.size):
        turned[i] *= root
    for i in range(3, mean.size):
        for j in range(3, mean.size):
            covariance[i, j] += turned[i] * turned[j]
