r"""Detours in one Gaussian: when an echo of another's call came, not only whence.

A detour :math:`e = |b - l| + |l - p| - |b - p|` binds the vehicle p, the landmark l and the caller
b, each a part of the state, and asks nothing of the heading. With :math:`e_l, e_b` its slopes by
landmark and caller, and :math:`e_p = -e_l - e_b`,

- it **corrects** all three where landmark and caller are placed (`correct_detour`), to second
  order: a way of length L of which the variance across is t is longer by :math:`t / 2L` than its
  means say, which is known to the square of that (Bar-Shalom, Li & Kirubarajan 2001,
  Sec. 10.3.2): what has just been placed is unsure of its ways;
- it **places** one of the two that is new or a ray, x, by the other, y, which is placed: with the
  bearing, whose direction is u, there is one range r in closed form
  (`pipistrelle.estimation.measurement.landmark_range`), and

  .. math:: dx = dp + u\, a^T (dy - dp) + q\,(d\theta + d\phi) + \frac{u}{k} de, \quad
            k = e_x \cdot u, \quad a = -\frac{e_y}{k}, \quad
            q = r \left( u_\perp - u \frac{e_x \cdot u_\perp}{k} \right)

  correlates it with the caller as with the vehicle (`place_by_detour`). Between vehicle and caller
  k vanishes, and the range is anybody's guess: it must be known to a tenth of itself, and the
  detour be surely one (`SOME`), for any error of none has a range, and seems sure;
- else it **weighs** the members of a ray (`weigh_by_detour`).

Between two rays a detour says nothing: a pair of members fits any.
"""

import math

import numpy as np
from jaxtyping import Float

from pipistrelle.estimation.ekf.gaussian import (
    APPLIED,
    GATED,
    MOST_WAITING,
    WAITING,
    Joint,
    State,
    defer,
    flush,
    point_rows,
    retract,
)
from pipistrelle.estimation.measurement import (
    BELIEVED,
    NEAREST,
    SOME,
    caller_range_by_detour,
    detour_slopes,
    range_by_detour,
)
from pipistrelle.estimation.rays import log_likelihood
from pipistrelle.jit import Flag, Whole, no_alloc

SURE = 0.1
"""Largest standard deviation of a range by which a detour places a point, as a share of it."""


@no_alloc
def _bend(dx: float, dy: float, xx: float, xy: float, yy: float) -> float:
    """Variance across a way of which the covariance is known, over its length."""
    square = dx * dx + dy * dy
    across = dy * dy * xx - 2.0 * dx * dy * xy + dx * dx * yy
    return max(across, 0.0) / max(square * math.sqrt(square), NEAREST**3)


@no_alloc
def _expected(
    joint: Joint, size: Whole, i: Whole, ib: Whole, w: Float[np.ndarray, " m"]
) -> tuple[float, float]:
    """Detour over the point at index i of the caller at ib, and its variance; P H^T goes into w."""
    mean = joint.mean
    detour, lx, ly, bx, by = detour_slopes(
        mean[0], mean[1], mean[i], mean[i + 1], mean[ib], mean[ib + 1]
    )
    px, py = -lx - bx, -ly - by
    p0, p1 = joint.covariance[0], joint.covariance[1]
    li, lj = point_rows(joint, size, i)
    bi, bj = point_rows(joint, size, ib)
    for a in range(size):
        w[a] = px * p0[a] + py * p1[a] + lx * li[a] + ly * lj[a] + bx * bi[a] + by * bj[a]
    variance = px * w[0] + py * w[1] + lx * w[i] + ly * w[i + 1] + bx * w[ib] + by * w[ib + 1]
    return detour, variance


@no_alloc
def _bends(joint: Joint, size: Whole, i: Whole, ib: Whole) -> tuple[float, float]:
    """How much longer the detour is to second order, and how much larger its variance, at most."""
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
def correct_detour(
    joint: Joint,
    size: Whole,
    i: Whole,
    ib: Whole,
    detour: float,
    variance: float,
    bound: float,
    robust: bool,
) -> Whole:
    """Correct with a detour over the point at index i, its caller at ib; GATED beyond the bound.

    ``robust``: one that surprises counts less, as `estimation.ekf.huber` says.
    """
    if joint.taken[WAITING] == MOST_WAITING:
        flush(joint, size)
    w = joint.W[joint.taken[WAITING]]
    expected, spread = _expected(joint, size, i, ib, w)
    longer, wider = _bends(joint, size, i, ib)
    innovation, S = detour - expected - longer, spread + wider + variance
    if robust:
        S *= max(abs(innovation) / (BELIEVED * math.sqrt(S)), 1.0)
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
def tell_detour(joint: Joint, size: Whole, i: Whole, ib: Whole, variance: float) -> None:
    """Correct with a detour as expected, to first order: the covariance alone changes."""
    if joint.taken[WAITING] == MOST_WAITING:
        flush(joint, size)
    w = joint.W[joint.taken[WAITING]]
    _, spread = _expected(joint, size, i, ib, w)
    root = 1.0 / math.sqrt(spread + variance)
    for a in range(size):
        w[a] *= root
    defer(joint, size, w, 0.0)


