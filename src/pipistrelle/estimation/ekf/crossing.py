r"""Precise bearings: what a Gaussian member of a ray is too coarse for.

**A bearing waits.** A landmark that is first heard by a bearing too precise for the members of a
ray (`is_precise`) enters the state as the ray itself: the point :math:`p_0` from which it was heard
and a point q that it was heard through, which the filter carries, correlated with all else, like
any other point. No range is guessed. When a later bearing, in the direction u from p, crosses it,

.. math:: l = p + r u, \quad r = \frac{n \cdot (p_0 - p)}{n \cdot u}, \quad n \perp q - p_0,

the landmark is placed there, if the crossing is before both and r known to a fifth of itself: the
position of a farther one would be no Gaussian. Until then its bearings say nothing to the filter.
The covariance of l follows from the derivative

.. math:: n \cdot u\, dr = n \cdot \left( (1 - t) dp_0 + t\, dq - dp \right)
          - r (n \cdot u_\perp)(d\theta + d\phi)

with t the crossing's place on the first ray in units of :math:`|q - p_0|`.

**Its curvature is noise.** A bearing of a landmark of which along and across the line of sight the
relative covariance is :math:`P_{aa}, P_{cc}, P_{ac}` is, to second order, off by
:math:`-P_{ac}/r^2` with the variance :math:`(P_{aa} P_{cc} + P_{ac}^2)/r^4` besides (Bar-Shalom,
Li & Kirubarajan 2001, Sec. 10.3.2). A precise bearing is corrected for the one, and told the other
beside its R: what has just been placed is not pulled by more than the line it lies on.
"""

import math

from pipistrelle.estimation.ekf.gaussian import (
    Joint,
    State,
    flush,
    initialise,
    relative_covariance,
)
from pipistrelle.estimation.measurement import NEAREST, Row, observe
from pipistrelle.estimation.rays import FITTED, Sensing
from pipistrelle.jit import Whole, no_alloc

WAITS = -1.0
"""Weight of the two points of a bearing that waits."""
SURE = 0.2
"""Largest standard deviation of a placed landmark's range, as a share of it."""
PARALLEL = 1e-9
"""Sine under which two bearings do not cross."""
PARALLAX = 0.35
"""Least sine at which they do where some may be off by more than they say, by degrees at times: of
many bearings those would seem to cross first, and two have nobody to surprise."""


@no_alloc
def linear_to(sensing: Sensing) -> float:
    """How far [rad] a bearing of a ray's member is off that is linear in it, seen from the side."""
    share = sensing.ray_stds[0] / sensing.ray_ranges[0]
    return 0.5 * share * share


@no_alloc
def is_precise(row: Row, sensing: Sensing) -> bool:
    """Whether a bearing is more precise than a ray's members are linear, and they are fitted."""
    return sensing.sharing == FITTED and row.bearing_variance < linear_to(sensing) ** 2


