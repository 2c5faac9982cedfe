r"""EKF-SLAM and right-invariant EKF-SLAM with rays, moving callers, and removal of landmarks.

The state contains the pose and, two numbers each, the hypotheses of all landmarks,

.. math:: \hat X = [\hat x_v, \hat y_v, \hat\theta_v, \hat x_1, \hat y_1, \dots,
          \hat x_h, \hat y_h]^T
   :label: eq-8

(Eq. (8); the correspondence is known, and no part of it). `correction` updates it with a scan. The
covariance is of the linear or the right-invariant error (`gaussian`).

**Merging landmarks** (`merged`) is a measurement of their difference :math:`d = l_k - l_g` as 0, up
to `MERGED_STD`. With :math:`H = (\dots, I, \dots, -I, \dots)` and S = H P H^T + R = L L^T,

.. math:: W = P H^T L^{-T}, \qquad \hat X \leftarrow \hat X - W L^{-1} d, \qquad
          P \leftarrow P - W W^T ,

and the second landmark is dropped. The invariant error has the same H, without a heading column. If
d exceeds the gate (`MERGE_BOUND`), a wrong association has displaced a landmark, and the second is
dropped without the update.

**Moving callers** (`propagate_callers`) have a velocity in the state, under a separate label
(`velocity_of`), common to all hypotheses of the caller. It is a random walk of spectral density
:math:`q = \sigma^2` along each axis; in a time T

.. math:: \begin{bmatrix} b \\ v \end{bmatrix} \leftarrow
          \begin{bmatrix} I & T I \\ 0 & I \end{bmatrix}
          \begin{bmatrix} b \\ v \end{bmatrix} + w, \qquad
          \operatorname{cov} w = q \begin{bmatrix} \tfrac13 T^3 I & \tfrac12 T^2 I \\
          \tfrac12 T^2 I & T I \end{bmatrix}

(Bar-Shalom, Li & Kirubarajan 2001, Sec. 6.2.2: white noise acceleration). The invariant error
transforms velocities like points: from :math:`v = R(\xi_\theta)\,\hat v + V(\xi_\theta)\,\xi_v` and
the like for b follows :math:`\xi_b \leftarrow \xi_b + T \xi_v` for any heading, and isotropic noise
is invariant to rotation, so that both filters share this step.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from pipistrelle.config import InputError, RayConfig
from pipistrelle.detection.scans import UNLABELLED, Scan
from pipistrelle.estimation.beliefs import Gaussian, JointGaussian, Landmarks
from pipistrelle.estimation.checking import (
    check_belief,
    check_gate,
    usable_controls,
    usable_known,
    usable_pose,
    usable_scan,
)
from pipistrelle.estimation.ekf.correction import corrected
from pipistrelle.estimation.ekf.delayed_initialization import WAITING_WEIGHT
from pipistrelle.estimation.ekf.gaussian import (
    INVARIANT,
    LINEAR,
    Covariance,
    Labels,
    Mean,
    linear_part,
    propagate,
    propagate_invariant,
    retract,
    rotated_left,
    shifted_covariance,
)
from pipistrelle.estimation.motion import Controls, Durations, Motion, Pose, motion_numbers
from pipistrelle.estimation.observations.rows import LOSSES, scan_columns, timings_of
from pipistrelle.estimation.rays import update_params
from pipistrelle.estimation.recovery import Recoverable, correction, recovering
from pipistrelle.jit import Whole, kernel

_SUM = UNLABELLED - 1
"""Sum of the labels of a caller and of its velocity."""


@kernel
def velocity_of(label: Whole) -> Whole:
    """Convert a caller's label to the label of its velocity in the state, and back.

    >>> velocity_of(51), velocity_of(velocity_of(51))
    (-53, 51)
    """
    return _SUM - label


def is_velocity(landmark: Labels) -> Bool[np.ndarray, " h"]:
    """Return a mask of the entries of a state that are callers' velocities."""
    return landmark < UNLABELLED


def is_standing(landmark: Labels) -> Bool[np.ndarray, " h"]:
    """Return a mask of a state's landmark entries, without moving callers and their velocities.

    >>> is_standing(np.array([4, 51, -53]))
    array([ True, False, False])
    """
    velocity = is_velocity(landmark)
    if not velocity.any():
        return ~velocity
    return ~velocity & ~np.isin(landmark, _SUM - landmark[velocity])


