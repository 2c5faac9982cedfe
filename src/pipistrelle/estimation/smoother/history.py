"""History of a mission in the smoother: motion, measurements and index of unknowns.

Every label has a *slot*, with separate slots for a landmark and for a moving caller. An initialised
slot is a landmark of the separator (`border`) or a part of the chain's state. The measurements of
an uninitialised slot are kept, but skipped by the elimination until it is initialised.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from pipistrelle.detection.scans import BEARING, NUMBERS, RANGE, Scan
from pipistrelle.estimation.beliefs import Gaussian
from pipistrelle.estimation.motion import SMALLEST_STD
from pipistrelle.estimation.observations.rows import caller_labels
from pipistrelle.estimation.smoother.preintegration import NOTHING, Calibration, Led, Odometry
from pipistrelle.estimation.smoother.records import CALLER, POSE, Arrays, PlainLegs, Stack
from pipistrelle.jit import Whole, optimised_once

STRETCH = 64
"""Nodes per segment: landmarks leave the separator, and relinearisation starts, between segments.
"""
NEVER = np.iinfo(np.int64).max
"""Number of a segment that never occurs."""
Slot = tuple[int, bool]
"""A label, and whether it belongs to a moving caller."""


@dataclass(frozen=True, slots=True, kw_only=True)
class History:
    """The smoother's record of a mission: motion, measurements, and index of the unknowns."""

    legs: Stack
    """Columns of `records.Legs` (mean, noise, seconds, measurements), range of control steps,
    Jacobians."""
    steps: Stack  # mean, covariance and Jacobian of each control step since the node before
    rows: Stack  # `records.Rows`
    calibration: Calibration = NOTHING
    slots: Mapping[Slot, int] = field(default_factory=dict)
    index: Int[np.ndarray, " s"] = field(default_factory=lambda: np.empty(0, np.int64))
    """For each slot 1 + its number in the separator, or minus its index in the chain; 0:
    uninitialised."""
    latest: Int[np.ndarray, " s"] = field(default_factory=lambda: np.empty(0, np.int64))
    """Row of each slot's last bearing or range, or -1."""
    heard: Int[np.ndarray, "s 2"] = field(default_factory=lambda: np.empty((0, 2), np.int64))
    """First and last node with a measurement of each slot; NEVER and -1 without."""
    moves: Int[np.ndarray, " s"] = field(default_factory=lambda: np.empty(0, np.int64))
    placed: tuple[int, ...] = ()
    """Labels of the separator's landmarks, by their numbers."""
    known: Arrays
    """Priors of these landmarks: mean (l, 2), information xx, xy, yy (l, 3)."""
    leaves: Int[np.ndarray, " l"] = field(default_factory=lambda: np.empty(0, np.int64))
    """Segments after which these landmarks leave the separator, or NEVER."""
    way: float = 0.0
    """Travelled distance between nodes by odometry [m]."""
    ranged: bool = False
    """Whether a range or an excess path was measured."""
    callers: tuple[int, ...] = ()
    """Labels of the moving callers in the chain, in order."""
    first: Int[np.ndarray, " v"] = field(default_factory=lambda: np.empty(0, np.int64))
    begun: Float[np.ndarray, "v 2"] = field(default_factory=lambda: np.empty((0, 2)))

    @property
    def nodes(self) -> int:
        """Number of poses to estimate: the start, and a pose for each scan."""
        return self.legs.size

    @property
    def dimension(self) -> int:
        """Size of the state at a scan: 3 for the pose, 4 for each moving caller."""
        return POSE + CALLER * len(self.callers)

    @property
    def motion(self) -> PlainLegs:
        """Motion from each scan to the next, with its covariance, as `records.Legs`.

        If the speed scale is the only source of absolute size, the motion residual is taken at the
        odometry's scale, as it would fall with a shrinking world.
        """
        (mean, noise, seconds, rows, _, slopes), names = self.legs.arrays, self.calibration.names
        unscaled = not {"speed_of_sound", "range_scale"}.isdisjoint(names)
        free = "speed_scale" in names and (not self.ranged or unscaled)
        return mean, noise, seconds, rows, slopes, 1 if free else 0

    @property
    def span(self) -> tuple[int, int, int]:
        """Index of the last scan, and the first and end index of its measurements."""
        k = self.nodes - 1
        first, last = self.legs.arrays[3][k].tolist()
        return k, first, last

    @property
    def met(self) -> Int[np.ndarray, " l"]:
        """Index of the first scan that measured each estimated landmark, or NEVER."""
        return self._of_placed(self.heard[:, 0])

    @property
    def entering(self) -> Int[np.ndarray, " l"]:
        """Trajectory segment with the first measurement of each estimated landmark."""
        return self.met // STRETCH

    @property
    def silent(self) -> Int[np.ndarray, " l"]:
        """Index of the last scan that measured each estimated landmark, or -1."""
        return self._of_placed(self.heard[:, 1])

    def _of_placed(self, values: Int[np.ndarray, " s"]) -> Int[np.ndarray, " l"]:
        """Select the estimated landmarks' values from values of all landmarks and callers."""
        found, border = np.empty(len(self.placed), np.int64), self.index > 0
        found[self.index[border] - 1] = values[border]
        return found

    def places(self, columns: Int[np.ndarray, " l"]) -> Arrays:
        """Return where landmarks and callers are among the unknowns, as `records.Places`."""
        index = self.index
        if columns.size:
            index = np.where(index > 0, columns[np.maximum(index - 1, 0)], index)
        mean, _, seconds, *_ = self.legs.arrays
        return index, self.first, self.begun, self.calibration.sensor, mean, seconds


