r"""EKF-SLAM with rays: one Gaussian over the pose and every landmark hypothesis.

The state is the pose and, two numbers each, the members of all landmarks (Eq. 8; the
correspondence is constant and known and stays out of it). A frame is corrected measurement by
measurement (Eq. 11), each at the current mean: first the landmarks already mapped, in the order
of the scan, then the new ones are placed from the corrected pose.

A correction subtracts :math:`W W^T` with :math:`W = \bar P H^T L^{-T}, L L^T = S`: the two
halves of the covariance get the same products in the same order, so it stays symmetric to the
last bit.
"""

import math
from dataclasses import dataclass
from functools import lru_cache
from statistics import NormalDist

import numpy as np
from jaxtyping import Float, Int
from numba import njit

from pipistrelle.config import RayConfig
from pipistrelle.detection.scans import Scan
from pipistrelle.estimation.models import (
    MOTION_MODELS,
    NEAREST,
    Gaussian,
    Landmarks,
    Motion,
    advance,
    sight,
)
from pipistrelle.estimation.rays import log_likelihood, ray_members, survivors, weigh_and_share
from pipistrelle.geometry import wrap_angle

GATED, APPLIED = 1, 0


@dataclass(frozen=True, slots=True, kw_only=True)
class EkfBelief:
    """A joint Gaussian over pose and members.

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
        motion = self.motion
        mean, covariance = belief.mean.copy(), belief.covariance.copy()
        poses = Gaussian(mean=np.empty((len(controls), 3)), covariance=np.empty((len(dt), 3, 3)))
        _predict(
            mean, covariance, controls, dt, MOTION_MODELS.index(motion.model), motion.wheelbase,
            motion.control_std[0] ** 2, motion.control_std[1] ** 2, motion.noise_at_rest,
            poses.mean, poses.covariance,
        )  # fmt: skip
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
        rays = self.rays
        ranges, range_stds = _ray_members(rays)
        gate_passive, gate_active = gate_bounds(self.gate)
        mean, covariance, landmark, weight, gated = _update(
            belief.mean, belief.covariance, belief.landmark, belief.weight,
            scan.landmark, scan.bearing, scan.range,
            self.range_std**2, self.bearing_std**2, gate_passive, gate_active,
            ranges, range_stds, rays.power, rays.weights == "aggregated", rays.prune,
            rays.partial == "reinitialise",
        )  # fmt: skip
        return EkfBelief(
            mean=mean,
            covariance=covariance,
            landmark=landmark,
            weight=weight,
            gated=belief.gated + gated,
        )


_ray_members = lru_cache(maxsize=16)(ray_members)


@lru_cache(maxsize=16)
def gate_bounds(gate: float) -> tuple[float, float]:
    """Chi-square quantiles of one and of two degrees of freedom; infinite for a gate of 1.

    Parameters
    ----------
    gate : (0, 1]

    Returns
    -------
    one, two : squared Mahalanobis distances

    Examples
    --------
    >>> [round(bound, 2) for bound in gate_bounds(0.999)]
    [10.83, 13.82]
    """
    if gate >= 1.0:
        return math.inf, math.inf
    return NormalDist().inv_cdf(0.5 * (1.0 + gate)) ** 2, -2.0 * math.log(1.0 - gate)


@njit(cache=True, error_model="numpy")
def _predict(
    mean, covariance, controls, dt, model, wheelbase, first_variance, second_variance,
    noise_at_rest, pose_means, pose_covariances,
):  # fmt: skip
    """Advance mean and covariance in place; cross-covariances once, by the product of the F."""
    P = covariance[:3, :3].copy()
    shift_x = shift_y = 0.0  # entries (0, 2) and (1, 2) of the product of the F
    for k in range(controls.shape[0]):
        speed, turn = controls[k, 0], controls[k, 1]
        dx, dy, dheading, u00, u10, u20, u01, u11, u21 = advance(
            model, wheelbase, mean[2], speed, turn, dt[k]
        )
        mean[0] += dx
        mean[1] += dy
        mean[2] = wrap_angle(mean[2] + dheading)
        shift_x -= dy
        shift_y += dx
        noisy = 1.0 if noise_at_rest or speed != 0.0 or turn != 0.0 else 0.0
        q0, q1 = noisy * first_variance, noisy * second_variance
        xx = P[0, 0] - 2.0 * dy * P[0, 2] + dy * dy * P[2, 2]
        xy = P[0, 1] + dx * P[0, 2] - dy * P[1, 2] - dx * dy * P[2, 2]
        yy = P[1, 1] + 2.0 * dx * P[1, 2] + dx * dx * P[2, 2]
        xh = P[0, 2] - dy * P[2, 2]
        yh = P[1, 2] + dx * P[2, 2]
        P[0, 0] = xx + q0 * u00 * u00 + q1 * u01 * u01
        P[0, 1] = P[1, 0] = xy + q0 * u00 * u10 + q1 * u01 * u11
        P[1, 1] = yy + q0 * u10 * u10 + q1 * u11 * u11
        P[0, 2] = P[2, 0] = xh + q0 * u00 * u20 + q1 * u01 * u21
        P[1, 2] = P[2, 1] = yh + q0 * u10 * u20 + q1 * u11 * u21
        P[2, 2] += q0 * u20 * u20 + q1 * u21 * u21
        pose_means[k] = mean[:3]
        pose_covariances[k] = P
    for j in range(3, mean.size):
        covariance[0, j] += shift_x * covariance[2, j]
        covariance[1, j] += shift_y * covariance[2, j]
        covariance[j, 0] = covariance[0, j]
        covariance[j, 1] = covariance[1, j]
    covariance[:3, :3] = P


@njit(cache=True, error_model="numpy")
def _subtract_outer(covariance, size, w, columns):
    """Covariance minus the outer product of the columns of w, in place."""
    if columns == 1:
        w0 = w[0]
        for a in range(size):
            row, wa = covariance[a], w0[a]
            for b in range(size):
                row[b] -= wa * w0[b]
    else:
        w0, w1 = w[0], w[1]
        for a in range(size):
            row, wa, va = covariance[a], w0[a], w1[a]
            for b in range(size):
                row[b] -= wa * w0[b] + va * w1[b]


@njit(cache=True, error_model="numpy")
def _bearing_variance(covariance, i, c, s, d):
    """Innovation variance H P H^T of the bearing of the member at state index i, without R."""
    h0, h1 = s / d, -c / d  # by pose: (h0, h1, -1); by member: (-h0, -h1)
    pxx = covariance[0, 0] - 2.0 * covariance[0, i] + covariance[i, i]
    pxy = covariance[0, 1] - covariance[0, i + 1] - covariance[1, i] + covariance[i, i + 1]
    pyy = covariance[1, 1] - 2.0 * covariance[1, i + 1] + covariance[i + 1, i + 1]
    pxh = covariance[0, 2] - covariance[2, i]
    pyh = covariance[1, 2] - covariance[2, i + 1]
    return (
        h0 * h0 * pxx + 2.0 * h0 * h1 * pxy + h1 * h1 * pyy
        - 2.0 * (h0 * pxh + h1 * pyh) + covariance[2, 2]
    )  # fmt: skip


@njit(cache=True, error_model="numpy")
def _correct_bearing(mean, covariance, size, i, bearing, variance, bound, w):
    """Correct the state with the bearing of the member at index i; GATED when beyond bound."""
    distance, expected, c, s, d = sight(mean[0], mean[1], mean[2], mean[i], mean[i + 1])
    if distance < NEAREST:
        return APPLIED
    innovation = wrap_angle(bearing - expected)
    h0, h1 = s / d, -c / d
    p0, p1, p2 = covariance[0], covariance[1], covariance[2]
    pi, pj = covariance[i], covariance[i + 1]
    w0 = w[0]
    for a in range(size):
        w0[a] = h0 * (p0[a] - pi[a]) + h1 * (p1[a] - pj[a]) - p2[a]
    S = h0 * (w0[0] - w0[i]) + h1 * (w0[1] - w0[i + 1]) - w0[2] + variance
    if innovation * innovation > bound * S:
        return GATED
    root = 1.0 / math.sqrt(S)
    for a in range(size):
        w0[a] *= root
        mean[a] += w0[a] * (root * innovation)
    _subtract_outer(covariance, size, w, 1)
    return APPLIED


@njit(cache=True, error_model="numpy")
def _correct_active(
    mean, covariance, size, i, distance, bearing, range_variance, bearing_variance, bound, w
):
    """Correct the state with range and bearing of the member at index i; GATED beyond bound."""
    near, expected, c, s, d = sight(mean[0], mean[1], mean[2], mean[i], mean[i + 1])
    if near < NEAREST:
        return APPLIED
    nu0, nu1 = distance - near, wrap_angle(bearing - expected)
    h0, h1 = s / d, -c / d
    p0, p1, p2 = covariance[0], covariance[1], covariance[2]
    pi, pj = covariance[i], covariance[i + 1]
    w0, w1 = w[0], w[1]
    for a in range(size):
        east, north = p0[a] - pi[a], p1[a] - pj[a]
        w0[a] = -c * east - s * north
        w1[a] = h0 * east + h1 * north - p2[a]
    S00 = -c * (w0[0] - w0[i]) - s * (w0[1] - w0[i + 1]) + range_variance
    S01 = h0 * (w0[0] - w0[i]) + h1 * (w0[1] - w0[i + 1]) - w0[2]
    S11 = h0 * (w1[0] - w1[i]) + h1 * (w1[1] - w1[i + 1]) - w1[2] + bearing_variance
    L00 = math.sqrt(S00)
    L10 = S01 / L00
    L11 = math.sqrt(S11 - L10 * L10)
    e0 = nu0 / L00
    e1 = (nu1 - L10 * e0) / L11
    if e0 * e0 + e1 * e1 > bound:
        return GATED
    for a in range(size):
        w0[a] /= L00
        w1[a] = (w1[a] - L10 * w0[a]) / L11
        mean[a] += w0[a] * e0 + w1[a] * e1
    _subtract_outer(covariance, size, w, 2)
    return APPLIED


@njit(cache=True, error_model="numpy")
def _place(mean, covariance, size, i, distance, bearing, range_variance, bearing_variance):
    """Put a member at state index i, at a range and bearing from the pose (Eq. 16).

    The first ``size`` rows but the member's own are the rest of the state, with which it is
    correlated through the pose.
    """
    direction = mean[2] + bearing
    c, s = math.cos(direction), math.sin(direction)
    gx, gy = -distance * s, distance * c
    mean[i], mean[i + 1] = mean[0] + distance * c, mean[1] + distance * s
    for a in range(size):
        if a != i and a != i + 1:
            east = covariance[0, a] + gx * covariance[2, a]
            north = covariance[1, a] + gy * covariance[2, a]
            covariance[i, a] = covariance[a, i] = east
            covariance[i + 1, a] = covariance[a, i + 1] = north
    across = bearing_variance * distance * distance
    P02, P12, P22 = covariance[0, 2], covariance[1, 2], covariance[2, 2]
    xx = covariance[0, 0] + 2.0 * gx * P02 + gx * gx * P22
    xy = covariance[0, 1] + gy * P02 + gx * P12 + gx * gy * P22
    yy = covariance[1, 1] + 2.0 * gy * P12 + gy * gy * P22
    covariance[i, i] = xx + range_variance * c * c + across * s * s
    covariance[i + 1, i + 1] = yy + range_variance * s * s + across * c * c
    cross = xy + (range_variance - across) * c * s
    covariance[i, i + 1] = covariance[i + 1, i] = cross


@njit(cache=True, error_model="numpy")
def _drop_members(mean, covariance, landmark, weight, members, first, count, keep):
    """Close the gaps that dropped members of one landmark leave; returns the members left."""
    target = first
    for source in range(first, members):
        if source < first + count and not keep[source - first]:
            continue
        if target != source:
            landmark[target], weight[target] = landmark[source], weight[source]
            i, j = 3 + 2 * target, 3 + 2 * source
            mean[i], mean[i + 1] = mean[j], mean[j + 1]
            covariance[i : i + 2, :] = covariance[j : j + 2, :]
            covariance[:, i : i + 2] = covariance[:, j : j + 2]
        target += 1
    return target


@njit(cache=True, error_model="numpy")
def _correct_ray(
    mean, covariance, weight, members, first, count, bearing, variance, bound, power, aggregated, w
):
    """Weigh a ray's members by a bearing and share it among them; GATED when none expected it."""
    size = 3 + 2 * members
    likelihoods, share = np.empty(count), np.empty(count)
    gated = GATED
    for j in range(count):
        i = 3 + 2 * (first + j)
        _, expected, c, s, d = sight(mean[0], mean[1], mean[2], mean[i], mean[i + 1])
        innovation = wrap_angle(bearing - expected)
        S = _bearing_variance(covariance, i, c, s, d) + variance
        likelihoods[j] = log_likelihood(innovation, S)
        if innovation * innovation <= bound * S:
            gated = APPLIED
    if gated == GATED:
        return GATED
    weigh_and_share(
        likelihoods, weight[first : first + count], count, power, aggregated, share
    )
    for j in range(count):
        if share[j] > 0.0:
            i = 3 + 2 * (first + j)
            _correct_bearing(
                mean, covariance, size, i, bearing, variance / share[j], np.inf, w
            )
    return APPLIED


