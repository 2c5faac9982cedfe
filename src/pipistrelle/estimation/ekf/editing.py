r"""Landmarks that are taken out of an EKF's state, and two that become one.

Two placed landmarks that are one are a measurement: their difference :math:`d = l_k - l_g` is 0, up
to `MERGED_STD`. With :math:`H = (\dots, I, \dots, -I, \dots)` and S = H P H^T + R = L L^T,

.. math:: W = P H^T L^{-T}, \qquad \hat X \leftarrow \hat X - W L^{-1} d, \qquad
          P \leftarrow P - W W^T ,

and then the second is dropped. The invariant error has the same H: that d is 0 is true of the map
however it is turned, so it says nothing of the heading, and the mean moves by the exponential.
"""

import math

import numpy as np
from jaxtyping import Bool, Float, Int

from pipistrelle.config import InputError
from pipistrelle.estimation.ekf.caller_motion import is_standing, velocity_of
from pipistrelle.estimation.ekf.gaussian import LINEAR, retract
from pipistrelle.jit import kernel

MERGED_STD = 1e-3
"""Standard deviation of the difference of two landmarks that are one, along each axis [m]."""

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
    mean, covariance, landmark, weight = state
    gone = (landmark == _present(landmark, label)) | (landmark == velocity_of(label))
    kept = np.concatenate((np.ones(3, bool), np.repeat(~gone, 2)))
    return mean[kept], covariance[np.ix_(kept, kept)], landmark[~gone], weight[~gone]


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
        state = _equated(state, 3 + 2 * first.argmax(), 3 + 2 * second.argmax(), error)
    elif placed[second].all():
        mean, covariance, landmark, weight = removed(state, kept)
        return mean, covariance, np.where(landmark == gone, kept, landmark), weight
    return removed(state, gone)


def _equated(state: State, k: int, g: int, error: float) -> State:
    """Correct a state by the measurement that the points at two indices are one."""
    mean, P, landmark, weight = state
    size, d = mean.size, mean[k : k + 2] - mean[g : g + 2]
    PH = P[:, k : k + 2] - P[:, g : g + 2]
    S = PH[k : k + 2] - PH[g : g + 2] + MERGED_STD**2 * np.eye(2)
    a, b = math.sqrt(S[0, 0]), S[1, 0] / math.sqrt(S[0, 0])
    c = math.sqrt(S[1, 1] - b * b)
    w0 = PH[:, 0] / a
    w1 = (PH[:, 1] - b * w0) / c
    e0 = -d[0] / a
    e1 = (-d[1] - b * e0) / c
    mean = mean.copy()
    if error == LINEAR:
        mean += e0 * w0 + e1 * w1
    else:
        retract(mean, size, w0, e0, w1, e1)
    return mean, P - np.outer(w0, w0) - np.outer(w1, w1), landmark, weight


def _present(landmark: Int[np.ndarray, " h"], label: int) -> int:
    """Return a label that is on the map; refuse any other."""
    if label < 0 or label not in landmark:
        raise InputError(f"association: found landmark {label} to change, which is not on the map")
    return label
