r"""Log odds of existence of landmarks, and the detection of duplicates.

**Detection** (`probabilities`). A call detects a landmark with the probability p of its level,
corrected for spherical spreading (without levels: of its range), and of its bearing, learned from
the drive: h detections in n scans with an often detected landmark give h / (n + 1).

**Existence** (`judged`). A landmark is hidden with the probability q, and a place without landmark
is detected with q, as the interference of overlapping echoes recurs. A miss by all calls lowers the
log odds of existence by

.. math:: L(m) = \ln \frac{1 - q + q m}{q + (1 - q) m}, \qquad m = \prod (1 - p)^{1/5}

and a detection raises them by L(0), or less if its bearing is imprecise. The power weighs misses of
successive scans, which are correlated: over 3 to 13 scans in 10 simulated drives.

**Duplicates** (`doubles`). Wrong labels cause single duplicates, a loop closure a whole group.
Merging landmarks a and b costs

.. math:: c = d^2 + \ln |2 \pi S| + 2 \ln \lambda, \qquad d^2 = (l_a - l_b)^T S^{-1} (l_a - l_b)

with the covariance S of their difference in the joint map, and the density :math:`\lambda` of
landmarks. Each further pair of a group is tested given the pairs before, which the same drift has
moved. Groups grow greedily; the best is accepted if it is 99 times likelier than distinct landmarks
and than each contradicting group. Landmarks detected in a scan of the same caller are distinct
(`Known.together`). Source: Neira & Tardos, IEEE Transactions on Robotics and Automation 17 (2001).
Without a group, S is replaced by 16 S, as odometry may drift more than stated (`drifted`).
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from pipistrelle.detection.scans import OWN
from pipistrelle.estimation.beliefs import JointGaussian, is_among
from pipistrelle.estimation.session import REMEMBERED
from pipistrelle.geometry import wrap_angle
from pipistrelle.jit import Whole, kernel, no_alloc

CHANCE = 0.1
"""Probability q of a detection by chance, and that a landmark is hidden."""
MOST, CONFIRMED, GONE = 8.0, 3.5, -2.0
"""Log odds: upper limit, confirmation (probability 0.97), removal (0.12)."""
PATIENCE = 25
"""Scans without detection that remove an unconfirmed landmark."""
LEVEL_STD = 5.0
"""Standard deviation of levels [dB]."""
LASTING = 12
"""Detections from which a landmark serves to learn detection probabilities, and is unconfirmed, not
removed: except by levels of other callers only, as its position depends on theirs."""
FORGETTING = 0.2
"""Weight of the newest level in the mean."""
PERSISTENCE = 5
"""Scans over which the misses of a landmark are correlated."""
RINGS, SECTORS = 24, 8
"""Bins of detection probabilities: levels, `LEVEL_STD` wide, else ranges from 1 m by factors of the
root of 2 (to 4 km), and bearings."""
BINS = RINGS * SECTORS
WINDOW = REMEMBERED
"""Scans of which `Known.past` is kept."""
OFTEN = np.iinfo(np.uint8).max
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
    """Log odds of existence; infinite if it is stated: such landmarks are distinct, and stay."""
    confirmed: Bool[np.ndarray, " l"]
    source: Float[np.ndarray, "l c"]
    """Level at 1 m from the landmark (and from a moving caller), by caller [dB], or NaN."""
    past: Float[np.ndarray, "l c w"]
    """Log probability of a miss in each of the last `WINDOW` scans, by caller; 1 if detected."""
    together: UInt8[np.ndarray, "l l"]
    """Number of scans in which both landmarks were detected by the same caller."""


def nobody(callers: int) -> Known:
    """Return empty records of tracked landmarks, for a number of callers."""
    whole, number = np.empty(0, np.int64), np.empty(0)
    none, together = np.empty((0, callers)), np.empty((0, 0), np.uint8)
    yes, past = np.empty(0, np.bool_), np.empty((0, callers, WINDOW))
    return Known(whole, whole, whole, whole, number, yes, none, past, together)


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
        np.append(known.odds, np.full(labels.size, -math.log((1.0 - CHANCE) / CHANCE))),
        np.append(known.confirmed, np.zeros(labels.size, np.bool_)),
        source,
        past,
        together,
    )


def some(known: Known, kept: Bool[np.ndarray, " l"]) -> Known:
    """Return the records of the landmarks that a mask selects."""
    left = Known(*(column[kept] for column in known))
    return left._replace(together=left.together[:, kept])


def stated(known: Known, labels: Int[np.ndarray, " n"]) -> Known:
    """Return the records with some landmarks marked as stated."""
    told = is_among(known.label, labels)
    odds = np.where(told, math.inf, known.odds)
    return known._replace(odds=odds, confirmed=known.confirmed | told)


def merged(known: Known, pairs: Sequence[tuple[int, int]]) -> Known:
    """Return the records with duplicates merged: the first label, and the older record, remain."""
    if not pairs:
        return known
    after = Known(*(column.copy() for column in known))
    place = {label: n for n, label in enumerate(known.label.tolist())}
    for kept, gone in pairs:
        a, b = sorted((place[kept], place[gone]))
        after.label[a], after.label[b], place[kept] = kept, gone, a
        after.count[a] += after.count[b]
        for column in (after.odds, after.heard, after.confirmed):
            column[a] = max(column[a], column[b])
        both = np.maximum(after.together[a], after.together[b])
        after.together[a], after.together[:, a] = both, both
    return some(after, ~is_among(after.label, np.array([gone for _, gone in pairs])))


RowColumns = tuple[
    Int[np.ndarray, " m"], Int[np.ndarray, " m"], Float[np.ndarray, " m"], Float[np.ndarray, " m"]
]
"""Columns of a scan: label, caller, level and surety (0 to 1)."""
Place = tuple[
    Float[np.ndarray, " d"], Int[np.ndarray, " l"], Int[np.ndarray, " c"], Bool[np.ndarray, " c"]
]
"""Joint mean, indices in it of landmarks and callers (-1: absent), and whether each caller moves.
"""


def judged(
    known: Known, rows: RowColumns, place: Place, missed: Float[np.ndarray, " l"], scan: int
) -> Known:
    """Update landmarks' log odds of existence, counts and levels by a scan; return new records.

    ``missed``: probability m that an existing landmark is in no measurement.
    """
    names = "heard", "count", "odds", "confirmed", "source", "together"
    after = known._replace(**{name: getattr(known, name).copy() for name in names})
    _judge(tuple(after), rows, place, missed, scan)
    return after


@kernel
def _judge(
    columns: tuple[np.ndarray, ...],
    rows: RowColumns,
    there: Place,
    missed: Float[np.ndarray, " l"],
    scan: Whole,
) -> None:
    """Update landmarks' log odds of existence, detection counts and levels by a scan, in place."""
    known, (mean, at, _, _), (label, caller, level, surety) = Known(*columns), there, rows
    place = np.full(label.size, -1)
    for n in range(known.label.size):
        rise = 0.0
        for m in range(label.size):
            if label[m] != known.label[n]:
                continue
            rise, place[m] = max(rise, surety[m] * log_ratio(0.0)), n
            if at[n] < 0 or math.isnan(level[m]):
                continue
            far = math.hypot(mean[at[n]] - mean[0], mean[at[n] + 1] - mean[1])
            source = level[m] + _spreading(caller[m], far, at[n], there)
            before = known.source[n, caller[m]]
            mean_source = before + FORGETTING * (source - before)
            known.source[n, caller[m]] = source if math.isnan(before) else mean_source
        if rise > 0.0:
            known.odds[n] = max(min(known.odds[n] + rise, MOST), known.odds[n])
            known.count[n] += 1
            known.heard[n] = scan
        else:
            _lower(known, n, log_ratio(missed[n]), scan)
        if known.odds[n] >= CONFIRMED:
            known.confirmed[n] = True
    for a in range(place.size):  # pairs of landmarks that one caller detects together
        for b in range(place.size):
            i, j = place[a], place[b]
            if 0 <= i != j >= 0 and caller[a] == caller[b] and known.together[i, j] < OFTEN:
                known.together[i, j] += 1


