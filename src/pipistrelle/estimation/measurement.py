"""The measurement model with its Jacobians: range, bearing and excess path of a point.

`Measurements` and `ExcessPaths` are the rows of a scan as the filters' kernels take them. A filter
that weighs what else a scan may hold (its levels) adds a field here.
"""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from pipistrelle.detection.scans import (
    BEARING,
    BEARING_STD,
    EXCESS_PATH,
    EXCESS_PATH_STD,
    RANGE,
    RANGE_STD,
    UNLABELLED,
    Scan,
)
from pipistrelle.geometry import wrap_angle
from pipistrelle.jit import Whole, kernel, no_alloc

NEAREST = 1e-3
"""Points nearer than this [m] are too near to linearise a measurement."""
MIN_TDOA_SIGMAS = 3.0
"""An excess path places something only if it is above so many of its standard deviations: that of a
point between vehicle and caller is 0, and an error would place the point near one of them,
seemingly surely."""
HUBER_K = 2.0
"""Standard deviations beyond which Huber's rule lets a measurement count less."""


class Measurements(NamedTuple):
    """Rows of a scan, each of a landmark of its own, as the kernels take them."""

    landmark: Int[np.ndarray, " m"]
    bearing: Float[np.ndarray, " m"]  # [rad]
    range: Float[np.ndarray, " m"]  # [m], NaN where passive
    bearing_variance: Float[np.ndarray, " m"]  # [rad^2]
    range_variance: Float[np.ndarray, " m"]  # [m^2]


class ExcessPaths(NamedTuple):
    """The rows of a scan that have an excess path and a caller with a known label."""

    landmark: Int[np.ndarray, " d"]  # no landmark is its own caller
    caller: Int[np.ndarray, " d"]
    excess_path: Float[np.ndarray, " d"]  # [m]
    variance: Float[np.ndarray, " d"]  # [m^2]
    row: Int[np.ndarray, " d"]  # index in the scan


Columns = tuple[Int[np.ndarray, " m"], Float[np.ndarray, "8 m"]]
"""Labels and numbers of a scan's rows."""
Timings = tuple[Int[np.ndarray, " m"], Int[np.ndarray, " callers"], Int[np.ndarray, " v"]]
"""Callers of a scan's rows; the labels of the callers, and of those that move."""


def columns_of(scan: Scan) -> Columns:
    """Return a scan as kernels take it: a plain tuple is passed faster than a record."""
    return scan.landmark, np.ascontiguousarray(scan.numbers)


def timings_of(scan: Scan) -> Timings | None:
    """Return caller columns of a scan as kernels take them; None where it names no caller.

    A kernel that gets None is compiled without its code for excess paths.
    """
    if scan.callers.size == 0 and scan.moving.size == 0:
        return None
    return scan.caller, scan.callers, scan.moving


@kernel
def measurements(columns: Columns) -> Measurements:
    """Return the bearings and ranges of a scan, with variances.

    Rows of an excess path without a bearing stand at the end and are left out.
    """
    landmark, numbers = columns
    rows = landmark.size
    while rows > 0 and math.isnan(numbers[BEARING, rows - 1]):
        rows -= 1
    bearing_std, range_std = numbers[BEARING_STD, :rows], numbers[RANGE_STD, :rows]
    return Measurements(
        landmark[:rows],
        numbers[BEARING, :rows],
        numbers[RANGE, :rows],
        bearing_std * bearing_std,
        range_std * range_std,
    )


