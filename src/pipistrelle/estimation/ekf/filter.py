r"""EKF-SLAM with rays: one Gaussian over the pose and every landmark hypothesis.

The state is the pose and, two numbers each, the members of all landmarks,

.. math:: \hat X = [\hat x_v, \hat y_v, \hat\theta_v, \hat x_1, \hat y_1, \dots,
          \hat x_h, \hat y_h]^T
   :label: eq-8

(Eq. (8); the correspondence is constant and known and stays out of it). How a frame corrects it:
`correction`. A caller that moves has its velocity there, too: `roaming`.
"""

from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Bool, Float, Int

from pipistrelle.config import RayConfig
from pipistrelle.detection.scans import Scan
from pipistrelle.estimation.beliefs import NO_INNOVATIONS, Gaussian, Innovations, Landmarks
from pipistrelle.estimation.checking import (
    check_belief,
    check_gate,
    usable_controls,
    usable_known,
    usable_pose,
    usable_scan,
)
from pipistrelle.estimation.ekf.correction import corrected
from pipistrelle.estimation.ekf.crossing import WAITS
from pipistrelle.estimation.ekf.gaussian import LINEAR, propagate
from pipistrelle.estimation.ekf.roaming import is_velocity, roam, roams, stands, velocities_missing
from pipistrelle.estimation.measurement import columns_of, timings_of
from pipistrelle.estimation.motion import Motion, motion_numbers
from pipistrelle.estimation.rays import Sensing, sensing_of


@dataclass(frozen=True, slots=True, kw_only=True)
class EkfBelief:
    r"""A joint Gaussian over pose x and members m (Bradley & Abaid, Eqs. (8) and (9)).

    .. math:: P = \begin{bmatrix} P_{xx} & P_{xm} \\ P_{mx} & P_{mm} \end{bmatrix}
       :label: eq-9

    Attributes
    ----------
    mean : (3 + 2h)
        x, y [m], heading [rad]; then x, y [m] of each member.
    covariance : (3 + 2h, 3 + 2h)
    landmark : (h)
        Label of each member; the members of a ray stand together, near to far. A caller that moves
        has a member more, its velocity [m/s], by another label (`roaming.velocity_of`).
    weight : (h)
        Aggregated likelihood of each member within its landmark; `crossing.WAITS` of the two points
        of a bearing that waits to be crossed.
    gated : int
        Measurements rejected so far.
    innovations : Innovations
    """

    mean: Float[np.ndarray, " d"]
    covariance: Float[np.ndarray, "d d"]
    landmark: Int[np.ndarray, " h"]
    weight: Float[np.ndarray, " h"]
    gated: int
    innovations: Innovations = NO_INNOVATIONS

    def pose(self) -> Gaussian:
        """Return the vehicle's pose, (3) and (3, 3)."""
        return Gaussian(mean=self.mean[:3].copy(), covariance=self.covariance[:3, :3].copy())

    def landmarks(self) -> Landmarks:
        """Return the map, one row per member."""
        return self.rows(stands(self.landmark))

    def moving(self) -> Landmarks:
        """Return the callers that move, one row per member."""
        return self.rows(~stands(self.landmark) & ~is_velocity(self.landmark))

    def rows(self, kept: Bool[np.ndarray, " h"]) -> Landmarks:
        """Return some members by the linear error, those of a landmark together."""
        at = numbers_of(kept)
        mean, covariance = self.mean[at].reshape(-1, 2), self.covariance[np.ix_(at, at)]
        return map_rows(self.landmark[kept], self.weight[kept], mean, covariance)


def numbers_of(kept: Bool[np.ndarray, " h"]) -> Int[np.ndarray, " n"]:
    """Return where the numbers of some members stand in the state.

    Parameters
    ----------
    kept : (h)

    Returns
    -------
    (n)

    Examples
    --------
    >>> numbers_of(np.array([False, True]))
    array([5, 6])
    """
    return (3 + 2 * np.flatnonzero(kept)[:, np.newaxis] + np.arange(2)).ravel()


Kept = TypeVar("Kept", bound=EkfBelief)
"""The same kind of belief as was given."""


def map_rows(
    landmark: Int[np.ndarray, " h"],
    weights: Float[np.ndarray, " h"],
    mean: Float[np.ndarray, "h 2"],
    covariance: Float[np.ndarray, "d d"],
) -> Landmarks:
    """Lay out a map, one row per member, from the linear error of all.

    A bearing that waits is told as two members, equally likely, half as far as the point that it
    was heard through and twice as far, and as unsure of their range.

    Parameters
    ----------
    landmark, weights : (h)
        As of an `EkfBelief`.
    mean : (h, 2) [m]
    covariance : (2h, 2h) [m^2]

    Returns
    -------
    Landmarks
    """
    members = len(mean)
    blocks, rows = covariance.reshape(members, 2, members, 2), np.arange(members)
    means, own, weight = mean.copy(), blocks[rows, :, rows, :], weights.copy()
    for first in np.flatnonzero(weight == WAITS)[::2]:
        ray = mean[first + 1] - mean[first]
        pair = covariance[2 * first : 2 * first + 4, 2 * first : 2 * first + 4]
        for member, share in ((first, 0.5), (first + 1, 2.0)):
            G = np.kron([[1.0 - share, share]], np.eye(2))
            spread = G @ pair @ G.T + np.outer(share * ray, share * ray) / 4.0
            means[member], own[member] = mean[first] + share * ray, (spread + spread.T) / 2.0
            weight[member] = 0.5
    return Landmarks(landmark=landmark.copy(), mean=means, covariance=own, weight=weight)


