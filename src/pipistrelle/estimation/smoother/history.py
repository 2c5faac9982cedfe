"""The history of a drive: motion, measurements, and the numbers of the unknowns.

Every label has a *slot*, one as a landmark and another as a caller that moves. A slot that is
placed is a pair of columns of the border, or a part of the chain's state (`records.Places`).
Measurements are kept whether their landmark is placed or not: the elimination leaves out those of a
slot that is nowhere yet, and finds them once it is somewhere.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float, Int

from pipistrelle.detection.scans import BEARING, NUMBERS, Scan
from pipistrelle.estimation.beliefs import Gaussian
from pipistrelle.estimation.measurement import columns_of, excess_paths, timings_of
from pipistrelle.estimation.smoother.preintegration import SMALLEST_STD, Odometry
from pipistrelle.estimation.smoother.records import CALLER, POSE, Arrays
from pipistrelle.estimation.smoother.stack import Stack
from pipistrelle.jit import Whole, kernel

Slot = tuple[int, bool]
"""A label, and whether it is that of a caller that moves."""


@dataclass(frozen=True, slots=True, kw_only=True)
class History:
    """The motion, the measurements and the numbering of the unknowns."""

    legs: Stack  # mean, noise, seconds, rows (`records.Legs`), and first and last control step
    steps: Stack  # mean and covariance of each control step, since the node before it
    rows: Stack  # ends and numbers (`records.Rows`)
    slots: Mapping[Slot, int] = field(default_factory=dict)
    index: Int[np.ndarray, " s"] = field(default_factory=lambda: np.empty(0, np.int64))
    latest: Int[np.ndarray, " s"] = field(default_factory=lambda: np.empty(0, np.int64))
    """Last row of each slot with a bearing, or -1."""
    moves: Int[np.ndarray, " s"] = field(default_factory=lambda: np.empty(0, np.int64))
    placed: tuple[int, ...] = ()
    """Labels of the landmarks in the border, in the order of their columns."""
    known: Arrays
    """Prior knowledge of them (`records.Columns`)."""
    callers: tuple[int, ...] = ()
    """Labels of the moving callers in the chain, in order."""
    first: Int[np.ndarray, " v"] = field(default_factory=lambda: np.empty(0, np.int64))
    begun: Float[np.ndarray, "v 2"] = field(default_factory=lambda: np.empty((0, 2)))

    @property
    def nodes(self) -> int:
        """How many nodes the chain has."""
        return self.legs.size

    @property
    def columns(self) -> int:
        """How many columns the border has, with that of the constant."""
        return 1 + 2 * len(self.placed)

    @property
    def dimension(self) -> int:
        """How many numbers a state of the chain has."""
        return POSE + CALLER * len(self.callers)

    @property
    def motion(self) -> Arrays:
        """How the vehicle came to each node, as `records.Legs`."""
        return self.legs.arrays[:4]

    @property
    def span(self) -> tuple[int, int, int]:
        """The last node, its first row and the one after its last."""
        k = self.nodes - 1
        first, last = self.legs.arrays[3][k].tolist()
        return k, first, last

    def places(self) -> Arrays:
        """Return where each slot stands, as `records.Places` are."""
        return self.index, self.first, self.begun


def begun(pose: Gaussian) -> History:
    """Return the history of a drive that starts at a pose."""
    legs = Stack(
        (
            np.zeros((0, 3)),
            np.zeros((0, 3, 3)),
            np.zeros(0),
            np.zeros((0, 2), np.int64),
            np.zeros((0, 2), np.int64),
        )
    ).extended(1)
    legs.arrays[0][0], legs.arrays[1][0] = pose.mean, _sure(pose.covariance)
    steps = Stack((np.zeros((0, 3)), np.zeros((0, 3, 3))))
    rows = Stack((np.zeros((0, 4), np.int64), np.zeros((0, NUMBERS))))
    known = np.empty((0, 2)), np.empty((0, 3))
    return History(legs=legs, steps=steps, rows=rows, known=known)


def heard_more(history: History, odometry: Odometry, scan: Scan) -> History:
    """Return a history with a node more, at which odometry ends, and a scan heard from there."""
    landmarks, callers, history = _slots_of(history, scan)
    size, latest = len(landmarks), history.latest.copy()
    legs, rows = history.legs.extended(1), history.rows.extended(size)
    k, row, step = history.legs.size, history.rows.size, history.steps.size
    steps = history.steps.extended(len(odometry.mean))
    mean, noise, seconds, heard, ends = legs.arrays
    mean[k], noise[k], seconds[k] = 0.0, 0.0, odometry.seconds
    heard[k], ends[k] = (row, rows.size), (step, steps.size)
    if odometry.moves():
        mean[k], noise[k] = odometry.mean[-1], _sure(odometry.covariance[-1])
    steps.arrays[0][step : steps.size] = odometry.mean
    steps.arrays[1][step : steps.size] = odometry.covariance
    which, numbers = rows.arrays[0][row : rows.size], rows.arrays[1][row : rows.size]
    which[:, 0], which[:, 1], which[:, 2] = landmarks, callers, k
    numbers[:] = scan.numbers.T
    _link(which, numbers, latest, row)
    return replace(history, legs=legs, steps=steps, rows=rows, latest=latest)


@kernel
def _link(
    ends: Int[np.ndarray, "m 4"],
    numbers: Float[np.ndarray, "m 7"],
    latest: Int[np.ndarray, " s"],
    first: Whole,
) -> None:
    """Write of each row the row of its landmark's bearing before, and which is the latest."""
    for m in range(ends.shape[0]):
        ends[m, 3] = -1
        if not math.isnan(numbers[m, BEARING]):
            ends[m, 3] = latest[ends[m, 0]]
            latest[ends[m, 0]] = first + m


