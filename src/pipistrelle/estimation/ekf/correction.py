r"""EKF update of a joint Gaussian over pose and hypotheses by the measurements of a scan.

Measurements are applied in sequence, each linearised at the current mean: first mapped landmarks,
then new landmarks from the updated pose, last the excess paths. A bearing that initialised a
landmark together with an excess path is not used again.

**Excess paths** update vehicle, landmark and caller if both are initialised, to second order: a
segment of length L with the variance t across it is longer by :math:`t / 2L` than between the
means, with the square of that as variance (Bar-Shalom, Li & Kirubarajan 2001, Sec. 10.3.2). If one
is a ray, they weigh its hypotheses. Between two rays an excess path is not used, as some pair of
hypotheses fits any value.

**Merging of hypotheses** (`merge_members`). Hypotheses of a ray that converge to a point fit all
further bearings equally, and would never be pruned. Neighbours at a distance d within a limit of
their mean covariance P,

.. math:: d^T P^{-1} d \le \text{limit}^2,

are replaced by the mean and covariance of their mixture, and its covariances with the state x:

.. math:: m = w_a m_a + w_b m_b, \quad
          P_{mx} = w_a P_{ax} + w_b P_{bx}, \quad
          P_{mm} = w_a P_{aa} + w_b P_{bb} + w_a w_b \, d d^T

Source: moment matching, as in Salmond, SPIE 1305 (1990), for a mixture of two.
"""

import math

import numpy as np
from jaxtyping import Bool, Float, Int

from pipistrelle.detection.scans import RANGE
from pipistrelle.estimation.ekf.delayed_initialization import (
    WAITING_WEIGHT,
    Scratch,
    add_stored_range,
    add_waiting_bearing,
    drop_stored,
    is_precise,
    member_linearity,
    members_of,
    place_at_crossing,
    place_by_ranges,
    placed_by_excess_path,
    scratch_for,
    second_order,
    single,
)
from pipistrelle.estimation.ekf.gaussian import (
    APPLIED,
    BEYOND,
    GATED,
    MAX_WAITING,
    WAITING,
    Covariance,
    Joint,
    Labels,
    Mean,
    State,
    correct_active,
    correct_scalar,
    corrected_by,
    drop_members,
    flush,
    inflated,
    initialise,
    innovation_of,
    joint_of,
    point_rows,
    predicted_variance,
    range_only,
)
from pipistrelle.estimation.observations.bearing import observe
from pipistrelle.estimation.observations.excess_path import excess_path_slopes
from pipistrelle.estimation.observations.range import NEAREST
from pipistrelle.estimation.observations.rows import (
    SQUARED,
    Columns,
    ExcessPaths,
    Row,
    Timings,
    excess_paths,
    robust_loss,
    row_of,
    rows_with_bearing,
)
from pipistrelle.estimation.rays import (
    AS_PRINTED,
    BEARING,
    MOVED,
    UpdateParams,
    heaviest_member,
    log_likelihood,
    survivors,
    weigh_and_share,
)
from pipistrelle.geometry import wrap_angle
from pipistrelle.jit import Flag, Whole, kernel, no_alloc, no_alloc_inlined


@no_alloc
def merge_members(state: State, first: Whole, count: Whole, limit: float, scratch: Scratch) -> None:
    """Merge neighbouring hypotheses of a bearing-only landmark that agree, from near to far."""
    kept, last = 0, 0  # last: hypothesis into which the next may be merged
    for j in range(count):
        scratch.keep[j] = j == 0 or not _agree(state, first + last, first + j, limit)
        if scratch.keep[j]:
            kept, last = kept + 1, j
        else:
            _merge(state, first + last, first + j)
    if kept < count:
        drop_members(state, first, count, scratch.keep, scratch.source)


@no_alloc
def _agree(state: State, one: Whole, other: Whole, limit: float) -> Flag:
    """Return whether two hypotheses are within ``limit`` standard deviations of each other."""
    joint, size = state.joint, 3 + 2 * state.members[0]
    i, j = 3 + 2 * one, 3 + 2 * other
    ax, ay = point_rows(joint, size, i)
    bx, by = point_rows(joint, size, j)
    xx, xy, yy = 0.5 * (ax[i] + bx[j]), 0.5 * (ax[i + 1] + bx[j + 1]), 0.5 * (ay[i + 1] + by[j + 1])
    x, y = joint.mean[j] - joint.mean[i], joint.mean[j + 1] - joint.mean[i + 1]
    return yy * x * x - 2.0 * xy * x * y + xx * y * y <= limit * limit * (xx * yy - xy * xy)