@njit(cache=True, error_model="numpy")
def _range_for_ray(
    mean, covariance, landmark, weight, members, first, count, distance, bearing,
    range_variance, bearing_variance, reinitialise, w,
):  # fmt: skip
    """Give a partial landmark its range: one member is left. Returns the members left."""
    keep = np.zeros(count, dtype=np.bool_)
    heaviest = 0
    if not reinitialise:
        for j in range(1, count):
            if weight[first + j] > weight[first + heaviest]:
                heaviest = j
    keep[heaviest] = True
    members = _drop_members(mean, covariance, landmark, weight, members, first, count, keep)
    weight[first] = 1.0
    size, i = 3 + 2 * members, 3 + 2 * first
    if reinitialise:
        _place(mean, covariance, size, i, distance, bearing, range_variance, bearing_variance)
    else:
        _, _, c, s, _ = sight(mean[0], mean[1], mean[2], mean[i], mean[i + 1])
        mean[i], mean[i + 1] = mean[0] + distance * c, mean[1] + distance * s
        _correct_bearing(mean, covariance, size, i, bearing, bearing_variance, np.inf, w)
    return members


@njit(cache=True, error_model="numpy")
def _members_of(landmark, members, label):
    """Index of a landmark's first member and how many it has (0: not mapped)."""
    for first in range(members):
        if landmark[first] == label:
            last = first + 1
            while last < members and landmark[last] == label:
                last += 1
            return first, last - first
    return members, 0


