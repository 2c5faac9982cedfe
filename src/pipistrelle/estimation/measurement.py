"""The measurement model with its Jacobians: range and bearing of a point.

`Measurements` are the rows of a scan as the filters' kernels take them. A filter that weighs what
else a scan may hold (its detours, its levels) adds a field here.
"""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from pipistrelle.detection.scans import BEARING, BEARING_STD, RANGE, RANGE_STD, Scan
from pipistrelle.geometry import wrap_angle
from pipistrelle.jit import Whole, kernel, no_alloc

NEAREST = 1e-3
"""A measurement of a point nearer than this [m] says nothing that can be linearised."""
BELIEVED = 2.0
"""Standard deviations that a measurement may be off before Huber's rule lets it count less."""


class Measurements(NamedTuple):
    """Rows of a scan, each of a landmark of its own, as the kernels take them.

    Attributes
    ----------
    landmark : (m)
        Label.
    bearing : (m) [rad]
    range : (m) [m]
        NaN where passive.
    bearing_variance, range_variance : (m) [rad^2], [m^2]
        R, row by row.
    """

    landmark: Int[np.ndarray, " m"]
    bearing: Float[np.ndarray, " m"]
    range: Float[np.ndarray, " m"]
    bearing_variance: Float[np.ndarray, " m"]
    range_variance: Float[np.ndarray, " m"]


Columns = tuple[Int[np.ndarray, " m"], Float[np.ndarray, "7 m"]]
"""Labels and numbers of a scan."""


def columns_of(scan: Scan) -> Columns:
    """Return of a scan what a filter's kernel is handed: it makes `Measurements` of it.

    Parameters
    ----------
    scan : Scan

    Returns
    -------
    tuple of labels and numbers
        A plain tuple: a kernel takes one in no time, and a record in microseconds.
    """
    return scan.landmark, np.ascontiguousarray(scan.numbers)


@kernel
def measurements(columns: Columns) -> Measurements:
    """Return the rows of a scan as the kernels take them: standard deviations are squared here.

    Examples
    --------
    >>> from pipistrelle.detection.scans import make_scan
    >>> scan = make_scan(0.0, np.array([4]), np.zeros(1), range=2.0, bearing_std=0.5)
    >>> measurements(columns_of(scan)).bearing_variance
    array([0.25])
    """
    landmark, numbers = columns
    bearing_std, range_std = numbers[BEARING_STD], numbers[RANGE_STD]
    return Measurements(
        landmark,
        numbers[BEARING],
        numbers[RANGE],
        bearing_std * bearing_std,
        range_std * range_std,
    )


class Row(NamedTuple):
    """One of `Measurements`: numbers alone, which a kernel hands on for less than the arrays."""

    landmark: Whole
    bearing: float
    range: float
    bearing_variance: float
    range_variance: float


@no_alloc
def row_of(heard: Measurements, m: Whole) -> Row:
    """Take measurement m."""
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
    """Range, bearing, direction cosines and inverse range of a point, for kernels.

    Returns range [m], bearing [rad], cos and sin of the direction in the world, and k, the inverse
    of the range, which `NEAREST` bounds. The Jacobians follow: d range = (-c, -s, 0; c, s) and
    d bearing = (s k, -c k, -1; -s k, c k) by pose and point.
    """
    dx, dy = px - x, py - y
    distance = math.sqrt(dx * dx + dy * dy)
    inverse = 1.0 / max(distance, NEAREST)
    bearing = wrap_angle(math.atan2(dy, dx) - heading)
    return distance, bearing, dx * inverse, dy * inverse, inverse


def measurement_jacobians(
    pose: Float[np.ndarray, "3"], point: Float[np.ndarray, "2"]
) -> tuple[Float[np.ndarray, "2 3"], Float[np.ndarray, "2 2"]]:
    r"""Derivatives of range and bearing by the pose and by the landmark's position.

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
    return (
        np.array([[-c, -s, 0.0], [s * k, -c * k, -1.0]]),
        np.array([[c, s], [-s * k, c * k]]),
    )
