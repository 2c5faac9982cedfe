r"""Delayed initialization: store precise bearings until a second bearing crosses them.

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

**Second order.** Let :math:`P_{aa}, P_{cc}, P_{ac}` be the covariance of a landmark relative to
the vehicle, along and across the line of sight. Its bearing then has a bias of
:math:`-P_{ac}/r^2` and the additional variance :math:`(P_{aa} P_{cc} + P_{ac}^2)/r^4`
(Bar-Shalom, Li & Kirubarajan 2001, Sec. 10.3.2), for which precise bearings are corrected.
"""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from pipistrelle.estimation.ekf.gaussian import (
    Joint,
    Labels,
    State,
    flush,
    initialise,
    relative_covariance,
)
from pipistrelle.estimation.measurement import (
    MAX_RELATIVE_RANGE_STD,
    NEAREST,
    Row,
    observe,
)
from pipistrelle.estimation.rays import FITTED, UpdateParams
from pipistrelle.jit import Whole, kernel, no_alloc


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
MIN_CROSSING_SINE = 0.35
"""Least sine of a crossing angle with the robust setting, where bearings may have gross errors:
many bearings of small angle would seem to cross at once."""


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
def second_order_bearing(joint: Joint, size: Whole, i: Whole, row: Row) -> tuple[float, float]:
    """Correct a bearing for its second-order bias; return it and its larger variance."""
    mean = joint.mean
    _, _, c, s, k = observe(mean[0], mean[1], mean[2], mean[i], mean[i + 1])
    xx, xy, yy = relative_covariance(joint, size, i)
    along = c * c * xx + 2.0 * c * s * xy + s * s * yy
    across = s * s * xx - 2.0 * c * s * xy + c * c * yy
    cross = c * s * (yy - xx) + (c * c - s * s) * xy
    square = k * k
    variance = row.bearing_variance + (along * across + cross * cross) * square * square
    return row.bearing + cross * square, variance


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


@no_alloc
def place_at_crossing(state: State, first: Whole, row: Row, robust: bool) -> bool:
    """Initialise a landmark where two bearings cross; return False if this is too uncertain.

    It replaces the first stored point; the caller drops the second. ``robust``: larger angles only.
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
    if abs(sine) < (MIN_CROSSING_SINE if robust else PARALLEL_SINE):
        return False
    dx, dy = mean[i] - mean[0], mean[i + 1] - mean[1]
    r = (nx * dx + ny * dy) / sine
    t = ((r * ux - dx) * along_x + (r * uy - dy) * along_y) / (length * length)
    lever = r * (nx * uy - ny * ux) / sine  # dr = lever dphi
    by_bearing = lever * lever * bearing_variance
    most = MAX_RELATIVE_RANGE_STD * MAX_RELATIVE_RANGE_STD * r * r
    if r < NEAREST or t <= 0.0 or by_bearing > most:
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
    if variance + by_bearing > most:
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
