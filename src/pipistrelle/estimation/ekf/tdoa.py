r"""Time difference of arrival: what one excess path says about a Gaussian.

An excess path :math:`e = |b - l| + |l - p| - |b - p|` links the vehicle p, the landmark l and the
caller b, all parts of the state; the heading does not enter. With its slopes :math:`e_l, e_b` by
landmark and caller, and :math:`e_p = -e_l - e_b`,

- it **corrects** all three where landmark and caller are placed (`correct_excess_path`), to second
  order: a path of length L with the variance t across it is longer by :math:`t / 2L` than that of
  its means, with the square of that as variance (Bar-Shalom, Li & Kirubarajan 2001,
  Sec. 10.3.2);
- it **places** a new landmark or a ray x by the other end y, which is placed: with the direction u
  of the bearing there is one range r in closed form
  (`pipistrelle.estimation.measurement.landmark_range`), and

  .. math:: dx = dp + u\, a^T (dy - dp) + q\,(d\theta + d\phi) + \frac{u}{k} de, \quad
            k = e_x \cdot u, \quad a = -\frac{e_y}{k}, \quad
            q = r \left( u_\perp - u \frac{e_x \cdot u_\perp}{k} \right)

  correlates it with the caller as with the vehicle (`place_by_excess_path`). Between vehicle and
  caller k vanishes and the range is undetermined. So its standard deviation must be at most a tenth
  of it, and the excess path must be clearly above 0 (`MIN_TDOA_SIGMAS`): an excess path of 0 with
  an error has a range, too, which only seems sure;
- else it **weighs** the members of a ray (`weigh_by_excess_path`).

Between two rays an excess path is not used: some pair of members fits any value.

The excess paths of one scan: each places a landmark, corrects what is placed, or weighs a ray.

What one excess path says about a Gaussian is in `tdoa`.
"""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from pipistrelle.estimation.ekf.delayed_initialization import WAITING_WEIGHT, Scratch, members_of
from pipistrelle.estimation.ekf.gaussian import (
    APPLIED,
    GATED,
    MAX_WAITING,
    WAITING,
    Joint,
    State,
    defer,
    drop_members,
    flush,
    point_rows,
    retract,
)
from pipistrelle.estimation.measurement import (
    HUBER_K,
    MIN_TDOA_SIGMAS,
    NEAREST,
    Columns,
    Row,
    Timings,
    caller_range_by_excess_path,
    excess_path_slopes,
    excess_paths,
    range_by_excess_path,
)
from pipistrelle.estimation.rays import UpdateParams, log_likelihood, survivors, weigh_and_share
from pipistrelle.jit import Flag, Whole, kernel, no_alloc

MAX_RELATIVE_RANGE_STD = 0.1
"""An excess path places a point if the range has at most this standard deviation, divided by the
range."""


@no_alloc
def _bend(dx: float, dy: float, xx: float, xy: float, yy: float) -> float:
    """Return the variance perpendicular to a segment (dx, dy), divided by its length."""
    square = dx * dx + dy * dy
    across = dy * dy * xx - 2.0 * dx * dy * xy + dx * dx * yy
    return max(across, 0.0) / max(square * math.sqrt(square), NEAREST**3)


@no_alloc
def _expected(
    joint: Joint, size: Whole, i: Whole, ib: Whole, w: Float[np.ndarray, " m"]
) -> tuple[float, float]:
    """Predict the excess path over the point at i of the caller at ib; write P H^T into w."""
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
    """Return the second-order bias of the excess path, and an upper bound of its variance."""
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
    robust: bool,
) -> Whole:
    """Correct with an excess path over the point at index i of the caller at ib; GATED or APPLIED.

    ``robust`` raises its variance by Huber's rule.
    """
    if joint.taken[WAITING] == MAX_WAITING:
        flush(joint, size)
    w = joint.W[joint.taken[WAITING]]
    expected, spread = _expected(joint, size, i, ib, w)
    longer, wider = _bends(joint, size, i, ib)
    innovation, S = excess_path - expected - longer, spread + wider + variance
    if robust:
        S *= max(abs(innovation) / (HUBER_K * math.sqrt(S)), 1.0)
    if innovation * innovation > bound * S:
        return GATED
    root = 1.0 / math.sqrt(S)
    for a in range(size):
        w[a] *= root
    step = root * innovation
    if joint.turns == 0.0:
        retract(joint.mean, size, w, step, w, 0.0)
    defer(joint, size, w, joint.turns * step)
    return APPLIED


@no_alloc
def weigh_by_excess_path(
    state: State,
    ray: tuple[Whole, Whole],
    other: Whole,
    of_caller: Flag,
    excess_path: float,
    variance: float,
    likelihood: Float[np.ndarray, " m"],
) -> None:
    """Write the log likelihood of an excess path for each member of a ray; the other end is placed.

    ``ray`` is its first member and their number, ``other`` a member; with ``of_caller`` the ray is
    the caller's.
    """
    joint, size = state.joint, 3 + 2 * state.members[0]
    if joint.taken[WAITING] == MAX_WAITING:
        flush(joint, size)
    w, iy = joint.W[joint.taken[WAITING]], 3 + 2 * other
    for j in range(ray[1]):
        ix = 3 + 2 * (ray[0] + j)
        i, ib = (iy, ix) if of_caller else (ix, iy)
        expected, spread = _expected(joint, size, i, ib, w)
        longer, wider = _bends(joint, size, i, ib)
        off, S = excess_path - expected - longer, spread + wider + variance
        likelihood[j] = log_likelihood(off, S, False)


@no_alloc
def _leverage(
    joint: Joint, iy: Whole, of_caller: Flag, excess_path: float, direction: float
) -> tuple[float, float, float, float, float]:
    """Return the range of a point by excess path and direction, with a, k and e_x . u_perp.

    The point placed at index iy is the other end; the range is 0 where there is none.
    """
    mean = joint.mean
    c, s = math.cos(direction), math.sin(direction)
    dx, dy = mean[iy] - mean[0], mean[iy + 1] - mean[1]
    if of_caller:
        r = caller_range_by_excess_path(excess_path, dx, dy, c, s)
    else:
        r = range_by_excess_path(excess_path, dx, dy, c, s)
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
    """Return the relative standard deviation of a range by excess path and bearing; or infinity.

    ``measured`` is excess path, its variance, bearing and its variance. With ``of_caller`` the
    caller's range is asked, and a landmark is placed at index iy. It is infinite above
    `MAX_RELATIVE_RANGE_STD` and where the excess path may be 0 (`MIN_TDOA_SIGMAS`).
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
    """Write a member at index i by an excess path, a bearing and the point at index iy.

    The arguments are those of `relative_range_std`, which has found the range sure. Nothing may
    wait.
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
