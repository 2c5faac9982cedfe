r"""Excess paths (time differences of arrival) in the EKF: update, initialise and weigh landmarks.

An excess path :math:`e = |b - l| + |l - p| - |b - p|` relates vehicle p, landmark l and caller b,
all in the state; the heading does not enter. With its derivatives :math:`e_l, e_b` by landmark and
caller, and :math:`e_p = -e_l - e_b`,

- it **updates** all three if landmark and caller are initialised (`correct_excess_path`), to second
  order: a segment of length L with the variance t across it is longer by :math:`t / 2L` than
  between the means, with the square of that as variance (Bar-Shalom, Li & Kirubarajan 2001, Sec.
  10.3.2);
- it **initialises** a new landmark or ray x given the other end y: with the direction u of the
  bearing the range r has a closed form (`pipistrelle.estimation.measurement.landmark_range`), and

  .. math:: dx = dp + u\, a^T (dy - dp) + q\,(d\theta + d\phi) + \frac{u}{k} de, \quad
            k = e_x \cdot u, \quad a = -\frac{e_y}{k}, \quad
            q = r \left( u_\perp - u \frac{e_x \cdot u_\perp}{k} \right)

  correlates it with caller and vehicle (`place_by_excess_path`). Between vehicle and caller k
  vanishes and the range is undetermined, so its standard deviation must be at most a tenth of it,
  and the excess path clearly above 0 (`MIN_TDOA_SIGMAS`);
- else it **weighs** the hypotheses of a ray (`correct_by_excess_path`).

Between two rays an excess path is not used, as some pair of hypotheses fits any value.
"""

import math

import numpy as np
from jaxtyping import Float

from pipistrelle.estimation.ekf.delayed_initialization import WAITING_WEIGHT, Scratch, members_of
from pipistrelle.estimation.ekf.gaussian import (
    APPLIED,
    BEYOND,
    GATED,
    MAX_WAITING,
    WAITING,
    Joint,
    State,
    corrected_by,
    drop_members,
    flush,
    point_rows,
)
from pipistrelle.estimation.measurement import (
    MIN_TDOA_SIGMAS,
    NEAREST,
    SQUARED,
    ExcessPaths,
    Row,
    excess_path_slopes,
    range_by_excess_path,
    robust_loss,
)
from pipistrelle.estimation.rays import UpdateParams, log_likelihood, survivors, weigh_and_share
from pipistrelle.jit import Flag, Whole, no_alloc

MAX_RELATIVE_RANGE_STD = 0.1
"""Largest standard deviation of a range from an excess path, relative to the range."""


@no_alloc
def _bend(dx: float, dy: float, xx: float, xy: float, yy: float) -> float:
    """Return the position variance perpendicular to a segment (dx, dy), divided by its length."""
    square = dx * dx + dy * dy
    across = dy * dy * xx - 2.0 * dx * dy * xy + dx * dx * yy
    return max(across, 0.0) / max(square * math.sqrt(square), NEAREST**3)


@no_alloc
def _expected(
    joint: Joint, size: Whole, i: Whole, ib: Whole, w: Float[np.ndarray, " m"]
) -> tuple[float, float]:
    """Predict an excess path via point i from the caller at ib; return it and its variance."""
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
    return excess_path, variance


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
    excess_path: float,
    variance: float,
    bound: float,
    loss: Whole,
) -> Whole:
    """Update the state by an excess path via point i, caller at ib; return GATED or APPLIED."""
    if joint.taken[WAITING] == MAX_WAITING:
        flush(joint, size)
    w = joint.W[joint.taken[WAITING]]
    expected, spread = _expected(joint, size, i, ib, w)
    longer, wider = _bends(joint, size, i, ib)
    innovation, S = excess_path - expected - longer, spread + wider + variance
    S *= robust_loss(innovation * innovation / S, loss)[0]
    return GATED if corrected_by(joint, size, w, innovation, S, bound) == BEYOND else APPLIED


