"""Bearings that wait: where they cross is where a landmark that was only ever heard may stand."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

PARALLAX = 0.5
"""Least angle [rad] at which two bearings place a landmark."""
SURE = 0.5
"""Most standard deviations of the place, as a share of the range: beyond, it is anybody's guess."""


class Bearing(NamedTuple):
    """A bearing that waits: the number of the pose it was heard from, itself, its deviation."""

    node: int
    bearing: float
    std: float


def crossing(
    poses: Float[np.ndarray, "n 3"], waiting: tuple[Bearing, ...]
) -> Float[np.ndarray, "2"] | None:
    r"""Where the newest bearing of a landmark crosses an earlier one, if it does so clearly.

    Of the earlier bearings, the one that crosses most squarely, ahead of both poses. The crossing
    lies as far along the newest bearing as the other line is off, by :math:`r_1 \sigma_1`, and
    itself, by :math:`r_2 \sigma_2`, over the sine of the angle between them.

    Parameters
    ----------
    poses : (n, 3) [m, m, rad]
        By their numbers.
    waiting : tuple of Bearing
        The newest last.

    Returns
    -------
    (2) [m], or None

    Examples
    --------
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
    clear = np.abs(sine) >= np.sin(PARALLAX)
    sine[~clear] = 1.0
    dx, dy = poses[node, 0] - x, poses[node, 1] - y
    near = (dx * np.sin(other) - dy * np.cos(other)) / sine
    far = (dx * np.sin(angle) - dy * np.cos(angle)) / sine
    off = np.hypot(far * [bearing.std for bearing in earlier], near * last.std)
    good = clear & (near > 0.0) & (far > 0.0) & (off <= SURE * near * np.abs(sine))
    if not good.any():
        return None
    best = np.argmax(np.where(good, np.abs(sine), 0.0))
    return np.array([x, y]) + near[best] * np.array([np.cos(angle), np.sin(angle)])
