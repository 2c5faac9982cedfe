r"""Recovery from odometry failures, such as an unreported skid, slip or push.

The gate tests measurements individually against the predicted pose. After a skid it would reject
all, and the vehicle would stay lost, so the odometry is also tested. Each measurement is normal or
an outlier, and the negative log likelihood of a pose x is, up to constants, the truncated sum of
squares

.. math:: c(x) = \sum_i \min(d_i^2(x), b_i)

with :math:`d_i^2` the squared residual over its variance S (of the measurement and, given the pose,
of the map). Outliers have a uniform density u (any bearing, any range up to the sensor's reach), so
:math:`b_i = -2 \ln u - \ln |2 \pi S|`.

Without odometry, the pose has a wide prior of information :math:`\Lambda_0`, and the cost of the
scan is by Laplace's approximation

.. math:: c_1 = \min_x c(x) + \ln \frac{|\Lambda|}{|\Lambda_0|}

with :math:`\Lambda` the information of the inliers, so that few measurements, which some pose
always fits, are no evidence. The gain :math:`c(\hat x) - c_1` over the filter's pose
:math:`\hat x` is summed over scans (Page's cumulative sum), and the odometry since the last scan is
discarded if the sum exceeds the bound for three degrees of freedom. The minimum is found by
graduated non-convexity.

Page, Biometrika 41 (1954); Yang, Antonante, Tzoumas & Carlone, IEEE Robotics and Automation Letters
5 (2020).
"""

import math
from abc import abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from typing import Any, Self, TypeVar

import numpy as np
from jaxtyping import Bool, Float, Int

from pipistrelle.detection.scans import (
    BEARING,
    BEARING_STD,
    EXCESS_PATH,
    EXCESS_PATH_STD,
    RANGE,
    RANGE_STD,
    UNLABELLED,
    Scan,
    rows_of,
    with_columns,
)
from pipistrelle.estimation.beliefs import Belief, JointGaussian
from pipistrelle.estimation.motion import Pose, PoseCovariance
from pipistrelle.estimation.observations.bearing import bearing_slopes, observe
from pipistrelle.estimation.observations.excess_path import excess_path_slopes
from pipistrelle.estimation.observations.range import range_slopes
from pipistrelle.geometry import wrap_angle
from pipistrelle.jit import Whole, kernel, no_alloc

FASTER = 1.4
"""Factor of the convexity parameter per pass (Yang et al.)."""
UNTOLD = 1e-6
"""Least cost of an outlier, so that very uncertain measurements have no effect."""
SINGULAR = 1e-12
"""Least variance of a predicted pose [m^2, rad^2]."""


@dataclass(frozen=True, kw_only=True)
class Recoverable(Belief):
    """A belief that allows recovery after an odometry failure, such as a skid."""

    doubt: float = 0.0
    """Cumulative gain of discarding the odometry in the last scans."""

    @abstractmethod
    def joint(self, among: Int[np.ndarray, " n"] | None = None) -> JointGaussian:
        """Return the joint Gaussian of pose and landmarks, optionally only of given labels."""

    @abstractmethod
    def freed(self, pose: Pose, stds: Pose) -> Self:
        """Return the belief with the vehicle moved to a pose, and an independent error added."""


B = TypeVar("B", bound=Recoverable)
Vector, Matrix = Float[np.ndarray, " d"], Float[np.ndarray, "d d"]
Fit = tuple[Pose, float, Bool[np.ndarray, "2 m"]]
"""A pose, its cost, and inlier masks of bearings with ranges and of excess paths."""


@cache
def odometry_bound(gate: float) -> float:
    """Return the gain above which odometry counts as failed: a chi-square quantile.

    >>> round(odometry_bound(0.999), 2)
    16.27
    """
    from scipy.special import gammaincinv

    return float(2.0 * gammaincinv(1.5, gate))