@no_alloc
def curved(joint: Joint, size: Whole, i: Whole, row: Row) -> tuple[float, float]:
    """A bearing of the member at state index i without its second-order bias; variance with it."""
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
def await_crossing(state: State, row: Row, sensing: Sensing) -> None:
    """Append where a bearing was heard from, and a point that it was heard through."""
    through = sensing.ray_ranges[sensing.ray_ranges.size // 2]
    for ahead in (0.0, through):
        member = state.members[0]
        size = 3 + 2 * member
        initialise(state.joint, size, size, ahead, row.bearing, 0.0, row.bearing_variance)
        state.landmark[member], state.weight[member] = row.landmark, WAITS
        state.members[0] += 1


@no_alloc
def _from_vehicle(
    joint: Joint, i: Whole, direction: float
) -> tuple[float, float, float, float, float]:
    """Where a direction crosses the ray through the points at i and i + 2.

    Returns the normal of that ray, the sine of the crossing, r, and t in units of |q - p0|.
    """
    mean = joint.mean
    x, y = mean[i + 2] - mean[i], mean[i + 3] - mean[i + 1]
    length = math.sqrt(x * x + y * y)
    nx, ny = -y / length, x / length
    ux, uy = math.cos(direction), math.sin(direction)
    sine = nx * ux + ny * uy
    dx, dy = mean[i] - mean[0], mean[i + 1] - mean[1]
    if abs(sine) < PARALLEL:
        return nx, ny, sine, -1.0, -1.0
    r = (nx * dx + ny * dy) / sine
    return nx, ny, sine, r, ((r * ux - dx) * x + (r * uy - dy) * y) / (length * length)


@no_alloc
def _range_row(
    joint: Joint, size: Whole, i: Whole, normal: tuple[float, float, float], t: float, lever: float
) -> float:
    """Write covariances of r with the state into W[0]; return its variance without the bearing's.

    ``normal`` is n and n . u, ``lever`` what r gains by a turn of the direction.
    """
    P, w, (nx, ny, sine) = joint.covariance, joint.W[0], normal
    turn = lever * joint.turns
    for a in range(size):
        along = nx * ((1.0 - t) * P[i, a] + t * P[i + 2, a] - P[0, a])
        along += ny * ((1.0 - t) * P[i + 1, a] + t * P[i + 3, a] - P[1, a])
        w[a] = along / sine + turn * P[2, a]
    own = nx * ((1.0 - t) * w[i] + t * w[i + 2] - w[0])
    own += ny * ((1.0 - t) * w[i + 1] + t * w[i + 3] - w[1])
    return own / sine + turn * w[2]


@no_alloc
def place_crossing(state: State, first: Whole, row: Row, robust: bool) -> bool:
    """Place a landmark where a bearing crosses the one that waits, if that is sure enough.

    It takes the place of the first of the two points; the second is left to be dropped. ``robust``:
    a bearing may be off by more than it says.
    """
    joint, size, i = state.joint, 3 + 2 * state.members[0], 3 + 2 * first
    mean, direction = joint.mean, joint.mean[2] + row.bearing
    nx, ny, sine, r, t = _from_vehicle(joint, i, direction)
    ux, uy = math.cos(direction), math.sin(direction)
    least = PARALLAX if robust else PARALLEL
    lever, most = r * (nx * uy - ny * ux) / sine, SURE * SURE * r * r
    by_bearing = lever * lever * row.bearing_variance
    if abs(sine) < least or r < NEAREST or t <= 0.0 or by_bearing > most:
        return False
    flush(joint, size)
    variance = _range_row(joint, size, i, (nx, ny, sine), t, lever)
    if variance + by_bearing > most:
        return False
    _take_place(joint, size, i, (ux, uy, r, lever), variance, row.bearing_variance)
    mean[i], mean[i + 1] = mean[0] + r * ux, mean[1] + r * uy
    state.weight[first] = 1.0
    return True


@no_alloc
def _take_place(
    joint: Joint,
    size: Whole,
    i: Whole,
    crossing: tuple[float, float, float, float],
    range_variance: float,
    bearing_variance: float,
) -> None:
    """Write the rows of a landmark at p + r u into those of the point at i.

    Of dl = dp + u dr + r u' (turns dtheta + dphi), where u' is u turned left.
    """
    P, (ux, uy, r, lever) = joint.covariance, crossing
    w, x, y = joint.W[0], joint.W[1], joint.W[2]
    gx, gy = -r * uy * joint.turns, r * ux * joint.turns
    for a in range(size):
        x[a] = P[0, a] + ux * w[a] + gx * P[2, a]
        y[a] = P[1, a] + uy * w[a] + gy * P[2, a]
    rx = w[0] + ux * range_variance + gx * w[2]  # of r with the landmark
    ry = w[1] + uy * range_variance + gy * w[2]
    bx, by = ux * lever - r * uy, uy * lever + r * ux
    xx = x[0] + ux * rx + gx * x[2] + bx * bx * bearing_variance
    yy = y[1] + uy * ry + gy * y[2] + by * by * bearing_variance
    xy = x[1] + uy * rx + gy * x[2] + bx * by * bearing_variance
    for a in range(size):
        P[i, a] = P[a, i] = x[a]
        P[i + 1, a] = P[a, i + 1] = y[a]
    P[i, i], P[i + 1, i + 1] = xx, yy
    P[i, i + 1] = P[i + 1, i] = xy
