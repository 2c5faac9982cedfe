r"""Measurement models of the smoother: residuals, Jacobians and normal equations of a node.

**Model.** A sensor with offset l and rotation :math:`\delta` on a vehicle at (p, :math:`\theta`) is
at :math:`p + R(\theta) l` with heading :math:`\theta + \delta`. A clock delay :math:`\tau` moves it
back to :math:`p - \tau R(\theta - \tfrac12 \tau \omega) v`, :math:`\theta - \tau \omega`, with the
velocities v and :math:`\omega` of the motion to the node; callers count as stationary meanwhile. If
the true speed of sound is k times the assumed, a range r or an excess path is measured as r / k,
and a bearing is off by its slope (`Scan`) times k - 1 plus the lean parameter. A sensor with the
range scale 1 + e and the range bias b measures a range as (1 + e) r / k + b.

**Normal equations.** Jacobian rows are divided by the measurement's standard deviation, and
multiplied by the root of the Huber weight (joint for bearing and range, separate for excess paths).
They are accumulated (T, G, separator information), or, if far more precise than the prior state,
applied individually. Linearisation points are kept until the linear model deviates too far from the
measurement model (`nonlinearity`).
"""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from pipistrelle.detection.scans import (
    BEARING,
    BEARING_STD,
    EXCESS_PATH,
    EXCESS_PATH_STD,
    RANGE,
    RANGE_STD,
    SLOPE,
)
from pipistrelle.estimation.motion import SMALLEST_STD
from pipistrelle.estimation.observations.bearing import bearing_slopes, observe
from pipistrelle.estimation.observations.excess_path import excess_path_slopes
from pipistrelle.estimation.observations.range import (
    MIN_SPACING,
    NEAREST,
    Place,
    Ranges,
    Slopes,
    located,
    range_slopes,
)
from pipistrelle.estimation.observations.rows import robust_loss
from pipistrelle.estimation.smoother.records import (
    CALLER,
    POSE,
    Arrays,
    Border,
    ChainState,
    Front,
    NoiseModel,
    Places,
    PointArrays,
    Rows,
    Span,
    Work,
    add_multiple,
    work_of,
    write,
)
from pipistrelle.geometry import wrap_angle
from pipistrelle.jit import Whole, kernel, no_alloc, no_alloc_inlined, optimised_once

MISFIT = POSE
"""Entry of a Jacobian row for its residual, before moving callers' entries are inserted."""
Point = tuple[Whole, float, float]
"""Unknown of a position (as `Places.index`), and x and y [m]."""
Seen = tuple[float, float, float, float, float]
"""Range, bearing, cosines and inverse range of a point, from `observations.bearing.observe`."""


class View(NamedTuple):
    """Sensor pose at a scan, with the calibration parameters that affect its measurements."""

    x: float
    y: float
    heading: float
    c: float  # cosine and sine of the vehicle's heading
    s: float
    away_x: float  # offset from the vehicle in world axes [m]
    away_y: float
    by_late: tuple[float, float, float]  # derivative of the sensor pose by the clock delay
    scale: float  # true over assumed speed of sound, k
    lean: float  # multiplier of the bearings' slopes, about k - 1
    longer: float  # range scale, 1 + e
    bias: float  # range bias b [m]
    columns: tuple[Whole, Whole, Whole, Whole, Whole, Whole]  # as in `Places.sensor`
    known: bool  # whether no sensor parameter is estimated


@no_alloc
def view_of(pose: ChainState, border: Border, places: Places, k: Whole) -> View:
    """Return the sensor's pose and calibration at scan k, given the vehicle's pose."""
    sensor = places.sensor
    sound, turned, place, clock = sensor[0], sensor[1], sensor[2], sensor[3]
    heading, x, y = pose[2], 0.0, 0.0
    back = (0.0, 0.0, 0.0, 0.0, 0.0)
    if clock > 0 and places.seconds[k] > 0.0:
        back = _steps_back(heading, border[clock], places.way[k], places.seconds[k])
        heading += border[clock] * back[4]
    c, s = math.cos(heading), math.sin(heading)
    if place > 0:
        x = c * border[place] - s * border[place + 1]
        y = s * border[place] + c * border[place + 1]
    by_late = back[2] - back[4] * y, back[3] + back[4] * x, back[4]
    if clock > 0:
        x, y = x + back[0], y + back[1]
    heading += border[turned] if turned > 0 else 0.0
    off = border[sound] if sound > 0 else 0.0
    lean = off + border[sound + 1] if sound > 0 else 0.0
    at = pose[0] + x, pose[1] + y, heading
    longer = 1.0 + border[sensor[4]] if sensor[4] > 0 else 1.0
    bias = border[sensor[5]] if sensor[5] > 0 else 0.0
    columns = sound, turned, place, clock, sensor[4], sensor[5]
    known = sensor.sum() == 0
    return View(*at, c, s, x, y, by_late, 1.0 + off, lean, longer, bias, columns, known)


