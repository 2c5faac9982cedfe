r"""Back along the chain: means and covariances of all states and places.

Elimination left each state, and each place that has left the border, as a linear function of the
state after it and the border (`elimination.Links`, `elimination.leave`), with D, G and S:

.. math:: x_k = D \beta + G x_{k+1} + s, \qquad s \sim N(0, S) .

The last state and the border are solved first (`solution`). With :math:`\Sigma` the covariance of
the border, X that of a state with it and P its own, a node further back

.. math:: X_k = D \Sigma + G X_{k+1}, \quad \operatorname{Cov}(x_{k+1}, x_k) = X_{k+1} D^T +
          P_{k+1} G^T, \quad P_k = S + X_k D^T + G \operatorname{Cov}(x_{k+1}, x_k) .

Nothing is subtracted, and places that entered later are dropped by leaving out their columns.
Source: Rauch, Tung & Striebel, AIAA Journal 3, 1965, with a border.
"""

import numpy as np
from jaxtyping import Float, Int

from pipistrelle.estimation.smoother.records import Arrays, Links
from pipistrelle.estimation.smoother.small_matrices import (
    add_image,
    add_product,
    multiply,
    transpose,
    write,
    write_image,
)
from pipistrelle.jit import Whole, no_alloc, optimised_once

Left = tuple[Float[np.ndarray, "g 2 n"], Float[np.ndarray, "g 2 d"], Float[np.ndarray, "g 2 2"]]
"""D, G and S of places that have left the border."""


@optimised_once
def trace_back(
    links: Arrays,
    beta: Float[np.ndarray, " n"],
    last: Float[np.ndarray, " d"],
    count: Whole,
) -> Float[np.ndarray, "k d"]:
    """Return the states before the last so many links, the first of them first, and the last."""
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
    """Write where places that left are, as differences from their points, into ``beta``."""
    place = np.empty(2)
    for g in range(column.size - 1, -1, -1):
        beta[column[g]] = beta[column[g] + 1] = 0.0
        write_image(left[0][g], beta, place)
        add_image(left[1][g], state, place, 1.0)
        beta[column[g]], beta[column[g] + 1] = place[0], place[1]


@optimised_once
def spread_with_border(
    C: Float[np.ndarray, "d n"], border: Float[np.ndarray, "n n"]
) -> Float[np.ndarray, "d n"]:
    """Return the covariance of a state, of slopes C by the border, with the border of its own."""
    X = np.zeros(C.shape)
    multiply(C, border, X)
    return X


@optimised_once
def spread_back(
    links: Arrays,
    covariances: tuple[
        Float[np.ndarray, "d d"], Float[np.ndarray, "d n"], Float[np.ndarray, "n n"]
    ],
    count: Whole,
) -> tuple[Float[np.ndarray, "k d d"], Float[np.ndarray, "k d d"]]:
    """Return the covariances of the states before the last so many links, and with those after.

    ``covariances``: P of the last, X of it with the border, and that of the border; P and X become
    those of the first.
    """
    links, (P, X, border) = Links(*links), covariances
    d, n = X.shape
    own, cross = np.zeros((count, d, d)), np.zeros((count, d, d))
    across, turned, before = np.zeros((d, n)), np.zeros((n, d)), np.zeros((d, d))
    for k in range(count - 1, -1, -1):
        D, G = links.D[k], links.G[k]
        _transpose_slopes(D, turned)
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
def _transpose_slopes(D: Float[np.ndarray, "d n"], turned: Float[np.ndarray, "n d"]) -> None:
    """Write the transposed of D without its first column, that of the constant."""
    for a in range(D.shape[0]):
        turned[0, a] = 0.0
        for j in range(1, D.shape[1]):
            turned[j, a] = D[a, j]


@no_alloc
def _make_symmetric(P: Float[np.ndarray, "d d"]) -> None:
    """Replace a matrix by its mean with its transposed."""
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
    """Add places that left to the covariances (`spread_back`); return their own."""
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
    """Add D X^T, without the first column."""
    for e in range(total.shape[0]):
        for a in range(total.shape[1]):
            for j in range(1, D.shape[1]):
                total[e, a] += D[e, j] * X[a, j]
