r"""Resampling: from weighted particles to equally weighted ones.

The weights tell how many particles still count,

.. math:: N_\mathrm{eff} = \left( \sum_j w_j^2 \right)^{-1}

(Eq. (15)); below a threshold the particles are drawn anew, each as often as its weight says. The
draw is *stratified*: one uniform number in each of N equal strata of [0, 1), so particle j gets
:math:`N w_j` copies on average and differs from it by less than two. Weights are kept as logs,
because the product of a frame's likelihoods underflows.
"""

import math

import numpy as np
from jaxtyping import Float, Int

from pipistrelle.jit import kernel


def normalised(log_weight: Float[np.ndarray, " p"]) -> Float[np.ndarray, " p"]:
    """Return the weights that sum to one, from their logs.

    The sum is rounded once, so the order of the particles does not matter, to the last bit. Where
    no log weight is finite the weights are equal: such a filter has lost the vehicle, which is a
    result and not an error.

    >>> normalised(np.array([-1000.0, -1000.0 + np.log(3.0)])).round(12)
    array([0.25, 0.75])
    """
    weight = _shifted(log_weight)
    total = math.fsum(weight.tolist())
    return weight / total if total > 0.0 else np.full(weight.size, 1.0 / weight.size)


@kernel
def _shifted(log_weight):
    """Return the exponentials relative to the largest; zero where the log is not finite."""
    weight, largest = np.zeros(log_weight.size), -np.inf
    for j in range(log_weight.size):
        if math.isfinite(log_weight[j]):
            largest = max(largest, log_weight[j])
    for j in range(log_weight.size):
        if math.isfinite(log_weight[j]):
            weight[j] = math.exp(log_weight[j] - largest)
    return weight


def effective_particles(weight: Float[np.ndarray, " p"]) -> float:
    r"""Return how many equally weighted particles would be worth as much, in [1, p].

    .. math:: N_\mathrm{eff} = 1 / \sum_j w_j^2
       :label: eq-15

    Bradley & Abaid, Eq. (15); the weights sum to 1.

    Examples
    --------
    >>> effective_particles(np.array([0.5, 0.5, 0.0, 0.0]))
    2.0
    """
    return 1.0 / float(np.sum(weight * weight))


def stratified(
    weight: Float[np.ndarray, " p"], uniform: Float[np.ndarray, " p"]
) -> Int[np.ndarray, " p"]:
    """Draw each particle's ancestor, one from each stratum of the cumulated weights.

    The weights sum to 1, ``uniform`` is in [0, 1); the indices rise. Bradley & Abaid, Sec. III-B;
    Douc, Cappe & Moulines (2005).

    >>> stratified(np.array([0.1, 0.6, 0.3]), np.array([0.2, 0.9, 0.5])).tolist()
    [0, 1, 2]
    """
    points = (np.arange(weight.size) + uniform) / weight.size
    bounds = np.cumsum(weight)
    bounds /= bounds[-1]
    last = np.flatnonzero(weight)[-1]  # a point can round to 1
    return np.minimum(np.searchsorted(bounds, points, side="right"), last)
