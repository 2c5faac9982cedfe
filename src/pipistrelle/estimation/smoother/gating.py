"""The gate: measurements outside a share of their predicted distribution are dropped.

Bearing and range of a row are judged together. An excess path is judged alone: an error of one,
such as a wrong direct call, says nothing about the other.
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
from pipistrelle.estimation.measurement import observe
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
from pipistrelle.estimation.smoother.records import (
    Arrays,
    Front,
    Places,
    Points,
    Rows,
    Work,
    work_of,
)
from pipistrelle.estimation.smoother.solution import joint
from pipistrelle.geometry import wrap_angle
from pipistrelle.jit import Whole, kernel, no_alloc


@kernel
def drop_outside(
    rows: Arrays,
    span: tuple[Whole, Whole, Whole],
    places: Arrays,
    estimate: Points,
    front: Arrays,
    R: Float[np.ndarray, "n n"],
    bounds: tuple[float, float],
) -> tuple[Whole, float, float]:
    """Make what is outside the gate NaN, in place: a row's bearing and range, or its excess path.

    Returns how many were dropped, and of the directions that passed the sum of squared innovations,
    in deviations, and their degrees of freedom. What is new passes. See `entering_places`.
    """
    rows, places, front = Rows(*rows), Places(*places), Front(*front)
    (k, first, last), (dropped, squared, degrees) = span, (0, 0.0, 0.0)
    work = work_of(front.P.shape[0], 1, 0)
    view = view_of(estimate[0][k], estimate[1], places, k)
    for m in range(first, last):
        point = point_of(rows.ends[m, 0], k, places, estimate)
        if point[0] == 0:
            continue
        numbers = rows.numbers[m]
        if rows.ends[m, 1] >= 0:
            caller = point_of(rows.ends[m, 1], k, places, estimate)
            if caller[0] != 0:
                off = _surprise_of_excess_path(work, numbers, view, (point, caller), front, R)
                if off > bounds[0]:
                    rows.ends[m, 1] = -1
                    dropped += 1
        if math.isnan(numbers[BEARING]):
            continue
        off, size = _surprise_of_direction(work, numbers, view, point, front, R)
        if off > bounds[size - 1]:
            numbers[BEARING] = numbers[RANGE] = np.nan
            dropped += 1
        else:
            squared += off
            degrees += size
    return dropped, squared, degrees


@no_alloc
def _part(
    work: Work,
    written: tuple[Whole, Whole],
    by_chain: Float[np.ndarray, " d"],
    by_border: Float[np.ndarray, " n"],
) -> None:
    """Part a row of slopes in those by the chain and those by the border."""
    chain, size = written
    for e in range(chain):
        by_chain[work.at[e]] += work.slope[e]
    for e in range(chain, size):
        by_border[work.at[e]] += work.slope[e]


@kernel
def _surprise_of_direction(
    work: Work,
    numbers: Float[np.ndarray, " 8"],
    view: View,
    point: Point,
    front: Front,
    R: Float[np.ndarray, "n n"],
) -> tuple[float, Whole]:
    """Return the squared innovation of a bearing, with a range if any, and how many they are."""
    (i, px, py), d, n = point, front.P.shape[0], R.shape[0]
    seen = observe(view.x, view.y, view.heading, px, py)
    off, across = (
        wrap_angle(numbers[BEARING] - bearing_of(view, seen, numbers[SLOPE])),
        numbers[BEARING_STD],
    )
    size = 1 if math.isnan(numbers[RANGE]) else 2
    by_chain, by_border = np.zeros((size, d)), np.zeros((size, n))
    _part(work, write_bearing(work, view, seen, numbers[SLOPE], i), by_chain[0], by_border[0])
    if size == 2:
        _part(work, write_range(work, view, seen, i), by_chain[1], by_border[1])
    S = joint(front, R, n, by_chain, by_border)
    bb = S[0, 0] + across * across
    if size == 1:
        return off * off / bb, 1
    rr, far = S[1, 1] + numbers[RANGE_STD] ** 2, numbers[RANGE] - seen[0] / view.scale
    det = bb * rr - S[1, 0] * S[1, 0]
    return (rr * off * off - 2.0 * S[1, 0] * off * far + bb * far * far) / det, 2


@kernel
def _surprise_of_excess_path(
    work: Work,
    numbers: Float[np.ndarray, " 8"],
    view: View,
    ends: tuple[Point, Point],
    front: Front,
    R: Float[np.ndarray, "n n"],
) -> float:
    """Return the squared innovation of an excess path, divided by its variance."""
    d, n = front.P.shape[0], R.shape[0]
    by_chain, by_border = np.zeros((1, d)), np.zeros((1, n))
    path, chain, size = write_excess_path(work, view, ends)
    _part(work, (chain, size), by_chain[0], by_border[0])
    variance = joint(front, R, n, by_chain, by_border)[0, 0] + numbers[EXCESS_PATH_STD] ** 2
    return (numbers[EXCESS_PATH] - path) ** 2 / variance