@kernel
def correction(
    mean: Vector, P: Matrix, after: Vector, P_after: Matrix, turns: float
) -> tuple[float, float]:
    r"""Return the squared normalised correction of a pose by a scan, and its degrees of freedom.

    .. math:: (x^+ - x)^T (P - P^+)^{-1} (x^+ - x)

    over directions whose variance the scan reduces by a hundredth; chi-square if consistent.
    ``turns``: 1, or 0 for covariances of the invariant error. Landmarks are ignored.
    """
    e, D = after[:3] - mean[:3], P[:3, :3] - P_after[:3, :3]
    e[2] = wrap_angle(e[2])
    e[0] += (1.0 - turns) * mean[1] * e[2]
    e[1] -= (1.0 - turns) * mean[0] * e[2]
    squared = degrees = 0.0
    for i in range(3):
        if D[i, i] > 0.01 * P[i, i]:
            squared += e[i] * e[i] / D[i, i]
            degrees += 1.0
            share = D[:, i] / D[i, i]
            e -= share * e[i]
            D -= np.outer(share, D[i])
    return squared, degrees


def recovering(
    correct: Callable[[B, Scan], B], belief: B, scan: Scan, gate: float, reach: float
) -> B:
    """Update a belief by a scan; discard the odometry before it if the scan refutes it."""
    after: Any = correct(belief, scan)
    if gate >= 1.0 or (after.gated == belief.gated and after.doubt == 0.0):
        return after
    found = recovered(belief, after, scan, gate, reach)
    if isinstance(found, float):
        return after if found == after.doubt else replace(after, doubt=found)
    free: Any = correct(*found)
    return replace(free, doubt=0.0)


def recovered(before: B, after: B, scan: Scan, gate: float, reach: float) -> tuple[B, Scan] | float:
    """Test whether odometry failed; return a belief without it and the inliers, or the gain.

    ``before`` and ``after`` the update by the scan; ``gate``: accepted share of a predicted
    distribution; ``reach``: std [m] of the position without odometry (heading: half a turn).
    Returns the belief before the scan without the odometry, and the inlier measurements; or the
    cumulative gain, if the odometry is kept.
    """
    if after.gated == before.gated:
        return 0.0
    callers = scan.callers[scan.caller[scan.caller < scan.callers.size]]
    joint = before.joint(np.append(scan.landmark, callers))
    problem = _problem(joint, scan)
    stds = np.array([reach, reach, math.pi])
    kept = _cost(problem, after.pose().mean, reach)[0]
    pose, cost, fits = _fitted(problem, joint.mean[:3], stds)
    doubt = max(0.0, before.doubt + kept - cost)  # 0 if a cost is NaN
    if doubt <= odometry_bound(gate):
        return doubt
    timed = np.where(fits[1], scan.excess_path, np.nan)
    freed: Any = before.freed(pose, stds)
    free = replace(freed, gated=before.gated + int((~fits).sum()))
    return free, rows_of(with_columns(scan, excess_path=timed), fits[0])


Problem = tuple[Float[np.ndarray, "8 m"], Int[np.ndarray, "2 m"], np.ndarray, np.ndarray]
"""Numbers of a scan, indices of landmarks and callers in the joint mean (-1: absent), this mean,
and its covariance given the pose."""


def _problem(joint: JointGaussian, scan: Scan) -> Problem:
    """Return a scan's numbers and the map, with its covariance given the pose, as arrays."""
    at = {label: 3 + 2 * n for n, label in enumerate(joint.landmark.tolist())}
    calls = [scan.callers[n] if n < scan.callers.size else UNLABELLED for n in scan.caller]
    landmarks = [at.get(label, -1) for label in scan.landmark.tolist()]
    ends = np.array([landmarks, [at.get(int(label), -1) for label in calls]], np.int64)
    numbers = np.ascontiguousarray(scan.numbers)
    return numbers, ends, joint.mean, _given_pose(joint.covariance)


