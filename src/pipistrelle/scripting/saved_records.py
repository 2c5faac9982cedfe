"""The records that a saved drive may hold, and the laws that their numbers keep.

Kernels trust the numbers by which they find entries of arrays and check no bounds, so of a file
that somebody made each such number is checked here. A law is about one record; what its
annotations say of kinds and shapes is checked before (`saved_state`).
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from pipistrelle.config import RayConfig
from pipistrelle.detection.scans import Scan
from pipistrelle.estimation.beliefs import Gaussian, Innovations, JointGaussian, Landmarks
from pipistrelle.estimation.data_association.existence import Known
from pipistrelle.estimation.data_association.rows import (
    Caller,
    CallerPlace,
    EarlyScan,
    Memory,
    ScanRows,
)
from pipistrelle.estimation.data_association.tracks import Tracks
from pipistrelle.estimation.ekf.filter import EkfBelief
from pipistrelle.estimation.ekf.gaussian import INVARIANT, LINEAR
from pipistrelle.estimation.fastslam.block import LANES
from pipistrelle.estimation.fastslam.filter import FastSlamBelief
from pipistrelle.estimation.session import MOST_STEPS, SessionState, _Heard
from pipistrelle.estimation.smoother.belief import SmootherBelief
from pipistrelle.estimation.smoother.history import NEVER, STRETCH, History
from pipistrelle.estimation.smoother.preintegration import Calibration, Odometry
from pipistrelle.estimation.smoother.records import CALLER, POSE, Stack
from pipistrelle.estimation.smoother.sweep import Points, Solution, Stretch

LARGEST = np.sqrt(np.finfo(np.float64).max)
"""Of this the square is still a number."""
RECORDS: dict[str, Any] = {
    kind.__name__: kind
    for kind in (
        Caller, CallerPlace, Calibration, EarlyScan, EkfBelief, FastSlamBelief, Gaussian, History,
        Innovations, JointGaussian, Known, Landmarks, Memory, Odometry, Points, RayConfig, Scan,
        ScanRows, SessionState, SmootherBelief, Solution, Stack, Stretch, Tracks, _Heard,
    )
}  # fmt: skip
"""All that a file may name."""


def check_going_on(start: SessionState, state: SessionState, *, own: bool) -> None:
    """Refuse a state that a session of the same settings would not come to from its start.

    ``own``: whether the estimator is one from outside, whose beliefs may be of several kinds.
    """
    beliefs = [state.belief, *(heard.belief for heard in state.past)]
    beliefs += [state.open[0]] if state.open else []
    first = start.belief
    for belief in () if own else beliefs:
        same = type(belief) is type(first) and getattr(first, "error", 0) == getattr(
            belief, "error", 0
        )
        if isinstance(first, SmootherBelief) and same:
            old, new = first.history.calibration, belief.history.calibration
            same = (first.noise, first.rays, old.names) == (belief.noise, belief.rays, new.names)
            for name in ("assumed", "unit", "stds", "odometry", "sensor"):
                same = same and np.array_equal(getattr(old, name), getattr(new, name))
        if not same:
            raise ValueError("another estimator")
    memories = [state.memory, *(heard.memory for heard in state.past)]
    of_ours = (type(None), Memory)
    if isinstance(start.memory, of_ours) and any(
        type(m) is not type(start.memory) for m in memories
    ):
        raise ValueError("another association")


def within(values: Any, low: Any, high: Any) -> bool:
    """Tell whether all of some whole numbers are from one on, and below another.

    >>> within(np.array([0, 2]), 0, 3), within([3], 0, 3)
    (True, False)
    """
    array = np.asarray(values)
    return bool(np.all((array >= low) & (array < high)))


def _finite(*arrays: Any) -> bool:
    """Tell whether all numbers are finite, and their squares, too."""
    return all(bool(np.all(np.abs(array) <= LARGEST)) for array in arrays)


def _sessions(state: SessionState) -> bool:
    """Scans follow one another, and a leg to which steps may be added is there."""
    numbers = [heard.number for heard in state.past]
    end = state.first + len(state.labels)
    if state.first < 0 or numbers != [*range(end - len(numbers), end)]:
        return False
    try:
        known: list[Any] = [state.draws, *([state.open[1]] if state.open else [])]
        for draws in known:
            np.random.PCG64(0).state = draws
    except (ValueError, TypeError, KeyError, OverflowError, IndexError):
        return False
    legs = [*state.legs, *(leg for heard in state.past for leg in heard.legs)]
    going = (
        len(state.open) == 2 and 0 < len(legs[len(state.legs) - 1][1]) < MOST_STEPS
        if (state.open is not None and state.legs)
        else state.open is None
    )
    return going and all(_finite(dt) for _, dt in legs)


def _heard(heard: _Heard) -> bool:
    """A scan has a label for each row."""
    rows = heard.label.size
    return rows == heard.came.landmark.size == heard.scan.landmark.size and heard.number >= 0


def _scan(scan: Scan) -> bool:
    """Rows have callers, and direct calls are rows."""
    return scan.caller.min(initial=0) >= 0 and within(scan.direct, -1, scan.landmark.size)


def _early(early: EarlyScan) -> bool:
    """A scan's rows are those of the scan, and direct calls are among them."""
    rows = early.scan.landmark.size
    return (
        rows == early.rows.caller.size and within(early.direct, -1, rows) and _is_pose(early.pose)
    )


