r"""Preintegration: the control steps from one pose of the graph to the next, as one motion.

The graph has a pose where something was heard, not one for each control step: a step's noise has
rank 2, and nothing measures the poses between. `Odometry` keeps them relative to the pose before:
means :math:`d_j`, and covariances :math:`P_j` of x, y and heading in that pose's axes. When the
poses a and b at its ends are known better, so are those between, by the gain

.. math:: G_j = P_j \Phi_{mj}^T P_m^{-1}, \quad d_j \leftarrow d_j + G_j (a^{-1} b - d_m)

with :math:`\Phi_{mj}` the derivative of the last step by step j: the fixed-interval smoother of
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
"""Added in quadrature to x, y [m] and heading [rad] where a covariance needs an inverse."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Odometry:
    """The control steps since a pose of the graph."""

    mean: Float[np.ndarray, "m 3"]  # after each step, in the axes of that pose [m, m, rad]
    covariance: Float[np.ndarray, "m 3 3"]  # of x, y and heading in those axes
    seconds: float = 0.0  # how long they took

    def moves(self) -> bool:
        """Tell whether the vehicle has moved, or may have."""
        return bool(np.any(self.mean[-1:]) or np.any(self.covariance[-1:]))


NO_ODOMETRY = Odometry(mean=np.empty((0, 3)), covariance=np.empty((0, 3, 3)))
"""Odometry without a step."""


def extended(
    odometry: Odometry,
    motion: Motion,
    controls: Float[np.ndarray, "k c"],
    dt: Float[np.ndarray, " k"],
) -> Odometry:
    """Return odometry with more control steps.

    >>> motion = Motion(model="unicycle", control_std=(0.1, 0.1))
    >>> extended(NO_ODOMETRY, motion, np.ones((2, 2)) * [1.0, 0.0], np.ones(2)).mean[:, 0]
    array([1., 2.])
    """
    last = odometry.mean[-1] if len(odometry.mean) else np.zeros(3)
    spread = odometry.covariance[-1] if len(odometry.mean) else np.zeros((3, 3))
    mean, covariance = _propagated(last, spread, controls, dt, motion_numbers(motion))
    return Odometry(
        mean=np.concatenate([odometry.mean, mean]),
        covariance=np.concatenate([odometry.covariance, covariance]),
        seconds=odometry.seconds + float(dt.sum()),
    )


def placed(start: Gaussian, odometry: Odometry) -> Gaussian:
    """Return the poses after each step in the world, (m, 3) and (m, 3, 3), from the pose before.

    >>> north = Gaussian(mean=np.array([0.0, 1.0, np.pi / 2]), covariance=np.zeros((3, 3)))
    >>> ahead = Odometry(mean=np.array([[2.0, 0.0, 0.1]]), covariance=np.zeros((1, 3, 3)))
    >>> placed(north, ahead).mean.round(9) + 0.0
    array([[0.        , 3.        , 1.67079633]])
    """
    F, M = _moved_by_start(start.mean, odometry.mean), turned(start.mean[2])
    covariance = F @ start.covariance @ np.swapaxes(F, 1, 2) + M @ odometry.covariance @ M.T
    return Gaussian(mean=_composed(start.mean, odometry.mean), covariance=symmetric(covariance))


def propagated(
    start: Float[np.ndarray, "3"], joint: Float[np.ndarray, "d d"], odometry: Odometry
) -> Float[np.ndarray, "d d"]:
    """Return a joint covariance after the steps; the pose before them stands first in it.

    >>> ahead = Odometry(mean=np.array([[2.0, 0.0, 0.0]]), covariance=0.01 * np.eye(3)[None])
    >>> turn = np.diag([0.0, 0.0, 0.01, 0.0, 0.0])
    >>> propagated(np.zeros(3), turn, ahead).diagonal()
    array([0.01, 0.05, 0.02, 0.  , 0.  ])
    """
    F, M = np.eye(len(joint)), turned(start[2])
    F[:3, :3] = _moved_by_start(start, odometry.mean[-1:])[0]
    ahead = F @ joint @ F.T
    ahead[:3, :3] += M @ odometry.covariance[-1] @ M.T
    return ahead


