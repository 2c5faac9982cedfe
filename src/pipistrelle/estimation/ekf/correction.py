"""A frame's correction of one Gaussian over a pose and the members of all landmarks.

A frame is taken in measurement by measurement, each at the current mean: first the landmarks
already mapped, in the order of the scan, then the new ones are placed from the corrected pose, then
detours correct what both of its ends has placed, and weigh what one has (`timing`). A bearing that
a detour places, with it, is not taken in besides.
"""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from pipistrelle.estimation.ekf.crossing import (
    WAITS,
    await_crossing,
    curved,
    is_precise,
    linear_to,
    place_crossing,
)
from pipistrelle.estimation.ekf.gaussian import (
    APPLIED,
    GATED,
    State,
    bearing_variance,
    correct_active,
    correct_bearing,
    drop_members,
    flush,
    gaussian_of,
    initialise,
    joint_of,
)
from pipistrelle.estimation.ekf.huber import tempered
from pipistrelle.estimation.ekf.timing import (
    correct_detour,
    place_by_detour,
    unsure_by_detour,
    weigh_by_detour,
)
from pipistrelle.estimation.measurement import (
    Columns,
    Detours,
    Measurements,
    Row,
    detours,
    measurements,
    observe,
    row_of,
)
from pipistrelle.estimation.rays import (
    AS_PRINTED,
    Sensing,
    heaviest_member,
    log_likelihood,
    survivors,
    weigh_and_share,
)
from pipistrelle.geometry import wrap_angle
from pipistrelle.jit import Whole, kernel, no_alloc, no_alloc_inlined


class _Scratch(NamedTuple):
    """Room to work on the members of one landmark, and on the order of the state's numbers."""

    likelihood: Float[np.ndarray, " m"]
    share: Float[np.ndarray, " m"]
    keep: Bool[np.ndarray, " m"]
    source: Int[np.ndarray, " n"]


@kernel
def _scratch(members: Whole) -> _Scratch:
    """Make room for so many members."""
    return _Scratch(
        np.empty(members),
        np.empty(members),
        np.empty(members, np.bool_),
        np.empty(3 + 2 * members, np.int64),
    )


@no_alloc
def _members_of(
    landmark: Int[np.ndarray, " h"], members: Whole, label: Whole
) -> tuple[Whole, Whole]:
    """Index of a landmark's first member and how many it has (0: not mapped)."""
    for first in range(members):
        if landmark[first] == label:
            last = first + 1
            while last < members and landmark[last] == label:
                last += 1
            return first, last - first
    return members, 0


@no_alloc_inlined
def _correct_ray(
    state: State,
    first: Whole,
    count: Whole,
    row: Row,
    sensing: Sensing,
    scratch: _Scratch,
) -> Whole:
    """Weigh a ray's members by a bearing and share it among them; GATED when none expected it."""
    joint, mean, size = state.joint, state.joint.mean, 3 + 2 * state.members[0]
    weight, outcome = state.weight[first:], GATED
    bearing, variance = row.bearing, row.bearing_variance
    for j in range(count):
        i = 3 + 2 * (first + j)
        _, expected, c, s, k = observe(mean[0], mean[1], mean[2], mean[i], mean[i + 1])
        innovation = wrap_angle(bearing - expected)
        S = bearing_variance(joint, size, i, c, s, k) + variance
        scratch.likelihood[j] = log_likelihood(innovation, S, sensing.sharing == AS_PRINTED)
        if innovation * innovation <= sensing.passive_bound * S:
            outcome = APPLIED
    if outcome == GATED:
        return GATED
    weigh_and_share(
        scratch.likelihood, weight, count, sensing.power, sensing.aggregated, scratch.share
    )
    for j in range(count):
        if scratch.share[j] > 0.0:
            i = 3 + 2 * (first + j)
            correct_bearing(joint, size, i, bearing, variance / scratch.share[j], np.inf)
    return APPLIED