def begun(pose: Gaussian, calibration: Calibration) -> History:
    """Return a smoother's history that contains only the start pose."""
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
    legs.arrays[0][0], legs.arrays[1][0] = pose.mean, pose.covariance + SMALLEST_STD**2 * np.eye(3)
    steps = Stack((np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros((0, 3, q))))
    rows = Stack((np.zeros((0, 4), np.int64), np.zeros((0, NUMBERS))))
    known = np.empty((0, 2)), np.empty((0, 3))
    return History(legs=legs, steps=steps, rows=rows, calibration=calibration, known=known)


def heard_more(history: History, odometry: Odometry, scan: Scan) -> History:
    """Return the history extended by a scan, and by the odometry since the previous scan."""
    landmarks, callers, history = _slots_of(history, scan)
    legs, rows = history.legs.extended(1), history.rows.extended(landmarks.size)
    steps = history.steps.extended(len(odometry.mean))
    latest, heard = history.latest.copy(), history.heard.copy()
    led = odometry.mean, odometry.covariance, odometry.slopes
    _write_leg(legs.arrays, steps.arrays, led, (legs.size - 1, steps.size, odometry.seconds))
    ranged = _write_rows(
        (legs.arrays[3], *rows.arrays), (landmarks, callers, scan.numbers), (latest, heard),
        (legs.size - 1, rows.size - landmarks.size),
    )  # fmt: skip
    return replace(
        history,
        legs=legs,
        steps=steps,
        rows=rows,
        latest=latest,
        heard=heard,
        way=history.way + (math.hypot(*odometry.mean[-1, :2]) if len(odometry.mean) else 0.0),
        ranged=history.ranged or ranged,
    )


