r"""The search for a caller's place by excess paths over landmarks that are not known either.

Given the caller's place, a row's bearing and excess path are a point; those of one landmark are one
point at all times only where the caller truly is. The search takes a grid of ranges and bearings
about the direct call, for each place the misfit of all tracks (`misfit`: points as robust means of
what their rows say, headings as medians over tracks, residuals that count no more than
:math:`3 \sigma`), goes downhill from the best, and believes it if what is at another range fits
clearly worse.

A caller that stands is searched for twice, in windows that have little in common (`searched`).

Of a caller that moves the places at the begin, in the middle and at the end of the window are
looked for, which a parabola joins. A landmark that stands is told by its bearings alone, as the
vehicle goes by, and its excess path then tells of the caller at each scan: velocity and
acceleration can be observed, too.

Callers that turn: where one is whose rows do not fit where it was expected to be.

An estimator takes velocities for random walks; of a caller that turns at once it knows too late,
and its rows, held against where it was expected, are of no landmark. So where few of them fit, the
places about its direct call are tried: on the map its rows fit together at one place alone.

Scans from before there was a map, labelled by the map that came of them.

Excess paths say where landmarks are once their caller is on the map, and that it is from the scan
after the one in which its range is stated. Until then a vehicle that only listens has no landmark,
and one whose beam is narrow has few; but at the start the heading is known best, and what was heard
there says how the map lies. So these rows are held against the map when that has settled. Before,
map and vehicle are turned against each other as all rows fit best (`_turn`): their headings are
off by more than bearings are. A bearing alone places no landmark: with it comes the range that the
map has for it, stated so unsurely that little is said twice.

**The turn.** With the mean bearing of all landmarks :math:`\beta = a^T x` of the variance
:math:`a^T P a`, a turn by :math:`\delta` moves the mean to

.. math:: x + \frac{P a}{a^T P a}\, \delta, \qquad
          P - \frac{P a a^T P}{a^T P a}

being the covariance of what is left.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from pipistrelle.detection.scans import RANGE, RANGE_STD, UNLABELLED, Scan
from pipistrelle.estimation.association import is_among
from pipistrelle.estimation.beliefs import JointGaussian
from pipistrelle.estimation.data_association.pairs import (
    NOTHING,
    UNPLACED,
    Match,
    PlainChances,
    pair_costs,
    pair_innovations,
)
from pipistrelle.estimation.data_association.rows import Caller, CallerPlace, EarlyScan, part_of
from pipistrelle.estimation.data_association.tracks import TURN, Tracks, in_window
from pipistrelle.geometry import wrap_angle
from pipistrelle.jit import kernel, no_alloc

SCANS, SIGHTINGS, LEAST_TRACKS = 14, 4, 8
"""Scans that are looked at, sightings that make a track count, and how many of them it takes."""
RANGES = np.geomspace(2.5, 45.0, 22)
"""[m]"""
BEARINGS = np.array([-0.1, -0.05, 0.0, 0.05, 0.1])
"""Off the direct call [rad]."""
ANOTHER, CLEARLY, WELL = math.log(1.5), 25.0, 2.6
"""Factor of another range, by how much it must fit worse, and the most that a row may misfit."""
DIRECT_STD, LEAST_BEARING_STD, LEAST_WAY_STD = 0.05, 0.01, 0.05
"""Least deviations: of the direct call, of other bearings [rad], and of excess paths [m]."""
FARTHEST, NEAREST = 80.0, 0.05
"""Largest range of a landmark, and least distance from the caller [m]."""
FASTEST = 2.0
"""Largest speed of a caller that moves [m/s]."""
CAP = 9.0
"""A row's misfit counts no more."""
PASSES, WEIGHINGS = 3, 2
FIRST, FIRST_MOVING = 8, 10
"""Scans after which a caller that stands, and one that moves, is searched for, at every second."""
SECOND, LAST, APART, WIDELY = 20, 30, 0.15, math.log(2.0)
"""Scans after which one that stands is searched for once more, until it is found; logarithms of the
factor by which its two ranges must differ for the mean of both places to be taken, and for the
second alone."""


class Found(NamedTuple):
    """A caller's place."""

    place: CallerPlace
    misfit: float
    """Per row."""
    ahead: float
    """By how much places at other ranges misfit more."""
    tracks: int

    @property
    def sure(self) -> bool:
        """Whether it is to be believed."""
        return self.ahead > CLEARLY and self.misfit < WELL and self.tracks >= LEAST_TRACKS