@no_alloc
def _range_for_ray(
    state: State,
    first: Whole,
    count: Whole,
    row: Row,
    sensing: Sensing,
    scratch: _Scratch,
) -> None:
    """Give a partial landmark its range: one member is left."""
    left = 0 if sensing.reinitialise else heaviest_member(state.weight[first:], count)
    for j in range(count):
        scratch.keep[j] = j == left
    drop_members(state, first, count, scratch.keep, scratch.source)
    state.weight[first] = 1.0
    distance, bearing, variance = row.range, row.bearing, row.bearing_variance
    joint, mean = state.joint, state.joint.mean
    size, i = 3 + 2 * state.members[0], 3 + 2 * first
    if sensing.reinitialise:
        initialise(joint, size, i, distance, bearing, row.range_variance, variance)
    else:
        _, _, c, s, _ = observe(mean[0], mean[1], mean[2], mean[i], mean[i + 1])
        mean[i], mean[i + 1] = mean[0] + distance * c, mean[1] + distance * s
        correct_bearing(joint, size, i, bearing, variance, np.inf)


@no_alloc
def _correct_partial(
    state: State, first: Whole, count: Whole, row: Row, sensing: Sensing, scratch: _Scratch
) -> Whole:
    """Correct a ray with a bearing, and prune it; tell whether it was gated."""
    if _correct_ray(state, first, count, row, sensing, scratch) == GATED:
        return GATED
    if survivors(state.weight[first:], count, sensing.prune, scratch.keep) < count:
        drop_members(state, first, count, scratch.keep, scratch.source)
    return APPLIED


@no_alloc
def _correct_precisely(
    state: State,
    first: Whole,
    count: Whole,
    row: Row,
    sensing: Sensing,
    scratch: _Scratch,
) -> Whole:
    """Cross a bearing that waits, or correct with a precise one; tell whether it was gated.

    To the members of a ray, which an earlier, coarser one has cast, it is no more precise than they
    are linear.
    """
    joint, size, i = state.joint, 3 + 2 * state.members[0], 3 + 2 * first
    if count == 1:
        bearing, variance = curved(joint, size, i, row)
        return correct_bearing(joint, size, i, bearing, variance, sensing.passive_bound)
    if state.weight[first] != WAITS:
        variance = linear_to(sensing) ** 2
        coarse = Row(row.landmark, row.bearing, row.range, variance, row.range_variance)
        return _correct_partial(state, first, count, coarse, sensing, scratch)
    if place_crossing(state, first, row):
        scratch.keep[0], scratch.keep[1] = True, False
        drop_members(state, first, count, scratch.keep, scratch.source)
    return APPLIED


@no_alloc
def _correct_known(state: State, row: Row, sensing: Sensing, scratch: _Scratch) -> Whole:
    """Correct with one measurement of a mapped landmark; tell whether it was gated."""
    first, count = _members_of(state.landmark, state.members[0], row.landmark)
    if sensing.robust and state.weight[first] != WAITS:
        row = tempered(state, first, count, row)
    distance, bearing, variance = row.range, row.bearing, row.bearing_variance
    joint, size, i = state.joint, 3 + 2 * state.members[0], 3 + 2 * first
    passive = math.isnan(distance)
    if passive and (state.weight[first] == WAITS or is_precise(row, sensing)):
        return _correct_precisely(state, first, count, row, sensing, scratch)
    if count == 1 and passive:
        return correct_bearing(joint, size, i, bearing, variance, sensing.passive_bound)
    if count == 1:
        spread, bound = row.range_variance, sensing.active_bound
        return correct_active(joint, size, i, distance, bearing, spread, variance, bound)
    if not passive:
        _range_for_ray(state, first, count, row, sensing, scratch)
        return APPLIED
    return _correct_partial(state, first, count, row, sensing, scratch)


@no_alloc
def _single(state: State, label: Whole) -> Whole:
    """Return the one member of a landmark; -1 where it has another number of them."""
    first, count = _members_of(state.landmark, state.members[0], label)
    return first if count == 1 else -1