@kernel
def _given_pose(P: Float[np.ndarray, "d d"]) -> Float[np.ndarray, "d d"]:
    """Return the covariance of landmarks given the vehicle's pose, from the joint covariance."""
    left = P.copy()
    for e in range(3):
        pivot, row = max(left[e, e], SINGULAR), left[e].copy()
        for i in range(P.shape[0]):
            for j in range(P.shape[0]):
                left[i, j] -= row[i] * row[j] / pivot
    return left


@kernel
def _fitted(problem: Problem, predicted: Pose, stds: Pose) -> Fit:
    """Return the pose that best fits a scan with outliers, by graduated non-convexity."""
    pose, (_, ratios) = predicted.copy(), _cost(problem, predicted, stds[0])
    largest = max(ratios.max(), 1.0)
    convexity = 1.0 / (2.0 * largest - 1.0)
    weights, sharp = np.ones(ratios.shape), False
    while not sharp and convexity <= largest:
        _step(problem, pose, weights, predicted, stds)
        _, ratios = _cost(problem, pose, stds[0])
        sharp = True
        for p in range(2):
            for m in range(ratios.shape[1]):
                ratio = ratios[p, m]
                if ratio * (convexity + 1.0) <= convexity:
                    weights[p, m] = 1.0
                elif ratio * convexity >= convexity + 1.0:
                    weights[p, m] = 0.0
                else:
                    root = math.sqrt(convexity * (convexity + 1.0) / ratio)
                    weights[p, m], sharp = root - convexity, False
        convexity *= FASTER
    _step(problem, pose, weights, predicted, stds)
    information = _step(problem, pose, weights, predicted, stds)
    cost, ratios = _cost(problem, pose, stds[0])
    for std in stds:
        information += 2.0 * math.log(std)
    return pose, cost + information, ratios <= 1.0


@kernel
def _cost(problem: Problem, pose: Pose, reach: float) -> tuple[float, Float[np.ndarray, "2 m"]]:
    """Return a pose's truncated cost, and each squared residual relative to its outlier bound.

    The first row is for bearings with ranges, the second for excess paths; 0 if not measured.
    """
    ratios, cost = np.zeros(problem[1].shape), 0.0
    A, g = np.zeros((3, 3)), np.zeros(3)
    for m in range(ratios.shape[1]):
        squared, det, size = _direction(problem, pose, m, 0.0, A, g)
        late, variance = _lateness(problem, pose, m, 0.0, A, g)
        spread = 1.0 if math.isnan(problem[0][BEARING, m]) else 2.0 * math.pi
        spread *= 1.0 if math.isnan(problem[0][RANGE, m]) else reach
        most = _outlier(spread, det, size)
        latest = _outlier(2.0 * reach, variance, 1)
        ratios[0, m], ratios[1, m] = squared / most, late / latest
        cost += min(squared, most) + min(late, latest)
    return cost, ratios


@no_alloc
def _outlier(spread: float, det: float, size: Whole) -> float:
    """Return the cost of an outlier, uniform over a spread, relative to a normal measurement."""
    return max(2.0 * math.log(spread) - math.log((2.0 * math.pi) ** size * det), UNTOLD)


@kernel
def _step(
    problem: Problem, pose: Pose, weights: Float[np.ndarray, "2 m"], predicted: Pose, stds: Pose
) -> float:
    """Move a pose by a Gauss-Newton step with weighted measurements; return log det information."""
    information, A, g = 0.0, np.zeros((3, 3)), np.zeros(3)
    for a in range(3):
        off = predicted[a] - pose[a]
        A[a, a] = 1.0 / stds[a] ** 2
        g[a] = A[a, a] * (wrap_angle(off) if a == 2 else off)
    for m in range(weights.shape[1]):
        _direction(problem, pose, m, weights[0, m], A, g)
        _lateness(problem, pose, m, weights[1, m], A, g)
    for e in range(3):
        for i in range(e + 1, 3):
            share = A[i, e] / A[e, e]
            g[i] -= share * g[e]
            for j in range(e, 3):
                A[i, j] -= share * A[e, j]
    for e in range(2, -1, -1):
        for j in range(e + 1, 3):
            g[e] -= A[e, j] * g[j]
        g[e] /= A[e, e]
        pose[e] += g[e]
        information += math.log(A[e, e])
    pose[2] = wrap_angle(pose[2])
    return information


