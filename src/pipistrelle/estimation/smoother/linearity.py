"""When to linearise anew: when measurements are off the lines that stand for them.

Each measurement is linearised at points that stay while the estimate moves. How far the line is
then off the measurement itself is known: it is measured in standard deviations, for what the last
node heard.
"""

import math

import numpy as np
from jaxtyping import Float

from pipistrelle.detection.scans import (
    BEARING,
    BEARING_STD,
    EXCESS_PATH_STD,
    RANGE,
    RANGE_STD,
    SLOPE,
)
from pipistrelle.estimation.measurement import excess_path_slopes, observe
from pipistrelle.estimation.smoother.observations import (
    Point,
    bearing_of,
    point_of,
    view_of,
    write_bearing,
    write_excess_path,
    write_range,
)
from pipistrelle.estimation.smoother.records import Arrays, Places, Points, Rows, Work, work_of
from pipistrelle.geometry import wrap_angle
from pipistrelle.jit import Whole, no_alloc, optimised_once

Off = tuple[Float[np.ndarray, " d"], Float[np.ndarray, " n"]]
"""How far the state of a node and the border are from their points."""


@optimised_once
def nonlinearity(
    rows: Arrays,
    span: tuple[Whole, Whole, Whole],
    places: Arrays,
    points: Points,
    off: Off,
) -> float:
    """Return how far the lines of a node's rows are off at an estimate, the most [deviations].

    ``span``: the node, its first row and the one after its last.
    """
    rows, places, (k, first, last), most = Rows(*rows), Places(*places), span, 0.0
    work, border = work_of(off[0].size, 1, 0), points[1].copy()
    for i in range(1, off[1].size):
        border[i] += off[1][i]
    state = points[0][k] + off[0]
    then, now = (
        view_of(points[0][k], points[1], places, k),
        view_of(state, border, places, k),
    )
    for m in range(first, last):
        numbers, there = rows.numbers[m], point_of(rows.ends[m, 0], k, places, points)
        if there[0] == 0:
            continue
        here = _moved(there, off)
        if not math.isnan(numbers[BEARING]):
            seen = observe(then.x, then.y, then.heading, there[1], there[2])
            sight = observe(now.x, now.y, now.heading, here[1], here[2])
            row = write_bearing(work, then, seen, numbers[SLOPE], there[0])
            line = bearing_of(then, seen, numbers[SLOPE]) + _along(work, row, off)
            angle, far = bearing_of(now, sight, numbers[SLOPE]), sight[0]
            most = max(most, abs(wrap_angle(angle - line)) / numbers[BEARING_STD])
            if not math.isnan(numbers[RANGE]):
                line = seen[0] / then.scale + _along(
                    work, write_range(work, then, seen, there[0]), off
                )
                most = max(most, abs(far / now.scale - line) / numbers[RANGE_STD])
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
    """Return a place where it is believed to be."""
    i, x, y = point
    if i > 0:
        return i, x + off[1][i], y + off[1][i + 1]
    return i, x + off[0][-i], y + off[0][1 - i]


@no_alloc
def _along(work: Work, written: tuple[Whole, Whole], off: Off) -> float:
    """Return how far a row of slopes leads from its point."""
    chain, size = written
    total = 0.0
    for e in range(chain):
        total += work.slope[e] * off[0][work.at[e]]
    for e in range(chain, size):
        if work.at[e] > 0:
            total += work.slope[e] * off[1][work.at[e]]
    return total
