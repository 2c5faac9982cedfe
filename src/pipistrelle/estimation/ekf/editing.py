r"""Landmarks that are taken out of an EKF's state, and two that become one.

Two placed landmarks that are one are a measurement: their difference :math:`d = l_k - l_g` is 0, up
to `MERGED_STD`. With :math:`H = (\dots, I, \dots, -I, \dots)` and S = H P H^T + R = L L^T,

.. math:: W = P H^T L^{-T}, \qquad \hat X \leftarrow \hat X - W L^{-1} d, \qquad
          P \leftarrow P - W W^T ,

and then the second is dropped. The invariant error has the same H: that d is 0 is true of the map
however it is turned, so it says nothing of the heading, and the mean moves by the exponential.
Where d is beyond what S admits (`FARTHEST`), wrong rows have placed one of the two: their
difference then tells nothing of the rest, and the second is dropped alone.
"""

import math

import numpy as np
from jaxtyping import Bool, Float, Int

from pipistrelle.config import InputError
from pipistrelle.estimation.ekf.caller_motion import is_standing, velocity_of
from pipistrelle.estimation.ekf.gaussian import LINEAR, retract
from pipistrelle.jit import Whole, kernel

MERGED_STD = 1e-3
"""Standard deviation of the difference of two landmarks that are one, along each axis [m]."""
FARTHEST = 100.0
"""Largest squared distance of two that are one to be a measurement."""

State = tuple[
    Float[np.ndarray, " d"],
    Float[np.ndarray, "d d"],
    Int[np.ndarray, " h"],
    Float[np.ndarray, " h"],
]
"""Mean, covariance, and of each member its landmark's label and its weight, as `EkfBelief` has
them."""


@kernel
def is_placed(landmark: Int[np.ndarray, " h"]) -> Bool[np.ndarray, " h"]:
    """Return a mask of the members that are a landmark's or a caller's only one.

    >>> is_placed(np.array([4, 7, 7, 51, -53]))
    array([ True, False, False,  True, False])
    """
    placed = landmark >= 0
    for n in range(1, landmark.size):
        if landmark[n] == landmark[n - 1]:  # the members of a landmark are neighbours
            placed[n - 1] = placed[n] = False
    return placed


def removed(state: State, label: int) -> State:
    """Return a state without the members of a landmark, and without its velocity if it moves."""
    return _left(*state, _present(state[2], label))


@kernel
def _left(
    mean: Float[np.ndarray, " d"],
    covariance: Float[np.ndarray, "d d"],
    landmark: Int[np.ndarray, " h"],
    weight: Float[np.ndarray, " h"],
    label: Whole,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return what is left of a state without a landmark."""
    kept = np.flatnonzero((landmark != label) & (landmark != velocity_of(label)))
    left, P = np.empty(3 + 2 * kept.size), np.empty((3 + 2 * kept.size, 3 + 2 * kept.size))
    at = np.arange(left.size)
    for n in range(kept.size):
        at[3 + 2 * n], at[4 + 2 * n] = 3 + 2 * kept[n], 4 + 2 * kept[n]
    for i in range(at.size):
        left[i] = mean[at[i]]
        for j in range(at.size):
            P[i, j] = covariance[at[i], at[j]]
    return left, P, landmark[kept], weight[kept]


def merged(state: State, kept: int, gone: int, error: float) -> State:
    """Return a state in which two landmarks that stand are one, under the label of the first.

    Of a placed one and a ray the placed one stays, of two rays the first. `error`: as in
    `EkfBelief`.
    """
    landmark = state[2]
    standing = is_standing(landmark)
    first, second = (landmark == _present(landmark, label) for label in (kept, gone))
    if kept == gone or not standing[first | second].all():
        raise InputError(
            f"association: found the landmarks {kept} and {gone} to merge; expected two that stand"
        )
    placed = is_placed(landmark)
    if placed[first].all() and placed[second].all():
        k, g = 3 + 2 * int(first.argmax()), 3 + 2 * int(second.argmax())
        state = *_equated(*state[:2], k, g, error), *state[2:]
    elif placed[second].all():
        mean, covariance, landmark, weight = removed(state, kept)
        return mean, covariance, np.where(landmark == gone, kept, landmark), weight
    return removed(state, gone)


@kernel
def _equated(
    mean: Float[np.ndarray, " d"], P: Float[np.ndarray, "d d"], k: Whole, g: Whole, error: float
) -> tuple[Float[np.ndarray, " d"], Float[np.ndarray, "d d"]]:
    """Correct mean and covariance by the measurement that the points at two indices are one."""
    w0, w1 = P[:, k] - P[:, g], P[:, k + 1] - P[:, g + 1]
    a = math.sqrt(w0[k] - w0[g] + MERGED_STD * MERGED_STD)
    b = (w0[k + 1] - w0[g + 1]) / a
    c = math.sqrt(w1[k + 1] - w1[g + 1] + MERGED_STD * MERGED_STD - b * b)
    e0 = -(mean[k] - mean[g]) / a
    e1 = (-(mean[k + 1] - mean[g + 1]) - b * e0) / c
    if e0 * e0 + e1 * e1 > FARTHEST:
        return mean.copy(), P.copy()
    moved, left = mean.copy(), np.empty_like(P)
    w0 = w0 / a
    w1 = (w1 - b * w0) / c
    if error == LINEAR:
        moved += e0 * w0 + e1 * w1
    else:
        retract(moved, mean.size, w0, e0, w1, e1)
    for i in range(mean.size):
        for j in range(mean.size):
            left[i, j] = P[i, j] - w0[i] * w0[j] - w1[i] * w1[j]
    return moved, left


def _present(landmark: Int[np.ndarray, " h"], label: int) -> int:
    """Return a label that is on the map; refuse any other."""
    if label < 0 or label not in landmark:
        raise InputError(f"association: found landmark {label} to change, which is not on the map")
    return label
