"""Callers that turn: where one is whose rows do not fit where it was expected to be.

An estimator takes velocities for random walks; of a caller that turns at once it knows too late,
and its rows, held against where it was expected, are of no landmark. So where few of them fit, the
places about its direct call are tried: on the map its rows fit together at one place alone.
"""

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float

from pipistrelle.estimation.beliefs import JointGaussian
from pipistrelle.estimation.data_association.caller_search import seen_from

FEW, LEAST_ROWS = 0.5, 6
"""A caller may have turned if less than this share of its rows fits, of so many."""
BETTER = 30.0
"""By how much all rows together must fit better elsewhere."""
LEAST_REACH, REACH, NEAREST = 4.0, 3.0, 0.5
"""Ranges are tried that are off the expected one by so much [m], or by so many deviations of the
place, and none nearer than the last [m]."""
SHARES, BEARINGS = np.linspace(-1.0, 1.0, 21), np.linspace(-0.06, 0.06, 7)
"""Parts of that, and bearings off the direct call [rad]."""

Costs = Callable[[Float[np.ndarray, " d"]], Float[np.ndarray, "r n"]]
"""Costs of rows and landmarks (`pairs.pair_costs`) by the joint mean."""


def may_have_turned(fitting: int, rows: int) -> bool:
    """Tell whether too few of a caller's rows fit where it was expected."""
    return rows >= LEAST_ROWS and fitting < FEW * rows


def turned(joint: JointGaussian, at: int, bearing: float, costs: Costs) -> JointGaussian:
    """Return a joint Gaussian in which a caller is where its rows fit.

    ``at``: where the caller stands in the mean; ``bearing``: of its direct call.
    """
    mean, spread = joint.mean, np.diag(joint.covariance)[at : at + 2].sum()
    least, fitting = fit(costs(mean))
    if not may_have_turned(int(fitting.sum()), fitting.size):
        return joint
    towards, least, best = mean[2] + bearing, least - BETTER, mean
    expected = math.hypot(*(mean[at : at + 2] - mean[:2]))
    reach = max(LEAST_REACH, REACH * math.sqrt(spread))
    for far in np.maximum(expected + reach * SHARES, NEAREST):
        for angle in towards + BEARINGS:
            other = mean.copy()
            other[at : at + 2] = seen_from(mean[:3], far, angle)
            cost, _ = fit(costs(other))
            if cost < least:
                best, least = other, cost
    return replace(joint, mean=best)


def fit(costs: Float[np.ndarray, "r n"]) -> tuple[float, Bool[np.ndarray, " r"]]:
    """Return what rows cost together, each as clutter at most, and which are none."""
    least = costs.min(axis=1, initial=0.0)
    return float(least.sum()), least < 0.0
