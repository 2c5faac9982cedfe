r"""Covariances of all states of the chain, from the factors that the elimination has left.

Given the border, the chain's states have covariances and slopes by the border that follow from the
end of the chain back to its start,

.. math:: P_k^s = M_k - M_k \tilde N_k M_k, \qquad C_k^s = C_k + M_k \tilde A_k ,

with :math:`\tilde N = F^T N F` what the nodes that follow know of this one, and
:math:`\tilde A = F^T A` how the border moves what they know (Bryson & Frazier's adjoint, as a
matrix):

.. math:: N_k = T - T M T + (I - T M) \tilde N_k (I - M T), \qquad
          A_k = \tilde A_k - E_k - T (C_k^s - \bar C_k) .

With :math:`\Sigma` the border's covariance, the whole is :math:`P_k^s + C_k^s \Sigma C_k^{sT}`.
"""

import numpy as np
from jaxtyping import Float

from pipistrelle.estimation.smoother.records import (
    Arrays,
    Legs,
    Noise,
    Places,
    Points,
    Trail,
    Work,
    work_of,
)
from pipistrelle.estimation.smoother.rows import is_far_surer
from pipistrelle.estimation.smoother.small_matrices import (
    add_product,
    cholesky,
    multiply,
    solve_with,
    write,
)
from pipistrelle.estimation.smoother.solution import rooted
from pipistrelle.estimation.smoother.transition import predicted, transition
from pipistrelle.jit import Whole, kernel, no_alloc


@kernel
def marginals(
    legs: Arrays,
    places: Arrays,
    points: Points,
    trail: Arrays,
    noise: tuple[float, ...],
    R: Float[np.ndarray, "n n"],
    nodes: Whole,
) -> tuple[Float[np.ndarray, "k d d"], Float[np.ndarray, "k d d"]]:
    """Return the covariance of each node's state, and that with the one before (node, before)."""
    legs, places, trail, noise = Legs(*legs), Places(*places), Trail(*trail), Noise(*noise)
    at, n, d = points[0], R.shape[0], trail.T.shape[1]
    work, before = work_of(d, n), np.zeros((nodes, d, n))
    _go_forward(work, legs, places, at, noise, trail, before)
    own, cross = np.zeros((nodes, d, d)), np.zeros((nodes, d, d))
    A, N, P, link = np.zeros((d, n)), np.zeros((d, d)), np.zeros((d, d)), np.zeros((d, d))
    slopes, following = np.zeros((d, n)), np.zeros((d, n))
    for k in range(nodes - 1, -1, -1):
        M, Z = trail.M[k], work.C
        _corrected(before[k], trail, k, slopes)
        add_product(M, A, slopes, 1.0)
        given = M - _of(_of(M, N), M)
        write(slopes, Z)
        for a in range(d):
            rooted(R, Z[a], n)
        _add_products(Z, Z, own[k])
        own[k] += given
        if k + 1 < nodes:
            _add_products(following, Z, cross[k + 1])
            cross[k + 1] += link.T
        if k == 0:
            break
        write(Z, following)
        transition(work, k, legs, places, at, noise)
        predicted(work, trail.M[k - 1], P)
        slopes -= before[k]
        if is_far_surer(trail.T[k], P):
            N = _known_after(P, given, slopes, A)
        else:
            left = np.eye(d) - _of(M, trail.T[k])
            N = _of(trail.T[k], left) + _of(_of(left.T.copy(), N), left)
            add_product(np.eye(d), trail.E[k], A, -1.0)
            add_product(trail.T[k], slopes, A, -1.0)
        turned = work.F.T.copy()
        link = _of(_of(trail.M[k - 1], turned), np.eye(d) - _of(N, P))
        write(A, slopes)
        multiply(turned, slopes, A)
        N = _of(_of(turned, N), work.F)
    return own, cross


@kernel
def _go_forward(
    work: Work,
    legs: Legs,
    places: Places,
    at: Float[np.ndarray, "k d"],
    noise: Noise,
    trail: Trail,
    before: Float[np.ndarray, "k d n"],
) -> None:
    """Write the slopes of each node's state by the border, before its rows are heard."""
    for k in range(1, before.shape[0]):
        transition(work, k, legs, places, at, noise)
        _corrected(before[k - 1], trail, k - 1, work.C)
        multiply(work.F, work.C, before[k])


@kernel
def _known_after(
    P: Float[np.ndarray, "d d"],
    given: Float[np.ndarray, "d d"],
    off: Float[np.ndarray, "d n"],
    A: Float[np.ndarray, "d n"],
) -> Float[np.ndarray, "d d"]:
    """Return N from what a node's covariances are before, P, and given all; write A likewise.

    P^-1 (P - P_s) P^-1 and P^-1 (C_s - C): the same as by T and E, which are lost in rounding where
    a node's rows know its state far better than it was known.
    """
    d, N = P.shape[0], P - given
    L, x = np.zeros((d, d)), np.empty(d)
    cholesky(P, L)
    for j in range(off.shape[1]):
        x[:] = off[:, j]
        solve_with(L, x)
        A[:, j] = x
    for _ in range(2):
        for j in range(d):
            x[:] = N[:, j]
            solve_with(L, x)
            N[:, j] = x
        N = N.T.copy()
    return N


@no_alloc
def _add_products(
    Z: Float[np.ndarray, "d n"], Y: Float[np.ndarray, "d n"], total: Float[np.ndarray, "d d"]
) -> None:
    """Add Z Y^T, without the first column."""
    for a in range(Z.shape[0]):
        for b in range(Y.shape[0]):
            for j in range(1, Z.shape[1]):
                total[a, b] += Z[a, j] * Y[b, j]


@no_alloc
def _corrected(
    before: Float[np.ndarray, "d n"], trail: Trail, k: Whole, C: Float[np.ndarray, "d n"]
) -> None:
    """Write C - M E of node k."""
    write(before, C)
    add_product(trail.M[k], trail.E[k], C, -1.0)


@kernel
def _of(A: Float[np.ndarray, "d d"], B: Float[np.ndarray, "d d"]) -> Float[np.ndarray, "d d"]:
    """Return A B."""
    product = np.empty(A.shape)
    multiply(A, B, product)
    return product
