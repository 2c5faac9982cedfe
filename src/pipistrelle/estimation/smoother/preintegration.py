r"""Preintegration: the control steps from one node of the chain to the next, as one motion.

The chain has a node where something was heard, not one for each control step: a step's noise has
rank 2, and nothing measures the poses between. `Odometry` keeps them relative to the node before:
means :math:`d_j`, and covariances :math:`P_j` of x, y and heading in that pose's axes. When the
poses a and b at its ends are known better, so are those between, by the gain

.. math:: G_j = P_j \Phi_{mj}^T P_m^{-1}, \quad d_j \leftarrow d_j + G_j (a^{-1} b - d_m)

with :math:`\Phi_{mj}` the derivative of the last step by step j: the fixed-interval smoother of
Rauch, Tung & Striebel (1965).
"""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from pipistrelle.estimation.beliefs import Gaussian
from pipistrelle.estimation.motion import Motion, MotionNumbers, motion_numbers, propagate_pose
from pipistrelle.estimation.smoother.records import Arrays, Legs
from pipistrelle.estimation.smoother.small_matrices import cholesky
from pipistrelle.geometry import wrap_angle
from pipistrelle.jit import kernel, no_alloc

SMALLEST_STD = 1e-6
"""Added in quadrature to x, y [m] and heading [rad] of the start and of a motion: what is known
exactly would make all that is heard worthless."""

