r"""Match the measurements of a scan with landmarks: pair costs and three matching methods.

**Costs** (`pair_costs`). Own calls give bearing and range, another caller's bearing and, with the
caller on the map, excess path. A measurement and a landmark have the squared distance

.. math:: d^2 = \nu^T S^{-1} \nu, \qquad S = H P H^T + R

with the joint covariance P of pose, landmark and caller. The cost compares the landmark with
clutter of the density :math:`\lambda`, which is lower for precise bearings (`rows`):

.. math:: c = d^2 + \ln |2 \pi S| + 2 \ln (\lambda / p_D)

A cost below 0 is likelier than clutter. After a long trajectory the relative position may be so
uncertain that a good fit is no evidence (`Chances.vague`): such a measurement begins a new
landmark, which may be merged later (`existence.doubles`).

**Nearest** (`nearest`): the assignment of least total cost, each landmark at most once.

**Joint compatibility** (`jointly_compatible`): the largest set of pairs of negative cost that is
consistent as a whole, as all share the error of the pose. With the joint innovation :math:`\nu` and
its covariance S = L L^T

.. math:: d^2 = |y|^2, \qquad L y = \nu,

and the set is compatible while :math:`d^2` is within the quantile of :math:`\chi^2`. Each further
pair appends two rows to L and two numbers to y. The branch-and-bound search tries the likeliest
landmark of each measurement first and clutter last, and ends after `MOST_NODES` with the best set
so far. Neira & Tardos, IEEE Transactions on Robotics and Automation 17 (2001).

**Marginal** (`marginal`): pairs of high marginal probability over all assignments, by messages
between measurements i and landmarks j until convergence. With :math:`w_{ij} = e^{-c_{ij} / 2}`

.. math:: \mu_{ij} = \frac{w_{ij}}{1 + \sum_{k \ne j} w_{ik} \nu_{ki}}, \qquad
          \nu_{ji} = \frac{1}{1 + \sum_{k \ne i} \mu_{kj}}

and the probability is :math:`w_{ij} \nu_{ji} / (1 + \sum_k w_{ik} \nu_{ki})`. Williams & Lau, IEEE
Transactions on Aerospace and Electronic Systems 50 (2014).
"""

import math
from collections.abc import Callable
from functools import cache
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from pipistrelle.estimation.beliefs import JointGaussian
from pipistrelle.estimation.measurement import excess_path_slopes, observe
from pipistrelle.geometry import wrap_angle
from pipistrelle.jit import Whole, kernel, no_alloc

NOTHING = -1
"""Index of a measurement without landmark."""
Innovations = tuple[Float[np.ndarray, " e"], Float[np.ndarray, "e e"], Int[np.ndarray, " p"]]
"""Innovation of pairs (two numbers each), its covariance, and numbers measured for each pair."""
Innovate = Callable[[tuple[Int[np.ndarray, " p"], Int[np.ndarray, " p"]]], Innovations]
"""Function from pairs to their joint innovation (`pair_innovations`)."""
Match = Callable[[Float[np.ndarray, "m n"], Innovate | None], Int[np.ndarray, " m"]]
"""Function from pair costs to the landmark of each measurement, or NOTHING."""
LIKELY, SURE = 0.9, 0.99
"""Least probability of any landmark, and least share of the best landmark in it."""
MESSAGES, STAY = 50, 1e-6
"""Most message passes, and change of messages at convergence."""
LARGEST = 30.0
"""Largest logarithm of a weight, so that sums keep their digits."""
FARTHEST = 1e6
"""Finite substitute for an infinite cost."""


def nearest(
    costs: Float[np.ndarray, "m n"], innovate: Innovate | None = None
) -> Int[np.ndarray, " m"]:
    """Return each measurement's landmark by the assignment of least total cost, or NOTHING.

    >>> nearest(np.array([[-5.0, -4.0], [-4.5, np.inf], [3.0, np.inf]]))
    array([ 1,  0, -1])
    """
    from scipy.optimize import linear_sum_assignment  # deferred: costs a quarter of a second

    rows, landmarks = costs.shape
    bare = np.full((rows, rows), FARTHEST)
    np.fill_diagonal(bare, 0.0)
    taken, chosen = linear_sum_assignment(np.hstack([np.minimum(costs, FARTHEST), bare]))
    found = np.full(rows, NOTHING)
    found[taken] = np.where(chosen < landmarks, chosen, NOTHING)
    return found