@no_alloc
def _leverage(
    joint: Joint, iy: Whole, of_caller: Flag, excess_path: float, direction: float
) -> tuple[float, float, float, float, float]:
    """Return a point's range by excess path and direction (0 if none), and its derivatives.

    The other end is the initialised point at index iy.
    """
    mean = joint.mean
    c, s = math.cos(direction), math.sin(direction)
    dx, dy = mean[iy] - mean[0], mean[iy + 1] - mean[1]
    r = range_by_excess_path(excess_path, dx, dy, c, s, of_caller)
    if not NEAREST < r < math.inf:
        return 0.0, 0.0, 0.0, 0.0, 0.0
    x, y = mean[0] + r * c, mean[1] + r * s
    if of_caller:
        _, yx, yy, xx, xy = excess_path_slopes(mean[0], mean[1], mean[iy], mean[iy + 1], x, y)
    else:
        _, xx, xy, yx, yy = excess_path_slopes(mean[0], mean[1], x, y, mean[iy], mean[iy + 1])
    k = xx * c + xy * s
    if k == 0.0:
        return 0.0, 0.0, 0.0, 0.0, 0.0
    return r, -yx / k, -yy / k, k, -xx * s + xy * c


@no_alloc
def relative_range_std(
    joint: Joint,
    size: Whole,
    iy: Whole,
    of_caller: Flag,
    measured: tuple[float, float, float, float],
) -> float:
    """Return a range's relative standard deviation by excess path and bearing, or infinity.

    ``measured`` is excess path, its variance, bearing and its variance. ``of_caller`` selects the
    caller's range, with a landmark at index iy. It is infinite above `MAX_RELATIVE_RANGE_STD`, or
    if the excess path may be 0 (`MIN_TDOA_SIGMAS`).
    """
    excess_path, along, bearing, across = measured
    mean, turns = joint.mean, joint.turns
    if excess_path <= MIN_TDOA_SIGMAS * math.sqrt(along):
        return math.inf
    r, ax, ay, k, side = _leverage(joint, iy, of_caller, excess_path, mean[2] + bearing)
    if r == 0.0:
        return math.inf
    p0, p1, p2 = joint.covariance[0], joint.covariance[1], joint.covariance[2]
    yi, yj = point_rows(joint, size, iy)
    xx = yi[iy] - 2.0 * p0[iy] + p0[0]
    xy = yi[iy + 1] - p0[iy + 1] - p1[iy] + p0[1]
    yy = yj[iy + 1] - 2.0 * p1[iy + 1] + p1[1]
    xh, yh, turn = p2[iy] - p2[0], p2[iy + 1] - p2[1], -r * side / k
    spread = (
        ax * ax * xx + 2.0 * ax * ay * xy + ay * ay * yy
        + 2.0 * turns * turn * (ax * xh + ay * yh) + turn * turn * (turns * p2[2] + across)
        + along / (k * k)
    )  # fmt: skip
    share = math.sqrt(max(spread, 0.0)) / r
    return share if share <= MAX_RELATIVE_RANGE_STD else math.inf


@no_alloc
def place_by_excess_path(
    joint: Joint,
    size: Whole,
    i: Whole,
    iy: Whole,
    of_caller: Flag,
    measured: tuple[float, float, float, float],
) -> None:
    """Write a point's position and covariance at index i, by its bearing and excess path.

    Arguments as in `relative_range_std`; no columns may be deferred.
    """
    excess_path, along, bearing, across = measured
    mean, covariance, turns = joint.mean, joint.covariance, joint.turns
    direction = mean[2] + bearing
    c, s = math.cos(direction), math.sin(direction)
    r, ax, ay, k, side = _leverage(joint, iy, of_caller, excess_path, direction)
    qx, qy = r * (-s - c * side / k), r * (c - s * side / k)
    mean[i], mean[i + 1] = mean[0] + r * c, mean[1] + r * s
    for b in range(size):
        if b != i and b != i + 1:
            p0, p1, turned = covariance[0, b], covariance[1, b], turns * covariance[2, b]
            far = ax * (covariance[iy, b] - p0) + ay * (covariance[iy + 1, b] - p1)
            covariance[i, b] = covariance[b, i] = p0 + c * far + qx * turned
            covariance[i + 1, b] = covariance[b, i + 1] = p1 + s * far + qy * turned
    noise = along / (k * k)
    x0, x1, x2 = covariance[i, 0], covariance[i, 1], turns * covariance[i, 2]
    y0, y1, y2 = covariance[i + 1, 0], covariance[i + 1, 1], turns * covariance[i + 1, 2]
    far_x = ax * (covariance[i, iy] - x0) + ay * (covariance[i, iy + 1] - x1)
    far_y = ax * (covariance[i + 1, iy] - y0) + ay * (covariance[i + 1, iy + 1] - y1)
    covariance[i, i] = x0 + c * far_x + qx * x2 + c * c * noise + qx * qx * across
    covariance[i + 1, i + 1] = y1 + s * far_y + qy * y2 + s * s * noise + qy * qy * across
    cross = x1 + s * far_x + qy * x2 + c * s * noise + qx * qy * across
    covariance[i, i + 1] = covariance[i + 1, i] = cross


