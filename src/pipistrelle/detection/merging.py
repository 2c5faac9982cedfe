"""Merging: detections -> measurements, what the faces, then the callers' tones say of one landmark.

Faces are averaged per label and caller, whether the label is a landmark's or, where nobody tells
whose an echo is, just a number for the echo (`same_echo`). A sensing strategy then takes the rows
of some callers, and of the rows of one landmark is made one.
"""

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from pipistrelle.config import Strategy
from pipistrelle.detection.scans import COLUMNS, OWN, UNLABELLED, Scan, make_scan
from pipistrelle.detection.snapshots import Detections
from pipistrelle.geometry import wrap_angle
from pipistrelle.jit import Whole, kernel

LISTENS_TO = {"active": (True, False), "fused": (True, True), "passive": (False, True)}
"""Whether a strategy takes what the vehicle's own call, and what the others' calls bring back."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Heard:
    """One frame, averaged over the faces.

    Attributes
    ----------
    rows : Scan
        A row per label and caller, both rising.
    clutter : int
        Detections without a label.
    """

    rows: Scan
    clutter: int


def average_faces(
    time: float,
    detections: Detections,
    label: Int[np.ndarray, " d"],
    *,
    averaging: str,
    speed_of_sound: float,
) -> Heard:
    r"""Average what the faces say of each label, per caller: the strongest detection of each face.

    Bearings are averaged as directions, ``plain`` or ``weighted`` by the inverse variance at the
    array's angle, :math:`\cos^2\theta`. The range, of the vehicle's own call alone, is c/2 times
    the mean delay.

    Parameters
    ----------
    time : [s]
    detections : Detections
        (d) rows.
    label : (d)
        Of each detection, or UNLABELLED.
    averaging : "plain" or "weighted"
    speed_of_sound : [m/s]

    Returns
    -------
    Heard

    Notes
    -----
    Bradley & Abaid, Sec. II-D.

    Examples
    --------
    >>> detections = Detections(
    ...     face=np.array([0, 1]), caller=np.array([0, 0]), angle=np.radians([40.0, -50.0]),
    ...     bearing=np.radians([40.0, 42.0]), delay=np.array([0.02, 0.02]), power=np.ones(2))
    >>> rows = average_faces(
    ...     0.5, detections, np.array([3, 3]), averaging="plain", speed_of_sound=343.0).rows
    >>> np.degrees(rows.bearing).round(6), rows.range.round(6)
    (array([41.]), array([3.43]))
    """
    labels, clutter = _distinct(label)
    found = _Found(
        detections.face, detections.caller, detections.angle, detections.bearing, detections.delay,
        detections.power,
    )  # fmt: skip
    landmark, caller, bearing, delay, level = _average(
        labels, label, found, averaging == "weighted"
    )
    distance = 0.5 * speed_of_sound * np.where(caller == OWN, delay, np.nan)
    rows = make_scan(time, landmark, bearing, caller=caller, range=distance, level_db=level)
    return Heard(rows=rows, clutter=int(clutter))


def same_echo(
    detections: Detections, *, delay_gate: float, bearing_gate: float
) -> Int[np.ndarray, " d"]:
    """Number the echoes: detections of one call by different faces, at one time from one direction.

    The strongest detection begins, and takes of every other face the strongest that agrees with it
    and is not taken.

    Parameters
    ----------
    detections : Detections
        (d) rows.
    delay_gate : [s]
    bearing_gate : [rad]
        Largest differences within an echo.

    Returns
    -------
    (d)
        Numbers from 0, the strongest echo first.

    Examples
    --------
    >>> detections = Detections(
    ...     face=np.array([0, 1, 1]), caller=np.zeros(3, int), angle=np.radians([40.0, -50.0, 9.0]),
    ...     bearing=np.radians([40.0, 41.0, 99.0]), delay=np.full(3, 0.02), power=np.ones(3))
    >>> same_echo(detections, delay_gate=7e-4, bearing_gate=0.1)
    array([0, 0, 1])
    """
    order = np.argsort(-detections.power, kind="stable")
    found = _Found(
        detections.face, detections.caller, detections.angle, detections.bearing, detections.delay,
        detections.power,
    )  # fmt: skip
    return _number(order, found, delay_gate, bearing_gate)


def unlabelled(heard: Heard) -> Heard:
    """Forget the labels.

    Parameters
    ----------
    heard : Heard

    Returns
    -------
    Heard

    Examples
    --------
    >>> heard = Heard(rows=make_scan(0.5, np.array([4]), np.array([0.2])), clutter=0)
    >>> unlabelled(heard).rows.landmark
    array([-1])
    """
    nobody = np.full_like(heard.rows.landmark, UNLABELLED)
    return replace(heard, rows=replace(heard.rows, landmark=nobody))


def scan_of(heard: Heard, strategy: Strategy) -> Scan:
    """Take from a frame what a sensing strategy takes.

    Active takes what the vehicle's own call brings back, passive what those of others do, fused
    both: of the rows of one landmark it makes one (`fused`).

    Parameters
    ----------
    heard : Heard
    strategy : "active", "fused" or "passive"

    Returns
    -------
    Scan

    Examples
    --------
    >>> rows = make_scan(0.5, np.array([2, 2, 5]), np.array([0.2, 0.4, 1.0]),
    ...                  caller=np.array([0, 1, 1]), range=np.array([4.0, np.nan, np.nan]))
    >>> heard = Heard(rows=rows, clutter=0)
    >>> scan_of(heard, "fused").bearing.round(9).tolist()
    [0.3, 1.0]
    >>> scan_of(heard, "active").landmark.tolist()
    [2]
    """
    own, others = LISTENS_TO[strategy]
    rows = heard.rows
    return Scan(time=rows.time, **_fuse(_columns(rows), own, others, False)._asdict())


def labelled(scan: Scan, label: Int[np.ndarray, " m"]) -> Scan:
    """Give a scan's rows their labels: one row of each landmark's, and none that has no label.

    The bearing is the mean of the rows', as independent estimates; the rest is that of the first.

    Parameters
    ----------
    scan : Scan
    label : (m)

    Returns
    -------
    Scan
        The very same where nothing is to be done.

    Examples
    --------
    >>> scan = make_scan(0.5, np.full(3, UNLABELLED), np.array([0.2, 0.4, 1.0]), bearing_std=0.1)
    >>> told = labelled(scan, np.array([7, 7, UNLABELLED]))
    >>> told.landmark, told.bearing.round(9), told.bearing_std.round(4)
    (array([7]), array([0.3]), array([0.0707]))
    """
    if label is scan.landmark and _settled(label):
        return scan
    named = replace(scan, landmark=label)
    return Scan(time=scan.time, **_fuse(_columns(named), True, True, True)._asdict())


class _Found(NamedTuple):
    """Detections, as the kernels take them."""

    face: Int[np.ndarray, " d"]
    caller: Int[np.ndarray, " d"]
    angle: Float[np.ndarray, " d"]
    bearing: Float[np.ndarray, " d"]
    delay: Float[np.ndarray, " d"]
    power: Float[np.ndarray, " d"]


class _Columns(NamedTuple):
    """A scan, as the kernels take it; the fields in the order of `COLUMNS`."""

    landmark: Int[np.ndarray, " m"]
    caller: Int[np.ndarray, " m"]
    bearing: Float[np.ndarray, " m"]
    range: Float[np.ndarray, " m"]
    detour: Float[np.ndarray, " m"]
    bearing_std: Float[np.ndarray, " m"]
    range_std: Float[np.ndarray, " m"]
    detour_std: Float[np.ndarray, " m"]
    level_db: Float[np.ndarray, " m"]


def _columns(scan: Scan) -> _Columns:
    """Return a scan as the kernels take it."""
    return _Columns(*(getattr(scan, name) for name in COLUMNS))


@kernel
def _distinct(label: Int[np.ndarray, " d"]) -> tuple[Int[np.ndarray, " n"], Whole]:
    """Labels that occur, rising, and how often none was given."""
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
    labels: Int[np.ndarray, " n"], label: Int[np.ndarray, " d"], found: _Found, weighted: bool
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Mean direction and delay of each label and caller over its strongest rows per face.

    Returns label, caller, bearing, delay and the level of the strongest, a row for each pair that
    occurs.
    """
    faces = callers = 0
    for d in range(label.size):
        faces, callers = max(faces, found.face[d] + 1), max(callers, found.caller[d] + 1)
    landmark = np.empty(labels.size * callers, dtype=np.int64)
    caller = np.empty(landmark.size, dtype=np.int64)
    bearing, delay = np.empty(landmark.size), np.empty(landmark.size)
    level, row = np.empty(landmark.size), 0
    strongest = np.empty(faces, dtype=np.int64)
    for i in range(labels.size):
        for p in range(callers):
            strongest[:] = -1
            for d in range(label.size):
                if label[d] == labels[i] and found.caller[d] == p:
                    best = strongest[found.face[d]]
                    if best < 0 or found.power[d] > found.power[best]:
                        strongest[found.face[d]] = d
            total = east = north = late = loudest = 0.0
            for f in range(faces):
                d = strongest[f]
                if d >= 0:
                    weight = math.cos(found.angle[d]) ** 2 if weighted else 1.0
                    total += weight
                    east += weight * math.cos(found.bearing[d])
                    north += weight * math.sin(found.bearing[d])
                    late += weight * found.delay[d]
                    loudest = max(loudest, found.power[d])
            if total > 0.0:
                landmark[row], caller[row] = labels[i], p
                bearing[row] = wrap_angle(math.atan2(north, east))
                delay[row], level[row] = late / total, 10.0 * math.log10(loudest)
                row += 1
    return landmark[:row], caller[:row], bearing[:row], delay[:row], level[:row]