@no_alloc
def _merge(state: State, one: Whole, other: Whole) -> None:
    """Replace the first of two hypotheses of a landmark by the Gaussian of their mixture."""
    joint, weight, size = state.joint, state.weight, 3 + 2 * state.members[0]
    flush(joint, size)
    mean, P, i, j = joint.mean, joint.covariance, 3 + 2 * one, 3 + 2 * other
    total = weight[one] + weight[other]
    a = weight[one] / total
    b = 1.0 - a
    x, y = mean[j] - mean[i], mean[j + 1] - mean[i + 1]
    xx = a * P[i, i] + b * P[j, j] + a * b * x * x
    xy = a * P[i, i + 1] + b * P[j, j + 1] + a * b * x * y
    yy = a * P[i + 1, i + 1] + b * P[j + 1, j + 1] + a * b * y * y
    for k in range(size):
        P[i, k] = P[k, i] = a * P[i, k] + b * P[j, k]
        P[i + 1, k] = P[k, i + 1] = a * P[i + 1, k] + b * P[j + 1, k]
    P[i, i], P[i + 1, i + 1] = xx, yy
    P[i, i + 1] = P[i + 1, i] = xy
    mean[i], mean[i + 1] = mean[i] + b * x, mean[i + 1] + b * y
    weight[one] = total


@no_alloc_inlined
def _correct_ray(
    state: State, first: Whole, count: Whole, row: Row, params: UpdateParams, scratch: Scratch
) -> Whole:
    """Update a landmark's hypotheses by a bearing or a range; return GATED if it fits none."""
    joint, size = state.joint, 3 + 2 * state.members[0]
    weight, outcome = state.weight[first:], GATED
    for j in range(count):
        i = 3 + 2 * (first + j)
        innovation, slopes, variance, _ = innovation_of(joint, i, row)
        S = predicted_variance(joint, size, i, slopes) + variance
        scratch.likelihood[j] = log_likelihood(innovation, S, params.sharing == AS_PRINTED)
        if innovation * innovation <= params.passive_bound * S:
            outcome = APPLIED
    if outcome == GATED:
        return GATED
    weigh_and_share(
        scratch.likelihood, weight, count, params.power, params.aggregated, scratch.share
    )
    for j in range(count):
        if scratch.share[j] > 0.0:
            correct_scalar(joint, size, 3 + 2 * (first + j), row, np.inf, scratch.share[j])
    return APPLIED


@no_alloc
def _correct_ranged_ray(
    state: State, first: Whole, count: Whole, row: Row, params: UpdateParams, scratch: Scratch
) -> Whole:
    """Update a bearing-only landmark by its first range, and bearing; return GATED or APPLIED."""
    joint, distance = state.joint, row.range
    if params.ranged == MOVED:
        i, mean = 3 + 2 * (first + heaviest_member(state.weight[first:], count)), joint.mean
        _, _, c, s, _ = observe(mean[0], mean[1], mean[2], mean[i], mean[i + 1])
        mean[i], mean[i + 1] = mean[0] + distance * c, mean[1] + distance * s
        return _correct_partial(state, first, count, row, params, scratch)
    for j in range(count):
        scratch.keep[j] = j == 0
    drop_members(state, first, count, scratch.keep, scratch.source)
    state.weight[first] = 1.0
    size, i = 3 + 2 * state.members[0], 3 + 2 * first
    initialise(joint, size, i, distance, row.bearing, row.range_variance, row.bearing_variance)
    return APPLIED


@no_alloc
def _correct_partial(
    state: State, first: Whole, count: Whole, row: Row, params: UpdateParams, scratch: Scratch
) -> Whole:
    """Update, prune and merge a landmark's hypotheses; return GATED or APPLIED."""
    if _correct_ray(state, first, count, row, params, scratch) == GATED:
        return GATED
    kept = survivors(state.weight[first:], count, params.prune, scratch.keep)
    if kept < count:
        drop_members(state, first, count, scratch.keep, scratch.source)
    if params.merge > 0.0 and kept > 1:
        merge_members(state, first, kept, params.merge, scratch)
    return APPLIED


