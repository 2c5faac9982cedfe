r"""Whether a landmark exists: by how often it was heard, and was not where it should have been.

Each landmark has log odds. They rise when it is heard, the more the surer the row's bearing: what
is between two echoes that overlap comes back, too, but seldom as surely as one echo. They fall when
the landmark is not heard, though it should have been: its level, as it was heard before, is
expected at its present distance (spherical spreading, there and back of the vehicle's own call)
well above what is detected, and the vehicle's own call was sent towards it as before. They fall
less where something as loud came at the same time, or a row that fits is another's: a landmark may
be hidden, but what is hidden for forty scans is none. Of a sensor that tells no levels, a lidar
or a camera, a landmark is expected within its range and field of view, if these are known, unless
something nearer stands before it or a row fits it.

Landmarks that are on the map twice: a few wrong rows make one, a closed loop a whole group.

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
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from pipistrelle.detection.scans import OWN
from pipistrelle.estimation.association import is_among
from pipistrelle.estimation.beliefs import JointGaussian
from pipistrelle.estimation.measurement import excess_path_slopes
from pipistrelle.geometry import wrap_angle
from pipistrelle.jit import Whole, kernel, no_alloc

HEARD, MISSED = 2.0, 1.3
"""Rise of the log odds when a landmark is heard, and their fall when it should have been: a
detection probability of 0.75, and a chance of 0.1 that clutter is where it is."""
MOST, CONFIRMED, GONE = 8.0, 3.0, -2.0
"""Odds rise no further; a landmark is one; a landmark is none."""
LEAST_SCANS, PATIENCE = 3, 25
"""In how many scans it takes a landmark to be one; scans of silence after which a landmark that is
not yet one is none."""
LASTING = 12
"""A landmark that was heard in at least this many scans, and at least once by the vehicle's own
call, is never removed, only unconfirmed. The place of one that was heard by other callers alone
depends on where they are, so that it may be wrong."""
FAINTEST = 18.0
"""A landmark is expected from this level on [dB]."""
HIDDEN = 0.2
"""Share of the fall where something may hide the landmark."""
AS_LOUD = 3.0
"""A row may hide a landmark that is at most so much louder [dB]."""
TOGETHER = 1.0
"""A row hides a landmark whose path differs by less: the length of a call [m]."""
AIMED = 0.1
"""The vehicle's own call is as loud up to so much from the bearing at which it was heard [rad]."""
WITHIN, BEFORE = 0.9, 0.05
"""Without levels a landmark is expected within this share of the sensor's range, so far inside its
field of view, and where no nearer row is within such a bearing of it [rad]."""
NEAR = 0.3
"""Sound spreads from so far on [m]."""
FORGETTING = 0.2
"""Share of the newest level in the mean."""
OFTEN = 255
"""Scans in which two landmarks were heard together are counted up to so many."""


class Known(NamedTuple):
    """Landmarks as the association knows them, l of them."""

    label: Int[np.ndarray, " l"]
    born: Int[np.ndarray, " l"]
    """Number of the first scan, and of the last."""
    heard: Int[np.ndarray, " l"]
    count: Int[np.ndarray, " l"]
    """Scans in which it was heard."""
    odds: Float[np.ndarray, " l"]
    confirmed: Bool[np.ndarray, " l"]
    source: Float[np.ndarray, "l c"]
    """Level that it would have at 1 m, by caller [dB], or NaN; of one that moves: at 1 m from the
    caller, too."""
    aim: Float[np.ndarray, " l"]
    """Bearing at which the vehicle's own call was last heard of it [rad]."""
    together: UInt8[np.ndarray, "l l"]
    """Scans in which one caller was heard of two landmarks: then they are two."""


def nobody(callers: int) -> Known:
    """Return no landmarks."""
    whole, number = np.empty(0, np.int64), np.empty(0)
    none, together = np.empty((0, callers)), np.empty((0, 0), np.uint8)
    return Known(whole, whole, whole, whole, number, np.empty(0, np.bool_), none, number, together)


def with_new(known: Known, labels: list[int], scan: int, callers: int) -> Known:
    """Return known landmarks with new ones, that are heard in a scan for the first time."""
    callers = max(callers, known.source.shape[1])
    if not labels and callers == known.source.shape[1]:
        return known
    return Known(*_with_new(tuple(known), np.array(labels, np.int64), scan, callers))


