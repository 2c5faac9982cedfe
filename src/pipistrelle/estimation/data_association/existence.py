r"""Log odds of existence of landmarks, and the detection of duplicates.

**Existence** (`judged`). The log odds rise with each detection, more for a precise bearing, as the
interference of overlapping echoes recurs, but rarely with precise bearings. They fall when an
expected landmark is not detected: its former level, corrected for spherical spreading, is well
above the threshold, and the vehicle's call is aimed as before. They fall less if a loud measurement
of the same delay, or the match of another landmark, may hide it; yet a landmark hidden for forty
scans is removed. For sensors without levels (lidar, camera), a landmark is expected within range
and field of view, if known, unless a nearer measurement occludes it.

**Duplicates** (`doubles`). Wrong labels cause single duplicates, a loop closure a whole group.
Merging landmarks a and b costs

.. math:: c = d^2 + \ln |2 \pi S| + 2 \ln \lambda, \qquad d^2 = (l_a - l_b)^T S^{-1} (l_a - l_b)

with the covariance S of their difference in the joint map, and the density :math:`\lambda` of
landmarks. Each further pair of a group is tested given the pairs before, which the same drift has
moved. Groups grow greedily, and the group of least cost is accepted if clearly better than all
contradicting groups. Landmarks detected in a scan of the same caller are distinct
(`Known.together`). Source: Neira & Tardos, IEEE Transactions on Robotics and Automation 17 (2001).
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from pipistrelle.detection.scans import OWN
from pipistrelle.estimation.beliefs import JointGaussian, is_among
from pipistrelle.estimation.measurement import excess_path_slopes
from pipistrelle.estimation.session import REMEMBERED
from pipistrelle.geometry import wrap_angle
from pipistrelle.jit import Whole, kernel, no_alloc

HEARD, MISSED = 2.0, 1.3
"""Change of the log odds by a detection and by a miss, for detection probability 0.75 and clutter
probability 0.1."""
MOST, CONFIRMED, GONE = 8.0, 3.0, -2.0
"""Log odds: upper limit, confirmation, removal."""
PATIENCE = 25
"""Scans without detection that remove an unconfirmed landmark."""
LEVEL_STD = 5.0
"""Standard deviation of levels [dB]."""
LASTING = 12
"""Detections from which a landmark that the vehicle's own call detected is unconfirmed, but not
removed. If detected only by other callers, its position depends on theirs and may be wrong."""
FAINTEST = 18.0
"""Least expected level of a landmark that should be detected [dB]."""
HIDDEN = 0.2
"""Share of the fall if the landmark may be hidden."""
AS_LOUD = 3.0
"""A measurement hides landmarks at most this much louder [dB]."""
TOGETHER = 1.0
"""A measurement hides landmarks whose path length differs by less: the length of a call [m]."""
AIMED = 0.1
"""The vehicle's call has its former level up to this change of bearing [rad]."""
WITHIN, BEFORE = 0.9, 0.05
"""Without levels, a landmark is expected within this share of the range, this far inside the field
of view, and with no nearer measurement within this bearing [rad]."""
NEAR = 0.3
"""Least distance for spherical spreading [m]."""
FORGETTING = 0.2
"""Weight of the newest level in the mean."""
WINDOW = REMEMBERED
"""Scans of which `Known.past` is kept."""
OFTEN = 255
"""Largest count of joint detections."""


class Known(NamedTuple):
    """Records of all tracked landmarks: detections, log odds of existence, and echo levels."""

    label: Int[np.ndarray, " l"]
    born: Int[np.ndarray, " l"]
    """Scan of the first detection; ``heard``: of the last."""
    heard: Int[np.ndarray, " l"]
    count: Int[np.ndarray, " l"]
    """Number of scans with a detection."""
    odds: Float[np.ndarray, " l"]
    confirmed: Bool[np.ndarray, " l"]
    source: Float[np.ndarray, "l c"]
    """Level at 1 m from the landmark (and from a moving caller), by caller [dB], or NaN."""
    aim: Float[np.ndarray, " l"]
    """Bearing of the landmark at its last echo of the vehicle's own call [rad]."""
    past: Float[np.ndarray, "l c w"]
    """Log probability of a miss in each of the last `WINDOW` scans, by caller; 1 if detected."""
    together: UInt8[np.ndarray, "l l"]
    """Number of scans in which both landmarks were detected by the same caller."""


