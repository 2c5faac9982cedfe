r"""Find the position of a caller that is not on the map, and label early scans by a later map.

**Search** (`searched`). Given the caller's position, bearing and excess path of a measurement fix a
point, and the points of a landmark coincide over time only for the true position. A grid of ranges
and bearings about the direct call is scored by the robust misfit of all tracks (`misfit`: points as
weighted means, heading errors as medians over tracks, residuals capped at :math:`3 \sigma`), and
the best node is refined by a pattern search. It is accepted if every position at another range fits
much worse. For a moving caller, the begin, middle and end of a parabolic trajectory are searched:
bearings alone locate fixed landmarks as the vehicle moves, so that excess paths determine the
caller's velocity and acceleration.

**Turns** (`turned`). Estimators model a caller's velocity as a random walk, and lag behind a sharp
turn. Where few of its measurements match the map, positions about its direct call are tried.

**Early scans** (`labelled_by_map`). Excess paths determine landmarks only after the scan in which
the caller's range is first given. Earlier scans are matched later to the settled map; they fix its
rotation, as the heading is known best at the start. The map is first rotated relative to the
vehicle to the best common fit (`_turn`), as the heading error exceeds that of bearings. With the
mean bearing of all landmarks :math:`\beta = a^T x` of the variance :math:`a^T P a`, a rotation by
:math:`\delta` changes mean and covariance to

.. math:: x + \frac{P a}{a^T P a}\, \delta, \qquad
          P - \frac{P a a^T P}{a^T P a}
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
from pipistrelle.estimation.data_association.rows import (
    TURN,
    CallerPlace,
    CallerState,
    EarlyScan,
    Tracks,
    in_window,
    part_of,
)
from pipistrelle.geometry import wrap_angle
from pipistrelle.jit import kernel, no_alloc

SCANS, SIGHTINGS, LEAST_TRACKS = 14, 4, 8
"""Scans of the window, sightings that make a track count, and tracks required."""
RANGES = np.geomspace(2.5, 45.0, 22)
"""Ranges of the grid [m]."""
BEARINGS = np.array([-0.1, -0.05, 0.0, 0.05, 0.1])
"""Bearings of the grid relative to the direct call [rad]."""
ANOTHER, CLEARLY, WELL = math.log(1.5), 25.0, 2.6
"""Log ratio of distinct ranges, margin of misfit between them, largest misfit per measurement."""
DIRECT_STD, LEAST_BEARING_STD, LEAST_WAY_STD = 0.05, 0.01, 0.05
"""Floors of standard deviations: direct call [rad], other bearings [rad], excess paths [m]."""
FARTHEST, NEAREST = 80.0, 0.05
"""Largest range of a landmark and least distance from the caller [m]."""
FASTEST = 2.0
"""Largest speed of a moving caller [m/s]."""
CAP = 9.0
"""Cap of the misfit of a measurement [squared standard deviations]."""
PASSES, WEIGHINGS = 3, 2
FIRST, FIRST_MOVING = 8, 10
"""Scans before the search for a stationary or a moving caller, repeated every second scan."""
SECOND, LAST, APART, WIDELY = 20, 30, 0.15, math.log(2.0)
"""For a stationary caller, scans before the second search and before it ends; log ratios of the two
ranges from which their mean is taken, and from which only the second counts."""


class Found(NamedTuple):
    """Result of a search for a caller: position, misfit, and margin over other positions."""

    place: CallerPlace
    misfit: float
    """Misfit per measurement."""
    ahead: float
    """Margin by which positions at other ranges fit worse."""
    tracks: int

    @property
    def sure(self) -> bool:
        """Whether the found position is certain enough to be accepted."""
        return self.ahead > CLEARLY and self.misfit < WELL and self.tracks >= LEAST_TRACKS


def searched(caller: CallerState, moves: bool) -> tuple[CallerState, CallerPlace | None]:
    """Search for a caller's position if due; return its record, and the position if it is new.

    A second result is averaged with the first, or replaces it where they differ widely.
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


def _agreed(caller: CallerState, place: CallerPlace) -> CallerState:
    """Fix a caller's position and end its search; return its record."""
    return replace(caller, place=place._replace(agreed=True), tracks=Tracks())


def find_caller(tracks: Tracks) -> Found | None:
    """Find a stationary caller's position from tracked echoes; None without enough data."""
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
    """Find a moving caller's position and motion from tracked echoes; None without enough data."""
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
    """Fit a caller's parabolic trajectory to tracked echoes; return its three points and misfit."""
    node, least, step = begun
    line = np.stack([1.0 - share, share], axis=1)
    node, least = _downhill(node, least, step, line, seen, within)
    middle = 4.0 * share * (1.0 - share)
    curve = np.stack([line[:, 0] - 0.5 * middle, middle, line[:, 1] - 0.5 * middle], axis=1)
    node = np.stack([node[0], 0.5 * (node[0] + node[1]), node[1]])
    return _downhill(node, least, step / 3.0, curve, seen, within)


def _at_end(node: Float[np.ndarray, "3 2"], time: float, took: float) -> CallerPlace:
    """Return position, velocity and acceleration at the end of a parabola through three points."""
    velocity = (node[0] - 4.0 * node[1] + 3.0 * node[2]) / took
    acceleration = 4.0 * (node[0] - 2.0 * node[1] + node[2]) / took**2
    (x, y), (vx, vy), (ax, ay) = (of.tolist() for of in (node[2], velocity, acceleration))
    return CallerPlace(x, y, motion=(vx, vy, ax, ay), time=time)


