"""The history of a drive: motion, measurements, and what of it is among the unknowns.

Every label has a *slot*, one as a landmark and another as a caller that moves. A slot that is
placed is a place of the border, with a number of its own, or a part of the chain's state.
Measurements are kept whether their landmark is placed or not: the elimination leaves out those of a
slot that is nowhere yet, and finds them once it is somewhere.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from pipistrelle.detection.scans import BEARING, NUMBERS, Scan
from pipistrelle.estimation.beliefs import Gaussian
from pipistrelle.estimation.measurement import columns_of, excess_paths, timings_of
from pipistrelle.estimation.smoother.calibration import NOTHING, Calibration
from pipistrelle.estimation.smoother.preintegration import SMALLEST_STD, Odometry
from pipistrelle.estimation.smoother.records import CALLER, POSE, Arrays
from pipistrelle.estimation.smoother.stack import Stack
from pipistrelle.jit import Whole, kernel

STRETCH = 32
"""Nodes that are eliminated in one go: between stretches landmarks leave the border, and from the
start of any all can be linearised anew."""
NEVER = np.iinfo(np.int64).max
"""Number of a stretch that never comes."""
Slot = tuple[int, bool]
"""A label, and whether it is that of a caller that moves."""


@dataclass(frozen=True, slots=True, kw_only=True)
class History:
    """The motion, the measurements and the numbering of the unknowns."""

    legs: Stack
    """Mean, noise, seconds and rows of `records.Legs`; first control step and the one after the
    last; slopes."""
    steps: Stack  # mean and covariance of each control step, since the node before it; slopes
    rows: Stack  # ends and numbers (`records.Rows`)
    calibration: Calibration = NOTHING
    slots: Mapping[Slot, int] = field(default_factory=dict)
    index: Int[np.ndarray, " s"] = field(default_factory=lambda: np.empty(0, np.int64))
    """Of each slot 1 and its number in the border; minus its index in the chain; 0: nowhere."""
    latest: Int[np.ndarray, " s"] = field(default_factory=lambda: np.empty(0, np.int64))
    """Last row of each slot with a bearing, or -1."""
    heard: Int[np.ndarray, "s 2"] = field(default_factory=lambda: np.empty((0, 2), np.int64))
    """First and last node at which each slot was heard; NEVER and -1 before."""
    moves: Int[np.ndarray, " s"] = field(default_factory=lambda: np.empty(0, np.int64))
    placed: tuple[int, ...] = ()
    """Labels of the landmarks of the border, by their numbers."""
    known: Arrays
    """Prior knowledge of them: mean (l, 2), information xx, xy, yy (l, 3)."""
    leaves: Int[np.ndarray, " l"] = field(default_factory=lambda: np.empty(0, np.int64))
    """Stretches after which they leave the border, or NEVER."""
    callers: tuple[int, ...] = ()
    """Labels of the moving callers in the chain, in order."""
    first: Int[np.ndarray, " v"] = field(default_factory=lambda: np.empty(0, np.int64))
    begun: Float[np.ndarray, "v 2"] = field(default_factory=lambda: np.empty((0, 2)))

    @property
    def nodes(self) -> int:
        """How many nodes the chain has."""
        return self.legs.size

    @property
    def dimension(self) -> int:
        """How many numbers a state of the chain has."""
        return POSE + CALLER * len(self.callers)

    @property
    def motion(self) -> Arrays:
        """How the vehicle came to each node, as `records.Legs`."""
        mean, noise, seconds, rows, _, slopes = self.legs.arrays
        return mean, noise, seconds, rows, slopes

    @property
    def span(self) -> tuple[int, int, int]:
        """The last node, its first row and the one after its last."""
        k = self.nodes - 1
        first, last = self.legs.arrays[3][k].tolist()
        return k, first, last

    @property
    def met(self) -> Int[np.ndarray, " l"]:
        """The node at which each landmark of the border was heard first, or NEVER."""
        return self._of_placed(self.heard[:, 0])

    @property
    def entering(self) -> Int[np.ndarray, " l"]:
        """The stretch in which each landmark of the border is heard first, or one that is none."""
        return self.met // STRETCH

    @property
    def silent(self) -> Int[np.ndarray, " l"]:
        """The node at which each landmark of the border was heard last, or -1."""
        return self._of_placed(self.heard[:, 1])

    def silent_for(self) -> Float[np.ndarray, " l"]:
        """Return how long each landmark of the border has not been heard [s]."""
        time = np.cumsum(self.legs.entries(2))
        return time[-1] - time[np.maximum(self.silent, 0)]

    def _of_placed(self, values: Int[np.ndarray, " s"]) -> Int[np.ndarray, " l"]:
        """Return what the slots of the landmarks of the border have, by their numbers."""
        found, border = np.empty(len(self.placed), np.int64), self.index > 0
        found[self.index[border] - 1] = values[border]
        return found

    def places(self, columns: Int[np.ndarray, " l"]) -> Arrays:
        """Return where each slot stands, as `records.Places`, by the columns of the landmarks."""
        index = self.index
        if columns.size:
            index = np.where(index > 0, columns[np.maximum(index - 1, 0)], index)
        return index, self.first, self.begun, self.calibration.sensor


def begun(pose: Gaussian, calibration: Calibration) -> History:
    """Return the history of a drive that starts at a pose."""
    q = calibration.odometry.size
    legs = Stack(
        (
            np.zeros((0, 3)),
            np.zeros((0, 3, 3)),
            np.zeros(0),
            np.zeros((0, 2), np.int64),
            np.zeros((0, 2), np.int64),
            np.zeros((0, 3, q)),
        )
    ).extended(1)
    legs.arrays[0][0], legs.arrays[1][0] = pose.mean, _sure(pose.covariance)
    steps = Stack((np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros((0, 3, q))))
    rows = Stack((np.zeros((0, 4), np.int64), np.zeros((0, NUMBERS))))
    known = np.empty((0, 2)), np.empty((0, 3))
    return History(legs=legs, steps=steps, rows=rows, calibration=calibration, known=known)


def heard_more(history: History, odometry: Odometry, scan: Scan) -> History:
    """Return a history with a node more, at which odometry ends, and a scan heard from there."""
    landmarks, callers, history = _slots_of(history, scan)
    size, latest, heard = len(landmarks), history.latest.copy(), history.heard.copy()
    legs, rows = history.legs.extended(1), history.rows.extended(size)
    k, row, step = history.legs.size, history.rows.size, history.steps.size
    steps = history.steps.extended(len(odometry.mean))
    mean, noise, seconds, spans, ends, slopes = legs.arrays
    mean[k], noise[k], slopes[k], seconds[k] = 0.0, 0.0, 0.0, odometry.seconds
    spans[k], ends[k] = (row, rows.size), (step, steps.size)
    if odometry.moves():
        mean[k], noise[k] = odometry.mean[-1], _sure(odometry.covariance[-1])
        slopes[k] = odometry.slopes[-1]
    steps.arrays[0][step : steps.size] = odometry.mean
    steps.arrays[1][step : steps.size] = odometry.covariance
    steps.arrays[2][step : steps.size] = odometry.slopes
    which, numbers = rows.arrays[0][row : rows.size], rows.arrays[1][row : rows.size]
    which[:, 0], which[:, 1], which[:, 2] = landmarks, callers, k
    numbers[:] = scan.numbers.T
    _link(which, numbers, latest, heard, row)
    return replace(history, legs=legs, steps=steps, rows=rows, latest=latest, heard=heard)


@kernel
def _link(
    ends: Int[np.ndarray, "m 4"],
    numbers: Float[np.ndarray, "m 7"],
    latest: Int[np.ndarray, " s"],
    heard: Int[np.ndarray, "s 2"],
    first: Whole,
) -> None:
    """Write of each row the row of its landmark's bearing before, and when its slots were heard."""
    for m in range(ends.shape[0]):
        ends[m, 3] = -1
        if not math.isnan(numbers[m, BEARING]):
            ends[m, 3] = latest[ends[m, 0]]
            latest[ends[m, 0]] = first + m
        for end in range(2):
            if ends[m, end] >= 0:
                slot, k = ends[m, end], ends[m, 2]
                heard[slot, 0], heard[slot, 1] = min(heard[slot, 0], k), k


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
        heard=np.concatenate([history.heard, np.tile([NEVER, -1], (count, 1))]),
        moves=np.append(history.moves, more),
    )