def _is_pose(gaussian: Gaussian) -> bool:
    """Tell whether a Gaussian is that of one pose, in numbers."""
    return gaussian.mean.shape == (POSE,) and _finite(gaussian.mean, gaussian.covariance)


def _memory(memory: Memory) -> bool:
    """Labels are those that were given, and those of callers whose place was stated."""
    known, callers = memory.known.label, [caller.label for caller in memory.callers.values()]
    return memory.scan >= 0 and within(known, 0, memory.labels + 1) and min(callers, default=0) >= 0


def _known(known: Known) -> bool:
    """Each landmark is there once."""
    return np.unique(known.label).size == known.label.size


def _tracks(tracks: Tracks) -> bool:
    """Each scan has its rows, each of a track."""
    count = len(tracks.last)
    return len(tracks.rows) == len(tracks.poses) and all(
        within(rows[:, 0], 0, count) for rows in tracks.rows
    )


def _ekf(belief: EkfBelief) -> bool:
    """The state has a pose and two numbers for each member."""
    size, members = belief.mean.size, belief.landmark.size
    numbers = belief.mean, belief.covariance, belief.weight, belief.origin
    return (
        size == POSE + 2 * members == belief.covariance.shape[0]
        and belief.error in (LINEAR, INVARIANT)
        and belief.covariance.diagonal().min() >= 0.0
        and _finite(*numbers)
    )


