r"""Callers that move, in the state of an EKF: a place, or a ray of them, and a velocity.

Nobody tells how a caller drives. Its velocity is taken for a random walk of spectral density
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

from dataclasses import replace
from typing import TYPE_CHECKING, TypeVar

import numpy as np
from jaxtyping import Bool, Float, Int

from pipistrelle.detection.scans import UNLABELLED
from pipistrelle.jit import Whole, kernel

if TYPE_CHECKING:
    from pipistrelle.estimation.ekf.filter import EkfBelief

    Kept = TypeVar("Kept", bound=EkfBelief)

_NOBODY, _SUM = UNLABELLED, UNLABELLED - 1
"""Labels are from 0 on; that of a caller and that of its velocity have one sum."""


@kernel
def velocity_of(label: Whole) -> Whole:
    """Return the label under which the velocity of a caller stands, and the other way round.

    Examples
    --------
    >>> velocity_of(51), velocity_of(velocity_of(51))
    (-53, 51)
    """
    return _SUM - label


def is_velocity(landmark: Int[np.ndarray, " h"]) -> Bool[np.ndarray, " h"]:
    """Tell which rows of a state are velocities, not places.

    Parameters
    ----------
    landmark : (h)

    Returns
    -------
    (h)

    Examples
    --------
    >>> is_velocity(np.array([4, 51, -53]))
    array([False, False,  True])
    """
    return landmark < _NOBODY


def stands(landmark: Int[np.ndarray, " h"]) -> Bool[np.ndarray, " h"]:
    """Tell which rows of a state are of what stands, neither callers that move nor velocities.

    Parameters
    ----------
    landmark : (h)

    Returns
    -------
    (h)

    Examples
    --------
    >>> stands(np.array([4, 51, -53]))
    array([ True, False, False])
    """
    velocity = is_velocity(landmark)
    if not velocity.any():
        return ~velocity
    return ~velocity & ~np.isin(landmark, _SUM - landmark[velocity])


def with_velocities(belief: "Kept", moving: Int[np.ndarray, " v"], std: float) -> "Kept":
    """Give each caller that moves a velocity, once it has a place.

    Parameters
    ----------
    belief : EkfBelief
    moving : (v)
        Labels of who moves.
    std : [m/s]
        Of a velocity of which nothing is known, along an axis.

    Returns
    -------
    EkfBelief

    Examples
    --------
    >>> from pipistrelle.estimation.ekf.filter import EkfBelief
    >>> belief = EkfBelief(
    ...     mean=np.arange(5.0), covariance=np.eye(5), landmark=np.array([9]), weight=np.ones(1),
    ...     gated=0,
    ... )
    >>> belief = with_velocities(belief, np.array([8, 9]), 2.0)
    >>> belief.landmark, belief.mean, belief.covariance.diagonal()
    (array([  9, -11]), array([0., 1., 2., 3., 4., 0., 0.]), array([1., 1., 1., 1., 1., 4., 4.]))
    """
    known = belief.landmark
    if np.count_nonzero(is_velocity(known)) == moving.size:
        return belief
    new = moving[np.isin(moving, known) & ~np.isin(_SUM - moving, known)]
    if new.size == 0:
        return belief
    size = belief.mean.size
    covariance = std * std * np.eye(size + 2 * new.size)
    covariance[:size, :size] = belief.covariance
    return replace(
        belief,
        mean=np.append(belief.mean, np.zeros(2 * new.size)),
        covariance=covariance,
        landmark=np.append(known, _SUM - new),
        weight=np.append(belief.weight, np.ones(new.size)),
    )


@kernel
def roam(
    mean: Float[np.ndarray, " d"],
    covariance: Float[np.ndarray, "d d"],
    landmark: Int[np.ndarray, " h"],
    seconds: float,
    walk_std: float,
) -> None:
    """Let every caller that moves go on for a time, in place, members of a ray together."""
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
