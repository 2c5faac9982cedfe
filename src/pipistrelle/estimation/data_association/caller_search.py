"""Find the position of a caller that is not on the map, or that has turned.

**Search** (`place_caller`). The echoes of a landmark, tracked over scans, agree in its position
only for the true position of the caller. Both are fitted, with the errors of all poses, by
Gauss-Newton; landmarks are eliminated. Its unknowns are the logarithm of the caller's range from
the first pose, its bearing, velocity and acceleration (0 if stationary). Echoes are normal or
outliers of uniform density (`recovery`), softly at first (graduated non-convexity). The position is
returned when the std of its range is small; a constant acceleration serves as few scans are needed.

**Turns** (`turned`). Estimators model a caller's velocity as a random walk, and lag behind a sharp
turn. Where few of its measurements match the map, positions about its direct call are tried.
"""

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float, Int

from pipistrelle.estimation.beliefs import JointGaussian
from pipistrelle.estimation.data_association.existence import WINDOW
from pipistrelle.estimation.data_association.rows import CallerPlace, Model, Tracks, in_window
from pipistrelle.estimation.observations.excess_path import excess_path_slopes, range_by_excess_path
from pipistrelle.estimation.observations.range import NEAREST
from pipistrelle.geometry import wrap_angle
from pipistrelle.jit import kernel, no_alloc

SURE = 0.1
"""Largest relative std of a range that an estimator uses, as it linearises about it."""
MEDIAN, SPREAD, FIELD = 10.0, 1.0, 40.0
"""Prior of a caller's range: median [m] and std of its logarithm; std of the positions of landmarks
about the vehicle [m]."""
STARTS = np.log(np.geomspace(2.5, 45.0, 8))
"""Logarithms of the ranges [m] at which fits begin."""
MOTION, SOFTNESS, PASSES, LEAST_STD = 6, 16.0, 5, 1e-5
"""Numbers of a caller's range, bearing and motion; softness of outliers in the first pass, divided
by 4 in each further (graduated non-convexity); passes; least std of an error [m, rad, m/s]."""

Seen = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]
"""Times [s] (k), poses (k, 3), world bearings of direct calls with stds (k, 2), and for each track
and scan world bearing, excess path and their stds (t, k, 4); NaN where missed."""


def place_caller(tracks: Tracks, moves: bool, model: Model) -> CallerPlace | None:
    """Return a caller's position from tracked echoes, or None if it is uncertain or not due."""
    times, poses, direct, table = in_window(tracks, WINDOW)
    heard = direct[~np.isnan(direct[:, 0]), 0]
    if len(tracks.poses) % 2 or not (len(table) and heard.size):
        return None
    model = model if moves else (*model[:2], 0.0, 0.0, model[4])
    seen, tried = (times - times[0], poses * np.array([1.0, 1.0, 0.0]), direct, table), []
    for start in STARTS.tolist():
        points, unknown = np.full((len(table), 2), np.nan), np.zeros(MOTION + 3 * len(poses))
        unknown[:2] = start, heard[0]
        tried.append((fitted(unknown, points, seen, model, SOFTNESS)[0], unknown, points))
    _, unknown, points = min(tried, key=lambda one: one[0])
    _, std = fitted(unknown, points, seen, model, 1.0)
    if not std < SURE:
        return None
    (x, y), time = seen_from(poses[0], math.exp(unknown[0]), unknown[1]).tolist(), float(times[0])
    vx, vy, ax, ay = unknown[2:MOTION].tolist()
    place = CallerPlace(x, y, motion=(vx, vy, ax, ay), time=time, since=time, std=std)
    return place if moves else CallerPlace(x, y, std=std)


def seen_from(pose: Float[np.ndarray, "3"], far: float, angle: float) -> Float[np.ndarray, "2"]:
    """Return the point at a range [m] and a world bearing [rad] from a vehicle pose."""
    return pose[:2] + far * np.array([math.cos(angle), math.sin(angle)])


