"""Initialisation of landmarks and callers in the smoother, delayed until their range is certain.

A measured range initialises at once. Otherwise an excess path gives the range along the bearing: of
a landmark if the caller is initialised, of a caller if the landmark is (`estimation.measurement`).
It is strongly nonlinear near the line from vehicle to caller, so its uncertainty is an unscented
transform of offset, bearing and excess path (eight sigma points at two standard deviations; Julier
& Uhlmann 1997), unknown if a sigma point has no range. Without it, a landmark is initialised where
its newest bearing clearly crosses an earlier bearing; the standard deviation along the newest
combines both lines over the sine of their angle. Moving callers' bearings are not crossed.
"""

import math

import numpy as np
from jaxtyping import Float, Int

from pipistrelle.detection.scans import BEARING, BEARING_STD, EXCESS_PATH, EXCESS_PATH_STD, RANGE
from pipistrelle.estimation.measurement import (
    MIN_TDOA_SIGMAS,
    range_by_excess_path,
)
from pipistrelle.estimation.smoother.observations import View, direction_of, point_of, view_of
from pipistrelle.estimation.smoother.records import (
    Arrays,
    Front,
    Places,
    PointArrays,
    Rows,
    cholesky,
)
from pipistrelle.estimation.smoother.solution import joint
from pipistrelle.jit import Whole, kernel, no_alloc, optimised_once

MAX_RELATIVE_RANGE_STD = 0.2
"""Largest standard deviation of a range from an excess path, relative to the range."""
MAX_RANGE = 1e6
"""Largest valid range [m]."""


@kernel
def excess_path_range(
    rows: Rows,
    heard: tuple[Whole, Whole, Whole],
    view: View,
    k: Whole,
    places: Places,
    estimate: PointArrays,
    front: Front,
    R: Float[np.ndarray, "n n"],
) -> float:
    """Return the range of a landmark or caller from its most precise excess path, or NaN."""
    m, first, last = heard
    slot, scale = rows.ends[m, 0], view.scale
    angle, across = direction_of(view, rows.numbers[m]), rows.numbers[m, BEARING_STD]
    spread, way, best, other = np.zeros((4, 4)), np.zeros(4), math.inf, -1
    clue, caller = -1, False
    for e in range(first, last):
        asked, ends = rows.ends[e, 1] == slot, (rows.ends[e, 0], rows.ends[e, 1])
        if ends[1] < 0 or not (asked or ends[0] == slot):
            continue
        i, x, y = point_of(ends[0] if asked else ends[1], k, places, estimate)
        if i == 0:
            continue
        way[0], way[1], way[2] = x - view.x, y - view.y, angle
        way[3] = scale * rows.numbers[e, EXCESS_PATH]
        spread[2, 2], spread[3, 3] = across * across, rows.numbers[e, EXCESS_PATH_STD] ** 2
        share = unscented_range(way, spread, asked)[1]
        if share < best:
            best, other, clue, caller = share, ends[0] if asked else ends[1], e, asked
    if best > MAX_RELATIVE_RANGE_STD:
        return math.nan
    i, x, y = point_of(other, k, places, estimate)
    way[0], way[1] = x - view.x, y - view.y
    way[3] = scale * rows.numbers[clue, EXCESS_PATH]
    spread = _offset_covariance(i, front, R)
    spread[2, 2] += across * across
    spread[3, 3] = rows.numbers[clue, EXCESS_PATH_STD] ** 2
    found, share = unscented_range(way, spread, caller)
    return found if share <= MAX_RELATIVE_RANGE_STD else math.nan


@kernel
def _offset_covariance(
    i: Whole, front: Front, R: Float[np.ndarray, "n n"]
) -> Float[np.ndarray, "4 4"]:
    """Return the 4x4 covariance of vehicle-to-caller offset (2), heading and an unused 0."""
    by_chain, by_border = np.zeros((3, front.P.shape[0])), np.zeros((3, R.shape[0]))
    for a in range(2):
        by_chain[a, a] = -1.0
        if i > 0:
            by_border[a, i + a] = 1.0
        else:
            by_chain[a, a - i] = 1.0
    by_chain[2, 2] = 1.0
    spread = np.zeros((4, 4))
    known = joint(front, R, R.shape[0], by_chain, by_border)
    for a in range(3):
        for b in range(3):
            spread[a, b] = known[a, b]
    return spread


