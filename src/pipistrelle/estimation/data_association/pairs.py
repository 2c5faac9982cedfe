r"""Match the measurements of a scan with landmarks: pair costs and two matching methods.

**Costs** (`pair_costs`). Own calls give bearing and range, another caller's bearing and, with the
caller on the map, excess path. A measurement and a landmark have the squared distance

.. math:: d^2 = \nu^T S^{-1} \nu, \qquad S = H P H^T + R

with the joint covariance P of pose, landmark and caller. The cost compares the landmark with
clutter of the density :math:`\lambda`, which is lower for precise bearings (`rows`):

.. math:: c = d^2 + \ln |2 \pi S| + 2 \ln (\lambda / p_D)

A range without a bearing has only its own terms, and clutter of any bearing. A cost below 0 is
likelier than clutter. After a long trajectory the relative position may be so
uncertain that a good fit is no evidence (`Chances.vague`): such a measurement begins a new
landmark, which may be merged later (`existence.doubles`).

**Nearest** (`nearest`): the assignment of least total cost, each landmark at most once.

**Marginal** (`marginal`): pairs of high marginal probability over all assignments, by messages
between measurements i and landmarks j until convergence. With :math:`w_{ij} = e^{-c_{ij} / 2}`

.. math:: \mu_{ij} = \frac{w_{ij}}{1 + \sum_{k \ne j} w_{ik} \nu_{ki}}, \qquad
          \nu_{ji} = \frac{1}{1 + \sum_{k \ne i} \mu_{kj}}

and the probability is :math:`w_{ij} \nu_{ji} / (1 + \sum_k w_{ik} \nu_{ki})`. Williams & Lau, IEEE
Transactions on Aerospace and Electronic Systems 50 (2014).
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from pipistrelle.estimation.beliefs import JointGaussian
from pipistrelle.estimation.observations.bearing import bearing_slopes, observe
from pipistrelle.estimation.observations.excess_path import excess_path_slopes
from pipistrelle.estimation.observations.range import Slopes, range_slopes
from pipistrelle.geometry import wrap_angle
from pipistrelle.jit import Whole, kernel, no_alloc

NOTHING = -1
"""Index of a measurement without landmark."""
Match = Callable[[Float[np.ndarray, "m n"]], Int[np.ndarray, " m"]]
"""Function from pair costs to the landmark of each measurement, or NOTHING."""
LIKELY, SURE = 0.9, 0.99
"""Least probability of any landmark, and least share of the best landmark in it."""
MESSAGES, STAY = 50, 1e-6
"""Most message passes, and change of messages at convergence."""
LARGEST = 30.0
"""Largest logarithm of a weight, so that sums keep their digits."""


def nearest(costs: Float[np.ndarray, "m n"]) -> Int[np.ndarray, " m"]:
    """Return each measurement's landmark by the assignment of least total cost, or NOTHING.

    >>> nearest(np.array([[-5.0, -4.0], [-4.5, np.inf], [3.0, np.inf]]))
    array([ 1,  0, -1])
    """
    from scipy.optimize import linear_sum_assignment  # deferred: costs a quarter of a second

    rows, landmarks = costs.shape
    bare = np.full((rows, rows), np.inf)
    np.fill_diagonal(bare, 0.0)
    taken, chosen = linear_sum_assignment(np.hstack([costs, bare]))
    found = np.full(rows, NOTHING)
    found[taken] = np.where(chosen < landmarks, chosen, NOTHING)
    return found


@kernel
def marginal(costs: Float[np.ndarray, "m n"]) -> Int[np.ndarray, " m"]:
    """Return each measurement's landmark if its marginal probability is high, else NOTHING.

    >>> marginal(np.array([[-9.0, -9.0], [np.inf, np.inf]]))
    array([-1, -1])
    >>> marginal(np.array([[-9.0, -9.0], [np.inf, -20.0]]))
    array([0, 1])
    """
    rows, landmarks, shares = _shares(costs)
    found, first = np.full(costs.shape[0], NOTHING), 0
    while first < rows.size:
        last, best, of_any = first, first, 0.0
        while last < rows.size and rows[last] == rows[first]:
            of_any += shares[last]
            if shares[last] > shares[best]:
                best = last
            last += 1
        if of_any > LIKELY and shares[best] >= SURE * of_any:
            found[rows[first]] = landmarks[best]
        first = last
    return found


@kernel
def _shares(
    costs: Float[np.ndarray, "m n"],
) -> tuple[Int[np.ndarray, " p"], Int[np.ndarray, " p"], Float[np.ndarray, " p"]]:
    """Return the measurement, landmark and marginal probability of each pair within the gate."""
    (m, n), (rows, landmarks) = costs.shape, np.nonzero(costs < np.inf)
    size, beyond = rows.size, np.full(n, m)
    weight, to_row, to_landmark = np.empty(size), np.ones(size), np.empty(size)
    for p in range(size):
        weight[p] = math.exp(min(-0.5 * costs[rows[p], landmarks[p]], LARGEST))
        beyond[landmarks[p]] -= 1
    sums, total, to_others = np.empty(m), np.empty(n), np.ones(n)
    for _ in range(MESSAGES):
        moved = 0.0
        _sum_up(sums, rows, weight, to_row)
        total[:] = 1.0
        for p in range(size):
            others = max(sums[rows[p]] - weight[p] * to_row[p], 1.0)
            to_landmark[p] = weight[p] / others
            total[landmarks[p]] += to_landmark[p]
        for p in range(size):
            message = 1.0 / max(total[landmarks[p]] - to_landmark[p], 1.0)
            moved = max(moved, abs(message - to_row[p]))
            to_row[p] = message
        for j in range(n):
            if beyond[j] > 0:  # measurements for which the landmark is beyond the gate
                moved = max(moved, abs(1.0 / total[j] - to_others[j]))
                to_others[j] = 1.0 / total[j]
        if moved < STAY:
            break
    _sum_up(sums, rows, weight, to_row)
    return rows, landmarks, weight * to_row / sums[rows]


@kernel
def _sum_up(
    sums: Float[np.ndarray, " m"],
    rows: Int[np.ndarray, " p"],
    weight: Float[np.ndarray, " p"],
    to_row: Float[np.ndarray, " p"],
) -> None:
    """Write, for each measurement, 1 plus the weighted sum of its messages from landmarks."""
    sums[:] = 1.0
    for p in range(rows.size):
        sums[rows[p]] += weight[p] * to_row[p]


class Rows(NamedTuple):
    """Bearings and ranges or excess paths of a caller's measurements, with stds and clutter."""

    bearing: Float[np.ndarray, " m"]
    bearing_std: Float[np.ndarray, " m"]
    way: Float[np.ndarray, " m"]
    """Range for the vehicle's own call, excess path for another's [m], or NaN."""
    way_std: Float[np.ndarray, " m"]
    clutter: Float[np.ndarray, " m"]
    """Clutter density relative to `Chances.clutter`."""