def searched(caller: Caller, moves: bool) -> tuple[Caller, CallerPlace | None]:
    """Search for a caller by its tracks, if it is time; return it, and its place if that is news.

    One that stands is searched for twice. What the two windows tell is nearly independent, so where
    they differ their mean is the better place; where they differ widely the first, of the shorter
    way, is wrong.
    """
    tracks, first, scans = caller.tracks, caller.place, len(caller.tracks.poses)
    begin = SECOND if first is not None else FIRST_MOVING if moves else FIRST
    if scans < begin or scans % 2:
        return caller, None
    found = find_moving_caller(tracks) if moves else find_caller(tracks)
    if found is None or not found.sure:
        return (caller if first is None or scans < LAST else _agreed(caller, first)), None
    place = found.place
    if first is None:
        return caller, place._replace(agreed=moves or scans >= SECOND)
    x, y = tracks.poses[0, :2]
    far = [math.hypot(one.x - x, one.y - y) for one in (first, place)]
    apart = abs(math.log(far[1] / far[0]))
    if apart < APART:
        return _agreed(caller, first), None
    share = 1.0 if apart > WIDELY else 0.5
    x, y = first.x + share * (place.x - first.x), first.y + share * (place.y - first.y)
    return caller, CallerPlace(x, y, agreed=True)


def _agreed(caller: Caller, place: CallerPlace) -> Caller:
    """Return a caller that is at a place, and not searched for any more."""
    return replace(caller, place=place._replace(agreed=True), tracks=Tracks())


def find_caller(tracks: Tracks) -> Found | None:
    """Return where a caller is by its tracks; None where they are too few, or it was not heard."""
    table, poses, direct = in_window(tracks, SCANS, SIGHTINGS)
    heard = direct[~np.isnan(direct)]
    if len(table) < LEAST_TRACKS or not heard.size:
        return None
    seen, still = (poses, table, direct), np.ones((len(poses), 1))
    grid = [(r, heard[-1] + b) for r in RANGES.tolist() for b in BEARINGS.tolist()]
    nodes = [seen_from(poses[-1], r, angle)[np.newaxis] for r, angle in grid]
    ranges, misfits = np.array([r for r, _ in grid]), _misfits(nodes, still, seen)
    best = int(misfits.argmin())
    node, least = _downhill(nodes[best], misfits[best], 0.12 * ranges[best], still, seen)
    others = _another(ranges, math.hypot(*(node[0] - poses[-1, :2])))
    ahead = float(misfits[others].min(initial=math.inf) - least)
    x, y = node[0].tolist()
    return Found(CallerPlace(x, y), least / _rows(table), ahead, len(table))


def find_moving_caller(tracks: Tracks) -> Found | None:
    """Return where a caller is that moves, and how; None as `find_caller`.

    The ends of its way in the window are looked for on a grid of ranges, then its middle, too. What
    fits best is held against what fits best at another range.
    """
    table, poses, direct = in_window(tracks, SCANS, SIGHTINGS)
    heard, times = np.flatnonzero(~np.isnan(direct)), tracks.times[-len(poses) :]
    if len(table) < LEAST_TRACKS or heard.size < 2:
        return None
    seen, first, last = (poses, table, direct), heard[0], heard[-1]
    took = float(times[last] - times[first])
    share = (times - times[first]) / took
    ends = [(s, r) for r in RANGES.tolist() for s in RANGES.tolist() if abs(r - s) < FASTEST * took]
    begins, finish = (poses[first], direct[first]), (poses[last], direct[last])
    nodes = [
        np.stack([seen_from(begins[0], s, begins[1]), seen_from(finish[0], r, finish[1])])
        for s, r in ends
    ]
    ranges = np.array([r for _, r in ends])
    misfits = _misfits(nodes, np.stack([1.0 - share, share], axis=1), seen)

    def range_of(way: Float[np.ndarray, "n 2"]) -> float:
        return math.hypot(*(way[-1] - poses[last, :2]))

    def best_of(
        costs: Float[np.ndarray, " g"], within: Callable[[np.ndarray], bool]
    ) -> tuple[Float[np.ndarray, "3 2"], float]:
        best = int(costs.argmin())
        return _bent((nodes[best], misfits[best], 0.12 * ranges[best]), share, seen, within)

    one = best_of(misfits, lambda way: True)
    found = range_of(one[0])
    other = best_of(
        np.where(_another(ranges, found), misfits, np.inf),
        lambda way: abs(math.log(range_of(way) / found)) > ANOTHER,
    )
    (way, least), (_, next_least) = sorted((one, other), key=lambda found: found[1])
    place = _at_end(way, float(times[last]), took)._replace(since=float(times[0]))
    return Found(place, least / _rows(table), next_least - least, len(table))