def _fastslam(belief: FastSlamBelief) -> Any:
    """Blocks have room for all particles, and particles for all members of their landmarks."""
    blocks, landmarks, lanes = belief.count.shape
    room = np.diff(belief.first)
    if {room.size, belief.landmark.size, belief.best_count.size} != {landmarks}:
        return False
    rows = belief.member.shape[1], len(belief.best_member)
    return (
        lanes == LANES
        and blocks == -(-belief.log_weight.size // LANES) > 0
        and (belief.poses.shape, belief.member.shape[2]) == ((blocks, 9 * LANES), 6 * LANES)
        and belief.first[0] == 0
        and within(room, 0, 1 + min(rows))
        and belief.first[-1] <= min(rows)
        and within(belief.count, 0, 1 + room[:, None])
        and within(belief.best_count, 0, 1 + room)
        and np.unique(belief.landmark).size == landmarks
        and _is_pose(belief.estimate)
        and _finite(belief.poses)
        and not np.isnan(belief.log_weight).any()
        and _members_are_numbers(belief, room)
    )


def _members_are_numbers(belief: FastSlamBelief, room: Any) -> bool:
    """Tell whether all members that count are numbers; rows beyond were never written."""
    blocks, c = belief.member.shape[0], int(belief.first[-1])
    place = np.arange(c) - np.repeat(belief.first[:-1], room)
    best = belief.best_member[:c][place < np.repeat(belief.best_count, room)]
    there = place[:, None] < np.repeat(belief.count, room, axis=1)
    numbers = belief.member[:, :c].reshape(blocks, c, 6, LANES)
    return not (np.isnan(best).any() or np.any(np.isnan(numbers) & there[:, :, None]))


def _stack(stack: Stack) -> bool:
    """What is counted and what was written is there."""
    room = {len(array) for array in stack.arrays if array.ndim}
    return len(room) == 1 and len(stack.written) == 1 and (
        0 <= stack.size <= stack.written[0] <= min(room)
    )  # fmt: skip


def _shapes(stack: Stack, *rest: tuple[int, ...], whole: Sequence[int] = ()) -> bool:
    """Tell whether the entries of each of a stack's arrays are so large.

    ``whole``: which arrays are of whole numbers.
    """
    kinds = [np.int64 if n in whole else np.float64 for n in range(len(rest))]
    found = [array.dtype for array in stack.arrays]
    return tuple(array.shape[1:] for array in stack.arrays) == rest and found == kinds


def _has_shapes(arrays: Sequence[Any], *shapes: tuple[int, ...]) -> bool:
    """Tell whether arrays are of finite numbers, and so large."""
    return tuple(array.shape for array in arrays) == shapes and all(
        array.dtype == np.float64 and _finite(array) for array in arrays
    )


def _calibration(calibration: Calibration) -> bool:
    """Each number has all that is known of it."""
    return within(calibration.odometry, 0, POSE) and calibration.sensor.min() >= 0


def _history(history: History) -> Any:
    """All numbers of nodes, rows, slots, landmarks and callers are of what is there."""
    q, p = history.calibration.odometry.size, history.calibration.stds.size
    legs = _shapes(history.legs, (3,), (3, 3), (), (2,), (2,), (3, q), whole=(3, 4))
    if not (legs and _shapes(history.steps, (3,), (3, 3), (3, q)) and p >= q):
        return False
    if not (_shapes(history.rows, (4,), (8,), whole=(0,)) and history.legs.size):
        return False
    slots, nodes, placed = len(history.slots), history.nodes, len(history.placed)
    callers, ends = len(history.callers), history.rows.entries(0)
    heard, led = history.legs.entries(3), history.legs.entries(4)
    of_border, in_chain = history.index[history.index > 0], -history.index[history.index < 0]
    lengths = {history.index.size, history.latest.size, len(history.heard), history.moves.size}
    return (
        lengths == {slots}
        and [*history.slots.values()] == [*range(slots)]
        and within(heard, 0, 1 + history.rows.size)
        and within(led, 0, 1 + history.steps.size)
        and not any(np.any(span[:, 0] > span[:, 1]) for span in (heard, led))
        and within(ends[:, :3], (0, -1, 0), (slots, slots, nodes))
        and within(ends[:, 3], -1, np.arange(len(ends)))
        and np.all((ends[:, 3] < 0) | (ends[ends[:, 3], 0] == ends[:, 0]))
        and np.array_equal(np.sort(of_border), 1 + np.arange(placed))
        and np.array_equal(np.sort(in_chain), POSE + CALLER * np.arange(callers))
        and within(history.latest, -1, history.rows.size)
        and within(history.heard[:, 1], -1, nodes)
        and np.all((history.heard[:, 0] == NEVER) | within_each(history.heard[:, 0], nodes))
        and within(history.moves, 0, 2)
        and _has_shapes(history.known, (placed, 2), (placed, 3))
        and (history.leaves.size, history.first.size) == (placed, callers)
        and within(history.first, 0, nodes)
        and _finite(history.way, *map(history.legs.entries, (0, 1, 2, 5)))
        and _finite(*map(history.steps.entries, range(3)))
    )


def _columns(columns: Any, first: int, width: int) -> bool:
    """Tell whether places have columns of the border, two each, or 0."""
    there = columns[columns != 0]
    return (
        within(there, first, width - 1)
        and np.unique(there).size == there.size
        and not np.any((there - first) % 2)
    )


def _smoother(belief: SmootherBelief) -> Any:
    """The solution is of the history."""
    history, solution = belief.history, belief.solution
    points, odometry = solution.points, belief.odometry
    p, q = history.calibration.stds.size, history.calibration.odometry.size
    nodes, d, w, n = history.nodes, history.dimension, len(solution.border), solution.beta.size
    if solution.columns.size != len(history.placed) or len(solution.places) != 6:
        return False
    places = history.places(solution.columns)
    return (
        all(map(np.array_equal, places[:4], solution.places[:4]))
        and all(a.dtype == b.dtype for a, b in zip(places, solution.places, strict=True))
        and all(a.shape[1:] == b.shape[1:] for a, b in zip(places, solution.places, strict=True))
        and all(len(array) >= nodes for array in solution.places[4:])
        and n == max(1 + p, 2 + int(solution.columns.max(initial=-2))) <= w
        and _has_shapes(solution.front, (d, w), (d, d), (w, w))
        and (solution.factor.shape, solution.covariance.shape) == ((n, n), (d, d))
        and (points.at.size, points.parameters.size) == (nodes, p)
        and len(points.spots) == len(history.placed)
        and _shapes(points.at, (d,))
        and len(belief.noise) == 5
        and odometry.slopes.shape[1:] == (3, q)
        and _is_pose(belief.at)
        and _is_pose(belief.ahead)
        and _stretches(solution.stretches, nodes, (d, w), (1 + p, len(history.placed)))
        and _finite(solution.border, solution.factor, solution.beta)
        and _finite(points.at.entries(0), points.spots, solution.covariance, odometry.mean)
    )  # fmt: skip


def _stretches(
    stretches: Sequence[Stretch], nodes: int, size: tuple[int, int], border: tuple[int, int]
) -> bool:
    """Tell whether stretches cover all nodes, in arrays that grow up to a size.

    ``size``: of the state and of the border; ``border``: its first column of places, and how many
    there are.
    """
    (d, most), (first, placed), least = size, border, 0
    if len(stretches) != 1 + (nodes - 1) // STRETCH:
        return False
    for number, one in enumerate(stretches):
        w, (g, a), left = one.front[0].shape[-1], (one.gone.size, one.freed.size), one.left
        wide = one.links.arrays[0].shape[-1]
        fits = (
            one.first == number * STRETCH
            and one.links.size == min(STRETCH, nodes - one.first)
            and least <= w <= wide <= most
            and _has_shapes(one.front, (d, w), (d, d), (w, w))
            and _shapes(one.links, (d, wide), (d, d), (d, d))
            and one.columns.size <= placed
            and _columns(one.columns, first, w)
            and g == a
            and within(one.gone, 0, placed)
            and _columns(one.freed, first, left[0].shape[2])
            and one.freed.all()
            and left[0].shape[2] <= most
            and _has_shapes(left, (g, 2, left[0].shape[2]), (g, 2, d), (g, 2, 2))
        )
        if not fits:
            return False
        least = w
    return True


def within_each(values: Any, high: int) -> Any:
    """Return a mask of what is from 0 on, and below a number."""
    return (values >= 0) & (values < high)


LAWS: dict[Any, Callable[[Any], Any]] = {
    Calibration: _calibration,
    EarlyScan: _early,
    EkfBelief: _ekf,
    FastSlamBelief: _fastslam,
    History: _history,
    Known: _known,
    Memory: _memory,
    Scan: _scan,
    SessionState: _sessions,
    SmootherBelief: _smoother,
    Stack: _stack,
    Tracks: _tracks,
    _Heard: _heard,
}
"""Of each record whose numbers must agree."""