def with_points(belief: Kept, known: Landmarks, by_state: Float[np.ndarray, "n d"]) -> Kept:
    """Append members to a belief.

    Parameters
    ----------
    belief : EkfBelief
    known : Landmarks of n / 2 rows
        Their covariances are of errors of their own.
    by_state : (n, d)
        How their errors hang on the state's besides.

    Returns
    -------
    EkfBelief
    """
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


def with_velocities(belief: Kept, moving: Int[np.ndarray, " v"], std: float) -> Kept:
    """Give each caller that moves a velocity, once it has a place.

    Parameters
    ----------
    belief : EkfBelief
    moving : (v)
        Labels of who moves.
    std : [m/s]
        Of a velocity of which nothing is known, along an axis.

    Returns
    -------
    EkfBelief

    Examples
    --------
    >>> belief = EkfBelief(
    ...     mean=np.arange(5.0), covariance=np.eye(5), landmark=np.array([9]), weight=np.ones(1),
    ...     gated=0,
    ... )
    >>> belief = with_velocities(belief, np.array([8, 9]), 2.0)
    >>> belief.landmark, belief.mean, belief.covariance.diagonal()
    (array([  9, -11]), array([0., 1., 2., 3., 4., 0., 0.]), array([1., 1., 1., 1., 1., 4., 4.]))
    """
    if moving.size == 0:
        return belief
    labels = velocities_missing(belief.landmark, moving)
    if labels.size == 0:
        return belief
    size = labels.size
    unknown = Landmarks(
        landmark=labels,
        mean=np.zeros((size, 2)),
        covariance=np.tile(std * std * np.eye(2), (size, 1, 1)),
        weight=np.ones(size),
    )
    return with_points(belief, unknown, np.zeros((2 * size, belief.mean.size)))


@dataclass(frozen=True, slots=True, kw_only=True)
class EkfSlam:
    """EKF-SLAM (Bradley & Abaid, Sec. III-A) with rays (Sec. III-C).

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
    robust: bool = False
    speed_std: float = 1.0
    walk_std: float = 0.2

    def __post_init__(self) -> None:
        """Refuse a gate that is no share."""
        check_gate(self.gate)

    def init(self, pose: Gaussian) -> EkfBelief:
        """Return the belief that knows a pose, (3) and (3, 3), and no landmark."""
        pose = usable_pose(pose)
        return EkfBelief(
            mean=pose.mean,
            covariance=pose.covariance,
            landmark=np.empty(0, dtype=np.int64),
            weight=np.empty(0),
            gated=0,
        )

    def knowing(self, belief: EkfBelief, known: Landmarks) -> EkfBelief:
        """Return a first belief that has landmarks in its map.

        Parameters
        ----------
        belief : EkfBelief
            Without landmarks.
        known : Landmarks
            One row each.

        Returns
        -------
        EkfBelief

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
        return with_points(belief, known, np.zeros((2 * known.landmark.size, 3)))

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

        with F and U the derivatives of the motion by the pose and by the control.

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
            After each step.

        Notes
        -----
        Bradley & Abaid, Eq. (10).
        """
        check_belief(belief, EkfBelief)
        controls, dt = usable_controls(self.motion, controls, dt)
        mean, covariance = belief.mean.copy(), belief.covariance.copy()
        poses = Gaussian(mean=np.empty((len(dt), 3)), covariance=np.empty((len(dt), 3, 3)))
        numbers = tuple(motion_numbers(self.motion))
        propagate(mean, covariance, controls, dt, numbers, poses.mean, poses.covariance)
        if roams(belief.landmark):
            roam(mean, covariance, belief.landmark, dt.sum(), self.walk_std)
        moved = EkfBelief(
            mean=mean,
            covariance=covariance,
            landmark=belief.landmark,
            weight=belief.weight,
            gated=belief.gated,
            innovations=belief.innovations,
        )
        return moved, poses

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
        sensing = sensing_of(self.rays, self.gate, robust=self.robust)
        corrected = EkfBelief(**taken_in(belief, scan, sensing, LINEAR))
        return with_velocities(corrected, scan.moving, self.speed_std)


def taken_in(belief: EkfBelief, scan: Scan, sensing: Sensing, turns: float) -> dict[str, Any]:
    """Return what a scan makes of the fields of an `EkfBelief`.

    Parameters
    ----------
    belief : EkfBelief
    scan : Scan
    sensing : Sensing
    turns : float
        Of which error the covariance is: `gaussian.LINEAR` or `gaussian.INVARIANT`.

    Returns
    -------
    dict of field to value
    """
    mean, covariance, landmark, weight, gated, squared, degrees = corrected(
        belief.mean,
        belief.covariance,
        belief.landmark,
        belief.weight,
        columns_of(scan),
        timings_of(scan),
        sensing,
        turns,
    )
    return {
        "mean": mean,
        "covariance": covariance,
        "landmark": landmark,
        "weight": weight,
        "gated": belief.gated + gated,
        "innovations": belief.innovations.plus(squared, degrees),
    }
