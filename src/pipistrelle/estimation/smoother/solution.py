r"""Solution for the separator (`border`), and covariances of all states by a backward pass.

The information is factored from its last row to its first, :math:`\Lambda = R^T R` with R lower
triangular, so that every loop runs along a row; the first column of R is then the right-hand side.
Unused columns have a pivot of 1. Elimination left each state, and each landmark that has left the
separator, with the conditional (`elimination.Links`, `elimination.leave`)

.. math:: x_k = D \beta + G x_{k+1} + s, \qquad s \sim N(0, S) .

With :math:`\Sigma` the covariance of the separator, X a state's covariance with it and P the
state's covariance, the previous node has

.. math:: X_k = D \Sigma + G X_{k+1}, \quad \operatorname{Cov}(x_{k+1}, x_k) = X_{k+1} D^T +
          P_{k+1} G^T, \quad P_k = S + X_k D^T + G \operatorname{Cov}(x_{k+1}, x_k) .

Source: Rauch, Tung & Striebel, AIAA Journal 3, 1965, extended by the separator.
"""

import math

import numpy as np
from jaxtyping import Float, Int

from pipistrelle.estimation.smoother.records import (
    Arrays,
    Links,
    add_image,
    add_product,
    multiply,
    transpose,
    write,
    write_image,
)
from pipistrelle.jit import Whole, kernel, no_alloc, optimised_once

Left = tuple[Float[np.ndarray, "g 2 n"], Float[np.ndarray, "g 2 d"], Float[np.ndarray, "g 2 2"]]
"""D, G and S of landmarks that have left the separator."""


@optimised_once
def trace_back(
    links: Arrays,
    beta: Float[np.ndarray, " n"],
    last: Float[np.ndarray, " d"],
    count: Whole,
) -> Float[np.ndarray, "k d"]:
    """Return the last ``count`` + 1 states, in order, by a backward pass over links."""
    links, d = Links(*links), last.size
    states = np.empty((count + 1, d))
    for a in range(d):
        states[count, a] = last[a]
    for k in range(count - 1, -1, -1):
        write_image(links.D[k], beta, states[k])
        add_image(links.G[k], states[k + 1], states[k], 1.0)
    return states


@optimised_once
def places_left(
    left: Left, column: Int[np.ndarray, " g"], beta: Float[np.ndarray, " n"],
    state: Float[np.ndarray, " d"],
) -> None:  # fmt: skip
    """Write solved landmarks that left the separator, relative to their points, to ``beta``."""
    place = np.empty(2)
    for g in range(column.size - 1, -1, -1):
        beta[column[g]] = beta[column[g] + 1] = 0.0
        write_image(left[0][g], beta, place)
        add_image(left[1][g], state, place, 1.0)
        beta[column[g]], beta[column[g] + 1] = place[0], place[1]


@optimised_once
def spread_back(
    links: Arrays,
    covariances: tuple[
        Float[np.ndarray, "d d"], Float[np.ndarray, "d n"], Float[np.ndarray, "n n"]
    ],
    count: Whole,
) -> tuple[Float[np.ndarray, "k d d"], Float[np.ndarray, "k d d"]]:
    """Return covariances of the states before ``count`` links, and their cross-covariances.

    ``covariances``: P, X (both replaced by the first state's) and the separator's covariance.
    """
    links, (P, X, border) = Links(*links), covariances
    d, n = X.shape
    own, cross = np.zeros((count, d, d)), np.zeros((count, d, d))
    across, turned, before = np.zeros((d, n)), np.zeros((n, d)), np.zeros((d, d))
    for k in range(count - 1, -1, -1):
        D, G = links.D[k], links.G[k]
        transpose(D, turned)
        turned[0] = 0.0
        multiply(X, turned, cross[k])
        transpose(G, before)
        add_product(P, before, cross[k], 1.0)
        multiply(G, X, across)
        add_product(D, border, across, 1.0)
        write(across, X)
        write(links.S[k], P)
        add_product(X, turned, P, 1.0)
        add_product(G, cross[k], P, 1.0)
        _make_symmetric(P)
        write(P, own[k])
    return own, cross