@no_alloc
def weigh_by_detour(
    state: State,
    ray: tuple[Whole, Whole],
    other: Whole,
    of_caller: Flag,
    detour: float,
    variance: float,
    likelihood: Float[np.ndarray, " m"],
) -> None:
    """Write the log likelihoods of a detour by a ray's members, the other of the two being placed.

    ``ray`` is its first member and their number, ``other`` a member; ``of_caller``: the ray is the
    caller's.
    """
    joint, size = state.joint, 3 + 2 * state.members[0]
    if joint.taken[WAITING] == MOST_WAITING:
        flush(joint, size)
    w, iy = joint.W[joint.taken[WAITING]], 3 + 2 * other
    for j in range(ray[1]):
        ix = 3 + 2 * (ray[0] + j)
        i, ib = (iy, ix) if of_caller else (ix, iy)
        expected, spread = _expected(joint, size, i, ib, w)
        longer, wider = _bends(joint, size, i, ib)
        off, S = detour - expected - longer, spread + wider + variance
        likelihood[j] = log_likelihood(off, S, False)


@no_alloc
def _leverage(
    joint: Joint, iy: Whole, of_caller: Flag, detour: float, direction: float
) -> tuple[float, float, float, float, float]:
    """Where a detour and a direction place a point, by the one at index iy; r, a, k and e_x.u_perp.

    The range is 0 where there is none.
    """
    mean = joint.mean
    c, s = math.cos(direction), math.sin(direction)
    dx, dy = mean[iy] - mean[0], mean[iy + 1] - mean[1]
    if of_caller:
        r = caller_range_by_detour(detour, dx, dy, c, s)
    else:
        r = range_by_detour(detour, dx, dy, c, s)
    if not NEAREST < r < math.inf:
        return 0.0, 0.0, 0.0, 0.0, 0.0
    x, y = mean[0] + r * c, mean[1] + r * s
    if of_caller:
        _, yx, yy, xx, xy = detour_slopes(mean[0], mean[1], mean[iy], mean[iy + 1], x, y)
    else:
        _, xx, xy, yx, yy = detour_slopes(mean[0], mean[1], x, y, mean[iy], mean[iy + 1])
    k = xx * c + xy * s
    if k == 0.0:
        return 0.0, 0.0, 0.0, 0.0, 0.0
    return r, -yx / k, -yy / k, k, -xx * s + xy * c


@no_alloc
def unsure_by_detour(
    joint: Joint,
    size: Whole,
    iy: Whole,
    of_caller: Flag,
    measured: tuple[float, float, float, float],
) -> float:
    """Standard deviation of the range by a detour and a bearing, as a share of it; or infinity.

    ``measured`` are detour, its variance, bearing and its variance; ``of_caller``: the caller is
    placed by a landmark at index iy, else a landmark by the caller there. Infinite where it is more
    than `SURE`, and where the detour may be none (`SOME`).
    """
    detour, along, bearing, across = measured
    mean, turns = joint.mean, joint.turns
    if detour <= SOME * math.sqrt(along):
        return math.inf
    r, ax, ay, k, side = _leverage(joint, iy, of_caller, detour, mean[2] + bearing)
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
    return share if share <= SURE else math.inf


@no_alloc
def place_by_detour(
    joint: Joint,
    size: Whole,
    i: Whole,
    iy: Whole,
    of_caller: Flag,
    measured: tuple[float, float, float, float],
) -> None:
    """Put a member at index i, by a detour and a bearing, and by the point placed at index iy.

    As `unsure_by_detour` has them, which has found it sure. Nothing may wait; the first ``size``
    rows but the member's own are the rest of the state.
    """
    detour, along, bearing, across = measured
    mean, covariance, turns = joint.mean, joint.covariance, joint.turns
    direction = mean[2] + bearing
    c, s = math.cos(direction), math.sin(direction)
    r, ax, ay, k, side = _leverage(joint, iy, of_caller, detour, direction)
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