def _another(ranges: Float[np.ndarray, " n"], distance: float) -> Bool[np.ndarray, " n"]:
    """Return whether each range differs from a distance by more than a fixed ratio."""
    return np.abs(np.log(ranges / distance)) > ANOTHER


def seen_from(pose: Float[np.ndarray, "3"], far: float, angle: float) -> Float[np.ndarray, "2"]:
    """Return the point at a range [m] and a world bearing [rad] from a vehicle pose."""
    return pose[:2] + far * np.array([math.cos(angle), math.sin(angle)])


def _rows(table: Float[np.ndarray, "t k 4"]) -> int:
    """Count the measurements in a table of tracked echoes, without its NaN entries."""
    return int(np.count_nonzero(~np.isnan(table[..., 0])))


def _misfits(
    nodes: list[np.ndarray], weights: Float[np.ndarray, "k n"], seen: tuple[np.ndarray, ...]
) -> Float[np.ndarray, " g"]:
    """Return the misfit to tracked echoes of each candidate trajectory of a caller."""
    return np.array([misfit(weights @ node, *seen) for node in nodes])


def _downhill(
    nodes: Float[np.ndarray, "n 2"],
    least: float,
    step: float,
    weights: Float[np.ndarray, "k n"],
    seen: tuple[np.ndarray, ...],
    within: Callable[[np.ndarray], bool] = lambda nodes: True,
) -> tuple[Float[np.ndarray, "n 2"], float]:
    """Minimise a caller trajectory's misfit by pattern search; return its points and the misfit."""
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
    """Return the robust misfit of a caller's trajectory to all tracked echoes [squared stds]."""
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
    """Return the landmark position that fits a track of echoes; write its bearing residuals."""
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
    """Return the robust misfit of a track's bearings and excess paths to a landmark position."""
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
    """Return a robust mean of points, with less weight for points far from the previous mean."""
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
    """Write the point at a measurement's bearing and excess path, with variances; NaN if none."""
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
    """Correct each scan's heading by its median bearing residual, relative to the last scan."""
    scans = turn.size
    medians = np.zeros(scans)
    for k in range(scans):
        seen = off[:, k][~np.isnan(off[:, k])]
        if seen.size >= 3:
            medians[k] = np.median(seen)
    for k in range(scans):
        turn[k] -= min(max(medians[k] - medians[scans - 1], -0.1), 0.1)


FITTING_SHARE, LEAST_ROWS = 0.5, 6
"""Share of matching measurements below which a caller may have turned, and their least number."""
BETTER = 30.0
"""Margin by which the total cost must fall for a caller to be moved."""
LEAST_REACH, REACH, LEAST_RANGE = 4.0, 3.0, 0.5
"""Searched interval of ranges: floor [m], and multiple of the position's std; least range [m]."""
SHARES, TURN_BEARINGS = np.linspace(-1.0, 1.0, 21), np.linspace(-0.06, 0.06, 7)
"""Search grid: shares of the interval, and bearings relative to the direct call [rad]."""

Costs = Callable[[Float[np.ndarray, " d"]], Float[np.ndarray, "r n"]]
"""Pair costs (`pairs.pair_costs`) as a function of the joint mean."""


def may_have_turned(fitting: int, rows: int) -> bool:
    """Return whether too few of a caller's measurements match landmarks, as after a turn."""
    return rows >= LEAST_ROWS and fitting < FITTING_SHARE * rows


def turned(joint: JointGaussian, at: int, bearing: float, costs: Costs) -> JointGaussian:
    """Return a joint Gaussian with a caller moved to where its echoes match best, if it turned."""
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
    """Return the sum of measurements' least costs (0 for clutter), and a mask of the matched."""
    least = costs.min(axis=1, initial=0.0)
    return float(least.sum()), least < 0.0


FEW = 3
"""A scan is early if it ends with fewer landmarks and no caller was on the map before it."""
MOST, SETTLED = 16, 12
"""Most early scans kept, and scans after them until the map counts as settled."""
TURNS = np.linspace(-3.5, 3.5, 141)
"""Rotations tried [standard deviations]."""
SEPARATION, CLEARER = 0.04, 10.0
"""Rotations farther than the first [rad] from the best must cost more by the second."""
RANGE_SHARE = 0.2
"""Standard deviation of a range taken from the map, as a share of it."""


def direct_row(direct: Int[np.ndarray, " c"], number: int) -> int:
    """Return the measurement index of a caller's direct call in a scan, or -1 without."""
    return int(direct[number]) if number < direct.size else -1


def labelled_by_map(
    early: EarlyScan,
    joint: JointGaussian,
    sure: Int[np.ndarray, " s"],
    callers: Mapping[int, int],
    match: Match,
    chances: PlainChances,
) -> Scan:
    """Return an early scan with labels for the callers' measurements, matched to a later map.

    The early pose replaces that of ``joint``, as if uncorrelated with the map. ``callers``: index
    of each caller in the mean, UNPLACED if it was elsewhere.
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
    """Match measurements to the map after its best rotation; no matches if it is ambiguous."""
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
    """Return gain and variance of a map rotation, and the covariance without its uncertainty."""
    dx, dy = mean[there] - mean[0], mean[there + 1] - mean[1]
    squared = there.size * (dx * dx + dy * dy)
    slope = np.zeros(mean.size)
    slope[there], slope[there + 1] = -dy / squared, dx / squared
    slope[:3] = -slope[there].sum(), -slope[there + 1].sum(), -1.0
    spread = covariance @ slope
    variance = float(slope @ spread)
    return spread, variance, covariance - np.outer(spread, spread) / variance