@optimised_once
def _write_leg(legs: Arrays, steps: Arrays, led: Led, span: tuple[Whole, Whole, float]) -> None:
    """Store the odometry up to a scan in arrays; ``span``: scan, number of steps, duration [s]."""
    (mean, noise, seconds, _, ends, slopes), (k, last, took) = legs, span
    count = led[0].shape[0]
    first, moved = last - count, False
    for j in range(count):
        steps[0][first + j], steps[1][first + j] = led[0][j], led[1][j]
        steps[2][first + j] = led[2][j]
    ends[k, 0], ends[k, 1], seconds[k] = first, last, took
    mean[k], noise[k], slopes[k] = 0.0, 0.0, 0.0
    for a in range(3 if count else 0):
        moved = moved or led[0][count - 1, a] != 0.0
        for b in range(3):
            moved = moved or led[1][count - 1, a, b] != 0.0
    if moved:
        mean[k], noise[k], slopes[k] = led[0][count - 1], led[1][count - 1], led[2][count - 1]
        for a in range(3):
            noise[k, a, a] += SMALLEST_STD * SMALLEST_STD


@optimised_once
def _write_rows(
    rows: Arrays,
    scan: tuple[Int[np.ndarray, " m"], Int[np.ndarray, " m"], Float[np.ndarray, "8 m"]],
    seen: tuple[Int[np.ndarray, " s"], Int[np.ndarray, "s 2"]],
    span: tuple[Whole, Whole],
) -> bool:
    """Store a scan's measurements in the history; return whether any has a range or excess path."""
    (spans, ends, values), (landmarks, callers, numbers) = rows, scan
    (latest, heard), (k, first) = seen, span
    spans[k, 0], spans[k, 1], ranged = first, first + landmarks.size, False
    for m in range(landmarks.size):
        slot, row = landmarks[m], first + m
        ends[row, 0], ends[row, 1], ends[row, 2], ends[row, 3] = slot, callers[m], k, -1
        for e in range(numbers.shape[0]):
            values[row, e] = numbers[e, m]
        if not (math.isnan(numbers[BEARING, m]) and math.isnan(numbers[RANGE, m])):
            ends[row, 3], latest[slot] = latest[slot], row
        for end in (slot, callers[m]):
            if end >= 0:
                heard[end, 0], heard[end, 1] = min(heard[end, 0], k), k
        ranged = ranged or callers[m] >= 0 or not math.isnan(numbers[RANGE, m])
    return ranged


def _slots_of(
    history: History, scan: Scan
) -> tuple[Int[np.ndarray, " m"], Int[np.ndarray, " m"], History]:
    """Look up indices of a scan's landmarks and callers; return them and the extended history."""
    labels, callers = scan.landmark.tolist(), caller_labels(scan).tolist()
    moving = {*scan.moving.tolist(), *history.callers}
    named = [(label, label in moving) for label in labels]
    calling = [(label, label in moving) for label in callers]
    slots = history.slots
    if new := sorted(slot for slot in {*named, *calling} if slot[0] >= 0 and slot not in slots):
        slots = {**slots, **{slot: len(slots) + n for n, slot in enumerate(new)}}
        history = _with_slots(history, slots)
    landmarks = np.array([slots[one] for one in named], np.int64)
    return landmarks, np.array([slots.get(one, -1) for one in calling], np.int64), history


def _with_slots(history: History, slots: Mapping[Slot, int]) -> History:
    """Return the history with indices for new landmarks and callers, which are not located yet."""
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
    """Return the history with further landmarks as unknowns, given their Gaussian priors."""
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
    return replace(history, index=index, heard=heard, placed=placed, known=known, leaves=leaves)


def with_caller(history: History, label: int, place: Float[np.ndarray, "2"]) -> History:
    """Return the history with a moving caller as part of the state from the last scan on."""
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
    """Return the history with landmarks marked to be eliminated after a trajectory segment."""
    return replace(history, leaves=np.where(numbers, stretch, history.leaves))


def in_hindsight(history: History) -> History:
    """Return the history with landmarks scheduled for elimination after their last measurement."""
    last = history.silent // STRETCH
    return replace(history, leaves=np.where(last < (history.nodes - 1) // STRETCH, last, NEVER))


def slots_heard(history: History) -> Int[np.ndarray, " u"]:
    """Return the indices of the landmarks and callers that the last scan measured."""
    _, first, last = history.span
    ends = history.rows.arrays[0][first:last, :2].ravel()
    return ends[ends >= 0]
