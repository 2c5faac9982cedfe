r"""From costs of pairs to decisions: which row is of which landmark.

`nearest` takes the assignment that costs least, each landmark once. `marginal` takes what is sure
over all assignments: the probability that a row is of a landmark, by message passing. With
:math:`w_{ij} = e^{-c_{ij} / 2}` messages between rows i and landmarks j are

.. math:: \mu_{ij} = \frac{w_{ij}}{1 + \sum_{k \ne j} w_{ik} \nu_{ki}}, \qquad
          \nu_{ji} = \frac{1}{1 + \sum_{k \ne i} \mu_{kj}}

until they stay, and the probability is
:math:`w_{ij} \nu_{ji} / (1 + \sum_k w_{ik} \nu_{ki})`.

Williams & Lau, IEEE Transactions on Aerospace and Electronic Systems 50 (2014).
"""

import math
from collections.abc import Callable

import numpy as np
from jaxtyping import Float, Int

from pipistrelle.jit import kernel

NOTHING = -1
"""A row of no landmark."""
Innovations = tuple[Float[np.ndarray, " e"], Float[np.ndarray, "e e"], Int[np.ndarray, " p"]]
"""Of pairs, two numbers each: their innovation, its covariance, and how many of the two count."""
Innovate = Callable[[tuple[Int[np.ndarray, " p"], Int[np.ndarray, " p"]]], Innovations]
"""From rows and landmarks of pairs to their innovations together (`pairs.pair_innovations`)."""
Match = Callable[[Float[np.ndarray, "m n"], Innovate | None], Int[np.ndarray, " m"]]
"""From costs of rows and landmarks to the landmark of each row, or NOTHING."""
LIKELY, SURE = 0.9, 0.99
"""Probabilities from which on a row is taken to be of a landmark, and, if it is, of which."""
MESSAGES, STAY = 50, 1e-6
"""How often messages are passed, at most, and by how much they may still change."""
LARGEST = 30.0
"""Largest logarithm of a weight: beyond it a pair is as sure, and sums would lose digits."""
FARTHEST = 1e6
"""In place of an infinite cost."""


def nearest(
    costs: Float[np.ndarray, "m n"], innovate: Innovate | None = None
) -> Int[np.ndarray, " m"]:
    """Return the landmark of each row by the assignment that costs least, or NOTHING.

    ``innovate``: what all methods are given, and only joint compatibility needs.

    >>> nearest(np.array([[-5.0, -4.0], [-4.5, np.inf], [3.0, np.inf]]))
    array([ 1,  0, -1])
    """
    from scipy.optimize import linear_sum_assignment  # a quarter of a second, if not needed

    rows, landmarks = costs.shape
    bare = np.full((rows, rows), FARTHEST)
    np.fill_diagonal(bare, 0.0)
    taken, chosen = linear_sum_assignment(np.hstack([np.minimum(costs, FARTHEST), bare]))
    found = np.full(rows, NOTHING)
    found[taken] = np.where(chosen < landmarks, chosen, NOTHING)
    return found


def marginal(
    costs: Float[np.ndarray, "m n"], innovate: Innovate | None = None
) -> Int[np.ndarray, " m"]:
    """Return the landmark of each row where that is sure, or NOTHING.

    Here the first row is of either (`LIKELY`), but neither is sure (`SURE`).

    >>> marginal(np.array([[-9.0, -9.0], [np.inf, np.inf]]))
    array([-1, -1])
    >>> marginal(np.array([[-9.0, -9.0], [np.inf, -20.0]]))
    array([0, 1])
    """
    return _what_is_sure(costs)


@kernel
def _what_is_sure(costs: Float[np.ndarray, "m n"]) -> Int[np.ndarray, " m"]:
    """Return the landmark of each row where that is sure, or NOTHING."""
    rows, landmarks, shares = _shares(costs)
    found, first = np.full(costs.shape[0], NOTHING), 0
    while first < rows.size:
        last, best, of_any = first, first, 0.0
        while last < rows.size and rows[last] == rows[first]:
            of_any += shares[last]
            if shares[last] > shares[best]:
                best = last
            last += 1
        if of_any > LIKELY and shares[best] >= SURE * of_any:
            found[rows[first]] = landmarks[best]
        first = last
    return found


@kernel
def probabilities(costs: Float[np.ndarray, "m n"]) -> Float[np.ndarray, "m n"]:
    """Return the probability of each pair, of clutter what is left to 1.

    >>> probabilities(np.array([[0.0]]))
    array([[0.5]])
    """
    (rows, landmarks, values), shares = _shares(costs), np.zeros(costs.shape)
    for p in range(rows.size):
        shares[rows[p], landmarks[p]] = values[p]
    return shares


@kernel
def _shares(
    costs: Float[np.ndarray, "m n"],
) -> tuple[Int[np.ndarray, " p"], Int[np.ndarray, " p"], Float[np.ndarray, " p"]]:
    """Return the pairs that are within the gate, row by row, and the probability of each."""
    (m, n), (rows, landmarks) = costs.shape, np.nonzero(costs < np.inf)
    size, beyond = rows.size, np.full(n, m)
    weight, to_row, to_landmark = np.empty(size), np.ones(size), np.empty(size)
    for p in range(size):
        weight[p] = math.exp(min(-0.5 * costs[rows[p], landmarks[p]], LARGEST))
        beyond[landmarks[p]] -= 1
    sums, total, to_others = np.empty(m), np.empty(n), np.ones(n)
    for _ in range(MESSAGES):
        moved = 0.0
        _sum_up(sums, rows, weight, to_row)
        total[:] = 1.0
        for p in range(size):
            others = max(sums[rows[p]] - weight[p] * to_row[p], 1.0)
            to_landmark[p] = weight[p] / others
            total[landmarks[p]] += to_landmark[p]
        for p in range(size):
            message = 1.0 / max(total[landmarks[p]] - to_landmark[p], 1.0)
            moved = max(moved, abs(message - to_row[p]))
            to_row[p] = message
        for j in range(n):
            if beyond[j] > 0:  # rows of which this landmark is beyond the gate
                moved = max(moved, abs(1.0 / total[j] - to_others[j]))
                to_others[j] = 1.0 / total[j]
        if moved < STAY:
            break
    _sum_up(sums, rows, weight, to_row)
    return rows, landmarks, weight * to_row / sums[rows]


@kernel
def _sum_up(
    sums: Float[np.ndarray, " m"],
    rows: Int[np.ndarray, " p"],
    weight: Float[np.ndarray, " p"],
    to_row: Float[np.ndarray, " p"],
) -> None:
    """Write one and the weighted messages to each row."""
    sums[:] = 1.0
    for p in range(rows.size):
        sums[rows[p]] += weight[p] * to_row[p]