@kernel
def propagate_callers(
    mean: Mean,
    covariance: Float[np.ndarray, "d room"],
    landmark: Labels,
    dt: Durations,
    walk_std: float,
) -> None:
    """Predict moving callers through control steps, in place; their velocities are random walks."""
    q, size, seconds = walk_std * walk_std, mean.size, dt.sum()
    for velocity in range(landmark.size):
        if landmark[velocity] >= UNLABELLED:
            continue
        label, iv = velocity_of(landmark[velocity]), 3 + 2 * velocity
        members = np.flatnonzero(landmark == label)
        for member in members:
            i = 3 + 2 * member
            for axis in range(2):
                mean[i + axis] += seconds * mean[iv + axis]
                for b in range(size):
                    covariance[i + axis, b] += seconds * covariance[iv + axis, b]
        for member in members:
            i = 3 + 2 * member
            for axis in range(2):
                for b in range(size):
                    covariance[b, i + axis] += seconds * covariance[b, iv + axis]
        for axis in range(2):
            covariance[iv + axis, iv + axis] += q * seconds
            for member in members:
                i = 3 + 2 * member + axis
                covariance[i, iv + axis] += 0.5 * q * seconds**2
                covariance[iv + axis, i] = covariance[i, iv + axis]
                for other in members:
                    covariance[i, 3 + 2 * other + axis] += q * seconds**3 / 3.0


MERGED_STD = 1e-3
"""Standard deviation of the difference of merged landmarks along each axis [m]."""
MERGE_BOUND = 100.0
"""Largest squared distance of merged landmarks to update the state."""


@kernel
def is_placed(landmark: Labels, weight: Float[np.ndarray, " h"]) -> Bool[np.ndarray, " h"]:
    """Return a mask of the hypotheses that are the only hypothesis of their landmark or caller.

    >>> is_placed(np.array([4, 7, 7, 51, -53]), np.ones(5))
    array([ True, False, False,  True, False])
    """
    placed = (landmark >= 0) & (weight >= 0.0)
    for n in range(1, landmark.size):
        if landmark[n] == landmark[n - 1]:  # hypotheses of a landmark are contiguous
            placed[n - 1] = placed[n] = False
    return placed


def removed(belief: "EkfBelief", labels: Sequence[int]) -> "EkfBelief":
    """Return the belief without some landmarks, and moving callers with their velocities."""
    gone = np.array([_present(belief, label) for label in labels])[:, np.newaxis]
    landmark = belief.landmark
    kept = np.flatnonzero(((landmark != gone) & (landmark != _SUM - gone)).all(axis=0))
    mean, covariance = _left(belief.mean, belief.covariance, kept)
    landmark, weight = landmark[kept], belief.weight[kept]
    return replace(belief, mean=mean, covariance=covariance, landmark=landmark, weight=weight)


@kernel
def _left(
    mean: Mean, covariance: Covariance, kept: Int[np.ndarray, " k"]
) -> tuple[np.ndarray, np.ndarray]:
    """Return a state's mean and covariance with only the given entries of its map."""
    left, P = np.empty(3 + 2 * kept.size), np.empty((3 + 2 * kept.size, 3 + 2 * kept.size))
    at = np.arange(left.size)
    for n in range(kept.size):
        at[3 + 2 * n], at[4 + 2 * n] = 3 + 2 * kept[n], 4 + 2 * kept[n]
    for i in range(at.size):
        left[i] = mean[at[i]]
        for j in range(at.size):
            P[i, j] = covariance[at[i], at[j]]
    return left, P


def merged(belief: "EkfBelief", kept: int, gone: int) -> "EkfBelief":
    """Return the belief with two fixed landmarks merged under the label of the first.

    An initialised landmark replaces a ray; of two rays the first remains. The label may be new.
    """
    landmark = belief.landmark
    if kept not in landmark:
        former = landmark == _present(belief, gone)
        return replace(belief, landmark=np.where(former, kept, landmark))
    standing = is_standing(landmark)
    first, second = (landmark == _present(belief, label) for label in (kept, gone))
    if kept == gone or not standing[first | second].all():
        raise InputError(
            f"association: found the landmarks {kept} and {gone} to merge; expected two that stand"
        )
    placed = is_placed(landmark, belief.weight)
    if placed[first].all() and placed[second].all():
        k, g = 3 + 2 * int(first.argmax()), 3 + 2 * int(second.argmax())
        mean, covariance = _equated(belief.mean, belief.covariance, k, g, belief.error)
        belief = replace(belief, mean=mean, covariance=covariance)
    elif placed[second].all():
        belief = removed(belief, [kept])
        return replace(belief, landmark=np.where(belief.landmark == gone, kept, belief.landmark))
    return removed(belief, [gone])