@kernel
def unscented_range(
    way: Float[np.ndarray, "4"], spread: Float[np.ndarray, "4 4"], caller: bool
) -> tuple[float, float]:
    """Return a range from an excess path, and its relative std (infinite if unknown).

    ``way`` (4) is the offset to the other point (2), the direction of the unknown point, and the
    excess path; ``spread`` (4, 4) is their covariance. ``caller`` selects the range of the caller.
    In the example the landmark is at (3, 4), then between the two, and the caller at (6, 0).

    >>> way, spread = np.array([6.0, 0.0, np.arctan2(4.0, 3.0), 4.0]), np.diag([0, 0, 0, 0.01])
    >>> [round(float(number), 3) for number in unscented_range(way, spread, False)]
    [5.0, 0.016]
    >>> unscented_range(np.array([6.0, 0.0, 0.0, 0.0]), spread, False)[1]
    inf
    """
    if way[3] <= MIN_TDOA_SIGMAS * math.sqrt(spread[3, 3]):
        return math.nan, math.inf
    L, at, total = np.zeros((4, 4)), np.empty(4), 0.0
    cholesky(spread, L)
    first = _range(way, caller)
    for e in range(4):
        for side in (-2.0, 2.0):
            for a in range(4):
                at[a] = way[a] + side * L[a, e]
            other = _range(at, caller)
            if not (0.0 < other < MAX_RANGE):
                return math.nan, math.inf
            total += (other - first) ** 2
    if not (0.0 < first < MAX_RANGE):
        return math.nan, math.inf
    return first, math.sqrt(total / 8.0) / first


@no_alloc
def _range(way: Float[np.ndarray, "4"], caller: bool) -> float:
    """Return the range of a landmark or of a caller from an excess path."""
    c, s = math.cos(way[2]), math.sin(way[2])
    return range_by_excess_path(way[3], way[0], way[1], c, s, caller)


MIN_CROSSING_ANGLE = 0.5
"""Least angle [rad] between bearings that initialise a landmark."""
MAX_RELATIVE_PLACE_STD = 0.5
"""Largest standard deviation of a crossing, relative to the range."""


@optimised_once
def entering_places(
    rows: Arrays,
    span: tuple[Whole, Whole, Whole],
    moves: Int[np.ndarray, " s"],
    places: Arrays,
    estimate: PointArrays,
    front: Arrays,
    R: Float[np.ndarray, "n n"],
) -> Float[np.ndarray, "m 2"]:
    """Return initial positions for a frame's landmarks and callers, NaN if still uncertain."""
    rows, places, front = Rows(*rows), Places(*places), Front(*front)
    (k, first, last), found = span, np.full((span[2] - span[1], 2), np.nan)
    view = view_of(estimate[0][k], estimate[1], places, k)
    for m in range(first, last):
        slot, numbers = rows.ends[m, 0], rows.numbers[m]
        if places.index[slot] != 0 or math.isnan(numbers[BEARING]):
            continue
        away = numbers[RANGE] * view.scale
        if math.isnan(away):
            heard = m, first, last
            away = excess_path_range(rows, heard, view, k, places, estimate, front, R)
        if math.isnan(away) and not moves[slot]:
            away = range_by_crossing(rows, m, estimate, places)
        angle = direction_of(view, numbers)
        found[m - first, 0] = view.x + away * math.cos(angle)
        found[m - first, 1] = view.y + away * math.sin(angle)
    return found


@no_alloc
def range_by_crossing(rows: Rows, m: Whole, estimate: PointArrays, places: Places) -> float:
    """Return the range where a bearing clearly crosses an earlier bearing, or NaN."""
    numbers, (poses, border) = rows.numbers[m], estimate
    k = rows.ends[m, 2]
    view = view_of(poses[k], border, places, k)
    angle, best, found = direction_of(view, numbers), math.sin(MIN_CROSSING_ANGLE), math.nan
    earlier = rows.ends[m, 3]
    while earlier >= 0:
        k = rows.ends[earlier, 2]
        there = view_of(poses[k], border, places, k)
        other = direction_of(there, rows.numbers[earlier])
        sine = math.sin(other - angle)
        if abs(sine) >= best:
            dx, dy = there.x - view.x, there.y - view.y
            near = (dx * math.sin(other) - dy * math.cos(other)) / sine
            far = (dx * math.sin(angle) - dy * math.cos(angle)) / sine
            along = far * rows.numbers[earlier, BEARING_STD]
            across = near * numbers[BEARING_STD]
            off = math.sqrt(along * along + across * across)
            if near > 0.0 and far > 0.0 and off <= MAX_RELATIVE_PLACE_STD * near * abs(sine):
                best, found = abs(sine), near
        earlier = rows.ends[earlier, 3]
    return found
