r"""Joint compatibility: the largest set of pairs of rows and landmarks that fits as a whole.

All rows of a scan share the error of the pose, so pairs that are each within the gate may
contradict each other. Of a set of pairs with the joint innovation :math:`\nu` and its covariance
S = L L^T

.. math:: d^2 = |y|^2, \qquad L y = \nu,

and the set is compatible while :math:`d^2` is within the quantile of :math:`\chi^2` for its
numbers. A pair more adds two rows to L and two numbers to y. The search goes row by row, each row's
likeliest landmark first and no landmark last. It leaves a branch that cannot have more pairs than
the best set so far, or as many that fit better, and it ends after `MOST_NODES`: then the best set
so far is taken.

Neira & Tardos, IEEE Transactions on Robotics and Automation 17 (2001).
"""

import math
from functools import cache

import numpy as np
from jaxtyping import Float, Int

from pipistrelle.estimation.data_association.matching import NOTHING, Innovate, Innovations
from pipistrelle.jit import Whole, kernel, no_alloc

CONFIDENCE = 0.999
"""Share of right sets that are within the gate."""
MOST_NODES, MOST_ROWS = 3000, 100
"""How many pairs are tried at most, and how many rows are tested together: the work grows with the
cube of their number. Of each row only so many landmarks take part as can be tried."""


@cache
def gates(numbers: int) -> Float[np.ndarray, " g"]:
    """Return the largest squared distance of 0, 1, ... numbers.

    >>> gates(2).round(2)
    array([ 0.  , 10.83, 13.82])
    """
    from scipy.special import gammaincinv

    return 2.0 * gammaincinv(np.maximum(np.arange(numbers + 1), 1e-9) / 2.0, CONFIDENCE)


def jointly_compatible(
    costs: Float[np.ndarray, "m n"], innovate: Innovate | None
) -> Int[np.ndarray, " m"]:
    """Return the landmark of each row by the largest compatible set of pairs, or NOTHING.

    Pairs that are likelier than clutter take part.
    """
    found = np.full(len(costs), NOTHING)
    row, landmark = np.nonzero(costs < 0.0)
    if not row.size or innovate is None:
        return found
    order = np.lexsort((costs[row, landmark], row))
    row, landmark = row[order], landmark[order]
    rows, begins, counts = np.unique(row, return_index=True, return_counts=True)
    likely = np.arange(row.size) - np.repeat(begins, counts) < MOST_NODES // min(
        rows.size, MOST_ROWS
    )
    row, landmark = row[likely], landmark[likely]
    for first in range(0, rows.size, MOST_ROWS):
        part = (row >= rows[first]) & (row <= rows[first : first + MOST_ROWS][-1])
        part &= ~np.isin(landmark, found)  # what rows before have taken
        _match_together(found, row[part], landmark[part], innovate)
    return found


def _match_together(
    found: Int[np.ndarray, " m"],
    row: Int[np.ndarray, " p"],
    landmark: Int[np.ndarray, " p"],
    innovate: Innovate,
) -> None:
    """Write the landmarks of rows by the largest compatible set of some pairs, row by row."""
    options = np.append(np.flatnonzero(np.diff(row, prepend=-1)), row.size)
    pairs = _search(options, landmark, innovate((row, landmark)), gates(2 * (options.size - 1)))
    found[row[pairs]] = landmark[pairs]


@kernel
def _search(
    options: Int[np.ndarray, " o"],
    landmark: Int[np.ndarray, " p"],
    innovations: Innovations,
    gate: Float[np.ndarray, " g"],
) -> Int[np.ndarray, " c"]:
    """Return the pairs of the largest compatible set; options: where each row's pairs begin."""
    levels, numbers = options.size - 1, innovations[2]
    L, y = np.zeros((2 * levels, 2 * levels)), np.zeros(2 * levels)
    chosen, best = np.empty(levels, np.int64), np.empty(levels, np.int64)
    count, used, squared = (
        np.zeros(levels + 1, np.int64), np.zeros(levels + 1, np.int64), np.zeros(levels + 1)
    )  # fmt: skip
    following, level, most, least, nodes = options.copy(), 0, 0, math.inf, 0
    while level >= 0:
        k, option = count[level], following[level]
        if level == levels or option > options[level + 1] or nodes >= MOST_NODES:
            if level == levels and (k > most or (k == most and squared[level] < least)):
                most, least = k, squared[level]
                best[:k] = chosen[:k]
            level -= 1
            continue
        following[level] += 1
        here = level + 1
        count[here], used[here], squared[here] = k, used[level], squared[level]
        if option < options[here]:
            nodes += 1
            if _is_taken(landmark, chosen, k, option):
                continue
            chosen[k] = option
            squared[here] += _extended(L, y, chosen, k, innovations)
            count[here], used[here] = k + 1, used[level] + numbers[option]
            if squared[here] > gate[used[here]]:
                continue
        hoped = count[here] + levels - here
        if hoped > most or (hoped == most and squared[here] < least):
            level = here
            following[level] = options[level]
    return best[:most].copy()


@no_alloc
def _is_taken(
    landmark: Int[np.ndarray, " p"], chosen: Int[np.ndarray, " c"], k: Whole, option: Whole
) -> bool:
    """Tell whether one of the first k chosen pairs has the landmark of a pair."""
    taken = False
    for n in range(k):
        taken |= landmark[chosen[n]] == landmark[option]
    return taken


@no_alloc
def _extended(
    L: Float[np.ndarray, "d d"],
    y: Float[np.ndarray, " d"],
    chosen: Int[np.ndarray, " c"],
    k: Whole,
    innovations: Innovations,
) -> float:
    """Write the rows of the k-th chosen pair; return by how much the squared distance grows."""
    nu, S, _ = innovations
    for a in (2 * k, 2 * k + 1):
        whole = 2 * chosen[k] + a - 2 * k
        rest = nu[whole]
        for b in range(a + 1):
            value = S[whole, 2 * chosen[b // 2] + b % 2]
            for c in range(b):
                value -= L[a, c] * L[b, c]
            L[a, b] = math.sqrt(max(value, 1e-300)) if b == a else value / L[b, b]
            if b < a:
                rest -= L[a, b] * y[b]
        y[a] = rest / L[a, a]
    return y[2 * k] ** 2 + y[2 * k + 1] ** 2