@no_alloc
def _steps_back(
    heading: float, late: float, way: Float[np.ndarray, " 3"], seconds: float
) -> tuple[float, float, float, float, float]:
    """Return a vehicle's displacement during the clock delay, and its derivatives by the delay."""
    half = 0.5 * way[2]
    along = half / math.tan(half) if abs(half) > 1e-9 else 1.0
    ahead = (along * way[0] + half * way[1]) / seconds
    left = (along * way[1] - half * way[0]) / seconds
    turn = 0.5 * late * way[2] / seconds
    c, s = math.cos(heading - turn), math.sin(heading - turn)
    x, y = -(c * ahead - s * left), -(s * ahead + c * left)
    return late * x, late * y, x + turn * y, y - turn * x, -way[2] / seconds


@no_alloc
def point_of(slot: Whole, k: Whole, places: Places, points: PointArrays) -> Point:
    """Return a landmark's or caller's index among the unknowns and position at scan k, or zeros."""
    i, (at, border) = places.index[slot], points
    if i > 0:
        return i, border[i], border[i + 1]
    if i < 0 and k >= places.first[(-i - POSE) // CALLER]:
        return i, at[k, -i], at[k, -i + 1]
    return 0, 0.0, 0.0


@no_alloc
def bearing_of(view: View, seen: Seen, slope: float) -> float:
    """Return the predicted bearing [rad] of a point, corrected for the speed of sound."""
    return seen[1] if math.isnan(slope) else seen[1] - slope * view.lean


@no_alloc
def direction_of(view: View, numbers: Float[np.ndarray, " 8"]) -> float:
    """Return a measured bearing as a world direction [rad], corrected for the speed of sound."""
    angle = view.heading + numbers[BEARING]
    return angle if math.isnan(numbers[SLOPE]) else angle + numbers[SLOPE] * view.lean


@no_alloc
def range_of(view: View, distance: float) -> float:
    """Return the predicted range [m] at a distance from the sensor."""
    return view.longer * distance / view.scale + view.bias


@no_alloc
def distance_of(view: View, measured: float) -> float:
    """Return the distance from the sensor [m] that a range measures."""
    return (measured - view.bias) / view.longer * view.scale


@no_alloc
def write_bearing(
    work: Work, view: View, seen: Seen, slope: float, i: Whole
) -> tuple[Whole, Whole]:
    """Write a Jacobian row: the derivatives of a bearing by pose, parameters and measured point.

    This and the following functions return the number of chain entries and of all entries.
    """
    by_pose, lean = bearing_slopes(seen[2], seen[3], seen[4]), 0.0 if math.isnan(slope) else -slope
    size = _write_view(work, view, by_pose, (lean, lean, 0.0, 0.0))
    return _write_point(work, POSE, size, i, -by_pose[0], -by_pose[1])


@no_alloc
def write_range(work: Work, view: View, seen: Seen, i: Whole) -> tuple[Whole, Whole]:
    """Write a Jacobian row: the derivatives of a range by pose, parameters and measured point."""
    k, (by_x, by_y, _) = 1.0 / view.scale, range_slopes(seen[2], seen[3])
    far = seen[0] * k
    by_sensor = -view.longer * far * k, 0.0, far, 1.0
    k *= view.longer
    size = _write_view(work, view, (k * by_x, k * by_y, 0.0), by_sensor)
    return _write_point(work, POSE, size, i, -k * by_x, -k * by_y)


@no_alloc
def write_excess_path(
    work: Work, view: View, ends: tuple[Point, Point]
) -> tuple[float, Whole, Whole]:
    """Write a Jacobian row with an excess path's derivatives; return its prediction and lengths."""
    (i, px, py), (j, bx, by) = ends
    path, lx, ly, cx, cy = excess_path_slopes(view.x, view.y, px, py, bx, by)
    k = 1.0 / view.scale
    by_sensor = -path * k * k, 0.0, 0.0, 0.0
    size = _write_view(work, view, (-k * (lx + cx), -k * (ly + cy), 0.0), by_sensor)
    chain, size = _write_point(work, POSE, size, i, k * lx, k * ly)
    chain, size = _write_point(work, chain, size, j, k * cx, k * cy)
    return path * k, chain, size


@no_alloc
def _write_view(
    work: Work, view: View, by_pose: Slopes, by_sensor: tuple[float, float, float, float]
) -> Whole:
    """Convert derivatives by the sensor's pose to derivatives by vehicle's pose and parameters.

    ``by_sensor``: derivatives by speed of sound, lean, range scale and range bias.
    """
    at, slope, size, (by_x, by_y, by_heading) = work.at, work.slope, MISFIT + 1, by_pose
    sound, turned, place, clock, longer, bias = view.columns
    for a in range(POSE):
        at[a] = a
    slope[0], slope[1] = by_x, by_y
    slope[2] = by_heading + (by_y * view.away_x - by_x * view.away_y)
    at[MISFIT], slope[MISFIT] = 0, 0.0
    if sound > 0:
        at[size], at[size + 1] = sound, sound + 1
        slope[size], slope[size + 1] = by_sensor[0], by_sensor[1]
        size += 2
    if turned > 0:
        at[size], slope[size] = turned, by_heading
        size += 1
    if place > 0:
        at[size], at[size + 1] = place, place + 1
        slope[size] = view.c * by_x + view.s * by_y
        slope[size + 1] = view.c * by_y - view.s * by_x
        size += 2
    if clock > 0:
        late_x, late_y, turn = view.by_late
        at[size], slope[size] = clock, by_x * late_x + by_y * late_y + by_heading * turn
        size += 1
    if longer > 0:
        at[size], slope[size] = longer, by_sensor[2]
        size += 1
    if bias > 0:
        at[size], slope[size] = bias, by_sensor[3]
        size += 1
    return size


@no_alloc
def _write_point(
    work: Work, chain: Whole, size: Whole, i: Whole, by_x: float, by_y: float
) -> tuple[Whole, Whole]:
    """Insert a measurement's derivatives by a point's position into its Jacobian row."""
    if i > 0:
        work.at[size], work.at[size + 1] = i, i + 1
        work.slope[size], work.slope[size + 1] = by_x, by_y
        return chain, size + 2
    for e in range(size - 1, chain - 1, -1):
        work.at[e + 2], work.slope[e + 2] = work.at[e], work.slope[e]
    work.at[chain], work.at[chain + 1] = -i, 1 - i
    work.slope[chain], work.slope[chain + 1] = by_x, by_y
    return chain + 2, size + 2


Off = tuple[ChainState, Border]
"""Deviation of a node's state and of the separator from their linearisation points."""


@optimised_once
def nonlinearity(rows: Arrays, span: Span, places: Arrays, points: PointArrays, off: Off) -> float:
    """Return the largest linearisation error of a scan's measurements, in standard deviations."""
    rows, places, (k, first, last), most = Rows(*rows), Places(*places), span, 0.0
    work, border = work_of(off[0].size, 1, 0), points[1].copy()
    for i in range(1, off[1].size):
        border[i] += off[1][i]
    state = points[0][k] + off[0]
    then = view_of(points[0][k], points[1], places, k)
    now = view_of(state, border, places, k)
    for m in range(first, last):
        numbers, there = rows.numbers[m], point_of(rows.ends[m, 0], k, places, points)
        if there[0] == 0:
            continue
        here = _moved(there, off)
        seen = observe(then.x, then.y, then.heading, there[1], there[2])
        sight = observe(now.x, now.y, now.heading, here[1], here[2])
        if not math.isnan(numbers[BEARING]):
            row = write_bearing(work, then, seen, numbers[SLOPE], there[0])
            line = bearing_of(then, seen, numbers[SLOPE]) + _along(work, row, off)
            angle = bearing_of(now, sight, numbers[SLOPE])
            most = max(most, abs(wrap_angle(angle - line)) / numbers[BEARING_STD])
        if not math.isnan(numbers[RANGE]):
            row = write_range(work, then, seen, there[0])
            line = range_of(then, seen[0]) + _along(work, row, off)
            most = max(most, abs(range_of(now, sight[0]) - line) / numbers[RANGE_STD])
        if rows.ends[m, 1] >= 0:
            caller = point_of(rows.ends[m, 1], k, places, points)
            if caller[0] != 0:
                path, chain, size = write_excess_path(work, then, (there, caller))
                line, call = path + _along(work, (chain, size), off), _moved(caller, off)
                far = excess_path_slopes(now.x, now.y, here[1], here[2], call[1], call[2])[0]
                most = max(most, abs(far / now.scale - line) / numbers[EXCESS_PATH_STD])
    return most


@no_alloc
def _moved(point: Point, off: Off) -> Point:
    """Move a landmark or caller from its linearisation point to its current estimate."""
    i, x, y = point
    if i > 0:
        return i, x + off[1][i], y + off[1][i + 1]
    return i, x + off[0][-i], y + off[0][1 - i]


@no_alloc
def _along(work: Work, written: tuple[Whole, Whole], off: Off) -> float:
    """Return a measurement's linearly predicted change from linearisation point to estimate."""
    chain, size = written
    total = 0.0
    for e in range(chain):
        total += work.slope[e] * off[0][work.at[e]]
    for e in range(chain, size):
        if work.at[e] > 0:
            total += work.slope[e] * off[1][work.at[e]]
    return total


ALONE_ABOVE = 1e4
"""Measured over prior information above which updates are individual: batches cost a tenth, but
lose the square of this ratio in precision."""


@no_alloc
def hear(
    work: Work,
    front: Front,
    span: Span,
    rows: Rows,
    places: Places,
    points: PointArrays,
    noise: NoiseModel,
) -> float:
    """Add a scan's measurements to the normal equations; return twice their robust loss."""
    (k, begin, end), cost = span, 0.0
    work.T[:], work.G[:] = 0.0, 0.0
    work.alone[0] = _is_sure(front, span, rows, places, points, noise.damping)
    write(front.C, work.C)
    for a in range(front.P.shape[0] if noise.damping > 0.0 else 0):  # Levenberg
        work.at[0], work.slope[0] = a, math.sqrt(noise.damping)
        _add(work, front, 1, 1, (1.0, 0.0))
    view = view_of(points[0][k], points[1], places, k)
    for m in range(begin, end):
        numbers, landmark = rows.numbers[m], point_of(rows.ends[m, 0], k, places, points)
        if landmark[0] == 0:
            continue
        if not (math.isnan(numbers[BEARING]) and math.isnan(numbers[RANGE])):
            cost += _hear_direction(work, front, numbers, view, landmark, noise.loss)
        if rows.ends[m, 1] >= 0:
            caller = point_of(rows.ends[m, 1], k, places, points)
            if caller[0] != 0:
                path, chain, size = write_excess_path(work, view, (landmark, caller))
                sure = 1.0 / max(numbers[EXCESS_PATH_STD], SMALLEST_STD)
                off = (path - numbers[EXCESS_PATH]) * sure
                less, twice = _robust(off * off, noise.loss)
                _add(work, front, chain, size, (less * sure, less * off))
                cost += twice
    return cost


@no_alloc_inlined
def _hear_direction(
    work: Work,
    front: Front,
    numbers: Float[np.ndarray, " 8"],
    view: View,
    point: Point,
    loss: Whole,
) -> float:
    """Add a bearing, a range or both to the normal equations; return twice their loss."""
    i, px, py = point
    seen = observe(view.x, view.y, view.heading, px, py)
    aimed, ranged = not math.isnan(numbers[BEARING]), not math.isnan(numbers[RANGE])
    across = 1.0 / max(numbers[BEARING_STD], SMALLEST_STD) if aimed else 0.0
    turn = wrap_angle(bearing_of(view, seen, numbers[SLOPE]) - numbers[BEARING]) if aimed else 0.0
    along = 1.0 / max(numbers[RANGE_STD], SMALLEST_STD) if ranged else 0.0
    off, far = turn * across, (range_of(view, seen[0]) - numbers[RANGE]) * along if ranged else 0.0
    less, cost = _robust(off * off + far * far, loss)
    if i > 0 and not work.alone[0] and view.known:
        slopes = less * across * seen[4], less * along, less * across
        _add_direction(work, front, i, seen[2:4], slopes, (less * off, less * far))
        return cost
    if aimed:
        chain, size = write_bearing(work, view, seen, numbers[SLOPE], i)
        _add(work, front, chain, size, (less * across, less * off))
    if ranged:
        chain, size = write_range(work, view, seen, i)
        _add(work, front, chain, size, (less * along, less * far))
    return cost


@no_alloc_inlined
def _add_direction(
    work: Work,
    front: Front,
    i: Whole,
    cosines: tuple[float, float],
    slopes: tuple[float, float, float],
    off: tuple[float, float],
) -> None:
    """Add a bearing and range to the normal equations by closed formulas, faster than `_add`."""
    (c, s), (q, p, h), (b, r), T, G = cosines, slopes, off, work.T, work.G
    xx, yy = q * q * s * s + p * p * c * c, q * q * c * c + p * p * s * s
    xy = (p * p - q * q) * c * s
    xh, yh, xr, yr = -h * q * s, h * q * c, p * c * r - q * s * b, p * s * r + q * c * b
    T[0, 0] += xx
    T[0, 1] += xy
    T[1, 0] += xy
    T[1, 1] += yy
    T[0, 2] += xh
    T[2, 0] += xh
    T[1, 2] += yh
    T[2, 1] += yh
    T[2, 2] += h * h
    G[0, 0] -= xr
    G[1, 0] -= yr
    G[2, 0] -= h * b
    G[0, i] -= xx
    G[0, i + 1] -= xy
    G[1, i] -= xy
    G[1, i + 1] -= yy
    G[2, i] -= xh
    G[2, i + 1] -= yh
    upper, lower = front.information[i], front.information[i + 1]
    upper[0] += xr
    lower[0] += yr
    upper[i] += xx
    lower[i] += xy
    lower[i + 1] += yy
    front.information[0, 0] += b * b + r * r


@no_alloc
def _robust(squared: float, loss: Whole) -> tuple[float, float]:
    """Return the root of a robust loss's weight, and twice the loss, for a squared residual."""
    factor, twice = robust_loss(squared, loss)
    return math.sqrt(1.0 / factor), twice


@no_alloc
def _add(work: Work, front: Front, chain: Whole, size: Whole, weight: tuple[float, float]) -> None:
    """Weight a Jacobian row and add it to the normal equations, or apply it as a Kalman update."""
    at, slope, T, G, information = work.at, work.slope, work.T, work.G, front.information
    for e in range(size):
        slope[e] *= weight[0]
        if e >= chain and at[e] == 0:
            slope[e] = weight[1]
    for a in range(chain):
        for b in range(chain):
            T[at[a], at[b]] += slope[a] * slope[b]
        for b in range(chain, size):
            G[at[a], at[b]] += slope[a] * slope[b]
    if work.alone[0]:
        _correct_by_row(work, front, chain, size)
        return
    for a in range(chain, size):
        for b in range(chain, size):
            if at[a] >= at[b]:
                information[at[a], at[b]] += slope[a] * slope[b]


@no_alloc
def _correct_by_row(work: Work, front: Front, chain: Whole, size: Whole) -> None:
    """Update the newest state with a measurement's Jacobian row, as a Kalman filter does.

    With w its derivatives by the separator and S its variance, the information gains w w^T / S.
    """
    at, slope, P, C, w, gain = work.at, work.slope, front.P, front.C, work.w, work.u
    w[:] = 0.0
    for b in range(chain, size):
        w[at[b]] += slope[b]
    gain[:], S = 0.0, 1.0
    for b in range(chain):
        for a in range(P.shape[0]):
            gain[a] += P[a, at[b]] * slope[b]
        add_multiple(C[at[b]], slope[b], w)
    for b in range(chain):
        S += slope[b] * gain[at[b]]
    for a in range(P.shape[0]):
        share = gain[a] / S
        add_multiple(gain, -share, P[a])
        add_multiple(w, -share, C[a, : w.size])
    for i in range(w.size):
        share = w[i] / S
        if share != 0.0:
            add_multiple(w, share, front.information[i, : i + 1])


@no_alloc
def _is_sure(
    front: Front, span: Span, rows: Rows, places: Places, points: PointArrays, damping: float
) -> bool:
    """Return whether a scan's measurements are far more precise than its predicted pose."""
    (k, begin, end), x, y = span, points[0][span[0], 0], points[0][span[0], 1]
    turns, moves = damping, damping
    for m in range(begin, end):
        numbers, (i, px, py) = rows.numbers[m], point_of(rows.ends[m, 0], k, places, points)
        if i != 0 and not math.isnan(numbers[BEARING]):
            sure = 1.0 / max(numbers[BEARING_STD], SMALLEST_STD) ** 2
            turns += sure
            moves += sure / max((px - x) ** 2 + (py - y) ** 2, NEAREST * NEAREST)
        if i != 0 and not math.isnan(numbers[RANGE]):
            moves += 1.0 / max(numbers[RANGE_STD], SMALLEST_STD) ** 2
        if i != 0 and rows.ends[m, 1] >= 0:
            moves += 4.0 / max(numbers[EXCESS_PATH_STD], SMALLEST_STD) ** 2
    P = front.P
    return turns * P[2, 2] > ALONE_ABOVE or moves * (P[0, 0] + P[1, 1]) > ALONE_ABOVE


MOST = 64
"""Most ranges that place a landmark; their spacing grows by a sixteenth of the way since."""


@kernel
def places_left(
    rows: Arrays,
    m: Whole,
    estimate: PointArrays,
    places: Arrays,
    noise: Float[np.ndarray, "k 3 3"],
    loss: Whole,
) -> tuple[Whole, Place, Place]:
    """Return the number of places that a landmark's ranges up to row m leave, and these.

    An earlier position has the error of dead reckoning since, with isotropic steps.
    """
    rows, places, (poses, border) = Rows(*rows), Places(*places), estimate
    node, count = rows.ends[m, 2], 0
    points, distance, variance = np.empty(2 * MOST), np.empty(MOST), np.empty(MOST)
    at, P = 2 + 2 * np.arange(MOST), np.zeros((2 + 2 * MOST, 2 + 2 * MOST))
    here = view_of(poses[node], border, places, node)
    x, y, way = here.x, here.y, 0.0
    spread = turn = by_x = by_y = xx = xy = yy = 0.0  # of positions; of turns, and its moments
    moments = np.zeros((MOST, 7))
    while m >= 0 and count < MOST:
        while node > rows.ends[m, 2]:
            dx, dy, q = poses[node, 0] - here.x, poses[node, 1] - here.y, noise[node, 2, 2]
            spread += 0.5 * (noise[node, 0, 0] + noise[node, 1, 1])
            turn, by_x, by_y = turn + q, by_x + q * dx, by_y + q * dy
            xx, xy, yy = xx + q * dx * dx, xy + q * dx * dy, yy + q * dy * dy
            node -= 1
            way += math.hypot(poses[node, 0] - here.x - dx, poses[node, 1] - here.y - dy)
        view, std = view_of(poses[node], border, places, node), rows.numbers[m, RANGE_STD]
        far = math.hypot(view.x - x, view.y - y)
        if count == 0 or far >= max(MIN_SPACING * std, way / 16.0):
            x, y = points[2 * count], points[2 * count + 1] = view.x, view.y
            distance[count], variance[count] = distance_of(view, rows.numbers[m, RANGE]), std * std
            moments[count] = np.array((spread, turn, by_x, by_y, xx, xy, yy))
            count += not math.isnan(distance[count])
        m = rows.ends[m, 3]
    for i in range(count):  # a turn moves an earlier position at right angles to its lever
        spread, turn, by_x, by_y, xx, xy, yy = moments[i]
        ix, iy = points[2 * i] - here.x, points[2 * i + 1] - here.y
        for j in range(i, count):
            jx, jy = points[2 * j] - here.x, points[2 * j + 1] - here.y
            a, b = at[i], at[j]
            P[a, b] = spread + iy * jy * turn - (iy + jy) * by_y + yy
            P[a + 1, b + 1] = spread + ix * jx * turn - (ix + jx) * by_x + xx
            P[a, b + 1] = -(iy * jx * turn - iy * by_x - jx * by_y + xy)
            P[a + 1, b] = -(ix * jy * turn - ix * by_y - jy * by_x + xy)
            for u in range(2):
                for v in range(2):
                    P[b + v, a + u] = P[a + u, b + v]
    work = np.empty((MOST + 3, MOST))
    return located(Ranges(points, distance, variance, at, P, count, work), here.x, here.y, loss)
