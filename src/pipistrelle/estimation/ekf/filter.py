r"""EKF-SLAM with rays: one Gaussian over the pose and every landmark hypothesis.

The state is the pose and, two numbers each, the members of all landmarks,

.. math:: \hat X = [\hat x_v, \hat y_v, \hat\theta_v, \hat x_1, \hat y_1, \dots,
          \hat x_h, \hat y_h]^T
   :label: eq-8

(Eq. (8); the correspondence is constant and known, and no part of it). `correction` corrects it
with a scan. A moving caller has its velocity there, too (`caller_motion`). The covariance is that
of the linear or of the right-invariant error (`invariant_error`).
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from pipistrelle.config import RayConfig
from pipistrelle.detection.scans import Scan
from pipistrelle.estimation import recovery
from pipistrelle.estimation.beliefs import (
    NO_INNOVATIONS,
    Gaussian,
    Innovations,
    JointGaussian,
    Landmarks,
)
from pipistrelle.estimation.checking import (
    check_belief,
    check_gate,
    usable_controls,
    usable_known,
    usable_pose,
    usable_scan,
)
from pipistrelle.estimation.ekf.caller_motion import (
    has_velocities,
    is_standing,
    is_velocity,
    missing_velocities,
    propagate_callers,
)
from pipistrelle.estimation.ekf.correction import corrected
from pipistrelle.estimation.ekf.delayed_initialization import WAITING_WEIGHT
from pipistrelle.estimation.ekf.editing import is_placed, merged, removed
from pipistrelle.estimation.ekf.gaussian import INVARIANT, LINEAR, propagate
from pipistrelle.estimation.ekf.invariant_error import (
    linear_part,
    propagate_invariant,
    rotated_left,
    shifted_covariance,
)
from pipistrelle.estimation.measurement import columns_of, timings_of
from pipistrelle.estimation.motion import Motion, motion_numbers
from pipistrelle.estimation.rays import update_params


@dataclass(frozen=True, slots=True, kw_only=True)
class EkfBelief:
    r"""A joint Gaussian over pose x and members m (Bradley & Abaid, Eqs. (8) and (9)).

    .. math:: P = \begin{bmatrix} P_{xx} & P_{xm} \\ P_{mx} & P_{mm} \end{bmatrix}
       :label: eq-9
    """

    mean: Float[np.ndarray, " d"]
    """(3 + 2h): x, y [m] from the origin, heading [rad]; then x, y [m] of each member."""
    covariance: Float[np.ndarray, "d d"]
    """Of the error that `error` names, in the same order."""
    landmark: Int[np.ndarray, " h"]
    """Label of each member; the members of a ray stand together, near to far. A moving caller has a
    member more, its velocity [m/s], with another label (`caller_motion.velocity_of`)."""
    weight: Float[np.ndarray, " h"]
    """Aggregated likelihood of each member within its landmark; `WAITING_WEIGHT` for the two points
    of a bearing that waits to be crossed."""
    gated: int
    """Measurements rejected so far."""
    innovations: Innovations = NO_INNOVATIONS
    error: float = LINEAR
    """`gaussian.LINEAR` or `gaussian.INVARIANT`."""
    doubt: float = 0.0
    """Evidence that the odometry has failed (`estimation.recovery`)."""
    origin: Float[np.ndarray, "2"] = field(default_factory=lambda: np.zeros(2))
    """Where the vehicle started [m], for the invariant error; (0, 0) for the linear one."""

    def pose(self) -> Gaussian:
        """Return the vehicle's pose, (3) and (3, 3), with the covariance of the linear error."""
        mean, covariance = self.mean[:3].copy(), self.covariance[:3, :3].copy()
        if self.error == LINEAR:
            return Gaussian(mean=mean, covariance=covariance)
        linear = np.empty((3, 3))
        shifted_covariance(covariance, mean[0], mean[1], linear)
        mean[:2] += self.origin
        return Gaussian(mean=mean, covariance=linear, invariant=True)

    def landmarks(self) -> Landmarks:
        """Return the map, one row per member."""
        return self.rows(is_standing(self.landmark))

    def moving(self) -> Landmarks:
        """Return the callers that move, one row per member."""
        return self.rows(~is_standing(self.landmark) & ~is_velocity(self.landmark))

    def rows(self, kept: Bool[np.ndarray, " h"]) -> Landmarks:
        """Return some members with the covariance of the linear error, a landmark's together."""
        mean, covariance = self._linear(kept, with_pose=False)
        return _map_of(self.landmark[kept], self.weight[kept], mean.reshape(-1, 2), covariance)

    def joint(self, among: Int[np.ndarray, " n"] | None = None) -> JointGaussian:
        """Return pose and placed landmarks together, callers that move among them.

        ``among``: labels of the only landmarks that are returned.
        """
        placed = is_placed(self.landmark)
        if among is not None:
            placed &= np.isin(self.landmark, among)
        mean, covariance = self._linear(placed, with_pose=True)
        return JointGaussian(landmark=self.landmark[placed], mean=mean, covariance=covariance)

    def _linear(
        self, kept: Bool[np.ndarray, " h"], *, with_pose: bool
    ) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, "k k"]]:
        """Return mean and covariance of the linear error of some members (`linear_part`)."""
        invariant = self.error == INVARIANT
        return linear_part(self.mean, self.covariance, self.origin, kept, with_pose, invariant)

    def labels(self) -> list[int]:
        """Return the labels of all landmarks and callers, placed or not."""
        return sorted({*self.landmark[~is_velocity(self.landmark)].tolist()})

    def edited(self, remove: Sequence[int], merge: Sequence[tuple[int, int]]) -> "EkfBelief":
        """Return the belief without some landmarks, and with others as one (`editing`)."""
        state = (self.mean, self.covariance, self.landmark, self.weight)
        for kept, gone in merge:
            state = merged(state, kept, gone, self.error)
        for label in remove:
            state = removed(state, label)
        mean, covariance, landmark, weight = state
        return replace(self, mean=mean, covariance=covariance, landmark=landmark, weight=weight)

    def freed(self, pose: Float[np.ndarray, "3"], stds: Float[np.ndarray, "3"]) -> "EkfBelief":
        """Return the belief with the vehicle at a pose, with an independent error more."""
        here = np.append(pose[:2] - self.origin, pose[2])
        mean, P = np.append(here, self.mean[3:]), self.covariance.copy()
        noise = np.zeros((mean.size, 3))
        noise[:3] = np.diag(stds)
        if self.error == INVARIANT:
            for a, lever in enumerate(rotated_left((self.mean[:2] - here[:2])[np.newaxis])):
                P[a] += lever * P[2]
                P[:, a] += lever * P[:, 2]
            noise[:2, 2] -= stds[2] * rotated_left(mean[np.newaxis, :2])
            noise[3:, 2] = -stds[2] * rotated_left(mean[3:].reshape(-1, 2))
        P += np.einsum("ia,ja->ij", noise, noise, optimize=False)
        return replace(self, mean=mean, covariance=P)