@kernel
def excess_paths(columns: Columns, timings: Timings) -> ExcessPaths:
    """Return the excess paths of a scan. A caller's own row is no excess path over itself.

    >>> from dataclasses import replace
    >>> from pipistrelle.detection.scans import make_scan
    >>> timed = {"excess_path": np.array([3.0, np.nan, 2.0]), "excess_path_std": 0.5}
    >>> scan = make_scan(0.0, np.array([4, 5, 9]), np.zeros(3), caller=1, **timed)
    >>> scan = replace(scan, callers=np.array([-1, 9]))
    >>> of = excess_paths(columns_of(scan), timings_of(scan))
    >>> of.landmark, of.caller, of.variance
    (array([4]), array([9]), array([0.25]))
    """
    (landmark, numbers), (caller, callers, _) = columns, timings
    count, rows, whose = 0, np.empty(landmark.size, np.int64), np.empty(landmark.size, np.int64)
    for m in range(landmark.size):
        if math.isnan(numbers[EXCESS_PATH, m]) or caller[m] >= callers.size:
            continue
        label = callers[caller[m]]
        if label != UNLABELLED and label != landmark[m]:
            rows[count], whose[count] = m, label
            count += 1
    kept = rows[:count]
    std = numbers[EXCESS_PATH_STD][kept]
    return ExcessPaths(landmark[kept], whose[:count], numbers[EXCESS_PATH][kept], std * std, kept)


class Row(NamedTuple):
    """One of `Measurements`, as numbers: a kernel passes it faster than the arrays."""

    landmark: Whole
    bearing: float
    range: float
    bearing_variance: float
    range_variance: float


@no_alloc
def row_of(heard: Measurements, m: Whole) -> Row:
    """Return measurement m."""
    return Row(
        heard.landmark[m],
        heard.bearing[m],
        heard.range[m],
        heard.bearing_variance[m],
        heard.range_variance[m],
    )


@kernel
def observe(
    x: float, y: float, heading: float, px: float, py: float
) -> tuple[float, float, float, float, float]:
    """Return range, bearing, direction cosines and inverse range of a point, for kernels.

    Returns range [m], bearing [rad], cos c and sin s of the direction in the world, and k, the
    inverse of the range, bounded by `NEAREST`. The Jacobians follow: d range = (-c, -s, 0; c, s)
    and d bearing = (s k, -c k, -1; -s k, c k) by pose and point.
    """
    dx, dy = px - x, py - y
    distance = math.sqrt(dx * dx + dy * dy)
    inverse = 1.0 / max(distance, NEAREST)
    bearing = wrap_angle(math.atan2(dy, dx) - heading)
    return distance, bearing, dx * inverse, dy * inverse, inverse


def measurement_jacobians(
    pose: Float[np.ndarray, "3"], point: Float[np.ndarray, "2"]
) -> tuple[Float[np.ndarray, "2 3"], Float[np.ndarray, "2 2"]]:
    r"""Return the derivatives of range and bearing by the pose and by the landmark's position.

    .. math:: H_x = \begin{bmatrix} -c & -s & 0 \\ s/d & -c/d & -1 \end{bmatrix}, \qquad
              H_m = \begin{bmatrix} c & s \\ -s/d & c/d \end{bmatrix}

    with (c, s) the unit vector from the vehicle to the landmark and d their distance. A passive
    measurement is the bearing alone,

    .. math:: \phi_i = \operatorname{atan2}(y_i - y_v, x_i - x_v) - \theta_v
       :label: eq-7

    and has the second rows alone.

    Parameters
    ----------
    pose : (3) [m, m, rad]
    point : (2) [m]

    Returns
    -------
    H_x : (2, 3)
    H_m : (2, 2)

    Notes
    -----
    Bradley & Abaid, with Eqs. (6), (7) and (11).

    Examples
    --------
    >>> measurement_jacobians(np.zeros(3), np.array([2.0, 0.0]))[1]
    array([[ 1. ,  0. ],
           [-0. ,  0.5]])
    """
    _, _, c, s, k = observe(pose[0], pose[1], pose[2], point[0], point[1])
    return (np.array([[-c, -s, 0.0], [s * k, -c * k, -1.0]]), np.array([[c, s], [-s * k, c * k]]))


@kernel
def excess_path_slopes(
    x: float, y: float, px: float, py: float, bx: float, by: float
) -> tuple[float, float, float, float, float]:
    """Return the excess path over a point and its slopes, for kernels.

    The vehicle is at (x, y), the point at (px, py) and the caller at (bx, by). Returns the excess
    path [m], its derivatives by the point (2) and by the caller (2); those by the vehicle are minus
    their sum. Distances are bounded from below by `NEAREST`.
    """
    ux, uy, near = _away(x, y, px, py)
    wx, wy, onward = _away(bx, by, px, py)
    vx, vy, straight = _away(x, y, bx, by)
    return onward + near - straight, wx + ux, wy + uy, -wx - vx, -wy - vy