def _slots_of(history: History, scan: Scan) -> tuple[list[int], list[int], History]:
    """Return the slots of landmarks and callers (-1: none) of a scan, and a history with them."""
    labels, callers, slots = scan.landmark.tolist(), [-1] * scan.landmark.size, history.slots
    if (timings := timings_of(scan)) is not None:
        found = excess_paths(columns_of(scan), timings)
        for row, caller in zip(found.row.tolist(), found.caller.tolist(), strict=True):
            callers[row] = caller
    moving = {*scan.moving.tolist(), *history.callers}
    wanted = {(label, label in moving) for label in (*labels, *callers) if label >= 0}
    if new := sorted(wanted.difference(slots)):
        slots = {**slots, **{slot: len(slots) + n for n, slot in enumerate(new)}}
        history = _with_slots(history, slots)
    return (
        [slots[label, label in moving] for label in labels],
        [-1 if label < 0 else slots[label, label in moving] for label in callers],
        history,
    )


def _with_slots(history: History, slots: Mapping[Slot, int]) -> History:
    """Return a history with slots more, which are nowhere yet."""
    count = len(slots) - len(history.slots)
    more = np.array([moves for _, moves in slots], np.int64)[-count:]
    return replace(
        history,
        slots=slots,
        index=np.append(history.index, np.zeros(count, np.int64)),
        latest=np.append(history.latest, np.full(count, -1)),
        moves=np.append(history.moves, more),
    )


def with_places(
    history: History,
    labels: Sequence[int],
    mean: Float[np.ndarray, "l 2"],
    information: Float[np.ndarray, "l 3"],
) -> History:
    """Return a history with landmarks in the border, of which something is known beforehand."""
    slots, index = dict(history.slots), history.index
    for label in labels:
        slots.setdefault((label, False), len(slots))
    if len(slots) > len(history.slots):
        history = _with_slots(history, slots)
    index = history.index.copy()
    for number, label in enumerate(labels):
        index[slots[label, False]] = history.columns + 2 * number
    known = tuple(map(np.concatenate, zip(history.known, (mean, information), strict=True)))
    return replace(history, index=index, placed=(*history.placed, *labels), known=known)


def with_caller(history: History, label: int, place: Float[np.ndarray, "2"]) -> History:
    """Return a history with a moving caller in the chain, from the last node on."""
    index = history.index.copy()
    index[history.slots[label, True]] = -history.dimension
    return replace(
        history,
        index=index,
        callers=(*history.callers, label),
        first=np.append(history.first, history.nodes - 1),
        begun=np.concatenate([history.begun, place[None]]),
    )


def _sure(covariance: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3 3"]:
    """Return a covariance that is not singular (`SMALLEST_STD`)."""
    return covariance + SMALLEST_STD**2 * np.eye(3)