class Chances(NamedTuple):
    """Gate, clutter densities and detection probability of data association."""

    gate: float
    """Gate on the squared distance."""
    clutter: float
    """Density of clutter measurements [1/(rad m)]."""
    bearing_clutter: float
    """Density of clutter measurements without range or excess path [1/rad]."""
    detection: float
    """Detection probability of a landmark in range."""
    vague: float
    """Largest square root of the determinant of H P H^T, for bearing and range [rad m]."""


PlainChances = tuple[float, float, float, float, float]
"""`Chances` as a tuple for kernels."""
BARELY = 2.0
"""Least `vague` of a measurement, relative to the product of its bearing and range stds."""
OWN_CALL, UNPLACED = -1, -2
"""Substitutes for a caller's index in the joint mean: the vehicle, and an unmapped caller."""


@kernel
def pair_costs(
    rows: tuple[np.ndarray, ...],
    mean: Float[np.ndarray, " d"],
    covariance: Float[np.ndarray, "d d"],
    at: Int[np.ndarray, " n"],
    caller: Whole,
    chances: PlainChances,
) -> Float[np.ndarray, "m n"]:
    """Return the cost of matching each measurement with each landmark; infinite if gated."""
    heard, made = Rows(*rows), Chances(*chances)
    costs = np.full((heard.bearing.size, at.size), np.inf)
    H, index = np.zeros((2, 7)), np.zeros(7, np.int64)
    for n in range(at.size):
        if at[n] == caller:
            continue
        bearing, way = _expected(mean, at[n], caller, H, index)
        across, b, along = _spread(covariance, H, index, 5 if caller < 0 else 7)
        unsure = across * along - b * b if caller == OWN_CALL else 0.0
        for m in range(heard.bearing.size):
            nu = wrap_angle(heard.bearing[m] - bearing)
            a = across + heard.bearing_std[m] ** 2
            if nu * nu > made.gate * a:  # the bearing only, which is fast
                continue
            if unsure > max(made.vague, BARELY * heard.bearing_std[m] * heard.way_std[m]) ** 2:
                continue
            if math.isnan(heard.bearing[m]):
                c = along + heard.way_std[m] ** 2
                squared, size = (heard.way[m] - way) ** 2 / c, 2.0 * math.pi * c
                density = 2.0 * math.pi * made.clutter
            elif math.isnan(heard.way[m]) or caller == UNPLACED:
                squared, size = nu * nu / a, 2.0 * math.pi * a
                density = made.bearing_clutter
            else:
                off = heard.way[m] - way
                c = along + heard.way_std[m] ** 2
                det = a * c - b * b
                squared = (c * nu * nu - 2.0 * b * nu * off + a * off * off) / det
                size, density = (2.0 * math.pi) ** 2 * det, made.clutter * heard.clutter[m]
            if squared < made.gate and size > 0.0:  # determinant may be lost to rounding
                costs[m, n] = squared + math.log(size) + 2.0 * math.log(density / made.detection)
    return costs


