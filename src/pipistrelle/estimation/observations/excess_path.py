r"""Excess path of an echo (time difference of arrival): derivatives, and the range that it gives.

An excess path :math:`e = |b - l| + |l - p| - |b - p|` relates vehicle p, landmark l and caller b;
the heading does not enter. With the bearing of one end, and the position of the other, it gives the
range in closed form (`landmark_range`). Between vehicle and caller the range is undetermined, so an
excess path must be clearly above 0 (`MIN_TDOA_SIGMAS`).
"""

import math

import numpy as np
from jaxtyping import Float

from pipistrelle.config import FARTHEST
from pipistrelle.estimation.observations.range import NEAREST
from pipistrelle.jit import Flag, kernel, no_alloc

MIN_TDOA_SIGMAS = 3.0
"""Least ratio of an excess path to its standard deviation for initialisation. Between vehicle and
caller it is 0, and an error would falsely place a point near one of them with high confidence."""


@kernel
def excess_path_slopes(
    x: float, y: float, px: float, py: float, bx: float, by: float
) -> tuple[float, float, float, float, float]:
    """Return the excess path via a point, and its derivatives by point and caller.

    The vehicle is at (x, y), the point at (px, py) and the caller at (bx, by). Returns the excess
    path [m], its derivatives by the point (2) and by the caller (2); the derivatives by the vehicle
    are minus their sum. Distances are bounded from below by `NEAREST`.
    """
    ux, uy, near = _away(x, y, px, py)
    wx, wy, onward = _away(bx, by, px, py)
    vx, vy, straight = _away(x, y, bx, by)
    return onward + near - straight, wx + ux, wy + uy, -wx - vx, -wy - vy


@kernel
def _away(x: float, y: float, px: float, py: float) -> tuple[float, float, float]:
    """Return the unit vector and the distance from (x, y) to (px, py)."""
    dx, dy = px - x, py - y
    distance = math.sqrt(dx * dx + dy * dy)
    inverse = 1.0 / max(distance, NEAREST)
    return dx * inverse, dy * inverse, distance


@kernel
def range_by_excess_path(
    path: float, dx: float, dy: float, c: float, s: float, of_caller: Flag
) -> float:
    """Return a point's range [m] in direction (c, s) from its excess path and a caller's position.

    ``of_caller`` selects the range of a caller, for a point at (dx, dy). It is infinite or negative
    if nothing in this direction has the excess path (`landmark_range`).
    """
    if path <= 0.0:
        return math.inf
    away = math.sqrt(dx * dx + dy * dy)
    if of_caller:
        return 0.5 * path * (2.0 * away - path) / (c * dx + s * dy + path - away)
    return 0.5 * path * (2.0 * away + path) / (away + path - c * dx - s * dy)


def excess_path_of(
    vehicle: Float[np.ndarray, "2"], point: Float[np.ndarray, "2"], caller: Float[np.ndarray, "2"]
) -> float:
    """Return the excess path of an echo via a point [m]: its path length minus the direct path.

    .. math:: e = |b - l| + |l - p| - |b - p|

    Points of equal excess path form an ellipse with the caller b and the vehicle p as foci; all are
    x, y [m].

    >>> excess_path_of(np.zeros(2), np.array([3.0, 4.0]), np.array([6.0, 0.0]))
    4.0
    """
    return excess_path_slopes(*vehicle, *point, *caller)[0]


def landmark_range(excess_path: float, caller: Float[np.ndarray, "2"], bearing: float) -> float:
    r"""Return the range of a point [m] from its bearing and its excess path via a known caller.

    .. math:: r = \frac{(d + e)^2 - d^2}{2 (d + e - u \cdot v)}

    with v the vector from the vehicle to the caller (``caller``, in the vehicle's axes) [m], d its
    length, u the direction of the bearing [rad] and e the excess path [m]: the intersection of the
    bearing with the ellipse of equal excess path. Between vehicle and caller the range is
    undetermined (0 / 0). An excess path of 0 or less gives no range.

    >>> round(landmark_range(4.0, np.array([6.0, 0.0]), math.atan2(4.0, 3.0)), 9)
    5.0
    """
    dx, dy = caller
    return range_by_excess_path(excess_path, dx, dy, math.cos(bearing), math.sin(bearing), False)