def nobody(callers: int) -> Known:
    """Return empty records of tracked landmarks, for a number of callers."""
    whole, number = np.empty(0, np.int64), np.empty(0)
    none, together = np.empty((0, callers)), np.empty((0, 0), np.uint8)
    yes, past = np.empty(0, np.bool_), np.empty((0, callers, WINDOW))
    return Known(whole, whole, whole, whole, number, yes, none, number, past, together)


def with_new(known: Known, labels: list[int], scan: int, callers: int) -> Known:
    """Return the records with new landmarks added, first detected in this scan."""
    callers = max(callers, known.source.shape[1])
    if not labels and callers == known.source.shape[1]:
        return known
    return Known(*_with_new(tuple(known), np.array(labels, np.int64), scan, callers))


@kernel
def _with_new(
    columns: tuple[np.ndarray, ...], labels: Int[np.ndarray, " n"], scan: Whole, callers: Whole
) -> tuple[np.ndarray, ...]:
    """Return the records' arrays with entries for new landmarks appended."""
    known, none = Known(*columns), np.zeros(labels.size, np.int64)
    old, size = known.label.size, known.label.size + labels.size
    source, past = np.full((size, callers), np.nan), np.zeros((size, callers, WINDOW))
    source[:old, : known.source.shape[1]] = known.source
    past[:old, : known.source.shape[1]] = known.past
    together = np.zeros((size, size), np.uint8)
    together[:old, :old] = known.together
    return (
        np.append(known.label, labels),
        np.append(known.born, none + scan),
        np.append(known.heard, none + scan),
        np.append(known.count, none),
        np.append(known.odds, np.full(labels.size, -HEARD)),
        np.append(known.confirmed, np.zeros(labels.size, np.bool_)),
        source,
        np.append(known.aim, np.full(labels.size, np.nan)),
        past,
        together,
    )


def some(known: Known, kept: Bool[np.ndarray, " l"]) -> Known:
    """Return the records of the landmarks that a mask selects."""
    left = Known(*(column[kept] for column in known))
    return left._replace(together=left.together[:, kept])


def merged(known: Known, pairs: Sequence[tuple[int, int]]) -> Known:
    """Return the records with duplicates merged: of each pair, the first label remains."""
    if not pairs:
        return known
    after = Known(*(column.copy() for column in known))
    place = {label: n for n, label in enumerate(known.label.tolist())}
    for kept, gone in pairs:
        a, b = place[kept], place[gone]
        after.count[a] += after.count[b]
        for column in (after.odds, after.heard, after.confirmed):
            column[a] = max(column[a], column[b])
        both = np.maximum(after.together[a], after.together[b])
        after.together[a], after.together[:, a] = both, both
    return some(after, ~is_among(after.label, np.array([gone for _, gone in pairs])))


RowColumns = tuple[
    Int[np.ndarray, " m"],
    Int[np.ndarray, " m"],
    Float[np.ndarray, " m"],
    Float[np.ndarray, " m"],
    Float[np.ndarray, " m"],
    Float[np.ndarray, " m"],
]
"""Columns of a scan: label, caller, range or excess path, level, bearing and surety (0 to 1)."""
Sight = tuple[float, float]
"""Range [m] and field of view [rad] of a sensor without levels; range 0 if unknown."""
Place = tuple[
    Float[np.ndarray, " d"], Int[np.ndarray, " l"], Int[np.ndarray, " c"], Bool[np.ndarray, " c"]
]
"""Joint mean, indices in it of landmarks and callers (-1: absent), and whether each caller moves.
"""


def judged(
    known: Known,
    rows: RowColumns,
    place: Place,
    near: Bool[np.ndarray, " l"],
    scan: int,
    sight: Sight = (0.0, 0.0),
) -> Known:
    """Update landmarks' log odds of existence, counts and levels by a scan; return new records."""
    after = Known(*(column.copy() for column in known))
    _judge(tuple(after), rows, place, near, scan, sight)
    return after