@kernel
def fitted(
    unknown: Float[np.ndarray, " u"],
    points: Float[np.ndarray, "t 2"],
    seen: Seen,
    model: Model,
    softness: float,
) -> tuple[float, float]:
    """Fit a caller to tracked echoes by Gauss-Newton, in place; return cost and relative std.

    ``unknown``: logarithm of its range and its bearing from the first pose, velocity, acceleration,
    and the errors of all poses; ``points``: landmarks (NaN: unknown). The std is that of the range.
    """
    (times, poses, _, table), size, tracks = seen, unknown.size, len(points)
    cost, variance, places = math.inf, math.nan, np.empty((len(poses), 2))
    for number in range(PASSES + 1):
        there, start = poses + unknown[MOTION:].reshape(poses.shape), (unknown[0], unknown[1])
        far, ahead = math.exp(start[0]), (math.cos(start[1]), math.sin(start[1]))
        for e in range(2):
            motion = times * (unknown[2 + e] + 0.5 * times * unknown[4 + e])
            places[:, e] = poses[0, e] + far * ahead[e] + motion
        for t in range(tracks if number == 0 or number == PASSES // 2 else 0):
            _write_point(points[t], places, there, table[t], model[4])
        A, g, C = np.zeros((size, size)), np.zeros((size, 2)), np.zeros((tracks + 1, 2, size))
        B = np.zeros((tracks + 1, 5))
        cost = _add_priors((A, g, C[tracks], B[tracks]), unknown, seen, model)
        cost += _add_rows((A, g, C, B), start, points, places, there, seen, model[4], softness)
        cost += _eliminate_points((A, g, C, B), points, poses[0])
        g[0, 1] = 1.0
        variance = _solve(A, g)
        if number < PASSES:
            unknown += g[:, 0]
            for t in range(tracks):
                hx, hy = B[t, 3], B[t, 4]
                for e in range(size):
                    hx, hy = hx - C[t, 0, e] * g[e, 0], hy - C[t, 1, e] * g[e, 0]
                points[t, 0] += B[t, 0] * hx + B[t, 1] * hy
                points[t, 1] += B[t, 1] * hx + B[t, 2] * hy
        softness = max(1.0, 0.25 * softness)
    return cost, math.sqrt(variance)


@no_alloc
def _write_slopes(
    slopes: Float[np.ndarray, "9"],
    start: tuple[float, float],
    time: float,
    by_caller: tuple[float, float],
    by_pose: tuple[float, float, float],
) -> None:
    """Write derivatives by a caller's range, bearing and motion and by a pose."""
    far, c, s, (hx, hy) = math.exp(start[0]), math.cos(start[1]), math.sin(start[1]), by_caller
    slopes[0], slopes[1] = far * (c * hx + s * hy), far * (c * hy - s * hx)
    slopes[2], slopes[3] = time * hx, time * hy
    slopes[4], slopes[5] = 0.5 * time * time * hx, 0.5 * time * time * hy
    slopes[6], slopes[7], slopes[8] = by_pose


@kernel
def _add_priors(
    normal: tuple[np.ndarray, ...], unknown: Float[np.ndarray, " u"], seen: Seen, model: Model
) -> float:
    """Add the priors of a caller's range and motion and of the poses' errors; return the cost."""
    (times, poses, _, _), (along, turn, speed, walk, _) = seen, model
    slopes, index, none = np.ones(3), np.zeros(3, np.int64), (0.0, 0.0)
    cost = _add(normal, index[:1], slopes, none, SPREAD, math.log(MEDIAN) - unknown[0])
    for e in range(2, MOTION + 3):
        index[0], std = e, speed if e < 4 else walk / math.sqrt(times[-1])
        std = max(std, LEAST_STD) if e < MOTION else LEAST_STD
        cost += _add(normal, index[:1], slopes, none, std, -unknown[e])
    for k in range(1, len(poses)):
        (dx, dy, _), now, slopes[1] = poses[k] - poses[k - 1], MOTION + 3 * k, -1.0
        for e in range(3):
            index[0], index[1], index[2] = now + e, now + e - 3, now - 1
            slopes[2] = (dy, -dx, 0.0)[e]
            nu = unknown[now + e - 3] - unknown[now + e] - slopes[2] * unknown[now - 1]
            cost += _add(normal, index, slopes, none, max(turn if e == 2 else along, LEAST_STD), nu)
    return cost


@kernel
def _add_rows(
    normal: tuple[np.ndarray, ...],
    start: tuple[float, float],
    points: Float[np.ndarray, "t 2"],
    places: Float[np.ndarray, "k 2"],
    there: Float[np.ndarray, "k 3"],
    seen: Seen,
    clutter: float,
    softness: float,
) -> float:
    """Add tracked echoes and direct calls to the normal equations; return their robust cost."""
    (A, g, C, B), (times, _, direct, table), tracks = normal, seen, len(points)
    index, slopes, cost, none = np.arange(MOTION + 3), np.empty(MOTION + 3), 0.0, (0.0, 0.0)
    for k in range(len(there)):
        (px, py, turn), place, (bearing, std) = there[k], places[k], direct[k]
        index[MOTION:] = MOTION + 3 * k + np.arange(3)
        if not math.isnan(bearing):
            off, by = _off_bearing(bearing + turn, place[0] - px, place[1] - py)
            most = math.log(2.0 * math.pi / (std * std))
            weight, lost = _weighed(((off / std) ** 2, most), softness)
            _write_slopes(slopes, start, times[k], by, (-by[0], -by[1], -1.0))
            _add((A, g, C[tracks], B[tracks]), index, slopes, none, std / weight, off)
            cost += lost
        for t in range(tracks):
            if not math.isnan(table[t, k, 0]):
                row = table[t, k]
                found = _off_echo(row, there[k], place, points[t], clutter)
                off, by, late, (lx, ly, cx, cy), costs = found
                weight, lost = _weighed(costs, softness)
                _write_slopes(slopes, start, times[k], none, (-by[0], -by[1], -1.0))
                _add((A, g, C[t], B[t]), index, slopes, by, row[2] / weight, off)
                _write_slopes(slopes, start, times[k], (cx, cy), (-lx - cx, -ly - cy, 0.0))
                _add((A, g, C[t], B[t]), index, slopes, (lx, ly), row[3] / weight, late)
                cost += lost
    return cost


@no_alloc
def _off_bearing(bearing: float, dx: float, dy: float) -> tuple[float, tuple[float, float]]:
    """Return the residual of a bearing to a point, and its derivatives by the point."""
    squared = max(dx * dx + dy * dy, NEAREST * NEAREST)
    return wrap_angle(bearing - math.atan2(dy, dx)), (-dy / squared, dx / squared)


@no_alloc
def _off_echo(
    row: Float[np.ndarray, "4"],
    pose: Float[np.ndarray, "3"],
    place: Float[np.ndarray, "2"],
    point: Float[np.ndarray, "2"],
    clutter: float,
) -> tuple[float, tuple[float, float], float, tuple[float, ...], tuple[float, float]]:
    """Return an echo's residuals with derivatives, and the costs of an echo and of an outlier."""
    x, y, px, py = pose[0], pose[1], point[0], point[1]
    off, by = _off_bearing(row[0] + pose[2], px - x, py - y)
    path, lx, ly, cx, cy = excess_path_slopes(x, y, px, py, place[0], place[1])
    late, most = row[1] - path, -2.0 * math.log(2.0 * math.pi * clutter * row[2] * row[3])
    return off, by, late, (lx, ly, cx, cy), ((off / row[2]) ** 2 + (late / row[3]) ** 2, most)


@no_alloc
def _weighed(costs: tuple[float, float], softness: float) -> tuple[float, float]:
    """Return the root of a measurement's weight, and its cost, normal or as an outlier."""
    ahead = 0.5 * (costs[1] - costs[0])
    rare = math.exp(-abs(ahead) / softness)
    weight = (1.0 if ahead > 0.0 else rare) / (1.0 + rare)
    return math.sqrt(weight), min(costs) - 2.0 * math.log1p(math.exp(-abs(ahead)))


@no_alloc
def _add(
    normal: tuple[np.ndarray, ...],
    index: Int[np.ndarray, " s"],
    slopes: Float[np.ndarray, " s"],
    by_point: tuple[float, float],
    std: float,
    residual: float,
) -> float:
    """Add a residual with its derivatives to the normal equations; return its square."""
    (A, g, C, B), (lx, ly), weight = normal, by_point, 1.0 / (std * std)
    for a in range(index.size):
        i, share = index[a], weight * slopes[a]
        g[i, 0] += share * residual
        C[0, i], C[1, i] = C[0, i] + share * lx, C[1, i] + share * ly
        for b in range(index.size):
            A[i, index[b]] += share * slopes[b]
    B[0], B[1], B[2] = B[0] + weight * lx * lx, B[1] + weight * lx * ly, B[2] + weight * ly * ly
    B[3], B[4] = B[3] + weight * lx * residual, B[4] + weight * ly * residual
    return weight * residual * residual


@kernel
def _eliminate_points(
    normal: tuple[np.ndarray, ...], points: Float[np.ndarray, "t 2"], pose: Float[np.ndarray, "3"]
) -> float:
    """Eliminate landmarks from the normal equations, with their prior; return its cost."""
    (A, g, C, B), cost, none = normal, 0.0, np.empty(0, np.int64)
    for t in range(len(points)):
        for e in range(2):
            way = (1.0, 0.0) if e == 0 else (0.0, 1.0)
            cost += _add((A, g, C[t], B[t]), none, pose, way, FIELD, pose[e] - points[t, e])
        xx, xy, yy, hx, hy = B[t]
        det = xx * yy - xy * xy
        xx, xy, yy = yy / det, -xy / det, xx / det
        B[t, 0], B[t, 1], B[t, 2] = xx, xy, yy
        for i in range(len(A)):
            sx, sy = xx * C[t, 0, i] + xy * C[t, 1, i], xy * C[t, 0, i] + yy * C[t, 1, i]
            if sx != 0.0 or sy != 0.0:
                g[i, 0] -= sx * hx + sy * hy
                for j in range(i, len(A)):
                    A[i, j] -= sx * C[t, 0, j] + sy * C[t, 1, j]
    return cost


@no_alloc
def _solve(A: Float[np.ndarray, "u u"], g: Float[np.ndarray, "u 2"]) -> float:
    """Solve for the first column by the upper triangle; return the variance of the second."""
    size, variance = len(A), 0.0
    for e in range(size):
        variance += g[e, 1] * g[e, 1] / A[e, e]
        for i in range(e + 1, size):
            share = A[e, i] / A[e, e]
            if share != 0.0:
                g[i, 0], g[i, 1] = g[i, 0] - share * g[e, 0], g[i, 1] - share * g[e, 1]
                for j in range(i, size):
                    A[i, j] -= share * A[e, j]
    for e in range(size - 1, -1, -1):
        for j in range(e + 1, size):
            g[e, 0] -= A[e, j] * g[j, 0]
        g[e, 0] /= A[e, e]
    return variance


@kernel
def _write_point(
    point: Float[np.ndarray, "2"],
    places: Float[np.ndarray, "k 2"],
    there: Float[np.ndarray, "k 3"],
    rows: Float[np.ndarray, "k 4"],
    clutter: float,
) -> None:
    """Write the point of a track's measurements that fits all best, unless it fits best already."""
    least, tried, heard = math.inf, point.copy(), np.flatnonzero(~np.isnan(rows[:, 0]))
    for one in range(-1, heard.size):
        if one >= 0:
            k = heard[one]
            angle, (dx, dy) = rows[k, 0] + there[k, 2], places[k] - there[k, :2]
            c, s, path = math.cos(angle), math.sin(angle), max(rows[k, 1], rows[k, 3])
            far = min(range_by_excess_path(path, dx, dy, c, s, False), FIELD)
            tried[0], tried[1] = there[k, 0] + far * c, there[k, 1] + far * s
        cost = 0.0
        for k in heard:
            cost += _weighed(_off_echo(rows[k], there[k], places[k], tried, clutter)[4], 1.0)[1]
        if cost < least and not math.isnan(tried[0]):
            point[:], least = tried, cost


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