def _bent(
    begun: tuple[np.ndarray, float, float],
    share: Float[np.ndarray, " k"],
    seen: tuple[np.ndarray, ...],
    within: Callable[[np.ndarray], bool],
) -> tuple[Float[np.ndarray, "3 2"], float]:
    """Return begin, middle and end of the way that fits best near a straight one, and its misfit.

    ``begun``: begin and end of that, its misfit, and the first step [m]; ``share``: of it that is
    gone at each scan.
    """
    node, least, step = begun
    line = np.stack([1.0 - share, share], axis=1)
    node, least = _downhill(node, least, step, line, seen, within)
    middle = 4.0 * share * (1.0 - share)
    curve = np.stack([line[:, 0] - 0.5 * middle, middle, line[:, 1] - 0.5 * middle], axis=1)
    node = np.stack([node[0], 0.5 * (node[0] + node[1]), node[1]])
    return _downhill(node, least, step / 3.0, curve, seen, within)


def _at_end(node: Float[np.ndarray, "3 2"], time: float, took: float) -> CallerPlace:
    """Return place and motion at the end of a way by its begin, middle and end."""
    velocity = (node[0] - 4.0 * node[1] + 3.0 * node[2]) / took
    acceleration = 4.0 * (node[0] - 2.0 * node[1] + node[2]) / took**2
    (x, y), (vx, vy), (ax, ay) = (of.tolist() for of in (node[2], velocity, acceleration))
    return CallerPlace(x, y, motion=(vx, vy, ax, ay), time=time)


def _another(ranges: Float[np.ndarray, " n"], distance: float) -> Bool[np.ndarray, " n"]:
    """Return a mask of ranges that are others than a distance."""
    return np.abs(np.log(ranges / distance)) > ANOTHER


def seen_from(pose: Float[np.ndarray, "3"], far: float, angle: float) -> Float[np.ndarray, "2"]:
    """Return the point at a range [m] and a bearing in the world [rad] from a pose."""
    return pose[:2] + far * np.array([math.cos(angle), math.sin(angle)])


def _rows(table: Float[np.ndarray, "t k 4"]) -> int:
    """Return how many rows tracks have."""
    return int(np.count_nonzero(~np.isnan(table[..., 0])))


def _misfits(
    nodes: list[np.ndarray], weights: Float[np.ndarray, "k n"], seen: tuple[np.ndarray, ...]
) -> Float[np.ndarray, " g"]:
    """Return the misfit of each of several ways; arguments as those of `_downhill`."""
    return np.array([misfit(weights @ node, *seen) for node in nodes])


def _downhill(
    nodes: Float[np.ndarray, "n 2"],
    least: float,
    step: float,
    weights: Float[np.ndarray, "k n"],
    seen: tuple[np.ndarray, ...],
    within: Callable[[np.ndarray], bool] = lambda nodes: True,
) -> tuple[Float[np.ndarray, "n 2"], float]:
    """Return the nodes of the least misfit near others, by a pattern search, and its misfit.

    ``weights``: of the nodes in the caller's place at each scan; ``within``: which nodes may be.
    """
    end, size = step / 12.0, len(nodes)
    which = [np.ones((size, 1)), *(np.eye(size)[:, :, np.newaxis] if size > 1 else ())]
    angles = np.arange(8) * np.pi / 4.0
    moves = [one * np.array([math.cos(a), math.sin(a)]) for one in which for a in angles]
    while step > end:
        for move in moves:
            other = nodes + step * move
            value = misfit(weights @ other, *seen)
            if value < least and within(other):
                nodes, least = other, value
                break
        else:
            step *= 0.5
    return nodes, least