@kernel
def _judge(
    columns: tuple[np.ndarray, ...],
    rows: RowColumns,
    there: Place,
    near: Bool[np.ndarray, " l"],
    scan: Whole,
    sight: Sight,
) -> None:
    """Update landmarks' log odds of existence, detection counts and levels by a scan, in place."""
    known, (mean, at, callers, _) = Known(*columns), there
    label, caller, _, level, _, surety = rows
    place = np.full(label.size, -1)
    for n in range(known.label.size):
        far, bearing, rise = math.nan, math.nan, 0.0
        if at[n] >= 0:
            dx, dy = mean[at[n]] - mean[0], mean[at[n] + 1] - mean[1]
            far, bearing = math.hypot(dx, dy), wrap_angle(math.atan2(dy, dx) - mean[2])
        for m in range(label.size):
            if label[m] != known.label[n]:
                continue
            rise, place[m] = max(rise, HEARD * surety[m]), n
            if math.isnan(far) or math.isnan(level[m]):
                continue
            lost = _spreading(caller[m], far, at[n], there)
            source, before = level[m] + lost, known.source[n, caller[m]]
            mean_source = before + FORGETTING * (source - before)
            known.source[n, caller[m]] = source if math.isnan(before) else mean_source
            if caller[m] == OWN:
                known.aim[n] = bearing
        if rise > 0.0:
            known.odds[n] = min(known.odds[n] + rise, MOST)
            known.count[n] += 1
            known.heard[n] = scan
        else:
            missed = 0.0
            for c in range(callers.size):
                here = _missed(known, n, c, far, bearing, rows, there, near[n], sight)
                missed = max(missed, here)
            _lower(known, n, MISSED * missed, scan)
        if known.odds[n] >= CONFIRMED:
            known.confirmed[n] = True
    _count_together(known.together, place, caller)


@no_alloc
def _lower(known: Known, n: Whole, fall: float, scan: Whole) -> None:
    """Lower an undetected landmark's log odds of existence, in place, within its limits."""
    known.odds[n] -= fall
    if known.count[n] >= LASTING and not math.isnan(known.source[n, OWN]):
        if known.odds[n] < GONE:
            known.odds[n], known.confirmed[n] = GONE, False
    elif not known.confirmed[n] and scan - known.heard[n] > PATIENCE:
        known.odds[n] = -MOST


@no_alloc
def _count_together(
    together: UInt8[np.ndarray, "l l"],
    place: Int[np.ndarray, " m"],
    caller: Int[np.ndarray, " m"],
) -> None:
    """Increase the number of joint detections of each pair of landmarks by the same caller."""
    for a in range(place.size):
        for b in range(place.size):
            i, j = place[a], place[b]
            if 0 <= i != j >= 0 and caller[a] == caller[b] and together[i, j] < OFTEN:
                together[i, j] += 1


@no_alloc
def _spreading(caller: Whole, far: float, i: Whole, place: Place) -> float:
    """Return the loss of an echo's level by spherical spreading, via the landmark at i [dB].

    It is two-way for own calls, and for moving callers via the landmark, else from the landmark
    only.
    """
    loss = (40.0 if caller == OWN else 20.0) * math.log10(max(far, NEAR))
    mean, _, callers, moves = place
    if moves[caller] and callers[caller] >= 0:
        j = callers[caller]
        there = math.hypot(mean[i] - mean[j], mean[i + 1] - mean[j + 1])
        loss += 20.0 * math.log10(max(there, NEAR))
    return loss


@no_alloc
def _missed(
    known: Known,
    n: Whole,
    c: Whole,
    far: float,
    bearing: float,
    rows: RowColumns,
    place: Place,
    hidden: bool,
    sight: Sight,
) -> float:
    """Return the weight of an undetected echo as evidence against a landmark, from 0 to 1."""
    (_, caller, way, level, _, _), (mean, at, callers, _) = rows, place
    if math.isnan(far):
        return 0.0
    if math.isnan(known.source[n, c]):
        seen = c == OWN and not hidden and _in_sight(far, bearing, rows, sight)
        return 1.0 if seen else 0.0
    loud = known.source[n, c] - _spreading(c, far, at[n], place)
    if loud < FAINTEST or (c == OWN and abs(wrap_angle(bearing - known.aim[n])) > AIMED):
        return 0.0
    ahead = far
    if c != OWN:
        i, j = at[n], callers[c]
        if j < 0:
            return 0.0
        ahead = excess_path_slopes(mean[0], mean[1], mean[i], mean[i + 1], mean[j], mean[j + 1])[0]
        if ahead < 1.2 * TOGETHER:
            return 0.0
    ahead, factor = (2.0 * ahead, 2.0) if c == OWN else (ahead, 1.0)
    called = c == OWN
    for m in range(caller.size):
        if caller[m] != c:
            continue
        called = True
        if level[m] > loud - AS_LOUD:
            other = 0.0 if math.isnan(way[m]) else factor * way[m]
            if abs(other - ahead) < TOGETHER:
                hidden = True
    if not called:
        return 0.0
    return HIDDEN if hidden else 1.0