def _map_of(
    landmark: Int[np.ndarray, " h"],
    weights: Float[np.ndarray, " h"],
    mean: Float[np.ndarray, "h 2"],
    covariance: Float[np.ndarray, "d d"],
) -> Landmarks:
    """Return a map, one row per member, from the joint covariance (2h, 2h) of all.

    A waiting bearing becomes two members of equal weight, half and twice as far as the point in its
    direction, with standard deviations of half their range.
    """
    members = len(mean)
    blocks, rows = covariance.reshape(members, 2, members, 2), np.arange(members)
    means, own, weight = mean.copy(), blocks[rows, :, rows, :], weights.copy()
    for first in np.flatnonzero(weight == WAITING_WEIGHT)[::2]:
        ray = mean[first + 1] - mean[first]
        pair = covariance[2 * first : 2 * first + 4, 2 * first : 2 * first + 4]
        for member, share in ((first, 0.5), (first + 1, 2.0)):
            G = np.kron([[1.0 - share, share]], np.eye(2))
            spread = G @ pair @ G.T + np.outer(share * ray, share * ray) / 4.0
            means[member], own[member] = mean[first] + share * ray, (spread + spread.T) / 2.0
            weight[member] = 0.5
    return Landmarks(landmark=landmark.copy(), mean=means, covariance=own, weight=weight)