@no_alloc
def log_ratio(missed: float) -> float:
    """Return the log likelihood ratio against a landmark of a miss, by the probability m."""
    q = CHANCE
    return math.log((1.0 - q + q * missed) / (q + (1.0 - q) * missed))


@no_alloc
def _lower(known: Known, n: Whole, fall: float, scan: Whole) -> None:
    """Lower an undetected landmark's log odds of existence, in place, within its limits."""
    known.odds[n] -= fall
    of_others, own = False, not math.isnan(known.source[n, OWN])
    for level in known.source[n]:
        of_others |= not (own or math.isnan(level))
    if known.count[n] >= LASTING and not of_others:
        if known.odds[n] < GONE:
            known.odds[n], known.confirmed[n] = GONE, False
    elif not known.confirmed[n] and scan - known.heard[n] > PATIENCE:
        known.odds[n] = -MOST


@no_alloc
def _spreading(caller: Whole, far: float, i: Whole, place: Place) -> float:
    """Return the loss of an echo's level by spherical spreading, via the landmark at i [dB].

    It is two-way for own calls, and for moving callers via the landmark, else from the landmark
    only; 0 within 1 m.
    """
    loss = (40.0 if caller == OWN else 20.0) * math.log10(max(far, 1.0))
    mean, _, callers, moves = place
    if moves[caller] and callers[caller] >= 0:
        j = callers[caller]
        there = math.hypot(mean[i] - mean[j], mean[i + 1] - mean[j + 1])
        loss += 20.0 * math.log10(max(there, 1.0))
    return loss