@kernel
def _with_new(
    columns: tuple[np.ndarray, ...], labels: Int[np.ndarray, " n"], scan: Whole, callers: Whole
) -> tuple[np.ndarray, ...]:
    """Return the columns of known landmarks with new ones."""
    known, none = Known(*columns), np.zeros(labels.size, np.int64)
    old, size = known.label.size, known.label.size + labels.size
    source, together = np.full((size, callers), np.nan), np.zeros((size, size), np.uint8)
    source[:old, : known.source.shape[1]] = known.source
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
        together,
    )


def some(known: Known, kept: Bool[np.ndarray, " l"]) -> Known:
    """Return some of the known landmarks."""
    left = Known(*(column[kept] for column in known))
    return left._replace(together=left.together[:, kept])


def merged(known: Known, pairs: Sequence[tuple[int, int]]) -> Known:
    """Return known landmarks in which the second of each pair of labels is the first, too."""
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


Heard = tuple[
    Int[np.ndarray, " m"],
    Int[np.ndarray, " m"],
    Float[np.ndarray, " m"],
    Float[np.ndarray, " m"],
    Float[np.ndarray, " m"],
    Float[np.ndarray, " m"],
]
"""Label, caller, range or excess path, level, bearing and surety (from 0 to 1) of each row."""
Sight = tuple[float, float]
"""Range [m] and field of view [rad] of a sensor that tells no levels; a range of 0: not known."""
Place = tuple[
    Float[np.ndarray, " d"], Int[np.ndarray, " l"], Int[np.ndarray, " c"], Bool[np.ndarray, " c"]
]
"""Joint mean, where each known landmark stands in it, and each caller (-1: nowhere), and whether
the caller moves."""


def judged(
    known: Known,
    rows: Heard,
    place: Place,
    near: Bool[np.ndarray, " l"],
    scan: int,
    sight: Sight = (0.0, 0.0),
) -> Known:
    """Return landmarks after a scan, as known by what was heard and what was not.

    ``near``: whether a row may have been of the landmark; then it was hidden at most.
    """
    after = _copied(tuple(known))
    _judge(after, rows, place, near, scan, sight)
    return Known(*after)


@kernel
def _copied(columns: tuple[np.ndarray, ...]) -> tuple[np.ndarray, ...]:
    """Return the columns of `Known`, of which those that a scan changes are copies."""
    label, born, heard, count, odds, confirmed, source, aim, together = columns
    counts = heard.copy(), count.copy(), odds.copy(), confirmed.copy()
    return (label, born, *counts, source.copy(), aim.copy(), together.copy())


@kernel
def _judge(
    columns: tuple[np.ndarray, ...],
    rows: Heard,
    there: Place,
    near: Bool[np.ndarray, " l"],
    scan: Whole,
    sight: Sight,
) -> None:
    """Write odds, counts and levels after a scan."""
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
        if known.odds[n] >= CONFIRMED and known.count[n] >= LEAST_SCANS:
            known.confirmed[n] = True
    _count_together(known.together, place, caller)


@no_alloc
def _lower(known: Known, n: Whole, fall: float, scan: Whole) -> None:
    """Lower the odds of a landmark that was not heard."""
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
    """Count landmarks of which one caller was heard in a scan; of each row where its own stands."""
    for a in range(place.size):
        for b in range(place.size):
            i, j = place[a], place[b]
            if 0 <= i != j >= 0 and caller[a] == caller[b] and together[i, j] < OFTEN:
                together[i, j] += 1


@no_alloc
def _spreading(caller: Whole, far: float, i: Whole, place: Place) -> float:
    """Return what a level loses by the way of an echo from the landmark that stands at i [dB].

    That is there and back of the vehicle's own call, and from the landmark of another caller's, but
    of one that moves the way to the landmark, too.
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
    rows: Heard,
    place: Place,
    hidden: bool,
    sight: Sight,
) -> float:
    """Return how surely a caller's call should have been heard of a landmark: 1, `HIDDEN` or 0."""
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
def _in_sight(far: float, bearing: float, rows: Heard, sight: Sight) -> bool:
    """Tell whether a sensor without levels should have seen a landmark, and nothing hides it."""
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
