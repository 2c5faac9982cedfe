r"""Legs: what the controls say of the way from one pose of the graph to the next.

The graph has a pose where something was heard, not one for each control step: a step's noise has
rank 2, and nothing is asked of the poses between. A leg keeps them relative to the pose from which
it leads: means :math:`d_j`, and covariances :math:`P_j` of x, y and heading in that pose's axes.
When the poses a and b at its ends are known better, so are those between, by the gain

.. math:: G_j = P_j \Phi_{mj}^T P_m^{-1}, \quad d_j \leftarrow d_j + G_j (a^{-1} b - d_m)

with :math:`\Phi_{mj}` the derivative of the leg's end by its step j: the fixed-interval smoother of
Rauch, Tung & Striebel (1965).
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from pipistrelle.estimation.beliefs import Gaussian
from pipistrelle.estimation.motion import Motion, MotionNumbers, motion_numbers, propagate_pose
from pipistrelle.geometry import wrap
from pipistrelle.jit import kernel

SMALLEST_STD = 1e-6
"""Added in quadrature to x, y [m] and heading [rad] of what must have an inverse."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Leg:
    """The control steps since a pose of the graph.

    Attributes
    ----------
    mean : (m, 3) [m, m, rad]
        Poses after each step, in the axes of the one from which it leads.
    covariance : (m, 3, 3)
        Of x, y and heading in those axes.
    seconds : float
        How long they took.
    """

    mean: Float[np.ndarray, "m 3"]
    covariance: Float[np.ndarray, "m 3 3"]
    seconds: float = 0.0

    def moves(self) -> bool:
        """Tell whether the vehicle has moved, or may have."""
        return bool(np.any(self.mean[-1:]) or np.any(self.covariance[-1:]))


NOWHERE = Leg(mean=np.empty((0, 3)), covariance=np.empty((0, 3, 3)))
"""The leg of no step."""


def longer(
    leg: Leg, motion: Motion, controls: Float[np.ndarray, "k c"], dt: Float[np.ndarray, " k"]
) -> Leg:
    """Return a leg with control steps added.

    Examples
    --------
    >>> motion = Motion(model="unicycle", control_std=(0.1, 0.1))
    >>> longer(NOWHERE, motion, np.ones((2, 2)) * [1.0, 0.0], np.ones(2)).mean[:, 0]
    array([1., 2.])
    """
    last = leg.mean[-1] if len(leg.mean) else np.zeros(3)
    spread = leg.covariance[-1] if len(leg.mean) else np.zeros((3, 3))
    mean, covariance = _carried(last, spread, controls, dt, motion_numbers(motion))
    return Leg(
        mean=np.concatenate([leg.mean, mean]),
        covariance=np.concatenate([leg.covariance, covariance]),
        seconds=leg.seconds + float(dt.sum()),
    )


def placed(start: Gaussian, leg: Leg) -> Gaussian:
    """Return a leg's poses where they are in the world, (m, 3) and (m, 3, 3).

    Parameters
    ----------
    start : Gaussian of (3) and (3, 3)
        The pose from which it leads.
    leg : Leg

    Returns
    -------
    Gaussian

    Examples
    --------
    >>> north = Gaussian(mean=np.array([0.0, 1.0, np.pi / 2]), covariance=np.zeros((3, 3)))
    >>> ahead = Leg(mean=np.array([[2.0, 0.0, 0.1]]), covariance=np.zeros((1, 3, 3)))
    >>> placed(north, ahead).mean.round(9) + 0.0
    array([[0.        , 3.        , 1.67079633]])
    """
    F, M = _moved_by_start(start.mean, leg.mean), turned(start.mean[2])
    covariance = F @ start.covariance @ np.swapaxes(F, 1, 2) + M @ leg.covariance @ M.T
    return Gaussian(mean=_composed(start.mean, leg.mean), covariance=symmetric(covariance))


def carried(
    start: Float[np.ndarray, "3"], joint: Float[np.ndarray, "d d"], leg: Leg
) -> Float[np.ndarray, "d d"]:
    """Return the covariance of a leg's end and of what stands, from that of its start and this.

    Parameters
    ----------
    start : (3) [m, m, rad]
        The pose from which it leads.
    joint : (d, d)
        The pose's covariance stands first.
    leg : Leg

    Returns
    -------
    (d, d)

    Examples
    --------
    >>> ahead = Leg(mean=np.array([[2.0, 0.0, 0.0]]), covariance=0.01 * np.eye(3)[None])
    >>> turn = np.diag([0.0, 0.0, 0.01, 0.0, 0.0])
    >>> carried(np.zeros(3), turn, ahead).diagonal()
    array([0.01, 0.05, 0.02, 0.  , 0.  ])
    """
    F, M = np.eye(len(joint)), turned(start[2])
    F[:3, :3] = _moved_by_start(start, leg.mean[-1:])[0]
    ahead = F @ joint @ F.T
    ahead[:3, :3] += M @ leg.covariance[-1] @ M.T
    return ahead