@no_alloc
def _make_symmetric(P: Float[np.ndarray, "d d"]) -> None:
    """Make a matrix symmetric by averaging it with its transpose."""
    for a in range(P.shape[0]):
        for b in range(a):
            P[a, b] = P[b, a] = 0.5 * (P[a, b] + P[b, a])


@optimised_once
def spread_left(
    left: Left,
    column: Int[np.ndarray, " g"],
    covariances: tuple[
        Float[np.ndarray, "d d"], Float[np.ndarray, "d n"], Float[np.ndarray, "n n"]
    ],
) -> Float[np.ndarray, "g 2 2"]:
    """Add landmarks that left the separator to the covariances; return their 2 x 2 blocks."""
    P, X, border = covariances
    (d, n), own = X.shape, np.zeros((column.size, 2, 2))
    by_border, by_state = np.zeros((2, n)), np.zeros((2, d))
    for g in range(column.size - 1, -1, -1):
        i, D, G = column[g], left[0][g], left[1][g]
        border[i : i + 2], border[:, i : i + 2], X[:, i : i + 2] = 0.0, 0.0, 0.0
        multiply(D, border, by_border)
        add_product(G, X, by_border, 1.0)
        multiply(G, P, by_state)
        _add_by_slopes(D, X, by_state)
        write(left[2][g], own[g])
        _add_by_slopes(D, by_border, own[g])
        for e in range(2):
            add_image(by_state, G[e], own[g, e], 1.0)
        _make_symmetric(own[g])
        for e in range(2):
            for j in range(1, n):
                border[i + e, j] = border[j, i + e] = by_border[e, j]
            for a in range(d):
                X[a, i + e] = by_state[e, a]
        write(own[g], border[i : i + 2, i : i + 2])
    return own


@no_alloc
def _add_by_slopes(
    D: Float[np.ndarray, "e n"], X: Float[np.ndarray, "d n"], total: Float[np.ndarray, "e d"]
) -> None:
    """Add D X^T to ``total``, without the constant column."""
    for e in range(total.shape[0]):
        for a in range(total.shape[1]):
            for j in range(1, D.shape[1]):
                total[e, a] += D[e, j] * X[a, j]


@no_alloc
def factor(R: Float[np.ndarray, "n n"], n: Whole) -> None:
    """Factor an information matrix of n columns to R^T R in place; its first column becomes R b."""
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
    """Factor ``count`` rows from row i upwards, and subtract each from the others above it."""
    for p in range(i, i - count, -1):
        row, inverse = R[p], 1.0 / math.sqrt(R[p, p])
        for j in range(p + 1):
            row[j] *= inverse
        for r in range(i - count + 1, p):
            share, other = row[r], R[r]
            for j in range(r + 1):
                other[j] -= share * row[j]


@no_alloc
def minimise(R: Float[np.ndarray, "n n"], n: Whole, beta: Float[np.ndarray, " n"]) -> None:
    """Write the minimiser (1, b) of the cost, from the factor R."""
    beta[0] = 1.0
    for i in range(1, n):
        total = 0.0
        for j in range(i):
            total += R[i, j] * beta[j]
        beta[i] = -total / R[i, i]


@no_alloc
def rooted(R: Float[np.ndarray, "n n"], w: Float[np.ndarray, " n"], n: Whole) -> None:
    """Replace a separator derivative w by R^-T w; its squared norm is the variance of w b."""
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
    """Solve for the separator; return the last state relative to its point, and its covariance."""
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
    """Copy the lower triangle of an information matrix to R, with pivot 1 for unused columns."""
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
    """Write the covariance of a state: P given the separator, with derivatives C by it."""
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
    """Return the covariance of linear functions of the last state and the separator."""
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
    """Return the covariance of the separator from its factor, with 0 for the constant."""
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
