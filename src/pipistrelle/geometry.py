"""Angles and poses in the plane: wrapping, ranges and bearings, interpolation.

A pose is x, y [m] and heading [rad], counter-clockwise from +x. A bearing is relative to the
heading, counter-clockwise. Angles are wrapped to [-pi, pi).
"""

import math

import numpy as np
from jaxtyping import Float

from pipistrelle.jit import substituted


@substituted
def wrap_angle(angle: float) -> float:
    """Wrap an angle to [-pi, pi) [rad]; for compiled functions (see `wrap`)."""
    if -math.pi <= angle < math.pi:
        return angle
    wrapped = angle - 2.0 * math.pi * math.floor((angle + math.pi) / (2.0 * math.pi))
    return wrapped - 2.0 * math.pi if wrapped >= math.pi else wrapped


def wrap(angle: Float[np.ndarray, "*n"] | float) -> Float[np.ndarray, "*n"]:
    """Wrap angles to [-pi, pi) [rad].

    >>> wrap(np.array([0.0, np.pi, 3.5 * np.pi])) / np.pi
    array([ 0. , -1. , -0.5])
    """
    wrapped = angle - 2.0 * np.pi * np.floor((np.asarray(angle) + np.pi) / (2.0 * np.pi))
    return np.where(wrapped >= np.pi, wrapped - 2.0 * np.pi, wrapped)


def carrying(
    lever: Float[np.ndarray, "*k 2"], turn: Float[np.ndarray, "*k"] | float = 0.0
) -> Float[np.ndarray, "*k 3 3"]:
    """Return the matrices that turn a pose's error and carry it to a place at a lever from it.

    `lever` [m]: in the turned axes. `turn` [rad].

    >>> carrying(np.array([10.0, 0.0])) @ [0.0, 0.0, 0.1]
    array([0. , 1. , 0.1])
    """
    matrix = np.zeros((*lever.shape[:-1], 3, 3))
    matrix[..., 0, 0] = matrix[..., 1, 1] = np.cos(turn)
    matrix[..., 0, 1], matrix[..., 1, 0] = -np.sin(turn), np.sin(turn)
    matrix[..., 0, 2], matrix[..., 1, 2], matrix[..., 2, 2] = -lever[..., 1], lever[..., 0], 1.0
    return matrix


def range_and_bearing(
    pose: Float[np.ndarray, "3"], points: Float[np.ndarray, "n 2"]
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    r"""Return the distance and bearing of points as seen from a pose.

    .. math:: d_i = \lVert m_i - x_v \rVert, \qquad
              \phi_i = \operatorname{atan2}(y_i - y_v, x_i - x_v) - \theta_v
       :label: eq-6

    `pose` [m, m, rad]; `points` [m]. Returns range [m] and bearing [rad].

    Bradley & Abaid, Eq. (6), without its noise.

    >>> pose = np.array([1.0, 0.0, np.pi / 2])
    >>> range_and_bearing(pose, np.array([[1.0, 2.0]]))
    (array([2.]), array([0.]))
    """
    offset = points - pose[:2]
    bearing = np.arctan2(offset[:, 1], offset[:, 0]) - pose[2]
    return np.hypot(offset[:, 0], offset[:, 1]), wrap(bearing)


def circular_mean(
    angle: Float[np.ndarray, " n"], weight: Float[np.ndarray, " n"] | None = None
) -> float:
    """Return the weighted mean direction of angles, in [-pi, pi) [rad].

    `weight`: non-negative; equal weights by default.

    >>> round(circular_mean(np.array([np.pi - 0.1, -np.pi + 0.3])) + np.pi, 12)
    0.1
    """
    weight = np.ones_like(angle) if weight is None else weight
    return float(wrap(np.arctan2(weight @ np.sin(angle), weight @ np.cos(angle))))


def poses_at(
    time: Float[np.ndarray, " k"], known: Float[np.ndarray, " n"], path: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "k 3"]:
    """Interpolate poses linearly at other times; NaN outside the known times.

    `time`, `known` [s]: the latter increasing, of the `path` [m, m, rad], its heading unwrapped.

    >>> path = np.array([[0.0, 0.0, 3.0], [1.0, 2.0, 4.0]])
    >>> poses_at(np.array([0.25, 2.0]), np.array([0.0, 1.0]), path)
    array([[0.25, 0.5 , 3.25],
           [ nan,  nan,  nan]])
    """
    columns = [np.interp(time, known, column, left=np.nan, right=np.nan) for column in path.T]
    return np.column_stack(columns)


def path_at(
    time: Float[np.ndarray, " k"], known: Float[np.ndarray, " n"], path: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "k 3"]:
    """Interpolate poses with wrapped headings at other times; NaN outside the known times."""
    x, y, heading = path.T
    poses = poses_at(time, known, np.column_stack((x, y, np.unwrap(heading))))
    poses[:, 2] = wrap(poses[:, 2])
    return poses


def points_at(
    time: Float[np.ndarray, " k"], known: Float[np.ndarray, " n"], points: Float[np.ndarray, "n d"]
) -> Float[np.ndarray, "k d"]:
    """Interpolate points linearly at other times; outside, the first or last point is held."""
    return np.column_stack([np.interp(time, known, column) for column in points.T])