@kernel
def misfit(
    places: Float[np.ndarray, "k 2"],
    poses: Float[np.ndarray, "k 3"],
    table: Float[np.ndarray, "t k 4"],
    direct: Float[np.ndarray, " k"],
) -> float:
    """Return the misfit of all rows, were the caller at these places [squared deviations]."""
    tracks, scans = table.shape[0], table.shape[1]
    turn, off = np.zeros(scans), np.full((tracks, scans), np.nan)
    points, total = np.empty((scans, 6)), 0.0
    for _ in range(PASSES - 1):
        for t in range(tracks):
            _write_off(places, poses, table[t], turn, points, off[t])
        _correct_headings(off, turn)
    for t in range(tracks):
        point = _write_off(places, poses, table[t], turn, points, off[t])
        total += _of_track(places, poses, table[t], points, off[t], point)
    for k in range(scans):
        if not math.isnan(direct[k]):
            towards = math.atan2(places[k, 1] - poses[k, 1], places[k, 0] - poses[k, 0])
            sight = wrap_angle(direct[k] + turn[k] - towards) / DIRECT_STD
            total += min(sight * sight, CAP)
        if k > 0:
            total += ((turn[k] - turn[k - 1]) / TURN) ** 2
    return total


@no_alloc
def _write_off(
    places: Float[np.ndarray, "k 2"],
    poses: Float[np.ndarray, "k 3"],
    rows: Float[np.ndarray, "k 4"],
    turn: Float[np.ndarray, " k"],
    points: Float[np.ndarray, "k 6"],
    off: Float[np.ndarray, " k"],
) -> tuple[float, float]:
    """Return the point of a track; write how far its bearings are off.

    ``points``: room for each row's point, its direction and its variances along and across.
    """
    x, y, weight = 0.0, 0.0, 0.0
    for k in range(rows.shape[0]):
        _write_point(places[k], poses[k], rows[k], turn[k], points[k])
        if not math.isnan(points[k, 0]):
            share = 1.0 / (points[k, 4] + points[k, 5] + 4e-4)
            x, y, weight = x + share * points[k, 0], y + share * points[k, 1], weight + share
    for number in range(1 + WEIGHINGS if weight > 0.0 else 0):
        x, y = _weighed(points, x, y) if number else (x / weight, y / weight)
    for k in range(rows.shape[0]):
        if not math.isnan(points[k, 0]):
            towards = math.atan2(y - poses[k, 1], x - poses[k, 0])
            off[k] = wrap_angle(rows[k, 0] + turn[k] - towards)
    return x, y


@no_alloc
def _of_track(
    places: Float[np.ndarray, "k 2"],
    poses: Float[np.ndarray, "k 3"],
    rows: Float[np.ndarray, "k 4"],
    points: Float[np.ndarray, "k 6"],
    off: Float[np.ndarray, " k"],
    point: tuple[float, float],
) -> float:
    """Return the misfit of a track at its point."""
    total, (x, y) = 0.0, point
    for k in range(rows.shape[0]):
        if math.isnan(rows[k, 0]):
            continue
        if math.isnan(points[k, 0]):
            total += CAP
            continue
        straight = math.hypot(places[k, 0] - poses[k, 0], places[k, 1] - poses[k, 1])
        onward = math.hypot(x - places[k, 0], y - places[k, 1])
        path = onward + math.hypot(x - poses[k, 0], y - poses[k, 1]) - straight
        across = off[k] / math.hypot(rows[k, 2], LEAST_BEARING_STD)
        along = (rows[k, 1] - path) / math.hypot(rows[k, 3], LEAST_WAY_STD)
        total += min(across * across + along * along, CAP)
    return total


@no_alloc
def _weighed(points: Float[np.ndarray, "k 6"], x: float, y: float) -> tuple[float, float]:
    """Return the mean of points, of which those far from another mean count less."""
    sx, sy, weight = 0.0, 0.0, 0.0
    for k in range(points.shape[0]):
        if math.isnan(points[k, 0]):
            continue
        c, s = points[k, 2], points[k, 3]
        dx, dy = points[k, 0] - x, points[k, 1] - y
        along, across = c * dx + s * dy, c * dy - s * dx
        squared = along * along / points[k, 4] + across * across / (points[k, 5] + 1e-4)
        share = 1.0 / ((points[k, 4] + points[k, 5] + 4e-4) * (1.0 + 0.25 * squared))
        sx, sy, weight = sx + share * points[k, 0], sy + share * points[k, 1], weight + share
    return sx / weight, sy / weight


