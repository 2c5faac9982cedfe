"""The measurement model with Jacobians: range, bearing and excess path of a point.

`Row` and `ExcessPaths` hold a scan's measurements as the estimators' kernels take them.
"""

import math
from typing import NamedTuple, get_args

import numpy as np
from jaxtyping import Bool, Float, Int

from pipistrelle.config import FilterConfig
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
from pipistrelle.jit import Flag, Whole, kernel, no_alloc

NEAREST = 1e-3
"""Distance [m] below which a measurement is not linearised."""
MIN_TDOA_SIGMAS = 3.0
"""Least ratio of an excess path to its standard deviation for initialisation. Between vehicle and
caller it is 0, and an error would falsely place a point near one of them with high confidence."""
MAX_RELATIVE_RANGE_STD = 0.2
"""Largest standard deviation of the range of a crossing, or in the smoother by an excess path, that
initialises a landmark, relative to the range."""
LOSSES = get_args(FilterConfig.model_fields["robust"].annotation)
"""Names of the robust losses; their codes in kernels are their places."""
SQUARED, HUBER, CAUCHY = range(len(LOSSES))
HUBER_K = 2.0
"""Standard deviations above which Huber's loss down-weights a measurement."""
CAUCHY_K = 2.385
"""Scale of Cauchy's loss [standard deviations]: normal errors keep 95 % of their information."""


@no_alloc
def robust_loss(squared: float, loss: Whole) -> tuple[float, float]:
    r"""Return the factor on the variance of a measurement, and twice its loss.

    With the squared residual :math:`e^2` in units of its variance, the loss is e²/2 (SQUARED),

    .. math:: k e - \tfrac12 k^2 \; (e > k), \qquad \tfrac12 c^2 \ln(1 + e^2 / c^2)

    (HUBER, CAUCHY), and the factor the inverse of its weight: e / k and 1 + e² / c². Sources:
    Huber, Robust Statistics (1981); Holland & Welsch, Communications in Statistics 6 (1977).
    """
    if loss == CAUCHY:
        factor = 1.0 + squared / (CAUCHY_K * CAUCHY_K)
        return factor, CAUCHY_K * CAUCHY_K * math.log(factor)
    if loss == HUBER and squared > HUBER_K * HUBER_K:
        size = math.sqrt(squared)
        return size / HUBER_K, HUBER_K * (2.0 * size - HUBER_K)
    return 1.0, squared


class Row(NamedTuple):
    """A measured bearing and range with their variances, as scalars."""

    landmark: Whole
    bearing: float  # [rad], NaN for a range-only measurement
    range: float  # [m], NaN if passive
    bearing_variance: float  # [rad^2]
    range_variance: float  # [m^2]


class ExcessPaths(NamedTuple):
    """Measured excess paths of a scan, with landmark, caller and variance of each."""

    landmark: Int[np.ndarray, " d"]  # never the caller
    caller: Int[np.ndarray, " d"]
    excess_path: Float[np.ndarray, " d"]  # [m]
    variance: Float[np.ndarray, " d"]  # [m^2]
    row: Int[np.ndarray, " d"]  # index in the scan
    used: Bool[np.ndarray, " d"]  # whether it has initialised a landmark or caller


Columns = tuple[Int[np.ndarray, " m"], Float[np.ndarray, "8 m"]]
"""Labels and numbers of a scan's measurements."""
Timings = tuple[Int[np.ndarray, " m"], Int[np.ndarray, " callers"], Int[np.ndarray, " v"]]
"""Caller of each measurement of a scan; labels of the callers, and of the moving callers."""


def scan_columns(scan: Scan) -> Columns:
    """Return a scan's labels and numbers as a tuple of arrays, for compiled functions."""
    return scan.landmark, np.ascontiguousarray(scan.numbers)


def timings_of(scan: Scan) -> Timings | None:
    """Return a scan's callers as arrays for compiled functions, or None if it names no caller.

    For None, kernels are compiled without code for excess paths.
    """
    if scan.callers.size == 0 and scan.moving.size == 0:
        return None
    return scan.caller, scan.callers, scan.moving


@no_alloc
def rows_with_bearing(columns: Columns) -> Whole:
    """Count a scan's measurements with a bearing; others, a range or an excess path, come last."""
    rows, bearing = columns[0].size, columns[1][BEARING]
    while rows > 0 and math.isnan(bearing[rows - 1]):
        rows -= 1
    return rows


