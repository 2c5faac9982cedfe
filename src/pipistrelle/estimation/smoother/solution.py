r"""The border of the arrow, solved by a factor of its information, and joint covariances.

The information is factored from its last row to its first, :math:`\Lambda = R^T R` with R lower
triangular, so that every loop runs along a row. The first column of R is then the right-hand side.
Columns in which nothing stands have a pivot of 1, and are 0.
"""

import math

import numpy as np
from jaxtyping import Float

from pipistrelle.estimation.smoother.records import Arrays
from pipistrelle.estimation.smoother.small_matrices import add_image
from pipistrelle.jit import Whole, kernel, no_alloc, optimised_once


@no_alloc
def factor(R: Float[np.ndarray, "n n"], n: Whole) -> None:
    """Factor an information of n columns, R^T R, in place; its first column becomes R b.

    Four rows at a time: that reads and writes the rows above a quarter as often.
    """
    i = n - 1
    while i >= 4:
        _factor_rows(R, i, 4)
        a, b, c, d = R[i], R[i - 1], R[i - 2], R[i - 3]
        for r in range(i - 3):
            other, w, x, y, z = R[r], a[r], b[r], c[r], d[r]
            for j in range(r + 1):
                other[j] -= (w * a[j] + x * b[j]) + (y * c[j] + z * d[j])
        i -= 4
    _factor_rows(R, i, i)
    for row in R[1 : i + 1]:
        R[0, 0] -= row[0] * row[0]


@no_alloc
def _factor_rows(R: Float[np.ndarray, "n n"], i: Whole, count: Whole) -> None:
    """Factor so many rows from row i up, and take each from those of them that are above it."""
    for p in range(i, i - count, -1):
        row = R[p]
        _divide(row, p)
        for r in range(i - count + 1, p):
            share, other = row[r], R[r]
            for j in range(r + 1):
                other[j] -= share * row[j]


@no_alloc
def _divide(row: Float[np.ndarray, " n"], i: Whole) -> None:
    """Divide a row by the root of its pivot at i."""
    inverse = 1.0 / math.sqrt(row[i])
    for j in range(i + 1):
        row[j] *= inverse


@no_alloc
def minimise(R: Float[np.ndarray, "n n"], n: Whole, beta: Float[np.ndarray, " n"]) -> None:
    """Write (1, b) of the least cost, from the factor."""
    beta[0] = 1.0
    for i in range(1, n):
        total = 0.0
        for j in range(i):
            total += R[i, j] * beta[j]
        beta[i] = -total / R[i, i]


@no_alloc
def rooted(R: Float[np.ndarray, "n n"], w: Float[np.ndarray, " n"], n: Whole) -> None:
    """Replace a slope w by the border by R^-T w, whose square is the variance of w b."""
    w[0] = 0.0
    for i in range(n - 1, 0, -1):
        if w[i] != 0.0:
            w[i] /= R[i, i]
            for j in range(i):
                w[j] -= w[i] * R[i, j]
    w[0] = 0.0


@optimised_once
def solve(
    front: Arrays, n: Whole, R: Float[np.ndarray, "n n"], beta: Float[np.ndarray, " n"]
) -> tuple[Float[np.ndarray, " d"], Float[np.ndarray, "d d"]]:
    """Solve for the border; return the state's difference from its point, and its covariance.

    R and ``beta`` are written: the factor, and (1, b).
    """
    C, P, information = front
    d = P.shape[0]
    state, covariance, Z = np.zeros(d), np.empty((d, d)), np.empty((d, n))
    write_lower(information, n, R)
    factor(R, n)
    minimise(R, n, beta)
    add_image(C, beta, state, 1.0)
    spread(C, P, R, n, Z, covariance)
    return state, covariance


@no_alloc
def write_lower(
    information: Float[np.ndarray, "w w"], n: Whole, R: Float[np.ndarray, "n n"]
) -> None:
    """Write the lower triangle of an information of n columns to R, 1 where nothing stands."""
    for i in range(n):
        for j in range(i + 1):
            R[i, j] = information[i, j]
        if i > 0 and R[i, i] == 0.0:
            R[i, i] = 1.0


@no_alloc
def spread(
    C: Float[np.ndarray, "d w"],
    P: Float[np.ndarray, "d d"],
    R: Float[np.ndarray, "n n"],
    n: Whole,
    Z: Float[np.ndarray, "d n"],
    covariance: Float[np.ndarray, "d d"],
) -> None:
    """Write the covariance of a state, P given the border and with slopes C by it."""
    for a in range(P.shape[0]):
        for j in range(n):
            Z[a, j] = C[a, j]
        rooted(R, Z[a], n)
        for b in range(a + 1):
            total = P[a, b]
            for j in range(1, n):
                total += Z[a, j] * Z[b, j]
            covariance[a, b] = covariance[b, a] = total


@kernel
def joint(
    front: Arrays,
    R: Float[np.ndarray, "n n"],
    n: Whole,
    by_chain: Float[np.ndarray, "q d"],
    by_border: Float[np.ndarray, "q n"],
) -> Float[np.ndarray, "q q"]:
    """Return the covariance of linear functions of the last state and the border together."""
    C, P, _ = front
    q, d = by_chain.shape
    Z, covariance, last = by_border.copy(), np.empty((q, q)), np.zeros(q, np.int64)
    for e in range(q):
        for a in range(d):
            if by_chain[e, a] != 0.0:
                for j in range(n):
                    Z[e, j] += by_chain[e, a] * C[a, j]
        rooted(R, Z[e], n)
        for j in range(n):
            if Z[e, j] != 0.0:
                last[e] = j
        for f in range(e + 1):
            total = 0.0
            for j in range(min(last[e], last[f]) + 1):
                total += Z[e, j] * Z[f, j]
            for a in range(d):
                if by_chain[e, a] != 0.0:
                    for b in range(d):
                        total += by_chain[e, a] * P[a, b] * by_chain[f, b]
            covariance[e, f] = covariance[f, e] = total
    return covariance


@optimised_once
def border_covariance(R: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "n n"]:
    """Return the covariance of the border from its factor; row and column of the constant are 0."""
    n = R.shape[0]
    Z, covariance = np.zeros((n, n)), np.zeros((n, n))
    for i in range(1, n):
        Z[i, i] = 1.0
        rooted(R, Z[i], i + 1)
        for j in range(1, i + 1):
            total = 0.0
            for e in range(1, j + 1):
                total += Z[i, e] * Z[j, e]
            covariance[i, j] = covariance[j, i] = total
    return covariance