@kernel
def _equated(
    mean: Mean, P: Covariance, k: Whole, g: Whole, error: float
) -> tuple[Mean, Covariance]:
    """Condition mean and covariance on the points at k and g coinciding; return both."""
    w0, w1 = P[:, k] - P[:, g], P[:, k + 1] - P[:, g + 1]
    a = math.sqrt(w0[k] - w0[g] + MERGED_STD * MERGED_STD)
    b = (w0[k + 1] - w0[g + 1]) / a
    c = math.sqrt(w1[k + 1] - w1[g + 1] + MERGED_STD * MERGED_STD - b * b)
    e0 = -(mean[k] - mean[g]) / a
    e1 = (-(mean[k + 1] - mean[g + 1]) - b * e0) / c
    if e0 * e0 + e1 * e1 > MERGE_BOUND:
        return mean.copy(), P.copy()
    moved, left = mean.copy(), np.empty_like(P)
    w0 = w0 / a
    w1 = (w1 - b * w0) / c
    if error == LINEAR:
        moved += e0 * w0 + e1 * w1
    else:
        retract(moved, mean.size, w0, e0, w1, e1)
    for i in range(mean.size):
        for j in range(mean.size):
            left[i, j] = P[i, j] - w0[i] * w0[j] - w1[i] * w1[j]
    return moved, left


def _present(belief: "EkfBelief", label: int) -> int:
    """Return a landmark's label if it is on the map, and raise InputError otherwise."""
    if label < 0 or label not in belief.landmark:
        raise InputError(f"association: found landmark {label} to change, which is not on the map")
    return label