@no_alloc
def _surest(state: State, row: Row, timed: Detours, used: Bool[np.ndarray, " d"]) -> Whole:
    """Return the detour that tells the range of a row's landmark most surely; -1 where none does.

    It is one over the landmark, of a caller that is placed, or one of its own call over a placed
    one.
    """
    best, least, size = -1, math.inf, 3 + 2 * state.members[0]
    for d in range(timed.landmark.size):
        of_caller = timed.caller[d] == row.landmark
        if used[d] or not (of_caller or timed.landmark[d] == row.landmark):
            continue
        other = _single(state, timed.landmark[d] if of_caller else timed.caller[d])
        if other < 0:
            continue
        measured = (timed.detour[d], timed.variance[d], row.bearing, row.bearing_variance)
        share = unsure_by_detour(state.joint, size, 3 + 2 * other, of_caller, measured)
        if share < least:
            best, least = d, share
    return best


@no_alloc
def _place(
    state: State, member: Whole, row: Row, timed: Detours, d: Whole, used: Bool[np.ndarray, " d"]
) -> None:
    """Place a landmark, of which there is one member, by detour d and its bearing."""
    of_caller = timed.caller[d] == row.landmark
    other = _single(state, timed.landmark[d] if of_caller else timed.caller[d])
    measured = (timed.detour[d], timed.variance[d], row.bearing, row.bearing_variance)
    size = 3 + 2 * state.members[0]
    place_by_detour(state.joint, size, 3 + 2 * member, 3 + 2 * other, of_caller, measured)
    used[d] = True


@no_alloc
def _placed_by_detour(
    state: State,
    row: Row,
    timed: Detours,
    used: Bool[np.ndarray, " d"],
    scratch: _Scratch,
) -> bool:
    """Place a ray, or a bearing that waits, by a detour that tells its range surely; tell if so."""
    first, count = _members_of(state.landmark, state.members[0], row.landmark)
    if count == 1 or not math.isnan(row.range):
        return False
    d = _surest(state, row, timed, used)
    if d < 0:
        return False
    for j in range(count):
        scratch.keep[j] = j == 0
    drop_members(state, first, count, scratch.keep, scratch.source)
    state.weight[first] = 1.0
    _place(state, first, row, timed, d, used)
    return True


@no_alloc
def _weigh(
    state: State,
    timed: Detours,
    d: Whole,
    of_caller: bool,
    sensing: Sensing,
    scratch: _Scratch,
) -> None:
    """Weigh the members of a ray by detour d, and prune it."""
    label = timed.caller[d] if of_caller else timed.landmark[d]
    other = _single(state, timed.landmark[d] if of_caller else timed.caller[d])
    ray = _members_of(state.landmark, state.members[0], label)
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
def _correct_by_detour(
    state: State, timed: Detours, d: Whole, sensing: Sensing, scratch: _Scratch
) -> Whole:
    """Correct landmark, caller and vehicle by a detour, or weigh a ray; tell if it was gated."""
    member, caller = _single(state, timed.landmark[d]), _single(state, timed.caller[d])
    if member >= 0 and caller >= 0:
        size, i, ib = 3 + 2 * state.members[0], 3 + 2 * member, 3 + 2 * caller
        return correct_detour(
            state.joint, size, i, ib, timed.detour[d], timed.variance[d],
            sensing.passive_bound, sensing.robust,
        )  # fmt: skip
    ray = timed.landmark[d] if caller >= 0 else timed.caller[d]
    if (member >= 0 or caller >= 0) and _members_of(state.landmark, state.members[0], ray)[1]:
        _weigh(state, timed, d, bool(caller < 0), sensing, scratch)
    return APPLIED


