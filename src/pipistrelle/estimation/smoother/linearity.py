"""When to linearise anew: when measurements are off the lines that stand for them.

Each measurement is linearised at points that stay while the estimate moves. How far the line is
then off the measurement itself is known: it is measured in standard deviations, for what the last
node heard.
"""

import math

import numpy as np
from jaxtyping import Float

from pipistrelle.detection.scans import BEARING, BEARING_STD, EXCESS_PATH_STD, RANGE, RANGE_STD
from pipistrelle.estimation.measurement import excess_path_slopes, observe
from pipistrelle.estimation.smoother.records import Arrays, Places, Points, Rows
from pipistrelle.estimation.smoother.rows import point_of
from pipistrelle.geometry import wrap_angle
from pipistrelle.jit import Whole, kernel

Point = tuple[Whole, float, float]


@kernel
def nonlinearity(
    rows: Arrays,
    span: tuple[Whole, Whole, Whole],
    places: Arrays,
    points: Points,
    estimate: Points,
) -> float:
    """Return how far the lines of a node's rows are off at an estimate, the most [deviations].

    ``span``: the node, its first row and the one after its last. Of ``estimate`` the state is that
    of this node alone.
    """
    rows, places, (k, first, last), most = Rows(*rows), Places(*places), span, 0.0
    at, state = points[0][k], estimate[0]
    for m in range(first, last):
        numbers, there = rows.numbers[m], point_of(rows.ends[m, 0], k, places, points)
        if there[0] == 0:
            continue
        here = _estimated(there[0], state, estimate[1])
        if not math.isnan(numbers[BEARING]):
            most = max(most, _off_direction(numbers, at, state, there, here))
        if rows.ends[m, 1] >= 0:
            caller = point_of(rows.ends[m, 1], k, places, points)
            if caller[0] != 0:
                call = _estimated(caller[0], state, estimate[1])
                off = _off_excess_path(at, state, (there, caller), (here, call))
                most = max(most, abs(off) / numbers[EXCESS_PATH_STD])
    return most


@kernel
def _estimated(
    i: Whole, state: Float[np.ndarray, " d"], border: Float[np.ndarray, " n"]
) -> tuple[float, float]:
    """Return the place that stands at an index (`Places`)."""
    return (border[i], border[i + 1]) if i > 0 else (state[-i], state[1 - i])


@kernel
def _off_direction(
    numbers: Float[np.ndarray, " 7"],
    at: Float[np.ndarray, " d"],
    state: Float[np.ndarray, " d"],
    there: Point,
    here: tuple[float, float],
) -> float:
    """Return how far the line of a bearing is off, or that of its range, the greater."""
    distance, bearing, c, s, inverse = observe(at[0], at[1], at[2], there[1], there[2])
    far, angle, _, _, _ = observe(state[0], state[1], state[2], here[0], here[1])
    dx, dy = here[0] - there[1] - state[0] + at[0], here[1] - there[2] - state[1] + at[1]
    line = bearing + inverse * (c * dy - s * dx) - wrap_angle(state[2] - at[2])
    off = abs(wrap_angle(angle - line)) / numbers[BEARING_STD]
    if math.isnan(numbers[RANGE]):
        return off
    return max(off, abs(far - distance - c * dx - s * dy) / numbers[RANGE_STD])


@kernel
def _off_excess_path(
    at: Float[np.ndarray, " d"],
    state: Float[np.ndarray, " d"],
    there: tuple[Point, Point],
    here: tuple[tuple[float, float], tuple[float, float]],
) -> float:
    """Return how far the line of an excess path is off [m]."""
    (_, px, py), (_, bx, by) = there
    path, lx, ly, cx, cy = excess_path_slopes(at[0], at[1], px, py, bx, by)
    (qx, qy), (ax, ay) = here
    now = excess_path_slopes(state[0], state[1], qx, qy, ax, ay)[0]
    dx, dy = state[0] - at[0], state[1] - at[1]
    line = lx * (qx - px - dx) + ly * (qy - py - dy) + cx * (ax - bx - dx) + cy * (ay - by - dy)
    return now - path - line