@njit(cache=True, error_model="numpy")
def _update(
    old_mean, old_covariance, old_landmark, old_weight, labels, bearings, ranges,
    range_variance, bearing_variance, gate_passive, gate_active,
    ray_ranges, ray_stds, power, aggregated, prune, reinitialise,
):  # fmt: skip
    """Correct, prune and extend a copy of the belief; returns its arrays and the gated count."""
    members, room = old_landmark.size, 0
    known = np.empty(labels.size, dtype=np.bool_)
    for m in range(labels.size):
        known[m] = _members_of(old_landmark, members, labels[m])[1] > 0
        if not known[m]:
            room += ray_ranges.size if math.isnan(ranges[m]) else 1
    capacity = 3 + 2 * (members + room)
    mean, covariance = np.empty(capacity), np.empty((capacity, capacity))
    landmark, weight = np.empty(members + room, dtype=np.int64), np.empty(members + room)
    mean[: old_mean.size] = old_mean
    covariance[: old_mean.size, : old_mean.size] = old_covariance
    landmark[:members], weight[:members] = old_landmark, old_weight
    w, keep = np.empty((2, capacity)), np.empty(ray_ranges.size, dtype=np.bool_)
    gated = 0
    for m in range(labels.size):
        if not known[m]:
            continue
        first, count = _members_of(landmark, members, labels[m])
        size, i = 3 + 2 * members, 3 + 2 * first
        passive = math.isnan(ranges[m])
        if count == 1 and passive:
            gated += _correct_bearing(
                mean, covariance, size, i, bearings[m], bearing_variance, gate_passive, w
            )
        elif count == 1:
            gated += _correct_active(
                mean, covariance, size, i, ranges[m], bearings[m],
                range_variance, bearing_variance, gate_active, w,
            )  # fmt: skip
        elif passive:
            outcome = _correct_ray(
                mean, covariance, weight, members, first, count, bearings[m],
                bearing_variance, gate_passive, power, aggregated, w,
            )  # fmt: skip
            gated += outcome
            if outcome == APPLIED and survivors(weight[first:], count, prune, keep) < count:
                members = _drop_members(
                    mean, covariance, landmark, weight, members, first, count, keep
                )
        else:
            members = _range_for_ray(
                mean, covariance, landmark, weight, members, first, count, ranges[m], bearings[m],
                range_variance, bearing_variance, reinitialise, w,
            )  # fmt: skip
    for m in range(labels.size):
        if known[m]:
            continue
        passive = math.isnan(ranges[m])
        count = ray_ranges.size if passive else 1
        for j in range(count):
            distance = ray_ranges[j] if passive else ranges[m]
            spread = ray_stds[j] ** 2 if passive else range_variance
            i = 3 + 2 * members
            _place(mean, covariance, i, i, distance, bearings[m], spread, bearing_variance)
            landmark[members], weight[members] = labels[m], 1.0 / count
            members += 1
    mean[2] = wrap_angle(mean[2])
    size = 3 + 2 * members
    return (
        mean[:size].copy(), covariance[:size, :size].copy(),
        landmark[:members].copy(), weight[:members].copy(), gated,
    )  # fmt: skip