@no_alloc
def range_with_slopes(
    path: float, x: float, y: float, px: float, py: float, direction: float, of_caller: Flag
) -> tuple[float, float, float, float, float]:
    r"""Return a point's range by its excess path and world direction, and its derivatives.

    The vehicle is at (x, y), the other end at (px, py); the rest as in `range_by_excess_path`.
    Returns the range [m] (0 if there is none), its derivatives by the other end's offset (2), and
    the derivatives of the excess path along and across the direction,

    .. math:: k = e_x \cdot u, \quad e_x \cdot u_\perp
    """
    c, s = math.cos(direction), math.sin(direction)
    r = range_by_excess_path(path, px - x, py - y, c, s, of_caller)
    if not NEAREST < r < math.inf:
        return 0.0, 0.0, 0.0, 0.0, 0.0
    ex, ey = x + r * c, y + r * s
    if of_caller:
        _, ax, ay, bx, by = excess_path_slopes(x, y, px, py, ex, ey)
    else:
        _, bx, by, ax, ay = excess_path_slopes(x, y, ex, ey, px, py)
    k = bx * c + by * s
    if k == 0.0:
        return 0.0, 0.0, 0.0, 0.0, 0.0
    return r, -ax / k, -ay / k, k, -bx * s + by * c


Clue = tuple[float, float, float, float]
"""Offset from the vehicle to the other end (2) [m], world direction [rad], and excess path [m]."""
Spread = tuple[float, float, float, float, float, float, float]
"""Covariance of a `Clue`: xx, xy, yy of the offset; x, y with the direction; both variances."""


@no_alloc
def unscented_range(clue: Clue, spread: Spread, of_caller: Flag) -> tuple[float, float]:
    """Compute a range [m] from an excess path, and its variance by an unscented transform.

    The eight sigma points are at two standard deviations (Julier & Uhlmann 1997); NaN if one has no
    range. In the example the landmark is at (3, 4), then between the two, and the caller at (6, 0).

    >>> spread = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.01
    >>> r, variance = unscented_range((6.0, 0.0, np.arctan2(4.0, 3.0), 4.0), spread, False)
    >>> round(r, 3), round(variance, 4)
    (5.0, 0.0061)
    >>> unscented_range((6.0, 0.0, 0.0, 0.0), spread, False)
    (nan, nan)
    """
    (dx, dy, direction, path), (xx, xy, yy, xh, yh, hh, ee) = clue, spread
    if path <= MIN_TDOA_SIGMAS * math.sqrt(ee):
        return math.nan, math.nan
    a = math.sqrt(xx) if xx > 0.0 else 0.0  # the Cholesky factor, by columns
    b, c = (xy / a, xh / a) if xx > 0.0 else (0.0, 0.0)
    d = math.sqrt(max(yy - b * b, 0.0))
    e = (yh - b * c) / d if d > 0.0 else 0.0
    f, g = math.sqrt(max(hh - c * c - e * e, 0.0)), math.sqrt(ee)
    steps = (a, b, c, 0.0), (0.0, d, e, 0.0), (0.0, 0.0, f, 0.0), (0.0, 0.0, 0.0, g)
    middle, total = _range(path, dx, dy, direction, of_caller), 0.0
    for step in steps:
        for side in (-2.0, 2.0):
            x, y, turned, longer = side * step[0], side * step[1], side * step[2], side * step[3]
            other = _range(path + longer, dx + x, dy + y, direction + turned, of_caller)
            total += (other - middle) ** 2
    return (middle, total / 8.0) if 0.0 < middle < FARTHEST else (math.nan, math.nan)


@no_alloc
def _range(path: float, dx: float, dy: float, direction: float, of_caller: Flag) -> float:
    """Return a range [m] as `range_by_excess_path`, or NaN if nothing has the excess path."""
    c, s = math.cos(direction), math.sin(direction)
    found = range_by_excess_path(path, dx, dy, c, s, of_caller)
    return found if 0.0 < found < FARTHEST else math.nan