@no_alloc
def row_of(columns: Columns, m: Whole) -> Row:
    """Return bearing and range of measurement m in a scan, with variances, as scalars."""
    landmark, numbers = columns
    across, along = numbers[BEARING_STD, m], numbers[RANGE_STD, m]
    return Row(landmark[m], numbers[BEARING, m], numbers[RANGE, m], across * across, along * along)


@kernel
def excess_paths(columns: Columns, timings: Timings) -> ExcessPaths:
    """Return the excess paths in a scan, without the callers' direct calls.

    >>> from dataclasses import replace
    >>> from pipistrelle.detection.scans import make_scan
    >>> timed = {"excess_path": np.array([3.0, np.nan, 2.0]), "excess_path_std": 0.5}
    >>> scan = make_scan(0.0, np.array([4, 5, 9]), np.zeros(3), caller=1, **timed)
    >>> scan = replace(scan, callers=np.array([-1, 9]))
    >>> of = excess_paths(scan_columns(scan), timings_of(scan))
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
    kept, used = rows[:count], np.zeros(count, np.bool_)
    path, std = numbers[EXCESS_PATH][kept], numbers[EXCESS_PATH_STD][kept]
    return ExcessPaths(landmark[kept], whose[:count], path, std * std, kept, used)


def caller_labels(scan: Scan) -> Int[np.ndarray, " m"]:
    """Return the caller's label for each measurement with an excess path, else UNLABELLED."""
    labels, timings = np.full(scan.landmark.size, UNLABELLED), timings_of(scan)
    if timings is not None:
        found = excess_paths(scan_columns(scan), timings)
        labels[found.row] = found.caller
    return labels


@kernel
def observe(
    x: float, y: float, heading: float, px: float, py: float
) -> tuple[float, float, float, float, float]:
    """Return range, bearing, direction cosines and inverse range of a point from a pose.

    Returns range [m], bearing [rad], cos c and sin s of the direction in the world, and k, the
    inverse of the range, bounded by `NEAREST` (`bearing_slopes`, `range_slopes`).
    """
    dx, dy = px - x, py - y
    distance = math.sqrt(dx * dx + dy * dy)
    inverse = 1.0 / max(distance, NEAREST)
    bearing = wrap_angle(math.atan2(dy, dx) - heading)
    return distance, bearing, dx * inverse, dy * inverse, inverse


Slopes = tuple[float, float, float]
"""Derivatives by x, y and heading of the pose; by a point they are minus the first two."""


@kernel
def bearing_slopes(c: float, s: float, k: float) -> Slopes:
    """Return the derivatives of a bearing by the pose, from the numbers of `observe`."""
    return s * k, -c * k, -1.0


@kernel
def range_slopes(c: float, s: float) -> Slopes:
    """Return the derivatives of a range by the pose, from the numbers of `observe`."""
    return -c, -s, 0.0


def measurement_jacobians(
    pose: Float[np.ndarray, "3"], point: Float[np.ndarray, "2"]
) -> tuple[Float[np.ndarray, "2 3"], Float[np.ndarray, "2 2"]]:
    r"""Return the derivatives of range and bearing by the pose and by the landmark's position.

    .. math:: H_x = \begin{bmatrix} -c & -s & 0 \\ s/d & -c/d & -1 \end{bmatrix}, \qquad
              H_m = \begin{bmatrix} c & s \\ -s/d & c/d \end{bmatrix}

    with (c, s) the unit vector from the vehicle to the landmark and d their distance. A passive
    measurement is only the bearing,

    .. math:: \phi_i = \operatorname{atan2}(y_i - y_v, x_i - x_v) - \theta_v
       :label: eq-7

    with only the second rows (Bradley & Abaid, Eqs. (6), (7) and (11)). ``pose`` is (3) [m, m,
    rad], ``point`` (2) [m]; returns H_x (2, 3) and H_m (2, 2).

    >>> measurement_jacobians(np.zeros(3), np.array([2.0, 0.0]))[1]
    array([[ 1. ,  0. ],
           [-0. ,  0.5]])
    """
    _, _, c, s, k = observe(pose[0], pose[1], pose[2], point[0], point[1])
    by_pose = np.array([range_slopes(c, s), bearing_slopes(c, s, k)])
    return by_pose, -by_pose[:, :2]


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
