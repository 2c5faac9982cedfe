"""The excess paths of one scan: each places a landmark, corrects what is placed, or weighs a ray.

What one excess path says about a Gaussian is in `tdoa`.
"""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from pipistrelle.estimation.ekf.delayed_initialization import WAITING_WEIGHT
from pipistrelle.estimation.ekf.gaussian import APPLIED, State, drop_members
from pipistrelle.estimation.ekf.members import Scratch, members_of
from pipistrelle.estimation.ekf.tdoa import (
    correct_excess_path,
    place_by_excess_path,
    relative_range_std,
    weigh_by_excess_path,
)
from pipistrelle.estimation.measurement import Columns, Row, Timings, excess_paths
from pipistrelle.estimation.rays import UpdateParams, survivors, weigh_and_share
from pipistrelle.jit import Flag, Whole, kernel, no_alloc

ROBUST_BEARING_FACTOR = 3.0
"""Factor on the standard deviations of bearings where some may be off by more than they say: a
place that is wrong but seems sure makes all others wrong."""


class FrameExcessPaths(NamedTuple):
    """The excess paths of a scan, and the labels of callers that move."""

    landmark: Int[np.ndarray, " d"]
    caller: Int[np.ndarray, " d"]
    excess_path: Float[np.ndarray, " d"]  # [m]
    variance: Float[np.ndarray, " d"]  # [m^2]
    used: Bool[np.ndarray, " d"]  # whether an excess path has placed something
    moving: Int[np.ndarray, " v"]


@kernel
def frame_excess_paths(columns: Columns, timings: Timings) -> FrameExcessPaths:
    """Return the excess paths of a scan, none of them used."""
    heard = excess_paths(columns, timings)
    used = np.zeros(heard.landmark.size, dtype=np.bool_)
    return FrameExcessPaths(
        heard.landmark, heard.caller, heard.excess_path, heard.variance, used, timings[2]
    )


@no_alloc
def _single(state: State, label: Whole) -> Whole:
    """Return the index of a landmark's only member; -1 where it has none or several."""
    first, count = members_of(state.landmark, state.members[0], label)
    return first if count == 1 else -1


@no_alloc
def _surest(state: State, row: Row, frame: FrameExcessPaths, robust: bool) -> Whole:
    """Return the excess path that gives the range of a row's landmark most surely, or -1.

    It is over this landmark, of a placed caller, or of this landmark's own call, over a placed one.
    ``robust``: it must be sure even if the bearing's std is larger by `ROBUST_BEARING_FACTOR`.
    """
    best, least, size = -1, math.inf, 3 + 2 * state.members[0]
    across = row.bearing_variance * (
        ROBUST_BEARING_FACTOR * ROBUST_BEARING_FACTOR if robust else 1.0
    )
    for d in range(frame.landmark.size):
        of_caller = frame.caller[d] == row.landmark
        if frame.used[d] or not (of_caller or frame.landmark[d] == row.landmark):
            continue
        other = _single(state, frame.landmark[d] if of_caller else frame.caller[d])
        if other < 0:
            continue
        measured = (frame.excess_path[d], frame.variance[d], row.bearing, across)
        share = relative_range_std(state.joint, size, 3 + 2 * other, of_caller, measured)
        if share < least:
            best, least = d, share
    return best


@no_alloc
def _place(state: State, member: Whole, row: Row, frame: FrameExcessPaths, d: Whole) -> None:
    """Place a landmark of one member by excess path d and the bearing of its row."""
    of_caller = frame.caller[d] == row.landmark
    other = _single(state, frame.landmark[d] if of_caller else frame.caller[d])
    measured = (frame.excess_path[d], frame.variance[d], row.bearing, row.bearing_variance)
    size = 3 + 2 * state.members[0]
    place_by_excess_path(state.joint, size, 3 + 2 * member, 3 + 2 * other, of_caller, measured)
    frame.used[d] = True


@no_alloc
def placed_by_excess_path(
    state: State, row: Row, frame: FrameExcessPaths, robust: bool, scratch: Scratch
) -> bool:
    """Place a ray or a waiting bearing by an excess path that gives its range; tell if done."""
    first, count = members_of(state.landmark, state.members[0], row.landmark)
    if count == 1 or not math.isnan(row.range):
        return False
    d = _surest(state, row, frame, robust)
    if d < 0:
        return False
    for j in range(count):
        scratch.keep[j] = j == 0
    drop_members(state, first, count, scratch.keep, scratch.source)
    state.weight[first] = 1.0
    _place(state, first, row, frame, d)
    return True


@no_alloc
def added_by_excess_path(state: State, row: Row, frame: FrameExcessPaths, robust: bool) -> bool:
    """Append the landmark of a bearing whose range an excess path gives; tell if it was done."""
    d = _surest(state, row, frame, robust) if math.isnan(row.range) else -1
    if d < 0:
        return False
    member = state.members[0]
    state.landmark[member], state.weight[member] = row.landmark, 1.0
    state.members[0] += 1
    _place(state, member, row, frame, d)
    return True


@no_alloc
def _weigh(
    state: State,
    frame: FrameExcessPaths,
    d: Whole,
    of_caller: Flag,
    params: UpdateParams,
    scratch: Scratch,
) -> None:
    """Weigh the members of a ray by excess path d, and prune it."""
    label = frame.caller[d] if of_caller else frame.landmark[d]
    other = _single(state, frame.landmark[d] if of_caller else frame.caller[d])
    ray = members_of(state.landmark, state.members[0], label)
    first, count = ray
    if state.weight[first] == WAITING_WEIGHT:
        return
    weigh_by_excess_path(
        state, ray, other, of_caller, frame.excess_path[d], frame.variance[d], scratch.likelihood
    )
    weight = state.weight[first:]
    weigh_and_share(
        scratch.likelihood, weight, count, params.power, params.aggregated, scratch.share
    )
    if survivors(weight, count, params.prune, scratch.keep) < count:
        drop_members(state, first, count, scratch.keep, scratch.source)


@no_alloc
def correct_by_excess_path(
    state: State, frame: FrameExcessPaths, d: Whole, params: UpdateParams, scratch: Scratch
) -> Whole:
    """Correct landmark, caller and vehicle by excess path d, or weigh a ray; GATED or APPLIED."""
    member, caller = _single(state, frame.landmark[d]), _single(state, frame.caller[d])
    if member >= 0 and caller >= 0:
        size, i, ib = 3 + 2 * state.members[0], 3 + 2 * member, 3 + 2 * caller
        return correct_excess_path(
            state.joint, size, i, ib, frame.excess_path[d], frame.variance[d],
            params.passive_bound, params.robust,
        )  # fmt: skip
    ray = frame.landmark[d] if caller >= 0 else frame.caller[d]
    if (member >= 0 or caller >= 0) and members_of(state.landmark, state.members[0], ray)[1]:
        _weigh(state, frame, d, bool(caller < 0), params, scratch)
    return APPLIED
