r"""Merging of ray members that agree.

Bearings may draw two members of a ray to the same place. They then explain all that follows alike:
neither is ever pruned, and the landmark stays a ray. So neighbours whose distance d is within a
limit of their mean covariance P,

.. math:: d^T P^{-1} d \le \text{limit}^2,

become one, with mean and covariance of their mixture and its covariances with all else:

.. math:: m = w_a m_a + w_b m_b, \quad
          P_{mx} = w_a P_{ax} + w_b P_{bx}, \quad
          P_{mm} = w_a P_{aa} + w_b P_{bb} + w_a w_b \, d d^T

Source: moment matching, as in Salmond, SPIE 1305 (1990), for a mixture of two.
"""

from pipistrelle.estimation.ekf.gaussian import State, drop_members, flush, point_rows
from pipistrelle.estimation.ekf.members import Scratch
from pipistrelle.jit import Flag, Whole, no_alloc


@no_alloc
def merge_members(state: State, first: Whole, count: Whole, limit: float, scratch: Scratch) -> None:
    """Merge neighbours of a ray that agree, from near to far."""
    kept, last = 0, 0  # the member that is kept last, into which the next may go
    for j in range(count):
        scratch.keep[j] = j == 0 or not _agree(state, first + last, first + j, limit)
        if scratch.keep[j]:
            kept, last = kept + 1, j
        else:
            _merge(state, first + last, first + j)
    if kept < count:
        drop_members(state, first, count, scratch.keep, scratch.source)


@no_alloc
def _agree(state: State, one: Whole, other: Whole, limit: float) -> Flag:
    """Tell whether the distance of two members is within the limit of their mean covariance."""
    joint, size = state.joint, 3 + 2 * state.members[0]
    i, j = 3 + 2 * one, 3 + 2 * other
    ax, ay = point_rows(joint, size, i)
    bx, by = point_rows(joint, size, j)
    xx, xy, yy = 0.5 * (ax[i] + bx[j]), 0.5 * (ax[i + 1] + bx[j + 1]), 0.5 * (ay[i + 1] + by[j + 1])
    x, y = joint.mean[j] - joint.mean[i], joint.mean[j + 1] - joint.mean[i + 1]
    return yy * x * x - 2.0 * xy * x * y + xx * y * y <= limit * limit * (xx * yy - xy * xy)


@no_alloc
def _merge(state: State, one: Whole, other: Whole) -> None:
    """Replace the first of two members by their mixture."""
    joint, weight, size = state.joint, state.weight, 3 + 2 * state.members[0]
    flush(joint, size)
    mean, P, i, j = joint.mean, joint.covariance, 3 + 2 * one, 3 + 2 * other
    total = weight[one] + weight[other]
    a = weight[one] / total
    b = 1.0 - a
    x, y = mean[j] - mean[i], mean[j + 1] - mean[i + 1]
    xx = a * P[i, i] + b * P[j, j] + a * b * x * x
    xy = a * P[i, i + 1] + b * P[j, j + 1] + a * b * x * y
    yy = a * P[i + 1, i + 1] + b * P[j + 1, j + 1] + a * b * y * y
    for k in range(size):
        P[i, k] = P[k, i] = a * P[i, k] + b * P[j, k]
        P[i + 1, k] = P[k, i + 1] = a * P[i + 1, k] + b * P[j + 1, k]
    P[i, i], P[i + 1, i + 1] = xx, yy
    P[i, i + 1] = P[i + 1, i] = xy
    mean[i], mean[i + 1] = mean[i] + b * x, mean[i + 1] + b * y
    weight[one] = total