def marginal(
    costs: Float[np.ndarray, "m n"], innovate: Innovate | None = None
) -> Int[np.ndarray, " m"]:
    """Return each measurement's landmark if its marginal probability is high, else NOTHING.

    >>> marginal(np.array([[-9.0, -9.0], [np.inf, np.inf]]))
    array([-1, -1])
    >>> marginal(np.array([[-9.0, -9.0], [np.inf, -20.0]]))
    array([0, 1])
    """
    return _what_is_sure(costs)


@kernel
def _what_is_sure(costs: Float[np.ndarray, "m n"]) -> Int[np.ndarray, " m"]:
    """Return each measurement's landmark if its marginal probability is high, else NOTHING."""
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


CONFIDENCE = 0.999
"""Share of correct sets within the gate."""
MOST_NODES, MOST_ROWS = 3000, 100
"""Most pairs tried, and most measurements tested jointly, as the work grows with their cube."""


@cache
def gates(numbers: int) -> Float[np.ndarray, " g"]:
    """Return the gates on a squared Mahalanobis distance for 0, 1, ... degrees of freedom.

    >>> gates(2).round(2)
    array([ 0.  , 10.83, 13.82])
    """
    from scipy.special import gammaincinv

    return 2.0 * gammaincinv(np.maximum(np.arange(numbers + 1), 1e-9) / 2.0, CONFIDENCE)


def jointly_compatible(
    costs: Float[np.ndarray, "m n"], innovate: Innovate | None
) -> Int[np.ndarray, " m"]:
    """Return each measurement's landmark by the largest jointly compatible set, or NOTHING."""
    found = np.full(len(costs), NOTHING)
    row, landmark = np.nonzero(costs < 0.0)
    if not row.size or innovate is None:
        return found
    order = np.lexsort((costs[row, landmark], row))
    row, landmark = row[order], landmark[order]
    rows, begins, counts = np.unique(row, return_index=True, return_counts=True)
    likely = np.arange(row.size) - np.repeat(begins, counts) < MOST_NODES // min(
        rows.size, MOST_ROWS
    )
    row, landmark = row[likely], landmark[likely]
    for first in range(0, rows.size, MOST_ROWS):
        part = (row >= rows[first]) & (row <= rows[first : first + MOST_ROWS][-1])
        part &= ~np.isin(landmark, found)  # taken by earlier measurements
        _match_together(found, row[part], landmark[part], innovate)
    return found


def _match_together(
    found: Int[np.ndarray, " m"],
    row: Int[np.ndarray, " p"],
    landmark: Int[np.ndarray, " p"],
    innovate: Innovate,
) -> None:
    """Write the landmarks of a batch of measurements by the largest jointly compatible set."""
    options = np.append(np.flatnonzero(np.diff(row, prepend=-1)), row.size)
    pairs = _search(options, landmark, innovate((row, landmark)), gates(2 * (options.size - 1)))
    found[row[pairs]] = landmark[pairs]


@kernel
def _search(
    options: Int[np.ndarray, " o"],
    landmark: Int[np.ndarray, " p"],
    innovations: Innovations,
    gate: Float[np.ndarray, " g"],
) -> Int[np.ndarray, " c"]:
    """Return the largest jointly compatible set of pairs, by branch and bound."""
    levels, numbers = options.size - 1, innovations[2]
    L, y = np.zeros((2 * levels, 2 * levels)), np.zeros(2 * levels)
    chosen, best = np.empty(levels, np.int64), np.empty(levels, np.int64)
    count, used, squared = (
        np.zeros(levels + 1, np.int64), np.zeros(levels + 1, np.int64), np.zeros(levels + 1)
    )  # fmt: skip
    following, level, most, least, nodes = options.copy(), 0, 0, math.inf, 0
    while level >= 0:
        k, option = count[level], following[level]
        if level == levels or option > options[level + 1] or nodes >= MOST_NODES:
            if level == levels and (k > most or (k == most and squared[level] < least)):
                most, least = k, squared[level]
                best[:k] = chosen[:k]
            level -= 1
            continue
        following[level] += 1
        here = level + 1
        count[here], used[here], squared[here] = k, used[level], squared[level]
        if option < options[here]:
            nodes += 1
            if _is_taken(landmark, chosen, k, option):
                continue
            chosen[k] = option
            squared[here] += _extended(L, y, chosen, k, innovations)
            count[here], used[here] = k + 1, used[level] + numbers[option]
            if squared[here] > gate[used[here]]:
                continue
        hoped = count[here] + levels - here
        if hoped > most or (hoped == most and squared[here] < least):
            level = here
            following[level] = options[level]
    return best[:most].copy()