ROBUST_BEARING_FACTOR = 3.0
"""Factor on bearing standard deviations with the robust setting, as a wrong initial position would
displace all later landmarks."""


@no_alloc
def _single(state: State, label: Whole) -> Whole:
    """Return the index of a landmark's only hypothesis, or -1 if it has none or several."""
    first, count = members_of(state.landmark, state.members[0], label)
    return first if count == 1 else -1


@no_alloc
def _surest(state: State, row: Row, paths: ExcessPaths, loss: Whole) -> Whole:
    """Return the index of the excess path that best gives a landmark's range, or -1.

    It is of this landmark with an initialised caller, or via an initialised landmark if this
    landmark is the caller. With a robust loss precise even with the bearing std multiplied by
    `ROBUST_BEARING_FACTOR`.
    """
    best, least, size = -1, math.inf, 3 + 2 * state.members[0]
    across = row.bearing_variance * (
        1.0 if loss == SQUARED else ROBUST_BEARING_FACTOR * ROBUST_BEARING_FACTOR
    )
    for d in range(paths.landmark.size):
        of_caller = paths.caller[d] == row.landmark
        if paths.used[d] or not (of_caller or paths.landmark[d] == row.landmark):
            continue
        other = _single(state, paths.landmark[d] if of_caller else paths.caller[d])
        if other < 0:
            continue
        measured = (paths.excess_path[d], paths.variance[d], row.bearing, across)
        share = relative_range_std(state.joint, size, 3 + 2 * other, of_caller, measured)
        if share < least:
            best, least = d, share
    return best


@no_alloc
def placed_by_excess_path(
    state: State, row: Row, paths: ExcessPaths, loss: Whole, scratch: Scratch
) -> bool:
    """Initialise a landmark by bearing and excess path, if precise; return whether it was."""
    first, count = members_of(state.landmark, state.members[0], row.landmark)
    if count == 1 or not math.isnan(row.range):
        return False
    d = _surest(state, row, paths, loss)
    if d < 0:
        return False
    if count > 0:
        for j in range(count):
            scratch.keep[j] = j == 0
        drop_members(state, first, count, scratch.keep, scratch.source)
    else:
        state.landmark[first] = row.landmark
        state.members[0] += 1
    state.weight[first] = 1.0
    of_caller = paths.caller[d] == row.landmark
    other = _single(state, paths.landmark[d] if of_caller else paths.caller[d])
    measured = (paths.excess_path[d], paths.variance[d], row.bearing, row.bearing_variance)
    size = 3 + 2 * state.members[0]
    place_by_excess_path(state.joint, size, 3 + 2 * first, 3 + 2 * other, of_caller, measured)
    paths.used[d] = True
    return True


@no_alloc
def correct_by_excess_path(
    state: State, paths: ExcessPaths, d: Whole, params: UpdateParams, scratch: Scratch
) -> Whole:
    """Update landmark, caller and vehicle by excess path d of a scan; return GATED or APPLIED.

    If the other end is a ray, its hypotheses are weighed and pruned.
    """
    member, caller = _single(state, paths.landmark[d]), _single(state, paths.caller[d])
    joint, size, likelihood = state.joint, 3 + 2 * state.members[0], scratch.likelihood
    excess_path, variance = paths.excess_path[d], paths.variance[d]
    if member >= 0 and caller >= 0:
        i, ib = 3 + 2 * member, 3 + 2 * caller
        return correct_excess_path(
            joint, size, i, ib, excess_path, variance, params.passive_bound, params.loss
        )
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
        expected, spread = _expected(joint, size, i, ib, w)
        longer, wider = _bends(joint, size, i, ib)
        off, S = excess_path - expected - longer, spread + wider + variance
        likelihood[j] = log_likelihood(off, S, False)
    weight = state.weight[first:]
    weigh_and_share(likelihood, weight, count, params.power, params.aggregated, scratch.share)
    if survivors(weight, count, params.prune, scratch.keep) < count:
        drop_members(state, first, count, scratch.keep, scratch.source)
    return APPLIED