def _with_points(
    belief: EkfBelief, known: Landmarks, by_state: Float[np.ndarray, "n d"]
) -> EkfBelief:
    """Append members, with errors of their own and ``by_state`` times the error of the state."""
    P, cross = belief.covariance, by_state @ belief.covariance
    own = np.zeros((len(by_state), len(by_state)))
    for row, covariance in enumerate(known.covariance):
        own[2 * row : 2 * row + 2, 2 * row : 2 * row + 2] = covariance
    return replace(
        belief,
        mean=np.append(belief.mean, known.mean.ravel()),
        covariance=np.block([[P, cross.T], [cross, cross @ by_state.T + own]]),
        landmark=np.append(belief.landmark, known.landmark),
        weight=np.append(belief.weight, known.weight),
    )


def _with_velocities(belief: EkfBelief, moving: Int[np.ndarray, " v"], std: float) -> EkfBelief:
    """Give each placed moving caller a velocity of 0, with a std [m/s] along each axis."""
    if moving.size == 0:
        return belief
    labels = missing_velocities(belief.landmark, moving)
    if labels.size == 0:
        return belief
    size = labels.size
    unknown = Landmarks(
        landmark=labels,
        mean=np.zeros((size, 2)),
        covariance=np.tile(std * std * np.eye(2), (size, 1, 1)),
        weight=np.ones(size),
    )
    return _with_points(belief, unknown, np.zeros((2 * size, belief.mean.size)))