def with_places(
    history: History,
    labels: Sequence[int],
    mean: Float[np.ndarray, "l 2"],
    information: Float[np.ndarray, "l 3"],
) -> History:
    """Return a history with landmarks of the border, of which something is known beforehand.

    What was never heard stands there from the start.
    """
    slots = dict(history.slots)
    for label in labels:
        slots.setdefault((label, False), len(slots))
    if len(slots) > len(history.slots):
        history = _with_slots(history, slots)
    index, heard = history.index.copy(), history.heard.copy()
    for number, label in enumerate(labels, start=1 + len(history.placed)):
        slot = slots[label, False]
        index[slot] = number
        if heard[slot, 1] < 0:
            heard[slot] = 0
    known = tuple(map(np.concatenate, zip(history.known, (mean, information), strict=True)))
    leaves = np.append(history.leaves, np.full(len(labels), NEVER))
    placed = (*history.placed, *labels)
    return replace(
        history, index=index, heard=heard, placed=placed, known=known, leaves=leaves
    )


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


def with_leaving(history: History, numbers: Bool[np.ndarray, " l"], stretch: int) -> History:
    """Return a history of which some landmarks leave the border after a stretch."""
    return replace(history, leaves=np.where(numbers, stretch, history.leaves))


def in_hindsight(history: History) -> History:
    """Return a history whose landmarks leave the border once they are heard no more."""
    last = history.silent // STRETCH
    return replace(history, leaves=np.where(last < (history.nodes - 1) // STRETCH, last, NEVER))


def numbers_heard(history: History) -> Int[np.ndarray, " u"]:
    """Return the numbers of the landmarks of the border that the last node heard."""
    _, first, last = history.span
    ends = history.rows.arrays[0][first:last, :2]
    index = history.index[ends[ends >= 0]]
    return index[index > 0] - 1


def _sure(covariance: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3 3"]:
    """Return a covariance that is not singular (`SMALLEST_STD`)."""
    return covariance + SMALLEST_STD**2 * np.eye(3)
