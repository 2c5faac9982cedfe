"""Bearing of a point from a pose: predicted value with the range, derivatives, and crossings."""

import math

import numpy as np
from jaxtyping import Float

from pipistrelle.estimation.observations.range import NEAREST, Slopes, range_slopes
from pipistrelle.geometry import wrap_angle
from pipistrelle.jit import kernel

MIN_CROSSING_SINE = 0.48
"""Least sine of the angle at which two bearings initialise a landmark, if they may have gross
errors or the errors of poses are not counted: many at small angles would seem to cross at once."""


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


@kernel
def bearing_slopes(c: float, s: float, k: float) -> Slopes:
    """Return the derivatives of a bearing by the pose, from the numbers of `observe`."""
    return s * k, -c * k, -1.0


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