@dataclass(frozen=True, slots=True, kw_only=True)
class EkfSlam:
    """EKF-SLAM (Bradley & Abaid, Sec. III-A) with rays (Sec. III-C).

    Examples
    --------
    >>> from pipistrelle.config import RayConfig
    >>> from pipistrelle.detection.scans import make_scan
    >>> motion = Motion(model="bicycle", control_std=(0.1, 0.03), wheelbase=0.2)
    >>> slam = EkfSlam(motion=motion, rays=RayConfig())
    >>> belief = slam.init(Gaussian(mean=np.zeros(3), covariance=np.eye(3) * 1e-4))
    >>> known = {"range": np.array([2.0, np.nan]), "range_std": 0.2, "bearing_std": 0.15}
    >>> scan = make_scan(0.0, np.array([4, 9]), np.array([0.1, 0.2]), **known)
    >>> slam.update(belief, scan).landmarks().landmark.tolist()
    [4, 9, 9, 9, 9]
    """

    motion: Motion
    rays: RayConfig
    gate: float = 1.0
    """A measurement outside this share of its predicted distribution (chi-square) is dropped; 1
    drops none."""
    robust: bool = False
    """Whether a measurement that surprises counts less (`estimation.ekf.huber`)."""
    speed_std: float = 1.0
    """Velocity [m/s] along an axis of a moving caller, before anything is known of it."""
    walk_std: float = 0.2
    """Random walk of that velocity: its standard deviation after 1 s [m/s]."""
    error: float = LINEAR
    """The error that a first belief has: `gaussian.LINEAR` or `gaussian.INVARIANT`."""

    def __post_init__(self) -> None:
        """Refuse a gate that is no share."""
        check_gate(self.gate)

    def init(self, pose: Gaussian) -> EkfBelief:
        """Return the belief that knows a pose, (3) and (3, 3), and no landmark."""
        pose = usable_pose(pose)
        origin = np.zeros(2) if self.error == LINEAR else pose.mean[:2]
        return EkfBelief(
            mean=np.append(pose.mean[:2] - origin, pose.mean[2]),
            covariance=pose.covariance,
            landmark=np.empty(0, dtype=np.int64),
            weight=np.empty(0),
            gated=0,
            error=self.error,
            origin=origin,
        )

    def knowing(self, belief: EkfBelief, known: Landmarks) -> EkfBelief:
        r"""Return a first belief that has landmarks in its map, one row each.

        Their places do not depend on the heading of the vehicle: an invariant error is
        :math:`\xi_l = e_l - J\hat l\,\xi_\theta`, with their own errors e.

        Examples
        --------
        >>> motion = Motion(model="bicycle", control_std=(0.1, 0.03), wheelbase=0.2)
        >>> slam = EkfSlam(motion=motion, rays=RayConfig())
        >>> belief = slam.init(Gaussian(mean=np.zeros(3), covariance=np.eye(3)))
        >>> point = {"mean": np.array([[3.0, 4.0]]), "covariance": np.eye(2)[None]}
        >>> post = Landmarks(landmark=np.array([7]), weight=np.ones(1), **point)
        >>> slam.knowing(belief, post).landmarks().mean
        array([[3., 4.]])
        """
        check_belief(belief, EkfBelief)
        known = usable_known(known)
        mean = known.mean - belief.origin
        by_pose = np.zeros((mean.size, 3))
        if belief.error == INVARIANT:
            by_pose[:, 2] = -rotated_left(mean)
        return _with_points(belief, replace(known, mean=mean), by_pose)

    def predict(
        self,
        belief: EkfBelief,
        controls: Float[np.ndarray, "k c"],
        dt: Float[np.ndarray, " k"],
        rng: np.random.Generator | None = None,
    ) -> tuple[EkfBelief, Gaussian]:
        r"""Carry the belief through the control steps of a frame.

        .. math:: \bar P_{xx} = F P_{xx} F^T + U Q U^T, \qquad
                  \bar P_{xm} = \bar P_{mx}^T = F P_{xm}
           :label: eq-10

        with F and U the derivatives of the motion by the pose and by the control (Bradley & Abaid,
        Eq. (10)).

        Parameters
        ----------
        belief : EkfBelief
        controls : (k, c)
            As the motion model has them.
        dt : (k) [s]
        rng : Generator, optional
            Not used: this filter draws nothing.

        Returns
        -------
        belief : EkfBelief
        poses : Gaussian of (k, 3) and (k, 3, 3)
            After each step, with the covariance of the linear error.
        """
        check_belief(belief, EkfBelief)
        controls, dt = usable_controls(self.motion, controls, dt)
        mean, covariance = belief.mean.copy(), belief.covariance.copy()
        means, covariances = np.empty((len(dt), 3)), np.empty((len(dt), 3, 3))
        step = propagate if belief.error == LINEAR else propagate_invariant
        numbers = tuple(motion_numbers(self.motion))
        step(mean, covariance, controls, dt, numbers, means, covariances)
        if has_velocities(belief.landmark):
            propagate_callers(mean, covariance, belief.landmark, dt.sum(), self.walk_std)
        invariant = belief.error == INVARIANT
        if invariant:
            means[:, :2] += belief.origin
        poses = Gaussian(mean=means, covariance=covariances, invariant=invariant)
        return replace(belief, mean=mean, covariance=covariance), poses

    def update(
        self, belief: EkfBelief, scan: Scan, rng: np.random.Generator | None = None
    ) -> EkfBelief:
        r"""Correct the belief with a frame's measurements.

        .. math:: K_i = \bar P H_i^T (H_i \bar P H_i^T + R)^{-1}, \qquad
                  \hat X = \bar X + K_i (z_i - \bar z_i), \qquad
                  \hat P = (I - K_i H_i) \bar P
           :label: eq-11

        A landmark that is not in the map is placed where it was heard,

        .. math:: \hat x_i = \hat x_v + d_i \cos(\phi_i + \hat\theta_v), \qquad
                  \hat y_i = \hat y_v + d_i \sin(\phi_i + \hat\theta_v)
           :label: eq-16

        or, without a range, as a ray.

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
        check_belief(belief, EkfBelief)
        scan = usable_scan(scan)
        if scan.landmark.size == 0:
            return belief
        return recovery.corrected(
            self._corrected, belief, scan, self.gate, self.rays.range_bounds[1]
        )

    def _corrected(self, belief: EkfBelief, scan: Scan) -> EkfBelief:
        """Correct the belief with the measurements that pass the gate."""
        mean, covariance, landmark, weight, gated, squared, degrees = corrected(
            belief.mean,
            belief.covariance,
            belief.landmark,
            belief.weight,
            columns_of(scan),
            timings_of(scan),
            update_params(self.rays, self.gate, robust=self.robust),
            belief.error,
        )
        after = replace(
            belief,
            mean=mean,
            covariance=covariance,
            landmark=landmark,
            weight=weight,
            gated=belief.gated + gated,
            innovations=belief.innovations.plus(squared, degrees),
        )
        return _with_velocities(after, scan.moving, self.speed_std)
