"""Delayed initialization: where a landmark or a caller enters, once what is heard of it places it.

A range places what it is of. A landmark without one is placed by an excess path (`tdoa`), or where
two of its bearings cross clearly: of the earlier ones, the newest is crossed with the one that it
crosses most squarely, in front of both poses. The uncertainty along the newest bearing is that of
the other line, and its own, over the sine of their angle. Bearings of a moving caller are not
crossed: they say nothing of where it has gone between them.
"""

import math

import numpy as np
from jaxtyping import Float, Int

from pipistrelle.detection.scans import BEARING, BEARING_STD, RANGE
from pipistrelle.estimation.smoother.observations import direction_of, view_of
from pipistrelle.estimation.smoother.records import Arrays, Front, Places, Points, Rows
from pipistrelle.estimation.smoother.tdoa_initialization import place_by_excess_path
from pipistrelle.jit import Whole, no_alloc, optimised_once

MIN_CROSSING_ANGLE = 0.5
"""Least angle [rad] at which two bearings place a landmark."""
MAX_RELATIVE_PLACE_STD = 0.5
"""Largest standard deviation of the place, divided by the range."""


@optimised_once
def entering_places(
    rows: Arrays,
    span: tuple[Whole, Whole, Whole],
    moves: Int[np.ndarray, " s"],
    places: Arrays,
    estimate: Points,
    front: Arrays,
    R: Float[np.ndarray, "n n"],
) -> Float[np.ndarray, "m 2"]:
    """Return where the landmarks and callers of a frame's rows enter; NaN of those that do not.

    ``span``: the frame's node, its first row and the one after its last. ``estimate``: states of
    all nodes and the border. ``front``: at this node, and the factor of its information.
    """
    rows, places, front = Rows(*rows), Places(*places), Front(*front)
    k, first, last = span
    view, found = (
        view_of(estimate[0][k], estimate[1], places, k),
        np.full((last - first, 2), np.nan),
    )
    for m in range(first, last):
        slot, numbers = rows.ends[m, 0], rows.numbers[m]
        if places.index[slot] != 0 or math.isnan(numbers[BEARING]):
            continue
        away = numbers[RANGE] * view.scale
        if math.isnan(away):
            heard = m, first, last
            away = place_by_excess_path(rows, heard, view, k, places, estimate, front, R)
        if math.isnan(away) and not moves[slot]:
            away = range_by_crossing(rows, m, estimate, places)
        angle = direction_of(view, numbers)
        found[m - first, 0] = view.x + away * math.cos(angle)
        found[m - first, 1] = view.y + away * math.sin(angle)
    return found


@no_alloc
def range_by_crossing(rows: Rows, m: Whole, estimate: Points, places: Places) -> float:
    """Return the range where the bearing of row m clearly crosses an earlier one, or NaN."""
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