@no_alloc
def _correct_precisely(
    state: State, first: Whole, count: Whole, row: Row, params: UpdateParams, scratch: Scratch
) -> Whole:
    """Update a partially initialised landmark by a precise bearing; return GATED or APPLIED."""
    if state.weight[first] != WAITING_WEIGHT:
        variance = member_linearity(params) ** 2
        coarse = Row(row.landmark, row.bearing, row.range, variance, row.range_variance)
        return _correct_partial(state, first, count, coarse, params, scratch)
    if place_at_crossing(state, first, row, params.loss):
        scratch.keep[0], scratch.keep[1] = True, False
        drop_members(state, first, count, scratch.keep, scratch.source)
    return APPLIED


@no_alloc_inlined
def _correct_placed(
    state: State, first: Whole, row: Row, params: UpdateParams, scratch: Scratch
) -> Whole:
    """Update an initialised landmark by a measurement; return GATED or APPLIED."""
    joint, size, i = state.joint, 3 + 2 * state.members[0], 3 + 2 * first
    if math.isnan(row.range) or math.isnan(row.bearing):
        if math.isnan(row.bearing) or is_precise(row, params):
            row = second_order(joint, size, i, row)
        degrees, squared = 1.0, correct_scalar(joint, size, i, row, params.passive_bound, 1.0)
    else:
        degrees, squared = 2.0, correct_active(joint, size, i, row, params.active_bound)
    if squared == BEYOND:
        return GATED
    if not math.isnan(squared):
        scratch.innovations[0] += squared
        scratch.innovations[1] += degrees
    return APPLIED


@no_alloc
def _correct_known(state: State, row: Row, params: UpdateParams, scratch: Scratch) -> Whole:
    """Update the joint Gaussian by a mapped landmark's measurement; return GATED or APPLIED."""
    first, count = members_of(state.landmark, state.members[0], row.landmark)
    if state.weight[first] < WAITING_WEIGHT:
        drop_stored(state, row.landmark, scratch, 0)
        _add_new(state, row, params, False)
        return APPLIED
    if params.loss != SQUARED and state.weight[first] != WAITING_WEIGHT:
        row = inflated(state, first, count, row, params.loss)
    if count == 1:
        return _correct_placed(state, first, row, params, scratch)
    passive = math.isnan(row.range + row.bearing) or params.ranged == BEARING
    if passive and (state.weight[first] == WAITING_WEIGHT or is_precise(row, params)):
        return _correct_precisely(state, first, count, row, params, scratch)
    if not passive:
        return _correct_ranged_ray(state, first, count, row, params, scratch)
    return _correct_partial(state, first, count, row, params, scratch)


@no_alloc
def _correct_by_range(state: State, row: Row, params: UpdateParams, scratch: Scratch) -> Whole:
    """Update the state by a range-only measurement, or store it; return GATED or APPLIED."""
    first, count = members_of(state.landmark, state.members[0], row.landmark)
    if count > 0 and state.weight[first] > WAITING_WEIGHT:
        return _correct_known(state, row, params, scratch)
    stores = count == 0 or state.weight[first] < WAITING_WEIGHT
    if stores and add_stored_range(state, row, scratch):
        place_by_ranges(state, row, params.loss, scratch)
    return APPLIED


@no_alloc
def _bend(dx: float, dy: float, xx: float, xy: float, yy: float) -> float:
    """Return the position variance perpendicular to a segment (dx, dy), divided by its length."""
    square = dx * dx + dy * dy
    across = dy * dy * xx - 2.0 * dx * dy * xy + dx * dx * yy
    return max(across, 0.0) / max(square * math.sqrt(square), NEAREST**3)


@no_alloc
def _innovation(
    joint: Joint, size: Whole, i: Whole, ib: Whole, row: tuple, w: Float[np.ndarray, " m"]
) -> tuple[float, float]:
    """Return innovation and its variance of an excess path via point i from the caller at ib.

    ``row``: excess path and its variance.
    """
    mean = joint.mean
    excess_path, lx, ly, bx, by = excess_path_slopes(
        mean[0], mean[1], mean[i], mean[i + 1], mean[ib], mean[ib + 1]
    )
    px, py = -lx - bx, -ly - by
    p0, p1 = joint.covariance[0], joint.covariance[1]
    li, lj = point_rows(joint, size, i)
    bi, bj = point_rows(joint, size, ib)
    for a in range(size):
        w[a] = px * p0[a] + py * p1[a] + lx * li[a] + ly * lj[a] + bx * bi[a] + by * bj[a]
    variance = px * w[0] + py * w[1] + lx * w[i] + ly * w[i + 1] + bx * w[ib] + by * w[ib + 1]
    longer, wider = _bends(joint, size, i, ib)
    return row[0] - excess_path - longer, variance + wider + row[1]


