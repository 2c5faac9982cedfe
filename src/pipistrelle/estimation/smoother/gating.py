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
)
from pipistrelle.estimation.measurement import excess_path_slopes, observe
from pipistrelle.estimation.smoother.records import Arrays, Front, Places, Points, Rows
from pipistrelle.estimation.smoother.rows import point_of
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
    for m in range(first, last):
        point = point_of(rows.ends[m, 0], k, places, estimate)
        if point[0] == 0:
            continue
        numbers = rows.numbers[m]
        if rows.ends[m, 1] >= 0:
            caller = point_of(rows.ends[m, 1], k, places, estimate)
            if caller[0] != 0:
                off = _surprise_of_excess_path(numbers, estimate[0][k], (point, caller), front, R)
                if off > bounds[0]:
                    rows.ends[m, 1] = -1
                    dropped += 1
        if math.isnan(numbers[BEARING]):
            continue
        off, size = _surprise_of_direction(numbers, estimate[0][k], point, front, R)
        if off > bounds[size - 1]:
            numbers[BEARING] = numbers[RANGE] = np.nan
            dropped += 1
        else:
            squared += off
            degrees += size
    return dropped, squared, degrees


@no_alloc
def _write(
    by_chain: Float[np.ndarray, " d"],
    by_border: Float[np.ndarray, " n"],
    i: Whole,
    x: float,
    y: float,
) -> None:
    """Write slopes by a place where it stands."""
    if i > 0:
        by_border[i], by_border[i + 1] = x, y
    else:
        by_chain[-i], by_chain[1 - i] = x, y


@kernel
def _surprise_of_direction(
    numbers: Float[np.ndarray, " 7"],
    pose: Float[np.ndarray, " d"],
    point: tuple[Whole, float, float],
    front: Front,
    R: Float[np.ndarray, "n n"],
) -> tuple[float, Whole]:
    """Return the squared innovation of a bearing, with a range if any, and how many they are."""
    (i, px, py), d, n = point, front.P.shape[0], R.shape[0]
    distance, bearing, c, s, inverse = observe(pose[0], pose[1], pose[2], px, py)
    off, across = wrap_angle(numbers[BEARING] - bearing), numbers[BEARING_STD]
    size = 1 if math.isnan(numbers[RANGE]) else 2
    by_chain, by_border = np.zeros((size, d)), np.zeros((size, n))
    by_chain[0, 0], by_chain[0, 1], by_chain[0, 2] = s * inverse, -c * inverse, -1.0
    _write(by_chain[0], by_border[0], i, -s * inverse, c * inverse)
    if size == 2:
        by_chain[1, 0], by_chain[1, 1] = -c, -s
        _write(by_chain[1], by_border[1], i, c, s)
    S = joint(front, R, n, by_chain, by_border)
    bb = S[0, 0] + across * across
    if size == 1:
        return off * off / bb, 1
    rr, far = S[1, 1] + numbers[RANGE_STD] ** 2, numbers[RANGE] - distance
    det = bb * rr - S[1, 0] * S[1, 0]
    return (rr * off * off - 2.0 * S[1, 0] * off * far + bb * far * far) / det, 2


@kernel
def _surprise_of_excess_path(
    numbers: Float[np.ndarray, " 7"],
    pose: Float[np.ndarray, " d"],
    ends: tuple[tuple[Whole, float, float], tuple[Whole, float, float]],
    front: Front,
    R: Float[np.ndarray, "n n"],
) -> float:
    """Return the squared innovation of an excess path, divided by its variance."""
    ((i, px, py), (j, bx, by)), d, n = ends, front.P.shape[0], R.shape[0]
    path, lx, ly, cx, cy = excess_path_slopes(pose[0], pose[1], px, py, bx, by)
    by_chain, by_border = np.zeros((1, d)), np.zeros((1, n))
    by_chain[0, 0], by_chain[0, 1] = -lx - cx, -ly - cy
    _write(by_chain[0], by_border[0], i, lx, ly)
    _write(by_chain[0], by_border[0], j, cx, cy)
    variance = joint(front, R, n, by_chain, by_border)[0, 0] + numbers[EXCESS_PATH_STD] ** 2
    return (numbers[EXCESS_PATH] - path) ** 2 / variance