@no_alloc
def _direction(
    problem: Problem, pose: Pose, m: Whole, weight: float, A: PoseCovariance, g: Pose
) -> tuple[float, float, Whole]:
    """Return the squared residual of a bearing and range, its determinant and dimension.

    Adds them, weighted, to the normal equations. Without either or mapped landmark, the residual is
    0.
    """
    numbers, ends, mean, C = problem
    i = ends[0, m]
    no_bearing, no_range = math.isnan(numbers[BEARING, m]), math.isnan(numbers[RANGE, m])
    if i < 0 or (no_bearing and no_range):
        return 0.0, 1.0, 1
    distance, bearing, c, s, k = observe(pose[0], pose[1], pose[2], mean[i], mean[i + 1])
    xx, xy, yy = C[i, i], C[i, i + 1], C[i + 1, i + 1]
    nu, off = wrap_angle(numbers[BEARING, m] - bearing), numbers[RANGE, m] - distance
    bb = (s * s * xx - 2.0 * s * c * xy + c * c * yy) * k * k + numbers[BEARING_STD, m] ** 2
    rr = c * c * xx + 2.0 * c * s * xy + s * s * yy + numbers[RANGE_STD, m] ** 2
    h0, h1, _ = bearing_slopes(c, s, k)
    if no_range:
        _add(A, g, (h0, h1, -1.0), weight / bb, nu)
        return nu * nu / bb, bb, 1
    if no_bearing:
        _add(A, g, range_slopes(c, s), weight / rr, off)
        return off * off / rr, rr, 1
    br = (-s * c * xx + (c * c - s * s) * xy + c * s * yy) * k
    # The range, then the bearing given the range: two independent numbers.
    share = br / rr
    rest, left = nu - share * off, bb - share * br
    _add(A, g, range_slopes(c, s), weight / rr, off)
    _add(A, g, (h0 + share * c, h1 + share * s, -1.0), weight / left, rest)
    return off * off / rr + rest * rest / left, rr * left, 2


@no_alloc
def _lateness(
    problem: Problem, pose: Pose, m: Whole, weight: float, A: PoseCovariance, g: Pose
) -> tuple[float, float]:
    """Return an excess path's squared residual and variance; add it to the normal equations."""
    numbers, ends, mean, C = problem
    i, j = ends[0, m], ends[1, m]
    if i < 0 or j < 0 or i == j or math.isnan(numbers[EXCESS_PATH, m]):
        return 0.0, 1.0
    path, lx, ly, cx, cy = excess_path_slopes(
        pose[0], pose[1], mean[i], mean[i + 1], mean[j], mean[j + 1]
    )
    slopes, at = (lx, ly, cx, cy), (i, i + 1, j, j + 1)
    variance = numbers[EXCESS_PATH_STD, m] ** 2
    for a in range(4):
        for b in range(4):
            variance += slopes[a] * C[at[a], at[b]] * slopes[b]
    nu = numbers[EXCESS_PATH, m] - path
    _add(A, g, (-lx - cx, -ly - cy, 0.0), weight / variance, nu)
    return nu * nu / variance, variance


@no_alloc
def _add(
    A: PoseCovariance, g: Pose, slopes: tuple[float, float, float], weight: float, residual: float
) -> None:
    """Add a weighted residual with its derivatives by the pose to the normal equations A, g."""
    for a in range(3):
        g[a] += weight * slopes[a] * residual
        for b in range(3):
            A[a, b] += weight * slopes[a] * slopes[b]
