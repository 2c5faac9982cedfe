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
    add,
    add_product,
    cholesky,
    congruent,
    multiply,
    solve_with,
    transpose,
    write,
    write_identity,
)
from pipistrelle.estimation.smoother.solution import spread
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
    own, cross, small = np.zeros((nodes, d, d)), np.zeros((nodes, d, d)), np.zeros((6, d, d))
    A, slopes, following = np.zeros((d, n)), np.zeros((d, n)), np.zeros((d, n))
    N, link, given, Z = small[0], small[1], small[2], work.C
    for k in range(nodes - 1, -1, -1):
        _corrected(before[k], trail, k, slopes)
        add_product(trail.M[k], A, slopes, 1.0)
        multiply(trail.M[k], N, work.A)
        write(trail.M[k], given)
        add_product(work.A, trail.M[k], given, -1.0)
        spread(slopes, given, R, n, Z, own[k])
        if k + 1 < nodes:
            transpose(link, cross[k + 1])
            _add_products(following, Z, cross[k + 1])
        if k > 0:
            write(Z, following)
            transition(work, k, legs, places, at, noise)
            add(before[k], slopes, -1.0)
            _step_back(work, trail, k, small, slopes, A)
    return own, cross


@no_alloc
def _step_back(
    work: Work,
    trail: Trail,
    k: Whole,
    small: Float[np.ndarray, "6 d d"],
    off: Float[np.ndarray, "d n"],
    A: Float[np.ndarray, "d n"],
) -> None:
    """Write N and A of the node before k, and the covariance of both given the border.

    ``small``: N, that covariance, P_s, and arrays to work in; ``off``: C_s - C.
    """
    N, link, given, P, B, D = small[0], small[1], small[2], small[3], small[4], small[5]
    T, M = trail.T[k], trail.M[k]
    predicted(work, trail.M[k - 1], P)
    if is_far_surer(T, P):
        _know_after(work, P, given, N, off, A)
    else:
        write_identity(B)
        add_product(M, T, B, -1.0)
        multiply(T, B, D)
        transpose(B, work.B)
        congruent(work.B, N, work.A, D)
        write(D, N)
        add(trail.E[k], A, -1.0)
        add_product(T, off, A, -1.0)
    transpose(work.F, work.B)
    write_identity(B)
    add_product(N, P, B, -1.0)
    multiply(trail.M[k - 1], work.B, D)
    multiply(D, B, link)
    write(A, off)
    multiply(work.B, off, A)
    write(N, B)
    multiply(work.B, B, D)
    multiply(D, work.F, N)


@no_alloc
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


@no_alloc
def _know_after(
    work: Work,
    P: Float[np.ndarray, "d d"],
    given: Float[np.ndarray, "d d"],
    N: Float[np.ndarray, "d d"],
    off: Float[np.ndarray, "d n"],
    A: Float[np.ndarray, "d n"],
) -> None:
    """Write N and A from what a node's covariances are before, P, and given all.

    P^-1 (P - P_s) P^-1 and P^-1 (C_s - C): the same as by T and E, which are lost in rounding where
    a node's rows know its state far better than it was known.
    """
    cholesky(P, work.B)
    write(off, A)
    _solve_columns(work, A)
    write(P, N)
    add(given, N, -1.0)
    for _ in range(2):
        _solve_columns(work, N)
        transpose(N, work.A)
        write(work.A, N)


@no_alloc
def _solve_columns(work: Work, A: Float[np.ndarray, "d n"]) -> None:
    """Solve each column of A by the factor in B."""
    for j in range(A.shape[1]):
        for a in range(A.shape[0]):
            work.u[a] = A[a, j]
        solve_with(work.B, work.u)
        for a in range(A.shape[0]):
            A[a, j] = work.u[a]


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
