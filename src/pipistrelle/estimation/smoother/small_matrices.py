"""Products and factors of small matrices by loops, whose order of additions is always the same."""

import math

import numpy as np
from jaxtyping import Float

from pipistrelle.jit import no_alloc


@no_alloc
def write(A: Float[np.ndarray, "d n"], B: Float[np.ndarray, "d n"]) -> None:
    """Write A to B."""
    for a in range(B.shape[0]):
        for j in range(B.shape[1]):
            B[a, j] = A[a, j]


@no_alloc
def add(A: Float[np.ndarray, "d n"], B: Float[np.ndarray, "d n"], sign: float) -> None:
    """Add A, times a sign, to B, as many columns as both have."""
    for a in range(B.shape[0]):
        for j in range(min(A.shape[1], B.shape[1])):
            B[a, j] += sign * A[a, j]


@no_alloc
def transpose(A: Float[np.ndarray, "d e"], B: Float[np.ndarray, "e d"]) -> None:
    """Write the transposed of A to B."""
    for a in range(A.shape[0]):
        for b in range(A.shape[1]):
            B[b, a] = A[a, b]


@no_alloc
def write_identity(A: Float[np.ndarray, "d d"]) -> None:
    """Write the identity."""
    for a in range(A.shape[0]):
        for b in range(A.shape[0]):
            A[a, b] = 1.0 if a == b else 0.0


@no_alloc
def write_image(
    A: Float[np.ndarray, "d e"], x: Float[np.ndarray, " e"], image: Float[np.ndarray, " d"]
) -> None:
    """Write A x."""
    for a in range(image.size):
        image[a] = 0.0
    add_image(A, x, image, 1.0)


@no_alloc
def multiply(
    A: Float[np.ndarray, "d e"], B: Float[np.ndarray, "e n"], product: Float[np.ndarray, "d n"]
) -> None:
    """Write A B."""
    product[:] = 0.0
    add_product(A, B, product, 1.0)


@no_alloc
def add_product(
    A: Float[np.ndarray, "d e"],
    B: Float[np.ndarray, "e n"],
    total: Float[np.ndarray, "d n"],
    sign: float,
) -> None:
    """Add A B, times a sign, to what stands there, as many columns as both have.

    Three rows of B, those of a pose, are read at once.
    """
    columns = min(B.shape[1], total.shape[1])
    for a in range(A.shape[0]):
        first = 0
        row = total[a]
        if A.shape[1] >= 3:
            x, y, z, first = sign * A[a, 0], sign * A[a, 1], sign * A[a, 2], 3
            B0, B1, B2 = B[0], B[1], B[2]
            for j in range(columns):
                row[j] = ((row[j] + x * B0[j]) + y * B1[j]) + z * B2[j]
        for e in range(first, A.shape[1]):
            share = sign * A[a, e]
            if share != 0.0:
                for j in range(columns):
                    row[j] += share * B[e, j]


@no_alloc
def add_multiple(x: Float[np.ndarray, " n"], share: float, total: Float[np.ndarray, " n"]) -> None:
    """Add a share of x to what stands there, as far as that goes."""
    for j in range(total.size):
        total[j] += share * x[j]


@no_alloc
def add_image(
    A: Float[np.ndarray, "d e"],
    x: Float[np.ndarray, " e"],
    total: Float[np.ndarray, " d"],
    sign: float,
) -> None:
    """Add A x, times a sign, to what stands there."""
    for a in range(total.size):
        for e in range(x.size):
            total[a] += sign * A[a, e] * x[e]


@no_alloc
def congruent(
    F: Float[np.ndarray, "d d"],
    M: Float[np.ndarray, "d d"],
    A: Float[np.ndarray, "d d"],
    P: Float[np.ndarray, "d d"],
) -> None:
    """Add F M F^T to P; in A is F M."""
    multiply(F, M, A)
    for a in range(P.shape[0]):
        for b in range(a + 1):
            total = P[a, b]
            for e in range(P.shape[0]):
                total += A[a, e] * F[b, e]
            P[a, b] = P[b, a] = total


@no_alloc
def cholesky(A: Float[np.ndarray, "d d"], L: Float[np.ndarray, "d d"]) -> None:
    """Write the lower factor of a positive semidefinite matrix; a pivot that is not above 0 is 0.

    All of L that is above its diagonal is left as it is.
    """
    for j in range(A.shape[0]):
        pivot = A[j, j]
        for e in range(j):
            pivot -= L[j, e] * L[j, e]
        L[j, j] = math.sqrt(pivot) if pivot > 0.0 else 0.0
        for i in range(j + 1, A.shape[0]):
            total = A[i, j]
            for e in range(j):
                total -= L[i, e] * L[j, e]
            L[i, j] = total / L[j, j] if pivot > 0.0 else 0.0


@no_alloc
def solve_with(L: Float[np.ndarray, "d d"], x: Float[np.ndarray, " d"]) -> None:
    """Replace x by (L L^T)^-1 x; by 0 along what a pivot of 0 does not know (`cholesky`)."""
    d = x.size
    for a in range(d):
        for b in range(a):
            x[a] -= L[a, b] * x[b]
        x[a] = x[a] / L[a, a] if L[a, a] > 0.0 else 0.0
    for a in range(d - 1, -1, -1):
        for b in range(a + 1, d):
            x[a] -= L[b, a] * x[b]
        x[a] = x[a] / L[a, a] if L[a, a] > 0.0 else 0.0


@no_alloc
def posterior(
    P: Float[np.ndarray, "d d"],
    T: Float[np.ndarray, "d d"],
    work: tuple[
        Float[np.ndarray, "d d"],
        Float[np.ndarray, "d d"],
        Float[np.ndarray, "d d"],
    ],
    M: Float[np.ndarray, "d d"],
) -> None:
    """Write (P^-1 + T)^-1 as L (I + L^T T L)^-1 L^T, with P = L L^T: P may be singular."""
    (L, A, B), d = work, P.shape[0]
    L[:] = 0.0
    cholesky(P, L)
    multiply(T, L, A)
    B[:] = 0.0
    for a in range(d):
        B[a, a] = 1.0
        for e in range(d):
            for b in range(d):
                B[a, b] += L[e, a] * A[e, b]
    cholesky(B, A)
    for a in range(d):  # B = A^-1 L^T
        for b in range(d):
            total = L[b, a]
            for e in range(a):
                total -= A[a, e] * B[e, b]
            B[a, b] = total / A[a, a]
    for a in range(d):
        for b in range(a + 1):
            total = 0.0
            for e in range(d):
                total += B[e, a] * B[e, b]
            M[a, b] = M[b, a] = total
