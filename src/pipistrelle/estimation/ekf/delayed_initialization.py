r"""Delayed initialization: by crossing bearings, by ranges, and by a bearing and an excess path.

**Stored bearings.** A landmark first measured by a bearing too precise for ray hypotheses
(`is_precise`) enters the state as two points: :math:`p_0`, the position of the vehicle, and q, a
point in the direction of the bearing, both correlated with the state. When a later bearing, in the
direction u from p, crosses this line,

.. math:: l = p + r u, \quad r = \frac{n \cdot (p_0 - p)}{n \cdot u}, \quad n \perp q - p_0,

the landmark is initialised there, if the crossing is in front of both poses and the standard
deviation of r is at most r / 5, beyond which the position is not Gaussian. Bearings before that are
not used. The covariance of l follows from

.. math:: n \cdot u\, dr = n \cdot \left( (1 - t) dp_0 + t\, dq - dp \right)
          - r (n \cdot u_\perp)(d\theta + d\phi)

with t the position of the crossing on the first ray in units of :math:`|q - p_0|`.

**Stored ranges.** Of a landmark with ranges only, the positions of the vehicle enter the state,
with the range at each as a weight (`drop_stored`). When they leave a single place
(`observations.range`), its derivatives by ranges and positions correlate it with the state.

**Excess path.** With an excess path e, and the other end y in the state, a bearing in the direction
u places a landmark or caller x at the range r of `observations.excess_path`. With the derivatives
:math:`e_x, e_y`

.. math:: dx = dp + u\, a^T (dy - dp) + q\,(d\theta + d\phi) + \frac{u}{k} de, \quad
          k = e_x \cdot u, \quad a = -\frac{e_y}{k}, \quad
          q = r \left( u_\perp - u \frac{e_x \cdot u_\perp}{k} \right)

correlates it with caller and vehicle (`place_by_excess_path`).

**Second order.** Let :math:`P_{aa}, P_{cc}, P_{ac}` be the covariance of a landmark relative to
the vehicle, along and across the line of sight. Its bearing then has a bias of
:math:`-P_{ac}/r^2` and the additional variance :math:`(P_{aa} P_{cc} + P_{ac}^2)/r^4`, its range
:math:`P_{cc} / 2r` and :math:`P_{cc}^2 / 2r^2` (Bar-Shalom, Li & Kirubarajan 2001, Sec. 10.3.2).
Precise bearings and range-only measurements are corrected for it.
"""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from pipistrelle.estimation.ekf.gaussian import (
    Joint,
    Labels,
    State,
    drop_members,
    flush,
    initialise,
    relative_covariance,
)
from pipistrelle.estimation.observations.bearing import MIN_CROSSING_SINE, observe
from pipistrelle.estimation.observations.excess_path import range_with_slopes, unscented_range
from pipistrelle.estimation.observations.range import (
    MIN_SPACING,
    NEAREST,
    Ranges,
    is_certain,
    located,
    misfit,
    refined,
)
from pipistrelle.estimation.observations.rows import SQUARED, ExcessPaths, Row, robust_loss
from pipistrelle.estimation.rays import FITTED, UpdateParams
from pipistrelle.jit import Flag, Whole, kernel, no_alloc


class Scratch(NamedTuple):
    """Workspace to update a landmark's hypotheses, and the sums of the innovations."""

    likelihood: Float[np.ndarray, " m"]
    share: Float[np.ndarray, " m"]
    keep: Bool[np.ndarray, " m"]
    source: Int[np.ndarray, " n"]
    innovations: Float[np.ndarray, "2"]  # accumulates the two numbers of `beliefs.Innovations`


@kernel
def scratch_for(members: Whole) -> Scratch:
    """Allocate the temporary arrays for a number of landmark hypotheses."""
    return Scratch(
        np.empty(members),
        np.empty(members),
        np.empty(members, np.bool_),
        np.empty(3 + 2 * members, np.int64),
        np.zeros(2),
    )


@no_alloc
def members_of(landmark: Labels, members: Whole, label: Whole) -> tuple[Whole, Whole]:
    """Return the index of a landmark's first hypothesis, and their number (0: not in the map)."""
    for first in range(members):
        if landmark[first] == label:
            last = first + 1
            while last < members and landmark[last] == label:
                last += 1
            return first, last - first
    return members, 0


