r"""Landmarks that are on the map twice: a few wrong rows make one, a closed loop a whole group.

Two landmarks a and b are one at a cost

.. math:: c = d^2 + \ln |2 \pi S| + 2 \ln \lambda, \qquad d^2 = (l_a - l_b)^T S^{-1} (l_a - l_b)

with the covariance S of their difference, of the whole map's, and the density :math:`\lambda` of
landmarks. Of a group each pair is judged given those before it: where the pose is lost to a metre
the first pair of a closed loop tells little, those after it, which the same drift has moved, tell
all. So from each pair a group is grown by what costs least, and the group that costs least is
believed, if it is ahead of all that contradict it. Landmarks of which one caller was heard in one
scan are two (`existence.Known.together`).

Neira & Tardos, IEEE Transactions on Robotics and Automation 17 (2001), test rows jointly in this
way.
"""

import math

import numpy as np
from jaxtyping import Bool, Float, Int

from pipistrelle.estimation.beliefs import JointGaussian
from pipistrelle.estimation.data_association.existence import Known
from pipistrelle.jit import Whole, kernel, no_alloc

DENSEST = 0.05
"""Landmarks per square metre, at most: of a few the map's extent tells nothing."""
GAIN = 1.0
"""How much less at least each further pair makes its group cost."""
SURE = (8.0, 15.0, 6.0)
"""A pair by itself, a group of two and a larger one are believed if they cost less than minus
this."""
AHEAD = 5.0
"""By how much a group must cost less than what makes its first landmark one with another."""
GATE = 13.8
"""Largest squared distance of a pair: 1 in 1000 is beyond."""
LEAST_STD = 0.15
"""Least deviation of a difference along each axis [m]: how far filters are off that are sure."""

ASKED = (4, 6, 8, 12, 16, 24, 32, 64)
"""In how many scans a landmark was heard when it is asked whether it is on the map twice."""
BOTH = 0.1
"""Two landmarks are two if in more than this share of the scans of either both were heard."""

Pairs = list[tuple[int, int]]


@kernel
def asked_of(
    columns: tuple[np.ndarray, ...], at: Int[np.ndarray, " l"], now: Whole
) -> tuple[Int[np.ndarray, " o"], Bool[np.ndarray, "o o"], Int[np.ndarray, " a"]]:
    """Return known landmarks that stand on the map, which of them are two, and who is asked now.

    ``columns``: of `existence.Known`; ``at``: where each stands in the joint mean, or -1; ``now``:
    number of the scan. Who is asked is told as numbers of those that stand.
    """
    known = Known(*columns)
    old = np.flatnonzero((at >= 0) & (known.born < now))
    asked, apart = np.zeros(old.size, np.bool_), np.ones((old.size, old.size), np.bool_)
    for i in range(old.size):
        a = old[i]
        asked[i] = known.heard[a] == now and known.count[a] in ASKED
        for j in range(i):
            b = old[j]
            rarer = min(known.count[a], known.count[b])
            apart[i, j] = apart[j, i] = known.together[a, b] > BOTH * rarer
    return old, apart, np.flatnonzero(asked)


def doubles(
    joint: JointGaussian,
    at: Int[np.ndarray, " l"],
    apart: Bool[np.ndarray, "l l"],
    asked: Int[np.ndarray, " a"],
) -> Pairs:
    """Return pairs of landmarks that are one, as numbers of `at`, the lower first.

    Parameters
    ----------
    joint : JointGaussian
    at : (l)
        Where the landmarks stand in the joint mean.
    apart : (l, l)
        Which pairs are surely two.
    asked : (a)
        Numbers of landmarks of which a pair must hold one, for a group to be grown from it.
    """
    best: tuple[float, list[list[int]]] = 0.0, []
    prior = 2.0 * math.log(_density(joint, at))
    for number in asked.tolist():
        groups = _groups(joint, at, apart, number, prior)
        if not groups:
            continue
        cost, group = min(groups)
        others = [other for other, pairs in groups if group[0] not in pairs]
        limit = min(best[0], -SURE[min(len(group), 3) - 1], min(others, default=0.0) - AHEAD)
        if cost < limit:
            best = cost, group
    return _lower_first(best[1])


def _density(joint: JointGaussian, at: Int[np.ndarray, " l"]) -> float:
    """Return landmarks per square metre of the map."""
    area = float(np.ptp(joint.mean[at]) * np.ptp(joint.mean[at + 1]))
    return at.size / max(area, at.size / DENSEST)


def _groups(
    joint: JointGaussian,
    at: Int[np.ndarray, " l"],
    apart: Bool[np.ndarray, "l l"],
    number: int,
    prior: float,
) -> list[tuple[float, list[list[int]]]]:
    """Return the cost and the pairs of each group that grows from a pair of one landmark."""
    mean, covariance, pairs = joint.mean, joint.covariance, np.empty((at.size, 2), np.int64)
    groups = []
    for first in begun(mean, covariance, at, apart, number).tolist():
        cost, size = grown(mean, covariance, at, apart, tuple(first), prior, pairs)
        groups.append((cost, pairs[:size].tolist()))
    return groups