@no_alloc
def _expected(
    mean: Float[np.ndarray, " d"],
    i: Whole,
    caller: Whole,
    H: Float[np.ndarray, "2 7"],
    index: Int[np.ndarray, "7"],
) -> tuple[float, float]:
    """Predict a landmark's bearing, and range or excess path; write Jacobian H and its indices."""
    x, y = mean[0], mean[1]
    distance, bearing, c, s, k = observe(x, y, mean[2], mean[i], mean[i + 1])
    for e, column in enumerate((0, 1, 2, i, i + 1, max(caller, 0), max(caller, 0) + 1)):
        index[e] = column
    _write(H[0], bearing_slopes(c, s, k))
    if caller < 0:
        _write(H[1], range_slopes(c, s))
        return bearing, distance
    bx, by = mean[caller], mean[caller + 1]
    path, lx, ly, H[1, 5], H[1, 6] = excess_path_slopes(x, y, mean[i], mean[i + 1], bx, by)
    _write(H[1], (-lx - H[1, 5], -ly - H[1, 6], 0.0))
    H[1, 3], H[1, 4] = lx, ly
    return bearing, path


@no_alloc
def _write(row: Float[np.ndarray, "7"], by_pose: Slopes) -> None:
    """Write derivatives by the pose, and by the landmark, which are minus the first two."""
    for e in range(3):
        row[e] = by_pose[e]
    row[3], row[4] = -by_pose[0], -by_pose[1]


@no_alloc
def _spread(
    P: Float[np.ndarray, "d d"],
    H: Float[np.ndarray, "2 7"],
    index: Int[np.ndarray, "7"],
    size: Whole,
) -> tuple[float, float, float]:
    """Return predicted variances of bearing and range, and their covariance, by Jacobian H."""
    across, both, along = 0.0, 0.0, 0.0
    for a in range(size):
        for b in range(size):
            covariance = P[index[a], index[b]]
            across += H[0, a] * covariance * H[0, b]
            both += H[0, a] * covariance * H[1, b]
            along += H[1, a] * covariance * H[1, b]
    return across, both, along


def with_points(
    joint: JointGaussian, labels: list[int], points: tuple[Float[np.ndarray, " n"], ...]
) -> JointGaussian:
    """Append landmarks, measured by bearing and range from the pose, to a joint Gaussian.

    ``points``: bearings [rad], ranges [m], and their standard deviations.

    >>> here = JointGaussian(
    ...     landmark=np.empty(0, int), mean=np.zeros(3), covariance=np.diag([0.0, 0.0, 0.01]))
    >>> there = with_points(here, [7], tuple(np.array([[0.0], [2.0], [0.1], [0.2]])))
    >>> there.mean[3:], there.covariance[3:, 3:].round(9)
    (array([2., 0.]), array([[0.04, 0.  ],
           [0.  , 0.08]]))
    """
    mean, covariance = _with_points(joint.mean, joint.covariance, points)
    landmark = np.append(joint.landmark, labels)
    return JointGaussian(landmark=landmark, mean=mean, covariance=covariance)


@kernel
def _with_points(
    mean: Float[np.ndarray, " d"],
    covariance: Float[np.ndarray, "d d"],
    points: tuple[Float[np.ndarray, " n"], ...],
) -> tuple[Float[np.ndarray, " e"], Float[np.ndarray, "e e"]]:
    """Append landmarks, measured by bearing and range, to the mean and covariance of a map."""
    bearing, distance, bearing_std, range_std = points
    size, whole = mean.size, mean.size + 2 * bearing.size
    more, P = np.empty(whole), np.empty((whole, whole))
    more[:size], P[:size, :size] = mean, covariance
    for n in range(bearing.size):
        d, far = size + 2 * n, distance[n]
        towards = math.cos(mean[2] + bearing[n]), math.sin(mean[2] + bearing[n])
        turn = -far * towards[1], far * towards[0]
        for a in range(2):
            more[d + a] = mean[a] + far * towards[a]
            for i in range(d):
                P[d + a, i] = P[i, d + a] = P[a, i] + turn[a] * P[2, i]
        for a in range(2):
            for b in range(2):
                across = (turn[a] * bearing_std[n]) * (turn[b] * bearing_std[n])
                along = (towards[a] * range_std[n]) * (towards[b] * range_std[n])
                P[d + a, d + b] = P[d + a, b] + P[d + a, 2] * turn[b] + (across + along)
    return more, P