@no_alloc
def _bends(joint: Joint, size: Whole, i: Whole, ib: Whole) -> tuple[float, float]:
    """Return the second-order bias of an excess path, and an upper bound of its variance."""
    mean, p0, p1 = joint.mean, joint.covariance[0], joint.covariance[1]
    li, lj = point_rows(joint, size, i)
    bi, bj = point_rows(joint, size, ib)
    near = _bend(
        mean[i] - mean[0], mean[i + 1] - mean[1], li[i] - 2.0 * p0[i] + p0[0],
        li[i + 1] - p0[i + 1] - p1[i] + p0[1], lj[i + 1] - 2.0 * p1[i + 1] + p1[1],
    )  # fmt: skip
    onward = _bend(
        mean[i] - mean[ib], mean[i + 1] - mean[ib + 1], li[i] - 2.0 * li[ib] + bi[ib],
        li[i + 1] - li[ib + 1] - lj[ib] + bi[ib + 1], lj[i + 1] - 2.0 * lj[ib + 1] + bj[ib + 1],
    )  # fmt: skip
    straight = _bend(
        mean[ib] - mean[0], mean[ib + 1] - mean[1], bi[ib] - 2.0 * p0[ib] + p0[0],
        bi[ib + 1] - p0[ib + 1] - p1[ib] + p0[1], bj[ib + 1] - 2.0 * p1[ib + 1] + p1[1],
    )  # fmt: skip
    bent = near + onward + straight
    return 0.5 * (near + onward - straight), 0.5 * bent * bent


@no_alloc
def correct_excess_path(
    joint: Joint,
    size: Whole,
    i: Whole,
    ib: Whole,
    row: tuple[float, float],
    bound: float,
    loss: Whole,
) -> Whole:
    """Update the state by an excess path and its variance; return GATED or APPLIED.

    Its landmark is the point at index i, its caller at ib.
    """
    if joint.taken[WAITING] == MAX_WAITING:
        flush(joint, size)
    w = joint.W[joint.taken[WAITING]]
    innovation, S = _innovation(joint, size, i, ib, row, w)
    S *= robust_loss(innovation * innovation / S, loss)[0]
    return GATED if corrected_by(joint, size, w, innovation, S, bound) == BEYOND else APPLIED


@no_alloc
def correct_by_excess_path(
    state: State, paths: ExcessPaths, d: Whole, params: UpdateParams, scratch: Scratch
) -> Whole:
    """Update landmark, caller and vehicle by excess path d of a scan; return GATED or APPLIED.

    If the other end is a ray, its hypotheses are weighed and pruned.
    """
    member, caller = single(state, paths.landmark[d]), single(state, paths.caller[d])
    joint, size, likelihood = state.joint, 3 + 2 * state.members[0], scratch.likelihood
    row = paths.excess_path[d], paths.variance[d]
    if member >= 0 and caller >= 0:
        i, ib = 3 + 2 * member, 3 + 2 * caller
        return correct_excess_path(joint, size, i, ib, row, params.passive_bound, params.loss)
    label = paths.landmark[d] if caller >= 0 else paths.caller[d]
    first, count = members_of(state.landmark, state.members[0], label)
    if (member < 0 and caller < 0) or count == 0 or state.weight[first] <= WAITING_WEIGHT:
        return APPLIED
    if joint.taken[WAITING] == MAX_WAITING:
        flush(joint, size)
    w = joint.W[joint.taken[WAITING]]
    for j in range(count):
        ix = 3 + 2 * (first + j)
        i, ib = (ix, 3 + 2 * caller) if caller >= 0 else (3 + 2 * member, ix)
        likelihood[j] = log_likelihood(*_innovation(joint, size, i, ib, row, w), False)
    weight = state.weight[first:]
    weigh_and_share(likelihood, weight, count, params.power, params.aggregated, scratch.share)
    if survivors(weight, count, params.prune, scratch.keep) < count:
        drop_members(state, first, count, scratch.keep, scratch.source)
    return APPLIED