WAITING_WEIGHT = -1.0
"""Weight that marks the two points of a stored bearing."""
PARALLEL_SINE = 1e-9
"""Sine of the angle below which two bearings count as parallel."""


@no_alloc
def member_linearity(params: UpdateParams) -> float:
    """Return the linearisation error of bearings to a hypothesis from the side [rad]."""
    share = params.ray_stds[0] / params.ray_ranges[0]
    return 0.5 * share * share


@no_alloc
def is_precise(row: Row, params: UpdateParams) -> bool:
    """Return whether a bearing is too precise for a Gaussian mixture along it."""
    return params.sharing == FITTED and row.bearing_variance < member_linearity(params) ** 2


@no_alloc
def second_order(joint: Joint, size: Whole, i: Whole, row: Row) -> Row:
    """Correct a bearing, or a range-only measurement, for its second-order bias and variance."""
    mean = joint.mean
    _, _, c, s, k = observe(mean[0], mean[1], mean[2], mean[i], mean[i + 1])
    xx, xy, yy = relative_covariance(joint, size, i)
    along = c * c * xx + 2.0 * c * s * xy + s * s * yy
    across = s * s * xx - 2.0 * c * s * xy + c * c * yy
    cross = c * s * (yy - xx) + (c * c - s * s) * xy
    square = k * k
    if math.isnan(row.bearing):
        bent = max(across, 0.0) * k
        wider = row.range_variance + 0.5 * bent * bent
        return Row(row.landmark, row.bearing, row.range - 0.5 * bent, math.nan, wider)
    variance = row.bearing_variance + (along * across + cross * cross) * square * square
    return Row(row.landmark, row.bearing + cross * square, row.range, variance, row.range_variance)


