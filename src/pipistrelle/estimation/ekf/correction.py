"""A frame's correction of one Gaussian over a pose and the members of all landmarks.

A frame is taken in measurement by measurement, each at the current mean: first the landmarks
already mapped, in the order of the scan, then the new ones are placed from the corrected pose, then
detours correct what both of its ends has placed, and weigh what one has (`detours`). A bearing that
a detour places, with it, is not taken in besides.
"""

import math

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
from pipistrelle.estimation.ekf.detours import (
    Timed,
    added_by_detour,
    correct_by_detour,
    placed_by_detour,
    timed_of,
)
from pipistrelle.estimation.ekf.gaussian import (
    APPLIED,
    BEYOND,
    GATED,
    Joint,
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
from pipistrelle.estimation.ekf.members import Scratch, members_of, scratch_for
from pipistrelle.estimation.ekf.merging import merge_members
from pipistrelle.estimation.measurement import (
    Columns,
    Measurements,
    Row,
    Timings,
    measurements,
    observe,
    row_of,
)
from pipistrelle.estimation.rays import (
    ANEW,
    AS_PRINTED,
    BEARING,
    CORRECTED,
    MOVED,
    OTHERS,
    RESET,
    Sensing,
    heaviest_member,
    log_likelihood,
    renormalise,
    survivors,
    weigh_and_share,
)
from pipistrelle.geometry import wrap_angle
from pipistrelle.jit import Whole, kernel, no_alloc, no_alloc_inlined


@no_alloc_inlined
def _correct_ray(
    state: State,
    first: Whole,
    count: Whole,
    row: Row,
    sensing: Sensing,
    scratch: Scratch,
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
def _leave_one(
    state: State,
    first: Whole,
    count: Whole,
    row: Row,
    sensing: Sensing,
    scratch: Scratch,
) -> None:
    """Give a ray its range where that leaves one member: a full landmark."""
    left = 0 if sensing.ranged == ANEW else heaviest_member(state.weight[first:], count)
    for j in range(count):
        scratch.keep[j] = j == left
    drop_members(state, first, count, scratch.keep, scratch.source)
    state.weight[first] = 1.0
    distance, bearing, variance = row.range, row.bearing, row.bearing_variance
    joint, size, i = state.joint, 3 + 2 * state.members[0], 3 + 2 * first
    if sensing.ranged == ANEW:
        initialise(joint, size, i, distance, bearing, row.range_variance, variance)
        return
    if sensing.ranged == CORRECTED:
        correct_active(joint, size, i, distance, bearing, row.range_variance, variance, np.inf)
        return
    if sensing.ranged == RESET:
        mean = joint.mean
        _, expected, _, _, _ = observe(mean[0], mean[1], mean[2], mean[i], mean[i + 1])
        initialise(joint, size, i, distance, expected, row.range_variance, variance)
    else:
        _move_to_range(joint, i, distance)
    correct_bearing(joint, size, i, bearing, variance, np.inf)


@no_alloc
def _move_to_range(joint: Joint, i: Whole, distance: float) -> None:
    """Put the mean of the member at state index i at a range, in the direction in which it is."""
    mean = joint.mean
    _, _, c, s, _ = observe(mean[0], mean[1], mean[2], mean[i], mean[i + 1])
    mean[i], mean[i + 1] = mean[0] + distance * c, mean[1] + distance * s


@no_alloc
def _correct_ranged_ray(
    state: State,
    first: Whole,
    count: Whole,
    row: Row,
    sensing: Sensing,
    scratch: Scratch,
) -> Whole:
    """Correct a ray with range and bearing, as `rays` lists; tell whether it was gated."""
    if sensing.ranged < BEARING:
        _leave_one(state, first, count, row, sensing, scratch)
        return APPLIED
    weight = state.weight[first:]
    heaviest = heaviest_member(weight, count)
    if sensing.ranged == MOVED:
        _move_to_range(state.joint, 3 + 2 * (first + heaviest), row.range)
    if sensing.ranged == OTHERS:
        for j in range(count):
            scratch.keep[j] = j != heaviest
        drop_members(state, first, count, scratch.keep, scratch.source)
        count -= 1
        renormalise(weight, count)
    return _correct_partial(state, first, count, row, sensing, scratch)


@no_alloc
def _correct_partial(
    state: State, first: Whole, count: Whole, row: Row, sensing: Sensing, scratch: Scratch
) -> Whole:
    """Correct a ray with a bearing, and prune it; tell whether it was gated."""
    if _correct_ray(state, first, count, row, sensing, scratch) == GATED:
        return GATED
    kept = survivors(state.weight[first:], count, sensing.prune, scratch.keep)
    if kept < count:
        drop_members(state, first, count, scratch.keep, scratch.source)
    if sensing.merge > 0.0 and kept > 1:
        merge_members(state, first, kept, sensing.merge, scratch)
    return APPLIED


@no_alloc
def _correct_precisely(
    state: State,
    first: Whole,
    count: Whole,
    row: Row,
    sensing: Sensing,
    scratch: Scratch,
) -> Whole:
    """Cross a bearing that waits, or correct a ray with a precise one; tell whether it was gated.

    To the members of a ray, which an earlier, coarser one has cast, it is no more precise than they
    are linear.
    """
    if state.weight[first] != WAITS:
        variance = linear_to(sensing) ** 2
        coarse = Row(row.landmark, row.bearing, row.range, variance, row.range_variance)
        return _correct_partial(state, first, count, coarse, sensing, scratch)
    if place_crossing(state, first, row, sensing.robust):
        scratch.keep[0], scratch.keep[1] = True, False
        drop_members(state, first, count, scratch.keep, scratch.source)
    return APPLIED


@no_alloc_inlined
def _correct_placed(
    state: State, first: Whole, row: Row, sensing: Sensing, scratch: Scratch
) -> Whole:
    """Correct a placed landmark, and add up its innovations; tell whether it was gated."""
    joint, size, i = state.joint, 3 + 2 * state.members[0], 3 + 2 * first
    distance, bearing, variance = row.range, row.bearing, row.bearing_variance
    if math.isnan(distance):
        if is_precise(row, sensing):
            bearing, variance = curved(joint, size, i, row)
        degrees, bound = 1.0, sensing.passive_bound
        squared = correct_bearing(joint, size, i, bearing, variance, bound)
    else:
        degrees, bound, spread = 2.0, sensing.active_bound, row.range_variance
        squared = correct_active(joint, size, i, distance, bearing, spread, variance, bound)
    if squared == BEYOND:
        return GATED
    if not math.isnan(squared):
        scratch.innovations[0] += squared
        scratch.innovations[1] += degrees
    return APPLIED


@no_alloc
def _correct_known(state: State, row: Row, sensing: Sensing, scratch: Scratch) -> Whole:
    """Correct with one measurement of a mapped landmark; tell whether it was gated."""
    first, count = members_of(state.landmark, state.members[0], row.landmark)
    if sensing.robust and state.weight[first] != WAITS:
        row = tempered(state, first, count, row)
    if count == 1:
        return _correct_placed(state, first, row, sensing, scratch)
    passive = math.isnan(row.range) or sensing.ranged == BEARING
    if passive and (state.weight[first] == WAITS or is_precise(row, sensing)):
        return _correct_precisely(state, first, count, row, sensing, scratch)
    if not passive:
        return _correct_ranged_ray(state, first, count, row, sensing, scratch)
    return _correct_partial(state, first, count, row, sensing, scratch)


@no_alloc
def _add_new(state: State, row: Row, sensing: Sensing, moves: bool) -> None:
    """Append a measurement's landmark, one member or a ray of them (Eqs. (16) to (18)).

    Bearings of a caller that moves do not cross where it is: it is a ray, however precise they are.
    """
    joint, passive, across = state.joint, math.isnan(row.range), row.bearing_variance
    if passive and is_precise(row, sensing):
        if not moves:
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
    known: Bool[np.ndarray, " m"],
    sensing: Sensing,
    scratch: Scratch,
) -> Whole:
    """Correct with what is mapped, then append what is not; returns how many were gated."""
    gated = 0
    for m in range(heard.landmark.size):
        if known[m]:
            gated += _correct_known(state, row_of(heard, m), sensing, scratch)
    flush(state.joint, 3 + 2 * state.members[0])
    for m in range(heard.landmark.size):
        if not known[m]:
            _add_new(state, row_of(heard, m), sensing, False)
    return gated


@no_alloc
def _take_in_timed(
    state: State,
    heard: Measurements,
    known: Bool[np.ndarray, " m"],
    timed: Timed,
    sensing: Sensing,
    scratch: Scratch,
) -> Whole:
    """Do the same with what a detour does not place, then take in all other detours."""
    gated = 0
    for m in range(heard.landmark.size):
        if known[m]:
            row = row_of(heard, m)
            if not placed_by_detour(state, row, timed, sensing.robust, scratch):
                gated += _correct_known(state, row, sensing, scratch)
    flush(state.joint, 3 + 2 * state.members[0])
    for m in range(heard.landmark.size):
        if not known[m]:
            row = row_of(heard, m)
            if not added_by_detour(state, row, timed, sensing.robust):
                _add_new(state, row, sensing, row.landmark in timed.moving)
    for d in range(timed.landmark.size):
        if not timed.used[d]:
            gated += correct_by_detour(state, timed, d, sensing, scratch)
    flush(state.joint, 3 + 2 * state.members[0])
    return gated


@kernel
def corrected(
    old_mean: Float[np.ndarray, " d"],
    old_covariance: Float[np.ndarray, "d d"],
    old_landmark: Int[np.ndarray, " h"],
    old_weight: Float[np.ndarray, " h"],
    columns: Columns,
    timings: Timings | None,
    sensing: Sensing,
    turns: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, Whole, float, float]:
    """Correct, prune and extend a copy of the belief.

    Returns its arrays, the gated count, and the two numbers of `beliefs.Innovations`.

    ``turns`` says of which error the covariance is, as in `Joint`.
    """
    heard = measurements(columns)
    members, rows = old_landmark.size, heard.landmark.size
    most, known = members, np.empty(rows, dtype=np.bool_)
    for m in range(rows):
        known[m] = members_of(old_landmark, members, heard.landmark[m])[1] > 0
        if not known[m]:
            most += max(sensing.ray_ranges.size, 2) if math.isnan(heard.range[m]) else 1
    joint, scratch = joint_of(old_mean, old_covariance, 3 + 2 * most, turns), scratch_for(most)
    landmark, weight = np.empty(most, dtype=np.int64), np.empty(most)
    state = State(joint, landmark, weight, np.full(1, members))
    for member in range(members):
        landmark[member], weight[member] = old_landmark[member], old_weight[member]
    if timings is None:
        gated = _take_in(state, heard, known, sensing, scratch)
    else:
        gated = _take_in_timed(state, heard, known, timed_of(columns, timings), sensing, scratch)
    joint.mean[2], members = wrap_angle(joint.mean[2]), state.members[0]
    mean, covariance = gaussian_of(joint, 3 + 2 * members)
    squared, degrees = scratch.innovations
    landmark, weight = landmark[:members].copy(), weight[:members].copy()
    return mean, covariance, landmark, weight, gated, squared, degrees
