r"""Huber's rule: the more a measurement surprises, the less it counts.

Overlapping echoes make errors that no Gaussian describes. With the innovation :math:`\nu`, its
expected variance S and :math:`e = |\nu| / \sqrt S`,

.. math:: R' = R + S\,(e / k - 1) \quad (e > k = 2)

makes S' = S e / k: the correction is that of a measurement off by k standard deviations, and grows
no further. Range and bearing are judged separately; a ray is judged by the member that the bearing
surprises least.

Source: Huber, Robust Statistics (1981), for the influence of a bounded psi; applied to innovations
as by Karlgaard & Schaub, Journal of Guidance, Control, and Dynamics 30 (2007).
"""

import math

from pipistrelle.estimation.ekf.gaussian import State, bearing_variance, relative_covariance
from pipistrelle.estimation.measurement import HUBER_K, NEAREST, Row, observe
from pipistrelle.geometry import wrap_angle
from pipistrelle.jit import Whole, no_alloc


@no_alloc
def _excess(squared: float, S: float) -> float:
    """Return what to add to S so that an innovation is at most `HUBER_K` deviations."""
    return S * max(math.sqrt(squared / S) / HUBER_K - 1.0, 0.0)


@no_alloc
def inflated(state: State, first: Whole, count: Whole, row: Row) -> Row:
    """Return a measurement of ``count`` members, with its variances raised by Huber's rule."""
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