@no_alloc
def add_waiting_bearing(state: State, row: Row, params: UpdateParams) -> None:
    """Append a bearing line to the state as two points: the vehicle, and a point ahead."""
    through = params.ray_ranges[params.ray_ranges.size // 2]
    for ahead in (0.0, through):
        member = state.members[0]
        size = 3 + 2 * member
        initialise(state.joint, size, size, ahead, row.bearing, 0.0, row.bearing_variance)
        state.landmark[member], state.weight[member] = row.landmark, WAITING_WEIGHT
        state.members[0] += 1


MAX_STORED = 16
"""Most stored ranges of a landmark; when reached, every second is dropped."""


@no_alloc
def drop_stored(state: State, label: Whole, scratch: Scratch, spared: Whole) -> None:
    """Drop a landmark's stored ranges; of ``spared`` successive ranges keep the first (0: none).

    They are not contiguous; their weights are `WAITING_WEIGHT` minus the range [m].
    """
    members, count = state.members[0], 0
    for member in range(members):
        stored = state.landmark[member] == label and state.weight[member] < WAITING_WEIGHT
        scratch.keep[member] = not stored or (spared > 0 and count % spared == 0)
        count += stored
    drop_members(state, 0, members, scratch.keep, scratch.source)


@no_alloc
def add_stored_range(state: State, row: Row, scratch: Scratch) -> bool:
    """Store the vehicle's position and a range; return False if it is too near a stored range."""
    mean, count, least = state.joint.mean, 0, MIN_SPACING**2 * row.range_variance
    for member in range(state.members[0]):
        if state.landmark[member] == row.landmark:
            count += 1
            dx, dy = mean[3 + 2 * member] - mean[0], mean[4 + 2 * member] - mean[1]
            if dx * dx + dy * dy < least:
                return False
    if count == MAX_STORED:
        drop_stored(state, row.landmark, scratch, 2)
    flush(state.joint, 3 + 2 * state.members[0])
    member = state.members[0]
    initialise(state.joint, 3 + 2 * member, 3 + 2 * member, 0.0, 0.0, 0.0, 0.0)
    state.landmark[member], state.weight[member] = row.landmark, WAITING_WEIGHT - row.range
    state.members[0] += 1
    return True


@no_alloc
def _stored_ranges(state: State, row: Row, scratch: Scratch) -> Ranges:
    """Return the stored ranges of a measured landmark; nothing may be deferred."""
    joint, points, at, count = state.joint, state.joint.W[0], scratch.source, 0
    for member in range(state.members[0]):
        if state.landmark[member] == row.landmark:
            i = 3 + 2 * member
            points[2 * count], points[2 * count + 1] = joint.mean[i], joint.mean[i + 1]
            scratch.likelihood[count] = WAITING_WEIGHT - state.weight[member]
            scratch.share[count], at[count] = row.range_variance, i
            count += 1
    measured = scratch.likelihood, scratch.share
    return Ranges(points, *measured, at, joint.covariance, count, joint.W[1:])


@no_alloc
def place_by_ranges(state: State, row: Row, loss: Whole, scratch: Scratch) -> None:
    """Initialise a landmark where its stored ranges leave a single place; correlate it."""
    mean, P, i = state.joint.mean, state.joint.covariance, 3 + 2 * state.members[0]
    ranges = _stored_ranges(state, row, scratch)
    places, place, _ = located(ranges, mean[0], mean[1], loss)
    if places != 1:
        return
    place = refined(ranges, place[0], place[1], loss)
    mean[i], mean[i + 1] = place[0], place[1]
    at, n, work = ranges.at, ranges.count, ranges.work
    gx, gy, c, s = work[0], work[1], work[2], work[3]
    xx, xy, yy, variance = 0.0, 0.0, 0.0, row.range_variance * misfit(place[2], n)
    for j in range(n):
        dx, dy = mean[i] - mean[at[j]], mean[i + 1] - mean[at[j] + 1]
        away = max(math.sqrt(dx * dx + dy * dy), NEAREST)
        c[j], s[j], off = dx / away, dy / away, away - ranges.distance[j]
        noise = variance * robust_loss(off * off / variance, loss)[0]
        xx, xy = xx + noise * gx[j] * gx[j], xy + noise * gx[j] * gy[j]
        yy += noise * gy[j] * gy[j]
    for a in range(i):
        px = py = 0.0
        for j in range(n):
            along = c[j] * P[at[j], a] + s[j] * P[at[j] + 1, a]
            px, py = px + gx[j] * along, py + gy[j] * along
        P[i, a] = P[a, i] = px
        P[i + 1, a] = P[a, i + 1] = py
    for j in range(n):
        by_x = c[j] * P[i, at[j]] + s[j] * P[i, at[j] + 1]
        by_y = c[j] * P[i + 1, at[j]] + s[j] * P[i + 1, at[j] + 1]
        xx, xy, yy = xx + gx[j] * by_x, xy + gy[j] * by_x, yy + gy[j] * by_y
    P[i, i], P[i + 1, i + 1] = xx, yy
    P[i, i + 1] = P[i + 1, i] = xy
    member = state.members[0]
    state.landmark[member], state.weight[member] = row.landmark, 1.0
    state.members[0] += 1
    drop_stored(state, row.landmark, scratch, 0)


@no_alloc
def place_at_crossing(state: State, first: Whole, row: Row, loss: Whole) -> bool:
    """Initialise a landmark where two bearings cross; return False if this is too uncertain.

    It replaces the first stored point; the caller drops the second. A robust loss needs larger
    angles.
    """
    joint, size, i = state.joint, 3 + 2 * state.members[0], 3 + 2 * first
    mean, P, turns = joint.mean, joint.covariance, joint.turns
    direction, bearing_variance = mean[2] + row.bearing, row.bearing_variance
    # The stored line through the points at i and i + 2, with normal n, and u from the vehicle.
    along_x, along_y = mean[i + 2] - mean[i], mean[i + 3] - mean[i + 1]
    length = math.sqrt(along_x * along_x + along_y * along_y)
    nx, ny = -along_y / length, along_x / length
    ux, uy = math.cos(direction), math.sin(direction)
    sine = nx * ux + ny * uy
    if abs(sine) < (PARALLEL_SINE if loss == SQUARED else MIN_CROSSING_SINE):
        return False
    dx, dy = mean[i] - mean[0], mean[i + 1] - mean[1]
    r = (nx * dx + ny * dy) / sine
    t = ((r * ux - dx) * along_x + (r * uy - dy) * along_y) / (length * length)
    lever = r * (nx * uy - ny * ux) / sine  # dr = lever dphi
    by_bearing = lever * lever * bearing_variance
    if r < NEAREST or t <= 0.0 or not is_certain(r, by_bearing):
        return False
    flush(joint, size)
    # w: covariances of r with the state; its variance, without the bearing's.
    w, x, y, turn = joint.W[0], joint.W[1], joint.W[2], lever * turns
    for a in range(size):
        along = nx * ((1.0 - t) * P[i, a] + t * P[i + 2, a] - P[0, a])
        along += ny * ((1.0 - t) * P[i + 1, a] + t * P[i + 3, a] - P[1, a])
        w[a] = along / sine + turn * P[2, a]
    own = nx * ((1.0 - t) * w[i] + t * w[i + 2] - w[0])
    own += ny * ((1.0 - t) * w[i + 1] + t * w[i + 3] - w[1])
    variance = own / sine + turn * w[2]
    if not is_certain(r, variance + by_bearing):
        return False
    # dl = dp + u dr + r u' (turns dtheta + dphi), with u' perpendicular to u.
    gx, gy = -r * uy * turns, r * ux * turns
    for a in range(size):
        x[a] = P[0, a] + ux * w[a] + gx * P[2, a]
        y[a] = P[1, a] + uy * w[a] + gy * P[2, a]
    rx = w[0] + ux * variance + gx * w[2]  # covariance of r with the landmark
    ry = w[1] + uy * variance + gy * w[2]
    bx, by = ux * lever - r * uy, uy * lever + r * ux
    xx = x[0] + ux * rx + gx * x[2] + bx * bx * bearing_variance
    yy = y[1] + uy * ry + gy * y[2] + by * by * bearing_variance
    xy = x[1] + uy * rx + gy * x[2] + bx * by * bearing_variance
    for a in range(size):
        P[i, a] = P[a, i] = x[a]
        P[i + 1, a] = P[a, i + 1] = y[a]
    P[i, i], P[i + 1, i + 1] = xx, yy
    P[i, i + 1] = P[i + 1, i] = xy
    mean[i], mean[i + 1] = mean[0] + r * ux, mean[1] + r * uy
    state.weight[first] = 1.0
    return True


ROBUST_BEARING_FACTOR = 3.0
"""Factor on bearing standard deviations with the robust setting, as a wrong initial position would
displace all later landmarks."""


@no_alloc
def relative_range_variance(
    joint: Joint,
    size: Whole,
    iy: Whole,
    of_caller: Flag,
    measured: tuple[float, float, float, float],
) -> float:
    """Return the relative variance of a range by excess path and bearing; infinity if uncertain.

    ``measured`` is excess path, its variance, bearing and its variance. ``of_caller`` selects the
    caller's range, with a landmark at index iy.
    """
    (path, along, bearing, across), mean, turns = measured, joint.mean, joint.turns
    p2 = joint.covariance[2]
    xx, xy, yy = relative_covariance(joint, size, iy)
    xh, yh = turns * (p2[iy] - p2[0]), turns * (p2[iy + 1] - p2[1])
    clue = mean[iy] - mean[0], mean[iy + 1] - mean[1], mean[2] + bearing, path
    spread = xx, xy, yy, xh, yh, turns * turns * p2[2] + across, along
    away, variance = unscented_range(clue, spread, of_caller)
    return variance / (away * away) if is_certain(away, variance) else math.inf


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

    Arguments as in `relative_range_variance`; no columns may be deferred.
    """
    excess_path, along, bearing, across = measured
    mean, covariance, turns = joint.mean, joint.covariance, joint.turns
    direction = mean[2] + bearing
    c, s = math.cos(direction), math.sin(direction)
    x, y, px, py = mean[0], mean[1], mean[iy], mean[iy + 1]
    r, ax, ay, k, side = range_with_slopes(excess_path, x, y, px, py, direction, of_caller)
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


@no_alloc
def single(state: State, label: Whole) -> Whole:
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
        other = single(state, paths.landmark[d] if of_caller else paths.caller[d])
        if other < 0:
            continue
        measured = (paths.excess_path[d], paths.variance[d], row.bearing, across)
        share = relative_range_variance(state.joint, size, 3 + 2 * other, of_caller, measured)
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
    other = single(state, paths.landmark[d] if of_caller else paths.caller[d])
    measured = (paths.excess_path[d], paths.variance[d], row.bearing, row.bearing_variance)
    size = 3 + 2 * state.members[0]
    place_by_excess_path(state.joint, size, 3 + 2 * first, 3 + 2 * other, of_caller, measured)
    paths.used[d] = True
    return True