@kernel
def _number(
    order: Int[np.ndarray, " d"], found: _Found, delay_gate: float, bearing_gate: float
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


@kernel
def _settled(label: Int[np.ndarray, " m"]) -> bool:
    """Whether every row has a label, and none the label of another."""
    for m in range(label.size):
        if label[m] == UNLABELLED:
            return False
        for other in range(m):
            if label[other] == label[m]:
                return False
    return True


@kernel
def _fuse(rows: _Columns, own: bool, others: bool, labels_only: bool) -> _Columns:
    """Take the rows of some callers and make one row of those of each landmark.

    Rows without a label stay as they are, or are left out.
    """
    most = rows.landmark.size
    landmark, caller = np.empty(most, np.int64), np.empty(most, np.int64)
    numbers = np.empty((7, most))
    first, total = np.empty(most), np.zeros((2, most))  # of each landmark's bearing
    merged, count = np.zeros(most, np.int64), 0
    for m in range(most):
        label = rows.landmark[m]
        if not (own if rows.caller[m] == OWN else others) or (labels_only and label == UNLABELLED):
            continue
        k = count
        while k > 0 and label != UNLABELLED and landmark[k - 1] != label:
            k -= 1
        if k > 0 and label != UNLABELLED:
            k -= 1
        else:
            k, count = count, count + 1
            first[k], landmark[k], caller[k] = rows.bearing[m], label, rows.caller[m]
            numbers[:, k] = np.nan
        merged[k] += 1
        total[0, k] += wrap_angle(rows.bearing[m] - first[k])
        total[1, k] += rows.bearing_std[m] * rows.bearing_std[m]
        _take(numbers, k, rows, m)
    for k in range(count):
        if merged[k] > 1:
            share = 1.0 / merged[k]
            numbers[0, k] = wrap_angle(first[k] + share * total[0, k])
            numbers[3, k] = share * math.sqrt(total[1, k])
    return _Columns(
        landmark[:count], caller[:count], numbers[0, :count], numbers[1, :count],
        numbers[2, :count], numbers[3, :count], numbers[4, :count], numbers[5, :count],
        numbers[6, :count],
    )  # fmt: skip


@kernel
def _take(numbers: Float[np.ndarray, "7 m"], k: Whole, rows: _Columns, m: Whole) -> None:
    """Take of a row what its landmark does not have yet, and the level where it is higher."""
    if math.isnan(numbers[0, k]):
        numbers[0, k], numbers[3, k] = rows.bearing[m], rows.bearing_std[m]
    if math.isnan(numbers[1, k]):
        numbers[1, k], numbers[4, k] = rows.range[m], rows.range_std[m]
    if math.isnan(numbers[2, k]):
        numbers[2, k], numbers[5, k] = rows.detour[m], rows.detour_std[m]
    if not numbers[6, k] >= rows.level_db[m]:
        numbers[6, k] = rows.level_db[m]
