r"""Callers that move, in the state of an EKF: a place, or a ray of them, and a velocity.

How a caller drives is not known. Its velocity is taken for a random walk of spectral density
:math:`q = \sigma^2`, along each axis alike: in a time T

.. math:: \begin{bmatrix} b \\ v \end{bmatrix} \leftarrow
          \begin{bmatrix} I & T I \\ 0 & I \end{bmatrix}
          \begin{bmatrix} b \\ v \end{bmatrix} + w, \qquad
          \operatorname{cov} w = q \begin{bmatrix} \tfrac13 T^3 I & \tfrac12 T^2 I \\
          \tfrac12 T^2 I & T I \end{bmatrix}

(Bar-Shalom, Li & Kirubarajan 2001, Sec. 6.2.2: white noise acceleration). The velocity stands in
the state as two numbers more, like a point, under a label of its own (`velocity_of`); all members
of a caller's ray have it in common. It is never measured: what is heard of the caller's place
tells it. So it begins as nothing but its spread.

The right-invariant error treats it as it treats a point, and means the same: of
:math:`v = R(\xi_\theta)\,\hat v + V(\xi_\theta)\,\xi_v` and the like for b follows
:math:`\xi_b \leftarrow \xi_b + T \xi_v`, whatever the heading, and noise that is alike along both
axes stays so when it is turned. Both EKFs share what is here.
"""

import numpy as np
from jaxtyping import Bool, Float, Int

from pipistrelle.detection.scans import UNLABELLED
from pipistrelle.jit import Flag, Whole, kernel

_NOBODY, _SUM = UNLABELLED, UNLABELLED - 1
"""Labels are from 0 on; those of a caller and of its velocity add up to ``_SUM``."""


@kernel
def velocity_of(label: Whole) -> Whole:
    """Label of the velocity of a caller; of a velocity's label, the caller's.

    >>> velocity_of(51), velocity_of(velocity_of(51))
    (-53, 51)
    """
    return _SUM - label


def is_velocity(landmark: Int[np.ndarray, " h"]) -> Bool[np.ndarray, " h"]:
    """Return a mask of the rows of a state that are velocities, not places."""
    return landmark < _NOBODY


@kernel
def has_velocities(landmark: Int[np.ndarray, " h"]) -> Flag:
    """Tell whether any row of a state is a velocity."""
    least = 0
    for label in landmark:
        least = min(least, label)
    return least < _NOBODY


def is_standing(landmark: Int[np.ndarray, " h"]) -> Bool[np.ndarray, " h"]:
    """Return a mask of the rows that are neither callers that move nor their velocities.

    >>> is_standing(np.array([4, 51, -53]))
    array([ True, False, False])
    """
    velocity = is_velocity(landmark)
    if not velocity.any():
        return ~velocity
    return ~velocity & ~np.isin(landmark, _SUM - landmark[velocity])


def missing_velocities(
    landmark: Int[np.ndarray, " h"], moving: Int[np.ndarray, " v"]
) -> Int[np.ndarray, " n"]:
    """Return the labels of the velocities that the moving callers of a state still lack.

    >>> missing_velocities(np.array([51, 52, -53]), np.array([52]))
    array([-54])
    """
    velocity = _SUM - moving
    return velocity[np.isin(moving, landmark) & ~np.isin(velocity, landmark)]


@kernel
def propagate_callers(
    mean: Float[np.ndarray, " d"],
    covariance: Float[np.ndarray, "d room"],
    landmark: Int[np.ndarray, " h"],
    seconds: float,
    walk_std: float,
) -> None:
    """Move all callers through a time [s], in place; ``walk_std``: of a velocity after 1 s."""
    q, size = walk_std * walk_std, mean.size
    for velocity in range(landmark.size):
        if landmark[velocity] >= _NOBODY:
            continue
        label, iv = velocity_of(landmark[velocity]), 3 + 2 * velocity
        members = np.flatnonzero(landmark == label)
        for member in members:
            i = 3 + 2 * member
            for axis in range(2):
                mean[i + axis] += seconds * mean[iv + axis]
                for b in range(size):
                    covariance[i + axis, b] += seconds * covariance[iv + axis, b]
        for member in members:
            i = 3 + 2 * member
            for axis in range(2):
                for b in range(size):
                    covariance[b, i + axis] += seconds * covariance[b, iv + axis]
        for axis in range(2):
            covariance[iv + axis, iv + axis] += q * seconds
            for member in members:
                i = 3 + 2 * member + axis
                covariance[i, iv + axis] += 0.5 * q * seconds**2
                covariance[iv + axis, i] = covariance[i, iv + axis]
                for other in members:
                    covariance[i, 3 + 2 * other + axis] += q * seconds**3 / 3.0
