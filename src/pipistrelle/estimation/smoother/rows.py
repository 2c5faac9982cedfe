"""Rows of the normal equations: what a node's measurements say of its state and of the border.

A row of slopes and a misfit is divided by the measurement's standard deviation, and by the root of
Huber's weight. Bearing and range of a landmark have one weight together, an excess path its own.
Rows are gathered (T, G and the border's own information), or, where they know the state far better
than it was known, correct the front one by one.
"""

import math

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
from pipistrelle.estimation.measurement import NEAREST, observe
from pipistrelle.estimation.smoother.observations import (
    Point,
    View,
    bearing_of,
    point_of,
    view_of,
    write_bearing,
    write_excess_path,
    write_range,
)
from pipistrelle.estimation.smoother.records import Front, Noise, Places, Points, Rows, Work
from pipistrelle.estimation.smoother.small_matrices import add_multiple, write
from pipistrelle.geometry import wrap_angle
from pipistrelle.jit import Whole, no_alloc, no_alloc_inlined

LEAST_DEVIATION = 1e-6
"""A measurement counts as no surer [rad, m]."""
ALONE_ABOVE = 1e4
"""Information of a node's rows, over that of its state before, above which each row corrects alone.
All at once they cost a tenth of that, but lose the square of this number in precision."""


@no_alloc
def hear(
    work: Work,
    front: Front,
    span: tuple[Whole, Whole, Whole],
    rows: Rows,
    places: Places,
    points: Points,
    noise: Noise,
) -> float:
    """Gather T, G and the direct information of the rows of a node; return twice their cost.

    ``span``: the node, its first row and the one after its last.
    """
    (k, begin, end), believed, cost, G = span, noise.believed, 0.0, work.G
    work.T[:] = 0.0
    for a in range(G.shape[0]):
        for j in range(G.shape[1]):
            G[a, j] = 0.0
    work.alone[0] = _is_sure(front, span, rows, places, points, noise.damping)
    write(front.C, work.C)
    if noise.damping > 0.0:
        _hold(work, front, noise.damping)
    view = view_of(points[0][k], points[1], places, k)
    for m in range(begin, end):
        numbers, landmark = rows.numbers[m], point_of(rows.ends[m, 0], k, places, points)
        if landmark[0] == 0:
            continue
        if not math.isnan(numbers[BEARING]):
            cost += _hear_direction(work, front, numbers, view, landmark, believed)
        if rows.ends[m, 1] >= 0:
            caller = point_of(rows.ends[m, 1], k, places, points)
            if caller[0] != 0:
                ends = (landmark, caller)
                cost += _hear_excess_path(work, front, numbers, view, ends, believed)
    return cost


@no_alloc_inlined
def _hear_direction(
    work: Work,
    front: Front,
    numbers: Float[np.ndarray, " 8"],
    view: View,
    point: Point,
    believed: float,
) -> float:
    """Add a bearing, and its range if there is one; return what they cost, times two."""
    i, px, py = point
    seen = observe(view.x, view.y, view.heading, px, py)
    across = 1.0 / max(numbers[BEARING_STD], LEAST_DEVIATION)
    off = wrap_angle(bearing_of(view, seen, numbers[SLOPE]) - numbers[BEARING]) * across
    ranged = not math.isnan(numbers[RANGE])
    along = 1.0 / max(numbers[RANGE_STD], LEAST_DEVIATION) if ranged else 0.0
    far = (seen[0] / view.scale - numbers[RANGE]) * along if ranged else 0.0
    less, cost = _huber(off * off + far * far, believed)
    if i > 0 and not work.alone[0] and view.known:
        slopes = less * across * seen[4], less * along, less * across
        _add_direction(work, front, i, seen[2:4], slopes, (less * off, less * far))
        return cost
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
    """Add the rows of a bearing and a range, of a place at column i of the border: as `_add` does.

    ``slopes``: of the bearing by a move across, of the range by one along, of minus the bearing by
    the heading; ``off``: what they are off.
    """
    (c, s), (q, p, h), (b, r), T, G = cosines, slopes, off, work.T, work.G
    xx, xy, yy = (
        q * q * s * s + p * p * c * c,
        (p * p - q * q) * c * s,
        q * q * c * c + p * p * s * s,
    )
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
def _hear_excess_path(
    work: Work,
    front: Front,
    numbers: Float[np.ndarray, " 8"],
    view: View,
    ends: tuple[Point, Point],
    believed: float,
) -> float:
    """Add an excess path over a landmark, from a caller; return what it costs, times two."""
    path, chain, size = write_excess_path(work, view, ends)
    sure = 1.0 / max(numbers[EXCESS_PATH_STD], LEAST_DEVIATION)
    off = (path - numbers[EXCESS_PATH]) * sure
    less, cost = _huber(off * off, believed)
    _add(work, front, chain, size, (less * sure, less * off))
    return cost


@no_alloc
def _huber(squared: float, believed: float) -> tuple[float, float]:
    """Return the root of the weight of a misfit in deviations, and its loss, times two."""
    if squared <= believed * believed:
        return 1.0, squared
    size = math.sqrt(squared)
    return math.sqrt(believed / size), believed * (2.0 * size - believed)


@no_alloc
def _add(work: Work, front: Front, chain: Whole, size: Whole, weight: tuple[float, float]) -> None:
    """Add a row to T, to G and to the information about the border; or correct by it alone.

    ``weight``: by which its slopes are multiplied, and its misfit.
    """
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
    """Correct the front by a row alone: a Kalman filter's correction, without any difference.

    With w the row's slopes by the border, S its variance: the information gains w w^T / S.
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
def _hold(work: Work, front: Front, damping: float) -> None:
    """Hold each number of the state at its point, by a row of its own."""
    for a in range(front.P.shape[0]):
        work.at[0], work.slope[0] = a, math.sqrt(damping)
        _add(work, front, 1, 1, (1.0, 0.0))


@no_alloc
def _is_sure(
    front: Front,
    span: tuple[Whole, Whole, Whole],
    rows: Rows,
    places: Places,
    points: Points,
    damping: float,
) -> bool:
    """Tell whether a node's rows know its state far better than it is known (`ALONE_ABOVE`)."""
    (k, begin, end), x, y = span, points[0][span[0], 0], points[0][span[0], 1]
    turns, moves = damping, damping
    for m in range(begin, end):
        numbers, (i, px, py) = rows.numbers[m], point_of(rows.ends[m, 0], k, places, points)
        if i != 0 and not math.isnan(numbers[BEARING]):
            sure = 1.0 / max(numbers[BEARING_STD], LEAST_DEVIATION) ** 2
            turns += sure
            moves += sure / max((px - x) ** 2 + (py - y) ** 2, NEAREST * NEAREST)
            if not math.isnan(numbers[RANGE]):
                moves += 1.0 / max(numbers[RANGE_STD], LEAST_DEVIATION) ** 2
        if i != 0 and rows.ends[m, 1] >= 0:
            moves += 4.0 / max(numbers[EXCESS_PATH_STD], LEAST_DEVIATION) ** 2
    P = front.P
    return turns * P[2, 2] > ALONE_ABOVE or moves * (P[0, 0] + P[1, 1]) > ALONE_ABOVE
