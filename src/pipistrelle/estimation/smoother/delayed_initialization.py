"""Delayed initialization: a landmark is placed where two of its waiting bearings cross."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

MIN_CROSSING_ANGLE = 0.5
"""Least angle [rad] at which two bearings place a landmark."""
MAX_RELATIVE_PLACE_STD = 0.5
"""Largest standard deviation of the place, divided by the range."""


class Bearing(NamedTuple):
    """A waiting bearing: the number of the pose it was heard from, bearing and deviation [rad]."""

    node: int
    bearing: float
    std: float


def crossing(
    poses: Float[np.ndarray, "n 3"], waiting: tuple[Bearing, ...]
) -> Float[np.ndarray, "2"] | None:
    r"""Place where the newest bearing of a landmark clearly crosses an earlier one; or None.

    Of the earlier bearings, the one that crosses most squarely, in front of both poses (n, 3), is
    taken; the newest is the last. The uncertainty along the newest bearing is that of the other
    line, :math:`r_1 \sigma_1`, and its own, :math:`r_2 \sigma_2`, over the sine of their angle.

    >>> poses = np.array([[0.0, 0.0, 0.0], [2.0, 0.0, 0.0]])
    >>> crossing(poses, (Bearing(0, np.pi / 4, 0.02), Bearing(1, np.pi / 2, 0.02))).round(9)
    array([2., 2.])
    >>> crossing(poses, (Bearing(0, 0.0, 0.02), Bearing(1, 0.1, 0.02))) is None
    True
    """
    *earlier, last = waiting
    if not earlier:
        return None
    node = np.array([bearing.node for bearing in earlier])
    x, y, heading = poses[last.node]
    angle = heading + last.bearing
    other = poses[node, 2] + [bearing.bearing for bearing in earlier]
    sine = np.sin(other - angle)
    clear = np.abs(sine) >= np.sin(MIN_CROSSING_ANGLE)
    sine[~clear] = 1.0
    dx, dy = poses[node, 0] - x, poses[node, 1] - y
    near = (dx * np.sin(other) - dy * np.cos(other)) / sine
    far = (dx * np.sin(angle) - dy * np.cos(angle)) / sine
    off = np.hypot(far * [bearing.std for bearing in earlier], near * last.std)
    good = (
        clear & (near > 0.0) & (far > 0.0) & (off <= MAX_RELATIVE_PLACE_STD * near * np.abs(sine))
    )
    if not good.any():
        return None
    best = np.argmax(np.where(good, np.abs(sine), 0.0))
    return np.array([x, y]) + near[best] * np.array([np.cos(angle), np.sin(angle)])
