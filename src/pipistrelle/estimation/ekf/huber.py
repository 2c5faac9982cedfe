r"""Huber's rule: a measurement that surprises counts less, the more it does.

Echoes that overlap make errors that no Gaussian has. With the innovation :math:`\nu`, of which S is
the variance that the filter expects, and :math:`e = |\nu| / \sqrt S`,

.. math:: R' = R + S\,(e / k - 1) \quad (e > k = 2)

makes S' = S e / k, so that the correction grows no further with the surprise: it is that of a
measurement off by k standard deviations in the direction in which it is. Range and bearing are
asked each for itself, members of a ray by the one that the bearing surprises least.

Source: Huber, Robust Statistics (1981), for the influence of a bounded psi; applied to innovations
as by Karlgaard & Schaub, Journal of Guidance, Control, and Dynamics 30 (2007).
"""

import math

from pipistrelle.estimation.ekf.gaussian import (
    State,
    bearing_variance,
    relative_covariance,
)
from pipistrelle.estimation.measurement import BELIEVED, NEAREST, Row, observe
from pipistrelle.geometry import wrap_angle
from pipistrelle.jit import Whole, no_alloc


@no_alloc
def _excess(squared: float, S: float) -> float:
    """How much larger the variance must be, that a squared innovation surprise no more than k."""
    return S * max(math.sqrt(squared / S) / BELIEVED - 1.0, 0.0)


@no_alloc
def tempered(state: State, first: Whole, count: Whole, row: Row) -> Row:
    """A measurement of the members from ``first`` on, as surely as Huber's rule believes it."""
    joint, mean, size = state.joint, state.joint.mean, 3 + 2 * state.members[0]
    across, least, along = 0.0, math.inf, 0.0
    for j in range(count):
        i = 3 + 2 * (first + j)
        near, expected, c, s, k = observe(mean[0], mean[1], mean[2], mean[i], mean[i + 1])
        if near < NEAREST:
            return row
        innovation = wrap_angle(row.bearing - expected)
        S = bearing_variance(joint, size, i, c, s, k) + row.bearing_variance
        if innovation * innovation < least * S:
            least = innovation * innovation / S
            across = _excess(innovation * innovation, S)
        if count == 1 and not math.isnan(row.range):
            xx, xy, yy = relative_covariance(joint, size, i)
            S = c * c * xx + 2.0 * c * s * xy + s * s * yy + row.range_variance
            along = _excess((row.range - near) ** 2, S)
    return Row(
        row.landmark,
        row.bearing,
        row.range,
        row.bearing_variance + across,
        row.range_variance + along,
    )
