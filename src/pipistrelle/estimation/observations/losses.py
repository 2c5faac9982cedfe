"""Robust losses of measurements with outliers."""

import math
from typing import get_args

from pipistrelle.config import FilterConfig
from pipistrelle.jit import Whole, no_alloc

LOSSES = get_args(FilterConfig.model_fields["robust"].annotation)
"""Names of the robust losses; their codes in kernels are their places."""
SQUARED, HUBER, CAUCHY = range(len(LOSSES))
HUBER_K = 2.0
"""Standard deviations above which Huber's loss down-weights a measurement."""
CAUCHY_K = 2.385
"""Scale of Cauchy's loss [standard deviations]: normal errors keep 95 % of their information."""


@no_alloc
def robust_loss(squared: float, loss: Whole) -> tuple[float, float]:
    r"""Return the factor on the variance of a measurement, and twice its loss.

    With the squared residual :math:`e^2` in units of its variance, the loss is e²/2 (SQUARED),

    .. math:: k e - \tfrac12 k^2 \; (e > k), \qquad \tfrac12 c^2 \ln(1 + e^2 / c^2)

    (HUBER, CAUCHY), and the factor the inverse of its weight: e / k and 1 + e² / c². Sources:
    Huber, Robust Statistics (1981); Holland & Welsch, Communications in Statistics 6 (1977).
    """
    if loss == CAUCHY:
        factor = 1.0 + squared / (CAUCHY_K * CAUCHY_K)
        return factor, CAUCHY_K * CAUCHY_K * math.log(factor)
    if loss == HUBER and squared > HUBER_K * HUBER_K:
        size = math.sqrt(squared)
        return size / HUBER_K, HUBER_K * (2.0 * size - HUBER_K)
    return 1.0, squared