@no_alloc
def _write_point(
    place: Float[np.ndarray, "2"],
    pose: Float[np.ndarray, "3"],
    row: Float[np.ndarray, "4"],
    turn: float,
    point: Float[np.ndarray, "6"],
) -> None:
    """Write a row's point, direction and variances along and across; NaN where there is none."""
    point[0], angle = math.nan, row[0] + turn
    if math.isnan(row[0]):
        return
    c, s = math.cos(angle), math.sin(angle)
    wx, wy = pose[0] - place[0], pose[1] - place[1]
    straight = math.sqrt(wx * wx + wy * wy)
    whole = straight + max(row[1], 0.02)
    down = whole + wx * c + wy * s
    far = 0.5 * row[1] * (2.0 * straight + row[1]) / max(down, 1e-3)
    if not 0.0 < far < FARTHEST:
        return
    fx, fy = wx + far * c, wy + far * s
    onward = max(math.sqrt(fx * fx + fy * fy), NEAREST)
    by_range = max(1.0 + (fx * c + fy * s) / onward, 0.02)
    by_bearing = far * (c * fy - s * fx) / onward
    along = by_bearing / by_range * row[2], math.hypot(row[3], 0.03) / by_range
    point[0], point[1], point[2], point[3] = pose[0] + far * c, pose[1] + far * s, c, s
    point[4] = along[0] * along[0] + along[1] * along[1]
    point[5] = (far * math.hypot(row[2], LEAST_BEARING_STD)) ** 2


@kernel
def _correct_headings(off: Float[np.ndarray, "t k"], turn: Float[np.ndarray, " k"]) -> None:
    """Turn each scan by the median of what its bearings are off, the last one by nothing."""
    scans = turn.size
    medians = np.zeros(scans)
    for k in range(scans):
        seen = off[:, k][~np.isnan(off[:, k])]
        if seen.size >= 3:
            medians[k] = np.median(seen)
    for k in range(scans):
        turn[k] -= min(max(medians[k] - medians[scans - 1], -0.1), 0.1)


FITTING_SHARE, LEAST_ROWS = 0.5, 6
"""A caller may have turned if less than this share of its rows fits, of so many."""
BETTER = 30.0
"""By how much all rows together must fit better elsewhere."""
LEAST_REACH, REACH, LEAST_RANGE = 4.0, 3.0, 0.5
"""Ranges are tried that are off the expected one by so much [m], or by so many deviations of the
place, and none nearer than the last [m]."""
SHARES, TURN_BEARINGS = np.linspace(-1.0, 1.0, 21), np.linspace(-0.06, 0.06, 7)
"""Parts of that, and bearings off the direct call [rad]."""

Costs = Callable[[Float[np.ndarray, " d"]], Float[np.ndarray, "r n"]]
"""Costs of rows and landmarks (`pairs.pair_costs`) by the joint mean."""


def may_have_turned(fitting: int, rows: int) -> bool:
    """Tell whether too few of a caller's rows fit where it was expected."""
    return rows >= LEAST_ROWS and fitting < FITTING_SHARE * rows


def turned(joint: JointGaussian, at: int, bearing: float, costs: Costs) -> JointGaussian:
    """Return a joint Gaussian in which a caller is where its rows fit.

    ``at``: where the caller stands in the mean; ``bearing``: of its direct call.
    """
    mean, spread = joint.mean, np.diag(joint.covariance)[at : at + 2].sum()
    least, fitting = fit(costs(mean))
    if not may_have_turned(int(fitting.sum()), fitting.size):
        return joint
    towards, least, best = mean[2] + bearing, least - BETTER, mean
    expected = math.hypot(*(mean[at : at + 2] - mean[:2]))
    reach = max(LEAST_REACH, REACH * math.sqrt(spread))
    for far in np.maximum(expected + reach * SHARES, LEAST_RANGE):
        for angle in towards + TURN_BEARINGS:
            other = mean.copy()
            other[at : at + 2] = seen_from(mean[:3], far, angle)
            cost, _ = fit(costs(other))
            if cost < least:
                best, least = other, cost
    return replace(joint, mean=best)


def fit(costs: Float[np.ndarray, "r n"]) -> tuple[float, Bool[np.ndarray, " r"]]:
    """Return what rows cost together, each as clutter at most, and which are none."""
    least = costs.min(axis=1, initial=0.0)
    return float(least.sum()), least < 0.0