@kernel
def _away(x: float, y: float, px: float, py: float) -> tuple[float, float, float]:
    """Return the direction cosines and distance from (x, y) to (px, py)."""
    dx, dy = px - x, py - y
    distance = math.sqrt(dx * dx + dy * dy)
    inverse = 1.0 / max(distance, NEAREST)
    return dx * inverse, dy * inverse, distance


@kernel
def range_by_excess_path(excess_path: float, dx: float, dy: float, c: float, s: float) -> float:
    """Return the range of a point in direction (c, s) of the vehicle, the caller at (dx, dy).

    It is infinite or negative where no point there has such an excess path; see `landmark_range`.
    """
    if excess_path <= 0.0:
        return math.inf
    straight = math.sqrt(dx * dx + dy * dy)
    return (
        0.5
        * excess_path
        * (2.0 * straight + excess_path)
        / (straight + excess_path - c * dx - s * dy)
    )


@kernel
def caller_range_by_excess_path(
    excess_path: float, dx: float, dy: float, c: float, s: float
) -> float:
    """Return the range of a caller in direction (c, s) of the vehicle, the point at (dx, dy).

    It is infinite or negative where no caller there makes such an excess path.
    """
    if excess_path <= 0.0:
        return math.inf
    near = math.sqrt(dx * dx + dy * dy)
    return 0.5 * excess_path * (2.0 * near - excess_path) / (c * dx + s * dy + excess_path - near)


def excess_path_of(
    vehicle: Float[np.ndarray, "2"], point: Float[np.ndarray, "2"], caller: Float[np.ndarray, "2"]
) -> float:
    """Return how much longer the path of a sound over a point is than the straight one [m].

    .. math:: e = |b - l| + |l - p| - |b - p|

    Points of one excess path lie on an ellipse whose foci are the caller b and the vehicle p; all
    are x, y [m].

    Examples
    --------
    >>> excess_path_of(np.zeros(2), np.array([3.0, 4.0]), np.array([6.0, 0.0]))
    4.0
    """
    return excess_path_slopes(*vehicle, *point, *caller)[0]


def excess_path_jacobians(
    vehicle: Float[np.ndarray, "2"], point: Float[np.ndarray, "2"], caller: Float[np.ndarray, "2"]
) -> tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2"], Float[np.ndarray, "2"]]:
    r"""Return the derivatives of the excess path by vehicle, point and caller, (2) each.

    .. math:: e_l = w + u, \quad e_b = -w - v, \quad e_p = v - u

    with the unit vectors u and w to the point from the vehicle and from the caller, and v from the
    vehicle to the caller.
    """
    _, *slopes = excess_path_slopes(*vehicle, *point, *caller)
    by_point, by_caller = np.array(slopes[:2]), np.array(slopes[2:])
    return -by_point - by_caller, by_point, by_caller


def landmark_range(excess_path: float, caller: Float[np.ndarray, "2"], bearing: float) -> float:
    r"""Return the range of a point by its bearing and its excess path over a known caller.

    .. math:: r = \frac{(d + e)^2 - d^2}{2 (d + e - u \cdot v)}

    with v the vector from the vehicle to the caller, d its length and u the direction of the
    bearing: where the ray from the vehicle crosses the ellipse of that excess path. Between vehicle
    and caller numerator and denominator vanish together: there an excess path says nothing about
    the range. An excess path of 0 or less gives no range.

    Parameters
    ----------
    excess path : [m]
    caller : (2) [m]
        From the vehicle, in its axes.
    bearing : [rad]

    Returns
    -------
    [m]

    Examples
    --------
    >>> round(landmark_range(4.0, np.array([6.0, 0.0]), math.atan2(4.0, 3.0)), 9)
    5.0
    """
    dx, dy = caller
    return range_by_excess_path(excess_path, dx, dy, math.cos(bearing), math.sin(bearing))