@dataclass(frozen=True, slots=True, kw_only=True)
class EkfBelief(Recoverable):
    r"""Joint Gaussian of pose x and landmark hypotheses m (Bradley & Abaid, Eqs. (8) and (9)).

    .. math:: P = \begin{bmatrix} P_{xx} & P_{xm} \\ P_{mx} & P_{mm} \end{bmatrix}
       :label: eq-9
    """

    mean: Mean
    """(3 + 2h): x, y [m] from the origin, heading [rad]; then x, y [m] of each hypothesis."""
    covariance: Covariance
    """Covariance of the error that `error` selects, in the same order."""
    landmark: Labels
    """Label of each hypothesis; a ray's are contiguous, near to far. A moving caller also has an
    entry for its velocity [m/s], with another label (`velocity_of`)."""
    weight: Float[np.ndarray, " h"]
    """Aggregated likelihood of each hypothesis within its landmark; `WAITING_WEIGHT` for stored
    bearings, and less the range [m] for stored ranges, which are not on the map."""
    error: float = LINEAR
    """Error definition: `gaussian.LINEAR` or `gaussian.INVARIANT`."""
    origin: Float[np.ndarray, "2"] = field(default_factory=lambda: np.zeros(2))
    """Start position [m] for the invariant error; (0, 0) for the linear error."""

    def pose(self) -> Gaussian:
        """Return the vehicle's pose: mean [m, m, rad] and 3 x 3 covariance of the linear error."""
        mean, covariance = self.mean[:3].copy(), self.covariance[:3, :3].copy()
        if self.error == LINEAR:
            return Gaussian(mean=mean, covariance=covariance)
        linear = np.empty((3, 3))
        shifted_covariance(covariance, mean[0], mean[1], linear)
        mean[:2] += self.origin
        return Gaussian(mean=mean, covariance=linear, invariant=True)

    def landmarks(self) -> Landmarks:
        """Return the map of landmarks that do not move, a row per hypothesis."""
        return self.rows(is_standing(self.landmark) & (self.weight >= WAITING_WEIGHT))

    def moving(self) -> Landmarks:
        """Return the estimates of moving callers, a row per hypothesis."""
        return self.rows(~is_standing(self.landmark) & ~is_velocity(self.landmark))

    def rows(self, kept: Bool[np.ndarray, " h"]) -> Landmarks:
        """Return selected landmark hypotheses as a map, with covariances of x and y."""
        mean, covariance = self._linear(kept, with_pose=False)
        return _map_of(self.landmark[kept], self.weight[kept], mean.reshape(-1, 2), covariance)

    def joint(self, among: Int[np.ndarray, " n"] | None = None) -> JointGaussian:
        """Return the joint Gaussian of pose, initialised landmarks and moving callers."""
        placed = is_placed(self.landmark, self.weight)
        if among is not None:
            placed &= (self.landmark[:, np.newaxis] == among).any(axis=1)  # faster than np.isin
        mean, covariance = self._linear(placed, with_pose=True)
        return JointGaussian(landmark=self.landmark[placed], mean=mean, covariance=covariance)

    def _linear(
        self, kept: Bool[np.ndarray, " h"], *, with_pose: bool
    ) -> tuple[Durations, Float[np.ndarray, "k k"]]:
        """Return selected hypotheses' mean and covariance of x and y, perhaps with the pose."""
        invariant = self.error == INVARIANT
        return linear_part(self.mean, self.covariance, self.origin, kept, with_pose, invariant)

    def labels(self) -> list[int]:
        """Return the labels of all landmarks and callers, initialised or not."""
        return sorted({*self.landmark[~is_velocity(self.landmark)].tolist()})

    def edited(self, remove: Sequence[int], merge: Sequence[tuple[int, int]]) -> "EkfBelief":
        """Return the belief with some landmarks removed and some pairs of landmarks merged."""
        belief = self
        for kept, gone in merge:
            belief = merged(belief, kept, gone)
        return removed(belief, remove) if remove else belief

    def freed(self, pose: Pose, stds: Pose) -> "EkfBelief":
        """Return the belief with the vehicle moved to a pose, and its covariance enlarged."""
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
    landmark: Labels,
    weights: Float[np.ndarray, " h"],
    mean: Float[np.ndarray, "h 2"],
    covariance: Covariance,
) -> Landmarks:
    """Convert hypotheses and their joint covariance to a map, a row per hypothesis.

    A stored bearing becomes two hypotheses of equal weight, at half and twice the distance of its
    second point, with standard deviations of half their range.
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
    """Append points to the belief, with errors partly shared with its state (``by_state``)."""
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
    """Add a velocity of 0 with a std [m/s] to the state for each moving caller that has none."""
    if moving.size == 0:
        return belief
    velocity = _SUM - moving
    known = belief.landmark
    labels = velocity[np.isin(moving, known) & ~np.isin(velocity, known)]
    if (size := labels.size) == 0:
        return belief
    unknown = Landmarks(
        landmark=labels,
        mean=np.zeros((size, 2)),
        covariance=np.tile(std * std * np.eye(2), (size, 1, 1)),
        weight=np.ones(size),
    )
    return _with_points(belief, unknown, np.zeros((2 * size, belief.mean.size)))


@dataclass(frozen=True, slots=True, kw_only=True)
class EkfSlam:
    """EKF-SLAM (Bradley & Abaid, Sec. III-A) with bearing-only landmarks (Sec. III-C).

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
    """Gate: measurements outside this share of their predicted distribution (chi-square) are
    discarded; 1 keeps all."""
    robust: str = "none"
    """Loss of measurements of large innovation: none, huber or cauchy (`gaussian.inflated`)."""
    speed_std: float = 1.0
    """Initial standard deviation of a moving caller's velocity along each axis [m/s]."""
    walk_std: float = 0.2
    """Standard deviation of the random walk of that velocity after 1 s [m/s]."""
    error: float = LINEAR
    """Error of the initial belief: `gaussian.LINEAR` or `gaussian.INVARIANT`."""

    def __post_init__(self) -> None:
        """Raise InputError for an unknown loss, or a gate that is no probability in (0, 1]."""
        check_gate(self.gate, self.robust)

    def init(self, pose: Gaussian) -> EkfBelief:
        """Return the initial belief at a start pose with its covariance, without landmarks."""
        pose = usable_pose(pose)
        origin = np.zeros(2) if self.error == LINEAR else pose.mean[:2]
        return EkfBelief(
            mean=np.append(pose.mean[:2] - origin, pose.mean[2]),
            covariance=pose.covariance,
            landmark=np.empty(0, dtype=np.int64),
            weight=np.empty(0),
            error=self.error,
            origin=origin,
        )

    def knowing(self, belief: EkfBelief, known: Landmarks) -> EkfBelief:
        r"""Return the initial belief with known landmarks added to its map.

        Their positions are independent of the vehicle's heading: their invariant error is
        :math:`\xi_l = e_l - J\hat l\,\xi_\theta`, with independent errors e.

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
        controls: Controls,
        dt: Durations,
        rng: np.random.Generator | None = None,
    ) -> tuple[EkfBelief, Gaussian]:
        r"""Predict the belief through the control steps of a frame (Bradley & Abaid, Eq. (10)).

        .. math:: \bar P_{xx} = F P_{xx} F^T + U Q U^T, \qquad
                  \bar P_{xm} = \bar P_{mx}^T = F P_{xm}
           :label: eq-10

        with F and U the derivatives of the motion by the pose and by the control. ``controls`` (k,
        c) are of the motion model, ``dt`` (k) [s]; ``rng`` is unused. Returns the belief, and the
        pose after each step, (k, 3) and (k, 3, 3), with the covariance of the linear error.
        """
        check_belief(belief, EkfBelief)
        controls, dt = usable_controls(self.motion, controls, dt)
        mean, covariance = belief.mean.copy(), belief.covariance.copy()
        means, covariances = np.empty((len(dt), 3)), np.empty((len(dt), 3, 3))
        step = propagate if belief.error == LINEAR else propagate_invariant
        numbers = tuple(motion_numbers(self.motion))
        step(mean, covariance, controls, dt, numbers, means, covariances)
        propagate_callers(mean, covariance, belief.landmark, dt, self.walk_std)
        invariant = belief.error == INVARIANT
        if invariant:
            means[:, :2] += belief.origin
        poses = Gaussian(mean=means, covariance=covariances, invariant=invariant)
        return replace(belief, mean=mean, covariance=covariance), poses

    def update(
        self, belief: EkfBelief, scan: Scan, rng: np.random.Generator | None = None
    ) -> EkfBelief:
        r"""Update the belief with a frame's measurements (Bradley & Abaid, Eqs. (11), (16)-(21)).

        .. math:: K_i = \bar P H_i^T (H_i \bar P H_i^T + R)^{-1}, \qquad
                  \hat X = \bar X + K_i (z_i - \bar z_i), \qquad
                  \hat P = (I - K_i H_i) \bar P
           :label: eq-11

        A new landmark is initialised at its measured range d and bearing :math:`\phi`,

        .. math:: \hat x_i = \hat x_v + d_i \cos(\phi_i + \hat\theta_v), \qquad
                  \hat y_i = \hat y_v + d_i \sin(\phi_i + \hat\theta_v)
           :label: eq-16

        or, without a range, as a ray. ``rng`` is unused, as this filter is deterministic.
        """
        check_belief(belief, EkfBelief)
        scan = usable_scan(scan)
        if scan.landmark.size == 0:
            return belief
        return recovering(self._corrected, belief, scan, self.gate, self.rays.range_bounds[1])

    def _corrected(self, belief: EkfBelief, scan: Scan) -> EkfBelief:
        """Update the belief by a scan's measurements that pass the gate, and return it."""
        mean, covariance, landmark, weight, gated, squared, degrees = corrected(
            belief.mean,
            belief.covariance,
            belief.landmark,
            belief.weight,
            scan_columns(scan),
            timings_of(scan),
            update_params(self.rays, self.gate, loss=LOSSES.index(self.robust)),
            belief.error,
        )
        further = correction(belief.mean, belief.covariance, mean, covariance, belief.error)
        after = replace(
            belief,
            mean=mean,
            covariance=covariance,
            landmark=landmark,
            weight=weight,
            gated=belief.gated + gated,
            innovations=belief.innovations.plus(squared, degrees),
            corrections=belief.corrections.plus(*further),
        )
        return _with_velocities(after, scan.moving, self.speed_std)


@dataclass(frozen=True, slots=True, kw_only=True)
class InvariantEkfSlam(EkfSlam):
    """EKF-SLAM with the right-invariant error; fields and methods as in `EkfSlam`.

    A stationary vehicle with an uncertain heading does not gain heading information.

    >>> import numpy as np
    >>> from pipistrelle.config import RayConfig
    >>> from pipistrelle.detection.scans import make_scan
    >>> from pipistrelle.estimation.beliefs import Gaussian
    >>> from pipistrelle.estimation.motion import Motion
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

    error: float = INVARIANT