@kernel
def begun(
    mean: Float[np.ndarray, " d"],
    covariance: Float[np.ndarray, "d d"],
    at: Int[np.ndarray, " l"],
    apart: Bool[np.ndarray, "l l"],
    number: Whole,
) -> Int[np.ndarray, "p 2"]:
    """Return the pairs of one landmark that a group may grow from, the higher number first."""
    pairs, size = np.empty((at.size, 2), np.int64), 0
    for other in range(at.size):
        a, b = max(number, other), min(number, other)
        if not (apart[a, b] or math.isinf(_cost(mean, covariance, at[a], at[b], 0.0))):
            pairs[size, 0], pairs[size, 1], size = a, b, size + 1
    return pairs[:size]


def _lower_first(pairs: list[list[int]]) -> Pairs:
    """Return pairs with the lower number first, each after what the pairs before have made one.

    >>> _lower_first([[7, 3], [7, 5]])
    [(3, 7), (3, 5)]
    """
    stands_for: dict[int, int] = {}
    ordered = []
    for pair in pairs:
        a, b = sorted(stands_for.get(number, number) for number in pair)
        stands_for |= {b: a} | {number: a for number, other in stands_for.items() if other == b}
        ordered.append((a, b))
    return ordered


@kernel
def grown(
    mean: Float[np.ndarray, " d"],
    covariance: Float[np.ndarray, "d d"],
    at: Int[np.ndarray, " l"],
    apart: Bool[np.ndarray, "l l"],
    pair: tuple[Whole, Whole],
    prior: float,
    pairs: Int[np.ndarray, "l 2"],
) -> tuple[float, Whole]:
    """Write the group that grows from a pair; return what it costs and how many pairs it has.

    ``prior``: what the density adds to the cost of each pair.
    """
    a, b = pair
    cost = _cost(mean, covariance, at[a], at[b], prior)
    mean, P, apart = mean.copy(), covariance.copy(), apart.copy()
    total, size = 0.0, 0
    while True:
        total += cost
        pairs[size, 0], pairs[size, 1] = a, b
        size += 1
        _equate(mean, P, at[a], at[b])
        _take_over(apart, a, b)
        cost = -GAIN
        for i in range(at.size):
            for j in range(i):
                other = math.inf if apart[i, j] else _cost(mean, P, at[i], at[j], prior)
                if other < cost:
                    cost, a, b = other, i, j
        if cost == -GAIN:
            return total, size


@no_alloc
def _cost(
    mean: Float[np.ndarray, " d"], P: Float[np.ndarray, "d d"], a: Whole, b: Whole, prior: float
) -> float:
    """Return what it costs that the landmarks at two indices are one; infinite beyond the gate."""
    dx, dy, least = mean[a] - mean[b], mean[a + 1] - mean[b + 1], LEAST_STD * LEAST_STD
    xx = P[a, a] + P[b, b] - 2.0 * P[a, b] + least
    yy = P[a + 1, a + 1] + P[b + 1, b + 1] - 2.0 * P[a + 1, b + 1] + least
    if dx * dx > GATE * xx or dy * dy > GATE * yy:
        return math.inf
    xy = P[a, a + 1] + P[b, b + 1] - P[a, b + 1] - P[b, a + 1]
    det = xx * yy - xy * xy
    squared = (yy * dx * dx - 2.0 * xy * dx * dy + xx * dy * dy) / det
    if squared > GATE:
        return math.inf
    return squared + math.log((2.0 * math.pi) ** 2 * det) + prior


@kernel
def _equate(mean: Float[np.ndarray, " d"], P: Float[np.ndarray, "d d"], i: Whole, j: Whole) -> None:
    """Correct mean and covariance by the measurement that the points at two indices are one."""
    u, v = P[:, i] - P[:, j], P[:, i + 1] - P[:, j + 1]
    xx, xy = u[i] - u[j] + LEAST_STD * LEAST_STD, u[i + 1] - u[j + 1]
    yy = v[i + 1] - v[j + 1] + LEAST_STD * LEAST_STD
    det, dx, dy = xx * yy - xy * xy, mean[i] - mean[j], mean[i + 1] - mean[j + 1]
    for k in range(mean.size):
        by_x, by_y = (yy * u[k] - xy * v[k]) / det, (xx * v[k] - xy * u[k]) / det
        mean[k] -= by_x * dx + by_y * dy
        for m in range(mean.size):
            P[k, m] -= by_x * u[m] + by_y * v[m]


@no_alloc
def _take_over(apart: Bool[np.ndarray, "l l"], a: Whole, b: Whole) -> None:
    """Set apart from the first of a pair what was apart from either, and all from the second."""
    for k in range(apart.shape[0]):
        apart[a, k] = apart[k, a] = apart[a, k] or apart[b, k]
    for k in range(apart.shape[0]):
        apart[b, k] = apart[k, b] = True