def between(
    ends: Float[np.ndarray, "2 3"], joint: Float[np.ndarray, "6 6"], odometry: Odometry
) -> Gaussian:
    """Return the poses after each step, (m, 3) and (m, 3, 3), when those at both ends are known.

    ``ends`` (2, 3) are the pose before and the last, ``joint`` (6, 6) is their covariance.
    """
    a, b = ends
    M = turned(a[2])
    last, P = odometry.covariance[-1] + SMALLEST_STD**2 * np.eye(3), odometry.covariance
    relative = np.append(M[:2, :2].T @ (b - a)[:2], b[2] - a[2])
    ahead = np.tile(np.eye(3), (len(P), 1, 1))
    ahead[:, :2, 2] = _quarter(odometry.mean[-1, :2] - odometry.mean[:, :2])
    gain = P @ np.swapaxes(np.linalg.solve(last, ahead), 1, 2)
    off = relative - odometry.mean[-1]
    mean = odometry.mean + gain @ np.append(off[:2], wrap(off[2]))
    left = M @ (P - gain @ last @ np.swapaxes(gain, 1, 2)) @ M.T
    by_b = M @ gain @ M.T
    by_a = _moved_by_start(a, mean) - by_b @ _moved_by_start(a, relative[None])
    both = np.concatenate([by_a, by_b], axis=2)
    covariance = both @ joint @ np.swapaxes(both, 1, 2) + left
    poses = _composed(a, mean)
    poses[-1], covariance[-1] = b, joint[3:, 3:]
    return Gaussian(mean=poses, covariance=symmetric(covariance))


def turned(heading: float) -> Float[np.ndarray, "3 3"]:
    """Return the rotation by a heading of x and y of a pose."""
    c, s = np.cos(heading), np.sin(heading)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def symmetric(covariance: Float[np.ndarray, "*n d d"]) -> Float[np.ndarray, "*n d d"]:
    """Return a covariance without the rounding that makes its halves differ."""
    return 0.5 * (covariance + np.swapaxes(covariance, -1, -2))


def _quarter(points: Float[np.ndarray, "m 2"]) -> Float[np.ndarray, "m 2"]:
    """Rotate points by 90 degrees to the left."""
    return points @ np.array([[0.0, 1.0], [-1.0, 0.0]])


def _composed(
    start: Float[np.ndarray, "3"], relative: Float[np.ndarray, "m 3"]
) -> Float[np.ndarray, "m 3"]:
    """Return relative poses in the world."""
    poses = start + relative @ turned(start[2]).T
    poses[:, 2] = wrap(poses[:, 2])
    return poses


def _moved_by_start(
    start: Float[np.ndarray, "3"], relative: Float[np.ndarray, "m 3"]
) -> Float[np.ndarray, "m 3 3"]:
    """Return the derivatives of relative poses in the world by the pose before."""
    F = np.tile(np.eye(3), (len(relative), 1, 1))
    F[:, :2, 2] = _quarter(relative[:, :2] @ turned(start[2])[:2, :2].T)
    return F


@kernel
def _propagated(
    start: Float[np.ndarray, "3"],
    spread: Float[np.ndarray, "3 3"],
    controls: Float[np.ndarray, "k c"],
    dt: Float[np.ndarray, " k"],
    motion: MotionNumbers,
) -> tuple[Float[np.ndarray, "k 3"], Float[np.ndarray, "k 3 3"]]:
    """Propagate a pose and its covariance through control steps; return them after each."""
    pose, P = start.copy(), spread.copy()
    means, covariances = np.empty((dt.size, 3)), np.empty((dt.size, 3, 3))
    for k in range(dt.size):
        propagate_pose(pose, P, controls[k], dt[k], motion)
        means[k], covariances[k] = pose, P
    return means, covariances
