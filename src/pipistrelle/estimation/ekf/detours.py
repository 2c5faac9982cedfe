"""A frame's detours: which of them place a landmark, weigh a ray or correct what is placed.

What one detour says of a Gaussian is `timing`'s.
"""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from pipistrelle.estimation.ekf.crossing import WAITS
from pipistrelle.estimation.ekf.gaussian import APPLIED, State, drop_members
from pipistrelle.estimation.ekf.members import Scratch, members_of
from pipistrelle.estimation.ekf.timing import (
    correct_detour,
    place_by_detour,
    unsure_by_detour,
    weigh_by_detour,
)
from pipistrelle.estimation.measurement import Columns, Row, Timings, detours
from pipistrelle.estimation.rays import Sensing, survivors, weigh_and_share
from pipistrelle.jit import Flag, Whole, kernel, no_alloc

FARTHER = 3.0
"""Times its standard deviation by which a bearing may be off where some are by more than they say:
a place that is wrong, and sure, takes all others along."""


class Timed(NamedTuple):
    """The detours of a frame, and who moves.

    Attributes
    ----------
    landmark, caller : (d)
        Labels.
    detour : (d) [m]
    variance : (d) [m^2]
    used : (d)
        Whether one has placed something.
    moving : (v)
        Labels.
    """

    landmark: Int[np.ndarray, " d"]
    caller: Int[np.ndarray, " d"]
    detour: Float[np.ndarray, " d"]
    variance: Float[np.ndarray, " d"]
    used: Bool[np.ndarray, " d"]
    moving: Int[np.ndarray, " v"]


@kernel
def timed_of(columns: Columns, timings: Timings) -> Timed:
    """Return the detours of a scan, none of them used."""
    told = detours(columns, timings)
    used = np.zeros(told.landmark.size, dtype=np.bool_)
    return Timed(told.landmark, told.caller, told.detour, told.variance, used, timings[2])


@no_alloc
def _single(state: State, label: Whole) -> Whole:
    """Return the one member of a landmark; -1 where it has another number of them."""
    first, count = members_of(state.landmark, state.members[0], label)
    return first if count == 1 else -1


@no_alloc
def _surest(state: State, row: Row, timed: Timed, robust: bool) -> Whole:
    """Return the detour that tells the range of a row's landmark most surely; -1 where none does.

    It is one over the landmark, of a caller that is placed, or one of its own call over a placed
    one. ``robust``: it must be sure even if the bearing is off by `FARTHER` than it says.
    """
    best, least, size = -1, math.inf, 3 + 2 * state.members[0]
    across = row.bearing_variance * (FARTHER * FARTHER if robust else 1.0)
    for d in range(timed.landmark.size):
        of_caller = timed.caller[d] == row.landmark
        if timed.used[d] or not (of_caller or timed.landmark[d] == row.landmark):
            continue
        other = _single(state, timed.landmark[d] if of_caller else timed.caller[d])
        if other < 0:
            continue
        measured = (timed.detour[d], timed.variance[d], row.bearing, across)
        share = unsure_by_detour(state.joint, size, 3 + 2 * other, of_caller, measured)
        if share < least:
            best, least = d, share
    return best


@no_alloc
def _place(state: State, member: Whole, row: Row, timed: Timed, d: Whole) -> None:
    """Place a landmark, of which there is one member, by detour d and its bearing."""
    of_caller = timed.caller[d] == row.landmark
    other = _single(state, timed.landmark[d] if of_caller else timed.caller[d])
    measured = (timed.detour[d], timed.variance[d], row.bearing, row.bearing_variance)
    size = 3 + 2 * state.members[0]
    place_by_detour(state.joint, size, 3 + 2 * member, 3 + 2 * other, of_caller, measured)
    timed.used[d] = True


@no_alloc
def placed_by_detour(state: State, row: Row, timed: Timed, robust: bool, scratch: Scratch) -> bool:
    """Place a ray, or a bearing that waits, by a detour that tells its range surely; tell if so."""
    first, count = members_of(state.landmark, state.members[0], row.landmark)
    if count == 1 or not math.isnan(row.range):
        return False
    d = _surest(state, row, timed, robust)
    if d < 0:
        return False
    for j in range(count):
        scratch.keep[j] = j == 0
    drop_members(state, first, count, scratch.keep, scratch.source)
    state.weight[first] = 1.0
    _place(state, first, row, timed, d)
    return True


@no_alloc
def added_by_detour(state: State, row: Row, timed: Timed, robust: bool) -> bool:
    """Append a passive measurement's landmark where a detour tells its range surely; tell if so."""
    d = _surest(state, row, timed, robust) if math.isnan(row.range) else -1
    if d < 0:
        return False
    member = state.members[0]
    state.landmark[member], state.weight[member] = row.landmark, 1.0
    state.members[0] += 1
    _place(state, member, row, timed, d)
    return True


@no_alloc
def _weigh(
    state: State, timed: Timed, d: Whole, of_caller: Flag, sensing: Sensing, scratch: Scratch
) -> None:
    """Weigh the members of a ray by detour d, and prune it."""
    label = timed.caller[d] if of_caller else timed.landmark[d]
    other = _single(state, timed.landmark[d] if of_caller else timed.caller[d])
    ray = members_of(state.landmark, state.members[0], label)
    first, count = ray
    if state.weight[first] == WAITS:
        return
    weigh_by_detour(
        state, ray, other, of_caller, timed.detour[d], timed.variance[d], scratch.likelihood
    )
    weight = state.weight[first:]
    weigh_and_share(
        scratch.likelihood, weight, count, sensing.power, sensing.aggregated, scratch.share
    )
    if survivors(weight, count, sensing.prune, scratch.keep) < count:
        drop_members(state, first, count, scratch.keep, scratch.source)


@no_alloc
def correct_by_detour(
    state: State, timed: Timed, d: Whole, sensing: Sensing, scratch: Scratch
) -> Whole:
    """Correct landmark, caller and vehicle by detour d, or weigh a ray; tell if it was gated."""
    member, caller = _single(state, timed.landmark[d]), _single(state, timed.caller[d])
    if member >= 0 and caller >= 0:
        size, i, ib = 3 + 2 * state.members[0], 3 + 2 * member, 3 + 2 * caller
        return correct_detour(
            state.joint, size, i, ib, timed.detour[d], timed.variance[d],
            sensing.passive_bound, sensing.robust,
        )  # fmt: skip
    ray = timed.landmark[d] if caller >= 0 else timed.caller[d]
    if (member >= 0 or caller >= 0) and members_of(state.landmark, state.members[0], ray)[1]:
        _weigh(state, timed, d, bool(caller < 0), sensing, scratch)
    return APPLIED