@no_alloc
def _add_new(state: State, row: Row, params: UpdateParams, moves: bool) -> None:
    """Append a measured new landmark to the state: a hypothesis, or several along its bearing.

    A moving caller becomes a ray even by a precise bearing, as its bearings do not cross.
    """
    joint, passive, across = state.joint, math.isnan(row.range), row.bearing_variance
    if passive and is_precise(row, params):
        if not moves:
            add_waiting_bearing(state, row, params)
            return
        across = member_linearity(params) ** 2
    count = params.ray_ranges.size if passive else 1
    for j in range(count):
        far = params.ray_ranges[j] if passive else row.range
        spread = params.ray_stds[j] ** 2 if passive else row.range_variance
        member = state.members[0]
        size = 3 + 2 * member
        initialise(joint, size, size, far, row.bearing, spread, across)
        state.landmark[member], state.weight[member] = row.landmark, 1.0 / count
        state.members[0] += 1


@no_alloc
def _take_in(
    state: State,
    columns: Columns,
    known: Bool[np.ndarray, " m"],
    paths: ExcessPaths | None,
    moving: Int[np.ndarray, " v"] | None,
    params: UpdateParams,
    scratch: Scratch,
) -> Whole:
    """Update mapped landmarks, then append new landmarks; return the gated measurements' number."""
    gated = 0
    for m in range(known.size):
        if known[m]:
            row, placed = row_of(columns, m), False
            if paths is not None:
                placed = placed_by_excess_path(state, row, paths, params.loss, scratch)
            if not placed:
                gated += _correct_known(state, row, params, scratch)
    flush(state.joint, 3 + 2 * state.members[0])
    for m in range(known.size):
        if not known[m]:
            row, placed, moves = row_of(columns, m), False, False
            if paths is not None and moving is not None:
                placed = placed_by_excess_path(state, row, paths, params.loss, scratch)
                moves = row.landmark in moving
            if not placed:
                _add_new(state, row, params, moves)
    for m in range(known.size, columns[0].size):
        if not math.isnan(columns[1][RANGE, m]):
            gated += _correct_by_range(state, range_only(row_of(columns, m)), params, scratch)
    if known.size < columns[0].size:
        flush(state.joint, 3 + 2 * state.members[0])
    if paths is not None:
        for d in range(paths.landmark.size):
            if not paths.used[d]:
                gated += correct_by_excess_path(state, paths, d, params, scratch)
        flush(state.joint, 3 + 2 * state.members[0])
    return gated


@kernel
def corrected(
    old_mean: Mean,
    old_covariance: Covariance,
    old_landmark: Labels,
    old_weight: Float[np.ndarray, " h"],
    columns: Columns,
    timings: Timings | None,
    params: UpdateParams,
    turns: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, Whole, float, float]:
    """Update a copy of an EKF belief's arrays by a scan, and append new landmarks; return all.

    Returns its arrays, the number of gated measurements, and the numbers of `beliefs.Innovations`.
    """
    members, known = old_landmark.size, np.empty(rows_with_bearing(columns), dtype=np.bool_)
    most = members
    for m in range(known.size):
        row = row_of(columns, m)
        first, count = members_of(old_landmark, members, row.landmark)
        known[m] = count > 0
        if not known[m] or old_weight[first] < WAITING_WEIGHT:
            most += max(params.ray_ranges.size, 2) if math.isnan(row.range) else 1
    most += 2 * (columns[0].size - known.size)  # a stored range, and its place
    joint, scratch = joint_of(old_mean, old_covariance, 3 + 2 * most, turns), scratch_for(most)
    landmark, weight = np.empty(most, dtype=np.int64), np.empty(most)
    state = State(joint, landmark, weight, np.full(1, members))
    for member in range(members):
        landmark[member], weight[member] = old_landmark[member], old_weight[member]
    if timings is None:
        gated = _take_in(state, columns, known, None, None, params, scratch)
    else:
        paths, moving = excess_paths(columns, timings), timings[2]
        gated = _take_in(state, columns, known, paths, moving, params, scratch)
    joint.mean[2], members = wrap_angle(joint.mean[2]), state.members[0]
    size, (squared, degrees) = 3 + 2 * members, scratch.innovations
    mean, covariance = joint.mean[:size].copy(), joint.covariance[:size, :size].copy()
    landmark, weight = landmark[:members].copy(), weight[:members].copy()
    return mean, covariance, landmark, weight, gated, squared, degrees
