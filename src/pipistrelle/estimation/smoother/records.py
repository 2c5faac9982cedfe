"""Array records, shared stacks and small-matrix routines of the smoother's kernels.

The *separator* (`border`) holds the landmarks and parameters that all poses share. The matrix
routines are loops with a fixed order of additions, so that results are reproducible.
"""

from dataclasses import dataclass, field
from typing import Any, NamedTuple, Self

import numpy as np
from jaxtyping import Bool, Float, Int

from pipistrelle.estimation.observations.range import cholesky
from pipistrelle.jit import Whole, kernel, no_alloc

ROOM = 64
"""Initial capacity of a stack."""


@dataclass(frozen=True, slots=True)
class Stack:
    """Append-only arrays that grow along their first axis and share memory between beliefs.

    Copying the history of each immutable belief would cost the square of a mission's length. A
    stack is a prefix of arrays with spare capacity: extending it shares them, or copies them if
    another stack has already written behind the prefix.

    >>> stack = Stack((np.zeros((4, 2)),))
    >>> one, other = stack.extended(1), stack.extended(1)
    >>> one.arrays[0][0], other.arrays[0][0] = 1.0, 2.0
    >>> one.arrays[0][0], one.size
    (array([1., 1.]), 1)
    """

    arrays: tuple[np.ndarray, ...]
    size: int = 0
    written: list[int] = field(default_factory=lambda: [0])
    """Number of entries written by any stack of these arrays, shared between them."""

    def extended(self, count: int) -> Self:
        """Return the arrays with ``count`` further entries, which are still unwritten."""
        arrays, written, size = self.arrays, self.written, self.size + count
        if written[0] != self.size or size > len(arrays[0]):
            room = max(ROOM, len(arrays[0]), 2 * size if size > len(arrays[0]) else 0)
            spare = (np.zeros((room - self.size, *a.shape[1:]), a.dtype) for a in arrays)
            arrays = tuple(
                np.concatenate((a[: self.size], b)) for a, b in zip(arrays, spare, strict=True)
            )
            written = [0]
        written[0] = size
        return type(self)(arrays, size, written)

    def entries(self, number: int) -> np.ndarray:
        """Return the used entries of the array at index ``number``, without spare capacity."""
        return self.arrays[number][: self.size]


@no_alloc
def write(A: Float[np.ndarray, "d n"], B: Float[np.ndarray, "d n"]) -> None:
    """Copy the entries of matrix A to matrix B."""
    for a in range(B.shape[0]):
        for j in range(B.shape[1]):
            B[a, j] = A[a, j]


@no_alloc
def add(A: Float[np.ndarray, "d n"], B: Float[np.ndarray, "d n"], sign: float) -> None:
    """Add ``sign`` times matrix A to matrix B, in place, over their common columns."""
    for a in range(B.shape[0]):
        for j in range(min(A.shape[1], B.shape[1])):
            B[a, j] += sign * A[a, j]


@no_alloc
def transpose(A: Float[np.ndarray, "d e"], B: Float[np.ndarray, "e d"]) -> None:
    """Write the transpose of matrix A to matrix B."""
    for a in range(A.shape[0]):
        for b in range(A.shape[1]):
            B[b, a] = A[a, b]


@no_alloc
def write_identity(A: Float[np.ndarray, "d d"]) -> None:
    """Set a square matrix to the identity matrix, in place."""
    for a in range(A.shape[0]):
        for b in range(A.shape[0]):
            A[a, b] = 1.0 if a == b else 0.0


@no_alloc
def write_image(
    A: Float[np.ndarray, "d e"], x: Float[np.ndarray, " e"], image: Float[np.ndarray, " d"]
) -> None:
    """Write the product A x of a matrix and a vector to ``image``."""
    for a in range(image.size):
        image[a] = 0.0
    add_image(A, x, image, 1.0)


@no_alloc
def multiply(
    A: Float[np.ndarray, "d e"], B: Float[np.ndarray, "e n"], product: Float[np.ndarray, "d n"]
) -> None:
    """Write the matrix product A B to ``product``."""
    product[:] = 0.0
    add_product(A, B, product, 1.0)


@no_alloc
def add_product(
    A: Float[np.ndarray, "d e"],
    B: Float[np.ndarray, "e n"],
    total: Float[np.ndarray, "d n"],
    sign: float,
) -> None:
    """Add ``sign`` times the matrix product A B to ``total`` in place, over common columns."""
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
    """Add ``share`` times the vector x to the vector ``total``, in place."""
    for j in range(total.size):
        total[j] += share * x[j]


@no_alloc
def add_image(
    A: Float[np.ndarray, "d e"],
    x: Float[np.ndarray, " e"],
    total: Float[np.ndarray, " d"],
    sign: float,
) -> None:
    """Add ``sign`` times the product A x of a matrix and a vector to ``total``, in place."""
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
    """Add the matrix product F M F^T to P in place, and write F M to A."""
    multiply(F, M, A)
    for a in range(P.shape[0]):
        for b in range(a + 1):
            total = P[a, b]
            for e in range(P.shape[0]):
                total += A[a, e] * F[b, e]
            P[a, b] = P[b, a] = total


@no_alloc
def solve_with(L: Float[np.ndarray, "d d"], x: Float[np.ndarray, " d"]) -> None:
    """Solve L L^T y = x for y and write it to x; entries with a zero pivot of L become 0."""
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
    work: tuple[Float[np.ndarray, "d d"], Float[np.ndarray, "d d"], Float[np.ndarray, "d d"]],
    M: Float[np.ndarray, "d d"],
) -> None:
    """Write the posterior covariance (P^-1 + T)^-1 of prior covariance P and information T to M."""
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