Steps = tuple[Float[np.ndarray, "s 3"], Float[np.ndarray, "s 3 3"]]
"""Means and covariances of control steps, since the node before them."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Odometry:
    """The control steps since a node of the chain."""

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
    at: Gaussian,
    motion: Motion,
    controls: Float[np.ndarray, "k c"],
    dt: Float[np.ndarray, " k"],
) -> tuple[Odometry, Gaussian]:
    """Return odometry with more control steps, and the poses after these in the world.

    ``at`` is the pose before the odometry, (3) and (3, 3).

    >>> motion = Motion(model="unicycle", control_std=(0.1, 0.1))
    >>> north = Gaussian(mean=np.array([0.0, 1.0, np.pi / 2]), covariance=np.zeros((3, 3)))
    >>> ahead = np.ones((2, 2)) * [1.0, 0.0]
    >>> odometry, poses = extended(NO_ODOMETRY, north, motion, ahead, np.ones(2))
    >>> odometry.mean[:, 0], poses.mean[:, 1]
    (array([1., 2.]), array([2., 3.]))
    """
    steps, start = (odometry.mean, odometry.covariance), (at.mean, at.covariance)
    (mean, covariance), poses = _extended(steps, start, controls, dt, motion_numbers(motion))
    seconds = odometry.seconds + float(dt.sum())
    return (
        Odometry(mean=mean, covariance=covariance, seconds=seconds),
        Gaussian(mean=poses[0], covariance=poses[1]),
    )


def placed(start: Gaussian, odometry: Odometry) -> Gaussian:
    """Return the poses after each step in the world, (m, 3) and (m, 3, 3), from the node before.

    >>> north = Gaussian(mean=np.array([0.0, 1.0, np.pi / 2]), covariance=np.zeros((3, 3)))
    >>> ahead = Odometry(mean=np.array([[2.0, 0.0, 0.1]]), covariance=np.zeros((1, 3, 3)))
    >>> placed(north, ahead).mean.round(9) + 0.0
    array([[0.        , 3.        , 1.67079633]])
    """
    poses, spreads = _placed((start.mean, start.covariance), (odometry.mean, odometry.covariance))
    return Gaussian(mean=poses, covariance=spreads)


@kernel
def _placed(start: tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3 3"]], steps: Steps) -> Steps:
    """Place all steps from a start in the world."""
    poses, spreads = np.empty(steps[0].shape), np.empty(steps[1].shape)
    for k in range(len(poses)):
        place(start, steps[0][k], steps[1][k], poses[k], spreads[k])
    return poses, spreads


@kernel
def _extended(
    steps: Steps,
    start: tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3 3"]],
    controls: Float[np.ndarray, "k c"],
    dt: Float[np.ndarray, " k"],
    motion: MotionNumbers,
) -> tuple[Steps, Steps]:
    """Append control steps to others; return all, and the new ones from a start in the world."""
    before, size = steps[0].shape[0], dt.size
    mean, covariance = np.empty((before + size, 3)), np.empty((before + size, 3, 3))
    poses, spreads = np.empty((size, 3)), np.empty((size, 3, 3))
    pose, P = np.zeros(3), np.zeros((3, 3))
    for j in range(before):
        mean[j], covariance[j] = steps[0][j], steps[1][j]
        pose[:], P[:] = mean[j], covariance[j]
    for k in range(size):
        propagate_pose(pose, P, controls[k], dt[k], motion)
        mean[before + k], covariance[before + k] = pose, P
        place(start, pose, P, poses[k], spreads[k])
    return (mean, covariance), (poses, spreads)


@no_alloc
def place(
    start: tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3 3"]],
    relative: Float[np.ndarray, "3"],
    P: Float[np.ndarray, "3 3"],
    pose: Float[np.ndarray, "3"],
    covariance: Float[np.ndarray, "3 3"],
) -> None:
    """Write a pose in the world from one relative to a start, and its covariance F C F^T + R P R^T.

    ``start``: the pose and its covariance C.
    """
    (x, y, heading), C = start[0], start[1]
    c, s = math.cos(heading), math.sin(heading)
    dx, dy = c * relative[0] - s * relative[1], s * relative[0] + c * relative[1]
    pose[0], pose[1], pose[2] = x + dx, y + dy, wrap_angle(heading + relative[2])
    covariance[0, 0] = C[0, 0] - 2.0 * dy * C[0, 2] + dy * dy * C[2, 2]
    covariance[0, 1] = C[0, 1] + dx * C[0, 2] - dy * C[1, 2] - dx * dy * C[2, 2]
    covariance[1, 1] = C[1, 1] + 2.0 * dx * C[1, 2] + dx * dx * C[2, 2]
    covariance[0, 2], covariance[1, 2] = C[0, 2] - dy * C[2, 2], C[1, 2] + dx * C[2, 2]
    covariance[0, 0] += c * c * P[0, 0] - 2.0 * c * s * P[0, 1] + s * s * P[1, 1]
    covariance[0, 1] += c * s * (P[0, 0] - P[1, 1]) + (c * c - s * s) * P[0, 1]
    covariance[1, 1] += s * s * P[0, 0] + 2.0 * c * s * P[0, 1] + c * c * P[1, 1]
    covariance[0, 2] += c * P[0, 2] - s * P[1, 2]
    covariance[1, 2] += s * P[0, 2] + c * P[1, 2]
    covariance[2, 2] = C[2, 2] + P[2, 2]
    covariance[1, 0] = covariance[0, 1]
    covariance[2, 0], covariance[2, 1] = covariance[0, 2], covariance[1, 2]


@kernel
def poses_between(
    legs: Arrays,
    ends: Float[np.ndarray, "k 2"],
    steps: Arrays,
    nodes: Steps,
    cross: Float[np.ndarray, "k 3 3"],
) -> Steps:
    """Return all poses of a path and their covariances, from those of its nodes.

    ``ends``: first step of each leg, and the one after its last; ``cross``: covariance of each node
    with the one before.
    """
    legs, count = Legs(*legs), ends[-1, 1]
    mean, covariance = np.empty((1 + count, 3)), np.empty((1 + count, 3, 3))
    mean[0], covariance[0] = nodes[0][0], nodes[1][0]
    by_a, by_b, left = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    for k in range(1, ends.shape[0]):
        a, b, N = nodes[0][k - 1], nodes[0][k], legs.noise[k]
        for j in range(ends[k, 0], ends[k, 1]):
            mean[1 + j], covariance[1 + j] = b, nodes[1][k]
            if N[2, 2] == 0.0 or j + 1 == ends[k, 1]:
                continue
            slopes, step = (by_a, by_b, left), (steps[0][j], steps[1][j])
            _inside(a, b, legs.mean[k], N, step, mean[1 + j], slopes)
            both = _product(by_b, cross[k], by_a)
            left += _product(by_a, nodes[1][k - 1], by_a) + _product(by_b, nodes[1][k], by_b)
            covariance[1 + j] = 0.5 * (left + left.T) + (both + both.T)
    return mean, covariance


@kernel
def _product(
    A: Float[np.ndarray, "3 3"], P: Float[np.ndarray, "3 3"], B: Float[np.ndarray, "3 3"]
) -> Float[np.ndarray, "3 3"]:
    """Return A P B^T."""
    product, row = np.zeros((3, 3)), np.empty(3)
    for a in range(3):
        for e in range(3):
            row[e] = A[a, 0] * P[0, e] + A[a, 1] * P[1, e] + A[a, 2] * P[2, e]
        for b in range(3):
            product[a, b] = row[0] * B[b, 0] + row[1] * B[b, 1] + row[2] * B[b, 2]
    return product


@kernel
def _inside(
    a: Float[np.ndarray, " d"],
    b: Float[np.ndarray, " d"],
    leg: Float[np.ndarray, "3"],
    N: Float[np.ndarray, "3 3"],
    step: tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3 3"]],
    pose: Float[np.ndarray, "3"],
    slopes: tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3 3"], Float[np.ndarray, "3 3"]],
) -> None:
    """Write a pose between two nodes, its slopes by both, and what is left if both are known.

    ``leg``, N: the motion from a to b and its noise; ``step``: that from a to the pose.
    """
    (by_a, by_b, left), (d, P) = slopes, step
    c, s = math.cos(a[2]), math.sin(a[2])
    dx, dy = b[0] - a[0], b[1] - a[1]
    off = np.array([c * dx + s * dy, c * dy - s * dx, b[2] - a[2]]) - leg
    off[2] = wrap_angle(off[2])
    G, H, R, L = np.empty((3, 3)), np.empty((3, 3)), np.zeros((3, 3)), np.zeros((3, 3))
    for e in range(3):  # H = P ahead^T
        H[e, 0] = P[e, 0] - (leg[1] - d[1]) * P[e, 2]
        H[e, 1] = P[e, 1] + (leg[0] - d[0]) * P[e, 2]
        H[e, 2] = P[e, 2]
    cholesky(N, L)
    for e in range(3):
        y0 = H[e, 0] / L[0, 0]
        y1 = (H[e, 1] - L[1, 0] * y0) / L[1, 1]
        y2 = (H[e, 2] - L[2, 0] * y0 - L[2, 1] * y1) / L[2, 2]
        G[e, 2] = y2 / L[2, 2]
        G[e, 1] = (y1 - L[2, 1] * G[e, 2]) / L[1, 1]
        G[e, 0] = (y0 - L[1, 0] * G[e, 1] - L[2, 0] * G[e, 2]) / L[0, 0]
    at = d.copy()
    for e in range(3):
        at[e] += G[e, 0] * off[0] + G[e, 1] * off[1] + G[e, 2] * off[2]
    x, y = c * at[0] - s * at[1], s * at[0] + c * at[1]
    pose[0], pose[1], pose[2] = a[0] + x, a[1] + y, wrap_angle(a[2] + at[2])
    R[0, 0], R[0, 1], R[1, 0], R[1, 1], R[2, 2] = c, -s, s, c, 1.0
    by_b[:] = _product(R, G, R)
    left[:] = _product(R, P - _product(G, N, G), R)
    by_a[:] = -by_b
    for e in range(3):
        by_a[e, e] += 1.0
        by_a[e, 2] += by_b[e, 0] * dy - by_b[e, 1] * dx
    by_a[0, 2] -= y
    by_a[1, 2] += x