@kernel
def probabilities(
    hits: Float[np.ndarray, "c b"],
    asked: Float[np.ndarray, "c b"],
    source: Float[np.ndarray, "l c"],
    place: Place,
) -> tuple[Float[np.ndarray, "l c"], Int[np.ndarray, "l c"]]:
    """Return each call's detection probability of landmarks, and bins.

    ``source``: levels at 1 m, as in `Known`. A call with levels is judged by landmarks with levels
    above 0 dB; others, and absent landmarks, get the probability 0 and the bin -1.
    """
    mean, at, _, _ = place
    p, bins = np.zeros((at.size, len(hits))), np.full((at.size, len(hits)), -1)
    bare = np.array([np.isnan(source[:, c]).all() for c in range(len(hits))])
    for n in np.flatnonzero(at >= 0):
        dx, dy = mean[at[n]] - mean[0], mean[at[n] + 1] - mean[1]
        far, bearing = math.hypot(dx, dy), wrap_angle(math.atan2(dy, dx) - mean[2])
        sector = min(int(SECTORS * abs(bearing) / math.pi), SECTORS - 1)
        for c in range(len(hits)):
            level = (source[n, c] - _spreading(c, far, at[n], place)) / LEVEL_STD
            ring = 2.0 * math.log2(max(far, 1.0)) if bare[c] else level
            if ring >= 0.0:
                bins[n, c] = SECTORS * min(int(ring), RINGS - 1) + sector
                p[n, c] = hits[c, bins[n, c]] / (asked[c, bins[n, c]] + 1.0)
    return p, bins


DENSEST = 0.05
"""Largest density of landmarks [1/m^2]: the extent of a small map is no estimate of it."""
LIKELIER = 2.0 * math.log(99.0)
"""Least reduction of the cost by a group, and margin over groups that match its first landmark with
another: probability 0.99."""
GATE = 13.8
"""Gate on the squared distance of a pair, exceeded by 1 in 1000."""
LEAST_STD = 0.15
"""Least standard deviation of a difference along each axis [m], to allow for overconfident filters.
"""