@no_alloc
def _add_new(
    state: State,
    row: Row,
    timed: Detours,
    used: Bool[np.ndarray, " d"],
    moving: Int[np.ndarray, " v"],
    sensing: Sensing,
) -> None:
    """Append a measurement's landmark, one member or a ray of them (Eqs. (16) to (18)).

    Bearings of a caller that moves do not cross where it is: it is a ray, however precise they are.
    """
    joint, passive = state.joint, math.isnan(row.range)
    d = _surest(state, row, timed, used) if passive else -1
    if d >= 0:
        member = state.members[0]
        state.landmark[member], state.weight[member] = row.landmark, 1.0
        state.members[0] += 1
        _place(state, member, row, timed, d, used)
        return
    across = row.bearing_variance
    if passive and is_precise(row, sensing):
        if row.landmark not in moving:
            await_crossing(state, row, sensing)
            return
        across = linear_to(sensing) ** 2
    count = sensing.ray_ranges.size if passive else 1
    for j in range(count):
        far = sensing.ray_ranges[j] if passive else row.range
        spread = sensing.ray_stds[j] ** 2 if passive else row.range_variance
        member = state.members[0]
        size = 3 + 2 * member
        initialise(joint, size, size, far, row.bearing, spread, across)
        state.landmark[member], state.weight[member] = row.landmark, 1.0 / count
        state.members[0] += 1


@no_alloc
def _take_in(
    state: State,
    heard: Measurements,
    timed: Detours,
    known: tuple[Bool[np.ndarray, " m"], Bool[np.ndarray, " d"], Int[np.ndarray, " v"]],
    sensing: Sensing,
    scratch: _Scratch,
) -> Whole:
    """Correct with what is mapped, then append what is not; returns how many were gated.

    ``known``: of which rows the landmark is mapped, which detours have been used, who moves.
    """
    gated, (mapped, used, moving) = 0, known
    for m in range(heard.landmark.size):
        if mapped[m]:
            row = row_of(heard, m)
            if used.size == 0 or not _placed_by_detour(state, row, timed, used, scratch):
                gated += _correct_known(state, row, sensing, scratch)
    flush(state.joint, 3 + 2 * state.members[0])
    for m in range(heard.landmark.size):
        if not mapped[m]:
            _add_new(state, row_of(heard, m), timed, used, moving, sensing)
    for d in range(used.size):
        if not used[d]:
            gated += _correct_by_detour(state, timed, d, sensing, scratch)
    if used.size:
        flush(state.joint, 3 + 2 * state.members[0])
    mean = state.joint.mean
    mean[2] = wrap_angle(mean[2])
    return gated


@kernel
def corrected(
    old_mean: Float[np.ndarray, " d"],
    old_covariance: Float[np.ndarray, "d d"],
    old_landmark: Int[np.ndarray, " h"],
    old_weight: Float[np.ndarray, " h"],
    columns: Columns,
    sensing: Sensing,
    turns: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, Whole]:
    """Correct, prune and extend a copy of the belief; returns its arrays and the gated count.

    ``turns`` says of which error the covariance is, as in `Joint`.
    """
    heard, timed = measurements(columns), detours(columns)
    members, rows = old_landmark.size, heard.landmark.size
    most, known = members, np.empty(rows, dtype=np.bool_)
    for m in range(rows):
        known[m] = _members_of(old_landmark, members, heard.landmark[m])[1] > 0
        if not known[m]:
            most += max(sensing.ray_ranges.size, 2) if math.isnan(heard.range[m]) else 1
    joint, scratch = joint_of(old_mean, old_covariance, 3 + 2 * most, turns), _scratch(most)
    landmark, weight = np.empty(most, dtype=np.int64), np.empty(most)
    state = State(joint, landmark, weight, np.full(1, members))
    for member in range(members):
        landmark[member], weight[member] = old_landmark[member], old_weight[member]
    used = np.zeros(timed.landmark.size, dtype=np.bool_)
    gated = _take_in(state, heard, timed, (known, used, columns[4]), sensing, scratch)
    members = state.members[0]
    mean, covariance = gaussian_of(joint, 3 + 2 * members)
    return mean, covariance, landmark[:members].copy(), weight[:members].copy(), gated
