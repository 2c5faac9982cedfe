"""Faces: what the arrays on the vehicle's faces heard of one echo becomes one row.

A face may hear an echo that its neighbour hears too. Detections are averaged per label and caller,
whether the label is a landmark's or, without labels, just a number for the
echo (`same_echo`).
"""

import math
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float, Int

from pipistrelle.detection.certainty import BEARING_FLOOR, EXCESS_PATH_FLOOR, RANGE_FLOOR
from pipistrelle.detection.direct import DirectCalls
from pipistrelle.detection.scans import (
    BEARING,
    BEARING_STD,
    EXCESS_PATH,
    EXCESS_PATH_STD,
    LEVEL,
    NO_CALLERS,
    NUMBERS,
    OWN,
    RANGE,
    RANGE_STD,
    SLOPE,
    UNLABELLED,
    Scan,
)
from pipistrelle.detection.snapshots import Columns, Detections, columns_of
from pipistrelle.geometry import wrap_angle
from pipistrelle.jit import Whole, kernel


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameMeasurements:
    """One frame, averaged over the faces."""

    rows: Scan
    """One row per label and caller, both rising, as the oracle labels detections."""
    clutter: int
    """Number of detections without a label."""
    unlabelled: Scan | None = None
    """The same frame as a robot hears it, a row per echo and no label; None if not asked for."""
    causes: Int[np.ndarray, " e"] = field(default_factory=lambda: NO_CALLERS)
    """Label of the landmark that caused each of those rows, by the oracle, or UNLABELLED."""
    between: bool = False
    """Whether the call came between two calls of the vehicle."""


def average_faces(
    time: float,
    detections: Detections,
    label: Int[np.ndarray, " d"],
    *,
    averaging: str,
    speed_of_sound: float,
    callers: Int[np.ndarray, " c"] = NO_CALLERS,
) -> FrameMeasurements:
    r"""Average the strongest detections of the faces, for each label and caller.

    Bearings are averaged as directions, ``plain`` or ``weighted`` by the inverse variance at the
    array's angle, :math:`\cos^2\theta`. The range, of the vehicle's own call alone, is c/2 times
    the mean delay; the excess path, of another's, c times what the mean delay has over that of its
    direct call. What comes while the direct call still lasts has none: it was heard with it. The
    standard deviations are what the signal tells, and what no level removes (first line). The
    slope of a bearing by the speed of sound is the mean of the faces' own (second line; a face
    hears :math:`\sin\theta` as c times a phase):

    .. math:: \sigma^2 &= \sigma_{signal}^2 + \sigma_{floor}^2 \\
              d\phi / d \ln c &= \sum w \tan\theta / \sum w

    `time` [s]; `detections`: (d) rows; `label`: of each detection, or UNLABELLED; `speed_of_sound`
    [m/s]; `callers`: labels of the callers as landmarks, where they are known.

    Bradley & Abaid, Sec. II-D.

    >>> detections = Detections(
    ...     face=np.array([0, 1]), caller=np.array([0, 0]), angle=np.radians([40.0, -50.0]),
    ...     bearing=np.radians([40.0, 42.0]), delay=np.array([0.02, 0.02]), power=np.ones(2))
    >>> rows = average_faces(
    ...     0.5, detections, np.array([3, 3]), averaging="plain", speed_of_sound=343.0).rows
    >>> np.degrees(rows.bearing).round(6), rows.range.round(6)
    (array([41.]), array([3.43]))
    """
    labels, clutter = _distinct(label)
    found, direct = tuple(columns_of(detections)), tuple(detections.direct or _NO_DIRECT)
    landmark, caller, numbers = _average(
        labels, label, found, direct, averaging == "weighted", speed_of_sound
    )
    rows = Scan(time=time, landmark=landmark, caller=caller, numbers=numbers, callers=callers)
    return FrameMeasurements(rows=rows, clutter=int(clutter))


def same_echo(
    detections: Detections, *, delay_gate: float, bearing_gate: float
) -> Int[np.ndarray, " d"]:
    """Number the echoes: detections of one call by different faces, at one time from one direction.

    The strongest detection begins, and takes of every other face the strongest that agrees with it
    and is not taken.

    `detections`: (d) rows; `delay_gate` [s]; `bearing_gate` [rad]: largest differences within an
    echo. Returns numbers from 0, the strongest echo first.

    >>> detections = Detections(
    ...     face=np.array([0, 1, 1]), caller=np.zeros(3, int), angle=np.radians([40.0, -50.0, 9.0]),
    ...     bearing=np.radians([40.0, 41.0, 99.0]), delay=np.full(3, 0.02), power=np.ones(3))
    >>> same_echo(detections, delay_gate=7e-4, bearing_gate=0.1)
    array([0, 0, 1])
    """
    order = np.argsort(-detections.power, kind="stable")
    found = columns_of(detections)
    return _number(order, found, delay_gate, bearing_gate)


_NO_DIRECT = DirectCalls(np.empty(0, np.int64), np.empty(0), np.empty(0), 0.0)