@no_alloc
def _is_taken(
    landmark: Int[np.ndarray, " p"], chosen: Int[np.ndarray, " c"], k: Whole, option: Whole
) -> bool:
    """Return whether a pair's landmark is already matched in the first k chosen pairs."""
    taken = False
    for n in range(k):
        taken |= landmark[chosen[n]] == landmark[option]
    return taken


@no_alloc
def _extended(
    L: Float[np.ndarray, "d d"],
    y: Float[np.ndarray, " d"],
    chosen: Int[np.ndarray, " c"],
    k: Whole,
    innovations: Innovations,
) -> float:
    """Extend innovations' Cholesky factor by a pair; return its part of the squared distance."""
    nu, S, _ = innovations
    for a in (2 * k, 2 * k + 1):
        whole = 2 * chosen[k] + a - 2 * k
        rest = nu[whole]
        for b in range(a + 1):
            value = S[whole, 2 * chosen[b // 2] + b % 2]
            for c in range(b):
                value -= L[a, c] * L[b, c]
            L[a, b] = math.sqrt(max(value, 1e-300)) if b == a else value / L[b, b]
            if b < a:
                rest -= L[a, b] * y[b]
        y[a] = rest / L[a, a]
    return y[2 * k] ** 2 + y[2 * k + 1] ** 2


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
            if unsure > max(made.vague, BARELY * heard.bearing_std[m] * heard.way_std[m]) ** 2:
                continue
            nu = wrap_angle(heard.bearing[m] - bearing)
            a = across + heard.bearing_std[m] ** 2
            if math.isnan(heard.way[m]) or caller == UNPLACED:
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


@kernel
def pair_innovations(
    rows: tuple[np.ndarray, ...],
    mean: Float[np.ndarray, " d"],
    covariance: Float[np.ndarray, "d d"],
    at: Int[np.ndarray, " n"],
    caller: Whole,
    pairs: tuple[Int[np.ndarray, " p"], Int[np.ndarray, " p"]],
) -> tuple[Float[np.ndarray, " e"], Float[np.ndarray, "e e"], Int[np.ndarray, " p"]]:
    """Return innovations of measurement-landmark pairs, and the joint covariance of all.

    Each pair has two numbers, and a count of measured numbers; missing numbers are 0 of variance 1.
    """
    heard, (row, landmark) = Rows(*rows), pairs
    nu, S, numbers = np.zeros(2 * row.size), np.zeros((2 * row.size, 2 * row.size)), row.copy()
    H, index = np.zeros((row.size, 2, 7)), np.zeros((row.size, 7), np.int64)
    for p in range(row.size):
        m, k = row[p], 2 * p
        bearing, way = _expected(mean, at[landmark[p]], caller, H[p], index[p])
        nu[k], S[k, k] = wrap_angle(heard.bearing[m] - bearing), heard.bearing_std[m] ** 2
        if math.isnan(heard.way[m]) or caller == UNPLACED:
            H[p, 1], S[k + 1, k + 1], numbers[p] = 0.0, 1.0, 1
        else:
            nu[k + 1], S[k + 1, k + 1] = heard.way[m] - way, heard.way_std[m] ** 2
            numbers[p] = 2
        for q in range(p + 1):
            for a in range(2):
                for b in range(2):
                    both = 0.0
                    for i in range(7):
                        for j in range(7):
                            spread = covariance[index[p, i], index[q, j]]
                            both += H[p, a, i] * spread * H[q, b, j]
                    S[k + a, 2 * q + b] += both
                    if q < p:
                        S[2 * q + b, k + a] += both
    return nu, S, numbers


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
    for e, slope in enumerate((s * k, -c * k, -1.0, -s * k, c * k, 0.0, 0.0)):
        H[0, e] = slope
    if caller < 0:
        for e, slope in enumerate((-c, -s, 0.0, c, s, 0.0, 0.0)):
            H[1, e] = slope
        return bearing, distance
    bx, by = mean[caller], mean[caller + 1]
    path, lx, ly, cx, cy = excess_path_slopes(x, y, mean[i], mean[i + 1], bx, by)
    for e, slope in enumerate((-lx - cx, -ly - cy, 0.0, lx, ly, cx, cy)):
        H[1, e] = slope
    return bearing, path


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