UNDERSTATED = 4.0
"""Factor on the map's standard deviations that allows for a drift larger than stated."""

Pairs = list[tuple[int, int]]


@kernel
def asked_of(
    columns: tuple[np.ndarray, ...], at: Int[np.ndarray, " l"], now: Whole
) -> tuple[Int[np.ndarray, " o"], Bool[np.ndarray, "o o"], Int[np.ndarray, " a"]]:
    """Return mapped landmarks, stated first, distinct pairs, and which to test for duplicates."""
    known = Known(*columns)
    old, told = (at >= 0) & (known.born < now), np.isinf(known.odds)
    old = np.append(np.flatnonzero(old & told), np.flatnonzero(old & ~told))
    asked = np.zeros(old.size, np.bool_)
    for i, a in enumerate(old):
        count = known.count[a]  # 4, 8, 16 and so on
        asked[i] = known.heard[a] == now and count >= 4 and count & (count - 1) == 0
    apart = np.ones((old.size, old.size) if asked.any() else (0, 0), np.bool_)
    for i in range(apart.shape[0]):
        for j in range(i):
            a, b = old[i], old[j]
            rarer = min(known.count[a], known.count[b])
            both = known.together[a, b] > CHANCE * rarer or (told[a] and told[b])
            apart[i, j] = apart[j, i] = both
    return old, apart, np.flatnonzero(asked)


def doubles(
    joint: JointGaussian,
    at: Int[np.ndarray, " l"],
    apart: Bool[np.ndarray, "l l"],
    asked: Int[np.ndarray, " a"],
    least: float = 0.0,
) -> Pairs:
    """Find duplicate landmarks in a joint map; return pairs of their indices, lower first.

    ``apart``: pairs known to be distinct; ``asked``: landmarks from which groups may grow;
    ``least``: further reduction of the cost by a group.
    """
    best: tuple[float, list[list[int]]] = 0.0, []
    mean, covariance, pairs = joint.mean, joint.covariance, np.empty((at.size, 2), np.int64)
    area = float(np.ptp(mean[at]) * np.ptp(mean[at + 1]))
    prior = 2.0 * math.log(at.size / max(area, at.size / DENSEST))
    for number in asked.tolist():
        groups = []
        for first in begun(mean, covariance, at, apart, number).tolist():
            cost, size = grown(mean, covariance, at, apart, tuple(first), prior, pairs)
            groups.append((cost, pairs[:size].tolist()))
        cost, group = min(groups, default=best)
        others = [other for other, found in groups if group[0] not in found]
        limit = min(best[0], min([0.0, *others]) - LIKELIER - least)
        if cost < limit:
            best = cost, group
    return _lower_first(best[1])


def drifted(
    joint: JointGaussian,
    at: Int[np.ndarray, " l"],
    apart: Bool[np.ndarray, "l l"],
    asked: Int[np.ndarray, " a"],
    lifetimes: tuple[Int[np.ndarray, " l"], Int[np.ndarray, " l"]],
) -> Pairs:
    """Find duplicate landmarks after a drift larger than stated; return pairs of their indices.

    ``lifetimes``: scans of the first and of the last detection. Two landmarks are compared if the
    last detection of the one is before the first detection of the other.
    """
    born, heard = lifetimes
    before, wide = heard[:, np.newaxis] < born, UNDERSTATED**2 * joint.covariance
    apart = apart | ~(before | before.T)  # and such a drift has the probability 0.01
    return doubles(replace(joint, covariance=wide), at, apart, asked, LIKELIER)


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
        for k in range(at.size):  # landmark a has the forbidden pairs of both, b none else
            apart[a, k] = apart[k, a] = apart[a, k] or apart[b, k]
        apart[b] = apart[:, b] = True
        cost = 0.0
        for i in range(at.size):
            for j in range(i):
                other = math.inf if apart[i, j] else _cost(mean, P, at[i], at[j], prior)
                if other < cost:
                    cost, a, b = other, i, j
        if cost == 0.0:
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