@no_alloc
def _in_sight(far: float, bearing: float, rows: RowColumns, sight: Sight) -> bool:
    """Return whether a sensor without echo levels (a lidar) should have detected a landmark."""
    _, caller, way, level, seen, _ = rows
    if far > WITHIN * sight[0] or abs(bearing) > 0.5 * sight[1] - BEFORE:
        return False
    for m in range(caller.size):
        if not math.isnan(level[m]):
            return False
        if way[m] < far and abs(wrap_angle(seen[m] - bearing)) < BEFORE:
            return False
    return True


DENSEST = 0.05
"""Largest density of landmarks [1/m^2]: the extent of a small map is no estimate of it."""
GAIN = 1.0
"""Least cost reduction by each further pair of a group."""
SURE = (8.0, 15.0, 6.0)
"""Cost reductions required of a pair, a group of two pairs, and a larger group."""
AHEAD = 5.0
"""Margin over groups that match the first landmark with another."""
GATE = 13.8
"""Gate on the squared distance of a pair, exceeded by 1 in 1000."""
LEAST_STD = 0.15
"""Least standard deviation of a difference along each axis [m], to allow for overconfident filters.
"""

ASKED = (4, 6, 8, 12, 16, 24, 32, 64)
"""Numbers of detections at which a landmark is tested for duplicates."""
BOTH = 0.1
"""Two landmarks are distinct if both were detected in more than this share of the scans of either.
"""

Pairs = list[tuple[int, int]]


@kernel
def asked_of(
    columns: tuple[np.ndarray, ...], at: Int[np.ndarray, " l"], now: Whole
) -> tuple[Int[np.ndarray, " o"], Bool[np.ndarray, "o o"], Int[np.ndarray, " a"]]:
    """Return the mapped landmarks, their distinct pairs, and which to test for duplicates now."""
    known = Known(*columns)
    old = np.flatnonzero((at >= 0) & (known.born < now))
    asked = np.zeros(old.size, np.bool_)
    for i, a in enumerate(old):
        asked[i] = known.heard[a] == now and known.count[a] in ASKED
    apart = np.ones((old.size, old.size) if asked.any() else (0, 0), np.bool_)
    for i in range(apart.shape[0]):
        for j in range(i):
            a, b = old[i], old[j]
            rarer = min(known.count[a], known.count[b])
            apart[i, j] = apart[j, i] = known.together[a, b] > BOTH * rarer
    return old, apart, np.flatnonzero(asked)


def doubles(
    joint: JointGaussian,
    at: Int[np.ndarray, " l"],
    apart: Bool[np.ndarray, "l l"],
    asked: Int[np.ndarray, " a"],
) -> Pairs:
    """Find duplicate landmarks in a joint map; return pairs of their indices, lower first.

    ``apart``: pairs known to be distinct; ``asked``: landmarks from which groups may grow.
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
    """Return the density of landmarks in the map's bounding box [1/m^2], limited above."""
    area = float(np.ptp(joint.mean[at]) * np.ptp(joint.mean[at + 1]))
    return at.size / max(area, at.size / DENSEST)


def _groups(
    joint: JointGaussian,
    at: Int[np.ndarray, " l"],
    apart: Bool[np.ndarray, "l l"],
    number: int,
    prior: float,
) -> list[tuple[float, list[list[int]]]]:
    """Grow a group of pairs from each possible duplicate of a landmark; return costs and pairs."""
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
    """Return possible duplicates of a landmark within the gate as pairs, higher index first."""
    pairs, size = np.empty((at.size, 2), np.int64), 0
    for other in range(at.size):
        a, b = max(number, other), min(number, other)
        if not (apart[a, b] or math.isinf(_cost(mean, covariance, at[a], at[b], 0.0))):
            pairs[size, 0], pairs[size, 1], size = a, b, size + 1
    return pairs[:size]


def _lower_first(pairs: list[list[int]]) -> Pairs:
    """Sort each pair of indices, replacing indices that earlier pairs have merged.

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
    """Grow a group of duplicate pairs greedily from a pair; return its cost and number of pairs."""
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
    """Return the cost of merging the landmarks at indices a and b; infinite beyond the gate."""
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
    """Condition mean and covariance P, in place, on the landmarks at i and j being the same."""
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
    """Give landmark a the forbidden pairs of two merged landmarks; forbid all pairs with b."""
    for k in range(apart.shape[0]):
        apart[a, k] = apart[k, a] = apart[a, k] or apart[b, k]
    for k in range(apart.shape[0]):
        apart[b, k] = apart[k, b] = True