@kernel
def _distinct(label: Int[np.ndarray, " d"]) -> tuple[Int[np.ndarray, " n"], Whole]:
    """Return the sorted distinct labels, and the number of detections without one."""
    labels, count, clutter = np.empty_like(label), 0, 0
    for d in range(label.size):
        if label[d] == UNLABELLED:
            clutter += 1
            continue
        place = count
        while place > 0 and labels[place - 1] > label[d]:
            place -= 1
        if place > 0 and labels[place - 1] == label[d]:
            continue
        for i in range(count, place, -1):
            labels[i] = labels[i - 1]
        labels[place] = label[d]
        count += 1
    return labels[:count].copy(), clutter


@kernel
def _average(
    labels: Int[np.ndarray, " n"],
    label: Int[np.ndarray, " d"],
    detections: tuple,
    calls: tuple,
    weighted: bool,
    speed_of_sound: float,
) -> tuple[Int[np.ndarray, " m"], Int[np.ndarray, " m"], Float[np.ndarray, "8 m"]]:
    """Average direction and delay of each label and caller over its strongest rows per face.

    Returns label, caller and numbers of each pair that occurs.
    """
    found, direct = Columns(*detections), DirectCalls(*calls)
    faces = callers = 0
    for d in range(label.size):
        faces, callers = max(faces, found.face[d] + 1), max(callers, found.caller[d] + 1)
    landmark = np.empty(labels.size * callers, dtype=np.int64)
    caller, row = np.empty(landmark.size, dtype=np.int64), 0
    numbers = np.full((NUMBERS, landmark.size), np.nan)
    strongest = np.empty(faces, dtype=np.int64)
    for i in range(labels.size):
        for p in range(callers):
            _take_strongest(label, labels[i], p, found, strongest)
            total = east = north = late = loudest = across = along = slope = 0.0
            for f in range(faces):
                d = strongest[f]
                if d >= 0:
                    weight = math.cos(found.angle[d]) ** 2 if weighted else 1.0
                    total += weight
                    east += weight * math.cos(found.bearing[d])
                    north += weight * math.sin(found.bearing[d])
                    late += weight * found.delay[d]
                    slope += weight * math.tan(found.angle[d])
                    across += (weight * found.bearing_std[d]) ** 2
                    along += (weight * found.delay_std[d]) ** 2
                    loudest = max(loudest, found.power[d])
            if total > 0.0:
                landmark[row], caller[row] = labels[i], p
                numbers[BEARING, row] = wrap_angle(math.atan2(north, east))
                floor = BEARING_FLOOR[0] if p == OWN else BEARING_FLOOR[1]
                numbers[BEARING_STD, row] = math.hypot(math.sqrt(across) / total, floor)
                delay, spread = late / total, math.sqrt(along) / total
                delay = _after(direct, p, delay, spread) if p != OWN else (delay, spread)
                _write_way(numbers, row, p == OWN, delay, speed_of_sound)
                numbers[SLOPE, row] = slope / total
                numbers[LEVEL, row] = 10.0 * math.log10(loudest)
                row += 1
    return landmark[:row], caller[:row], numbers[:, :row].copy()


@kernel
def _write_way(
    numbers: Float[np.ndarray, "8 m"],
    row: Whole,
    own: bool,
    delay: tuple[float, float],
    speed_of_sound: float,
) -> None:
    """Write the range of the vehicle's own call by its delay, the excess path of another's."""
    late, spread = delay
    if own:
        metres = 0.5 * speed_of_sound
        numbers[RANGE, row] = metres * late
        numbers[RANGE_STD, row] = math.hypot(metres * spread, RANGE_FLOOR)
    else:
        numbers[EXCESS_PATH, row] = speed_of_sound * late
        numbers[EXCESS_PATH_STD, row] = math.hypot(speed_of_sound * spread, EXCESS_PATH_FLOOR)


@kernel
def _take_strongest(
    label: Int[np.ndarray, " d"],
    wanted: Whole,
    caller: Whole,
    found: Columns,
    strongest: Int[np.ndarray, " f"],
) -> None:
    """Write the index of each face's strongest detection of a label and a caller; -1 for none."""
    strongest[:] = -1
    for d in range(label.size):
        if label[d] == wanted and found.caller[d] == caller:
            best = strongest[found.face[d]]
            if best < 0 or found.power[d] > found.power[best]:
                strongest[found.face[d]] = d


@kernel
def _after(direct: DirectCalls, caller: Whole, delay: float, std: float) -> tuple[float, float]:
    """Return the delay of a sound after the caller's direct call [s], and its standard deviation.

    NaN where the direct call is not known, or still lasts.
    """
    if caller >= direct.delay.size or not delay - direct.delay[caller] >= direct.pulse:
        return math.nan, math.nan
    return delay - direct.delay[caller], math.hypot(std, direct.delay_std[caller])


@kernel
def _number(
    order: Int[np.ndarray, " d"], found: Columns, delay_gate: float, bearing_gate: float
) -> Int[np.ndarray, " d"]:
    """Number the echoes, greedily, in an order of the detections."""
    number, count = np.full(order.size, UNLABELLED, dtype=np.int64), 0
    for first in order:
        if number[first] != UNLABELLED:
            continue
        for d in order:
            if number[d] != UNLABELLED or found.caller[d] != found.caller[first]:
                continue
            late = abs(found.delay[d] - found.delay[first])
            off = abs(wrap_angle(found.bearing[d] - found.bearing[first]))
            taken = False
            for other in order:
                taken |= number[other] == count and found.face[other] == found.face[d]
            if late <= delay_gate and off <= bearing_gate and not taken:
                number[d] = count
        count += 1
    return number