def between(ends: Float[np.ndarray, "2 3"], joint: Float[np.ndarray, "6 6"], leg: Leg) -> Gaussian:
    """Return a leg's poses when those at its ends are known, (m, 3) and (m, 3, 3).

    Parameters
    ----------
    ends : (2, 3) [m, m, rad]
        The pose from which it leads, and the one to which it does.
    joint : (6, 6)
        Their covariance.
    leg : Leg

    Returns
    -------
    Gaussian
        The last is the second of the ends.
    """
    a, b = ends
    M = turned(a[2])
    last, P = leg.covariance[-1] + SMALLEST_STD**2 * np.eye(3), leg.covariance
    relative = np.append(M[:2, :2].T @ (b - a)[:2], b[2] - a[2])
    ahead = np.tile(np.eye(3), (len(P), 1, 1))
    ahead[:, :2, 2] = _quarter(leg.mean[-1, :2] - leg.mean[:, :2])
    gain = P @ np.swapaxes(np.linalg.solve(last, ahead), 1, 2)
    off = relative - leg.mean[-1]
    mean = leg.mean + gain @ np.append(off[:2], wrap(off[2]))
    left = M @ (P - gain @ last @ np.swapaxes(gain, 1, 2)) @ M.T
    by_b = M @ gain @ M.T
    by_a = _moved_by_start(a, mean) - by_b @ _moved_by_start(a, relative[None])
    both = np.concatenate([by_a, by_b], axis=2)
    covariance = both @ joint @ np.swapaxes(both, 1, 2) + left
    poses = _composed(a, mean)
    poses[-1], covariance[-1] = b, joint[3:, 3:]
    return Gaussian(mean=poses, covariance=symmetric(covariance))


def turned(heading: float) -> Float[np.ndarray, "3 3"]:
    """Return what turns x and y of a pose by a heading.

    Examples
    --------
    >>> turned(0.0).diagonal()
    array([1., 1., 1.])
    """
    c, s = np.cos(heading), np.sin(heading)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def symmetric(covariance: Float[np.ndarray, "*n d d"]) -> Float[np.ndarray, "*n d d"]:
    """Return a covariance whose halves differed by rounding."""
    return 0.5 * (covariance + np.swapaxes(covariance, -1, -2))


def _quarter(points: Float[np.ndarray, "m 2"]) -> Float[np.ndarray, "m 2"]:
    """Turn points by a quarter to the left."""
    return points @ np.array([[0.0, 1.0], [-1.0, 0.0]])


def _composed(
    start: Float[np.ndarray, "3"], relative: Float[np.ndarray, "m 3"]
) -> Float[np.ndarray, "m 3"]:
    """Return poses relative to one where they are in the world."""
    poses = start + relative @ turned(start[2]).T
    poses[:, 2] = wrap(poses[:, 2])
    return poses


def _moved_by_start(
    start: Float[np.ndarray, "3"], relative: Float[np.ndarray, "m 3"]
) -> Float[np.ndarray, "m 3 3"]:
    """Return the derivatives of poses relative to one by that one."""
    F = np.tile(np.eye(3), (len(relative), 1, 1))
    F[:, :2, 2] = _quarter(relative[:, :2] @ turned(start[2])[:2, :2].T)
    return F


@kernel
def _carried(
    start: Float[np.ndarray, "3"],
    spread: Float[np.ndarray, "3 3"],
    controls: Float[np.ndarray, "k c"],
    dt: Float[np.ndarray, " k"],
    motion: MotionNumbers,
) -> tuple[Float[np.ndarray, "k 3"], Float[np.ndarray, "k 3 3"]]:
    """Carry a pose and its covariance through control steps; returns them after each."""
    pose, P = start.copy(), spread.copy()
    means, covariances = np.empty((dt.size, 3)), np.empty((dt.size, 3, 3))
    for k in range(dt.size):
        propagate_pose(pose, P, controls[k], dt[k], motion)
        means[k], covariances[k] = pose, P
    return means, covariances