FEW = 3
"""A scan is early if fewer landmarks are known at its end, and no caller was on the map before."""
MOST, SETTLED = 16, 12
"""How many early scans are remembered, and after how many more the map is taken to have settled."""
TURNS = np.linspace(-3.5, 3.5, 141)
"""Turns that are tried, in standard deviations."""
SEPARATION, CLEARER = 0.04, 10.0
"""All turns that are so far from the best [rad] must cost so much more."""
RANGE_SHARE = 0.2
"""Deviation of a range that is taken from the map, as a share of it."""


def direct_row(direct: Int[np.ndarray, " c"], number: int) -> int:
    """Return the row of a caller's direct call, or -1, of the rows of all direct calls."""
    return int(direct[number]) if number < direct.size else -1


def labelled_by_map(
    early: EarlyScan,
    joint: JointGaussian,
    sure: Int[np.ndarray, " s"],
    callers: Mapping[int, int],
    match: Match,
    chances: PlainChances,
) -> Scan:
    """Return an early scan, its callers' rows with labels by a map that is known now.

    In place of the pose of ``joint`` comes that of the early scan, as if the errors of map and
    pose had nothing in common. ``sure``: labels of landmarks that are some; ``callers``: where
    callers stand in the mean, by number, or UNPLACED of those that were elsewhere.
    """
    mean, covariance = joint.mean.copy(), joint.covariance.copy()
    mean[:3], covariance[:3], covariance[:, :3] = early.pose.mean, 0.0, 0.0
    covariance[:3, :3] = early.pose.covariance
    kept = np.flatnonzero(is_among(joint.landmark, sure))
    there, names = 3 + 2 * kept, np.append(joint.landmark[kept], UNLABELLED)
    label, numbers = np.full(early.scan.caller.size, UNLABELLED), early.scan.numbers.copy()
    for number, place in callers.items():
        direct = direct_row(early.direct, number)
        at, rows = place if direct >= 0 else UNPLACED, early.rows
        heard = rows.usable if at == UNPLACED else rows.with_way
        used = np.flatnonzero(heard & (rows.caller == number))
        used = used[used != direct]
        found = _matched(part_of(rows, used, 0.0), (mean, covariance), there, at, match, chances)
        label[used] = names[found]
        if at == UNPLACED:
            used, i = used[found != NOTHING], there[found[found != NOTHING]]
            far = np.hypot(mean[i] - mean[0], mean[i + 1] - mean[1])
            numbers[RANGE, used], numbers[RANGE_STD, used] = far, RANGE_SHARE * far
    return replace(early.scan, landmark=label, numbers=numbers)


def _matched(
    rows: tuple[np.ndarray, ...],
    gaussian: tuple[Float[np.ndarray, " d"], Float[np.ndarray, "d d"]],
    there: Int[np.ndarray, " n"],
    at: int,
    match: Match,
    chances: PlainChances,
) -> Int[np.ndarray, " r"]:
    """Return which landmark each row is of, NOTHING of all if they fit at more than one turn."""
    (mean, _), (spread, variance, left) = gaussian, _turn(*gaussian, there)
    turns = math.sqrt(variance) * TURNS
    means = [mean + spread * (turn / variance) for turn in turns]
    costs = [pair_costs(rows, turned, left, there, at, chances) for turned in means]
    total = np.array([fit(cost)[0] for cost in costs]) + TURNS * TURNS
    best = int(total.argmin())
    others = total[np.abs(turns - turns[best]) > SEPARATION]
    if others.min(initial=0.0) < total[best] + CLEARER:
        return np.full(rows[0].size, NOTHING)
    return match(costs[best], partial(pair_innovations, rows, means[best], left, there, at))


def _turn(
    mean: Float[np.ndarray, " d"],
    covariance: Float[np.ndarray, "d d"],
    there: Int[np.ndarray, " n"],
) -> tuple[Float[np.ndarray, " d"], float, Float[np.ndarray, "d d"]]:
    """Return P a, a^T P a, and the covariance without the turn."""
    dx, dy = mean[there] - mean[0], mean[there + 1] - mean[1]
    squared = there.size * (dx * dx + dy * dy)
    slope = np.zeros(mean.size)
    slope[there], slope[there + 1] = -dy / squared, dx / squared
    slope[:3] = -slope[there].sum(), -slope[there + 1].sum(), -1.0
    spread = covariance @ slope
    variance = float(slope @ spread)
    return spread, variance, covariance - np.outer(spread, spread) / variance