Span = tuple[Whole, Whole, Whole]
"""A node, its first measurement and the end of its range."""
ChainState = Float[np.ndarray, " d"]
"""A state of the chain: pose, then position and velocity of each moving caller."""
Square = Float[np.ndarray, "d d"]
"""A matrix by two states of the chain."""
Border = Float[np.ndarray, " n"]
"""The separator; its first number is unused, or 1."""
Factor = Float[np.ndarray, "n n"]
"""Information of the separator or its factor, a lower triangle."""
Slopes = Float[np.ndarray, "d n"]
"""Derivatives of a state of the chain by the separator."""
POSE = 3
"""Size of the pose in a state of the chain."""
CALLER = 4
"""Size of each moving caller in a state of the chain: position and velocity."""


class Front(NamedTuple):
    """Gaussian of the newest state given the landmarks, and the landmarks' information matrix."""

    C: Float[np.ndarray, "d n"]
    P: Float[np.ndarray, "d d"]
    information: Float[np.ndarray, "n n"]  # lower triangle


class Legs(NamedTuple):
    """Motion from each scan to the next, with covariance and derivatives; entry 0 is the start."""

    mean: Float[np.ndarray, "k 3"]  # motion since the node before, in its axes
    noise: Float[np.ndarray, "k 3 3"]
    seconds: Float[np.ndarray, " k"]
    rows: Int[np.ndarray, "k 2"]  # first measurement of the node, and the end of its range
    slopes: Float[np.ndarray, "k 3 q"]
    """Jacobian of the motion by the odometry parameters, which come first in the separator."""
    scale: Whole
    """Separator column of the speed scale if nothing else fixes the size of the world, else 0."""


class Rows(NamedTuple):
    """All measurements of a mission as arrays, sorted by scan."""

    ends: Int[np.ndarray, "m 4"]
    """Slots of landmark and caller (-1: no excess path), node, and row of the landmark's previous
    bearing or range, or -1."""
    numbers: Float[np.ndarray, "m 8"]  # columns of a scan


class Places(NamedTuple):
    """Index of the unknowns of landmarks and callers, and data on moving callers and sensor."""

    index: Int[np.ndarray, " s"]  # separator column; minus the index in the chain; 0: no variable
    first: Int[np.ndarray, " v"]  # node at which each moving caller joins the chain
    begun: Float[np.ndarray, "v 2"]  # initial position of each moving caller [m]
    sensor: Int[np.ndarray, "6"]
    """Columns of the parameters in `preintegration.OF_SENSOR`; 0: known."""
    way: Float[np.ndarray, "k 3"]  # as `Legs.mean`
    seconds: Float[np.ndarray, " k"]


class NoiseModel(NamedTuple):
    """The smoother's robust loss, priors and noise of moving callers, and damping."""

    loss: Whole  # code of the robust loss (`rows.robust_loss`)
    place_std: float  # std of a moving caller's initial position [m]
    speed_std: float  # std of a moving caller's initial velocity along each axis [m/s]
    walk_std: float  # std of a moving caller's velocity change after 1 s [m/s]
    damping: float = 0.0  # Levenberg damping: added information of every unknown


class Links(NamedTuple):
    """Gaussian of each scan's state given the next state and the landmarks."""

    D: Float[np.ndarray, "k d n"]
    G: Float[np.ndarray, "k d d"]
    S: Float[np.ndarray, "k d d"]


class Work(NamedTuple):
    """Temporary matrices and vectors of the smoother's elimination."""

    F: Float[np.ndarray, "d d"]
    u: Float[np.ndarray, " d"]
    Q: Float[np.ndarray, "d d"]
    by: Float[np.ndarray, "d q"]  # Jacobian of a transition by the odometry parameters
    T: Float[np.ndarray, "d d"]
    G: Float[np.ndarray, "d n"]
    C: Float[np.ndarray, "d n"]
    E: Float[np.ndarray, "d n"]
    M: Float[np.ndarray, "d d"]
    A: Float[np.ndarray, "d d"]
    B: Float[np.ndarray, "d d"]
    at: Int[np.ndarray, " e"]  # unknowns of a Jacobian row: chain entries, then separator columns
    slope: Float[np.ndarray, " e"]
    alone: Bool[np.ndarray, "1"]  # whether measurements update the frontal state individually
    w: Float[np.ndarray, " n"]


Arrays = tuple[np.ndarray, ...]
"""A record as a plain tuple, which kernels take without overhead."""
PlainLegs = tuple[Any, ...]
"""`Legs` as a plain tuple."""
PointArrays = tuple[Float[np.ndarray, "k d"], Float[np.ndarray, " n"]]
"""Linearisation points: states of the chain, and the separator (its first number is unused)."""


@kernel
def work_of(d: Whole, n: Whole, q: Whole) -> Work:
    """Allocate a workspace for states of size d, n shared unknowns and q odometry parameters."""
    return Work(
        np.zeros((d, d)),
        np.zeros(d),
        np.zeros((d, d)),
        np.zeros((d, q)),
        np.zeros((d, d)),
        np.zeros((d, n)),
        np.zeros((d, n)),
        np.zeros((d, n)),
        np.zeros((d, d)),
        np.zeros((d, d)),
        np.zeros((d, d)),
        np.zeros(24, np.int64),
        np.zeros(24),
        np.zeros(1, np.bool_),
        np.zeros(n),
    )
