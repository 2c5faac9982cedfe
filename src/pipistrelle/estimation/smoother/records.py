"""Records of arrays that the smoother's kernels take, and where each number stands.

Arrays that grow: what a drive has heard is kept once, and shared by all beliefs about it.

A belief is never changed, and each frame makes a new one. Were its history copied, a mission would
cost the square of its length. A `Stack` is the first so many entries of arrays that have room for
more. What one belief adds stands behind the entries of all earlier ones, in the same arrays, unless
another belief has written there before: then it gets copies.

Products and factors of small matrices by loops, whose order of additions is always the same.
"""

import math
from dataclasses import dataclass, field
from typing import NamedTuple, Self

import numpy as np
from jaxtyping import Bool, Float, Int

from pipistrelle.jit import Whole, kernel, no_alloc

ROOM = 64
"""How many entries a first array holds."""


@dataclass(frozen=True, slots=True)
class Stack:
    """The first entries of arrays that grow together along their first axes.

    >>> stack = Stack((np.zeros((4, 2)),))
    >>> one, other = stack.extended(1), stack.extended(1)
    >>> one.arrays[0][0], other.arrays[0][0] = 1.0, 2.0
    >>> one.arrays[0][0], one.size
    (array([1., 1.]), 1)
    """

    arrays: tuple[np.ndarray, ...]
    size: int = 0
    written: list[int] = field(default_factory=lambda: [0])
    """How many entries of the arrays some stack has; stacks of the same arrays share it."""

    def extended(self, count: int) -> Self:
        """Return a stack with so many entries more, which are yet to be written."""
        arrays, written, size = self.arrays, self.written, self.size + count
        if written[0] != self.size or size > len(arrays[0]):
            room = max(ROOM, len(arrays[0]), 2 * size if size > len(arrays[0]) else 0)
            arrays = tuple(_copied(array, self.size, room) for array in arrays)
            written = [0]
        written[0] = size
        return type(self)(arrays, size, written)

    def entries(self, number: int) -> np.ndarray:
        """Return the entries of an array."""
        return self.arrays[number][: self.size]


def _copied(array: np.ndarray, size: int, room: int) -> np.ndarray:
    """Return the first entries of an array, in one with more room."""
    copied = np.zeros((room, *array.shape[1:]), array.dtype)
    copied[:size] = array[:size]
    return copied


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


POSE = 3
"""Numbers of the chain's state that are the pose."""
CALLER = 4
"""Numbers of each moving caller: its place and its velocity."""


class Front(NamedTuple):
    """The last state of the chain, given the border, and the evidence about the border."""

    C: Float[np.ndarray, "d n"]
    P: Float[np.ndarray, "d d"]
    information: Float[np.ndarray, "n n"]  # lower triangle


class Legs(NamedTuple):
    """How the vehicle came to each node of the chain; the first is the start."""

    mean: Float[np.ndarray, "k 3"]  # motion since the node before, in its axes
    noise: Float[np.ndarray, "k 3 3"]
    seconds: Float[np.ndarray, " k"]
    rows: Int[np.ndarray, "k 2"]  # what was heard from it: first row, and the one after the last
    slopes: Float[np.ndarray, "k 3 q"]
    """Of the motion, by the parameters of odometry, which stand first in the border."""
    scale: Int[np.ndarray, "1"]
    """Column of the speed's scale where nothing else tells how large the world is, or 0."""


class Rows(NamedTuple):
    """Measurements in the order of their nodes."""

    ends: Int[np.ndarray, "m 4"]
    """Slots of the landmark, and of the excess path's caller or -1; the node; the row of the
    landmark's bearing before, or -1."""
    numbers: Float[np.ndarray, "m 8"]  # as those of a scan


class Places(NamedTuple):
    """Where each slot, a landmark or a caller, stands among the unknowns, and the parameters."""

    index: Int[np.ndarray, " s"]  # column of the border; minus the index in the chain; 0: nowhere
    first: Int[np.ndarray, " v"]  # node at which each moving caller joins the chain
    begun: Float[np.ndarray, "v 2"]  # where it was placed then
    sensor: Int[np.ndarray, "4"]
    """Columns of the speed of sound, of the sensor's heading, of its place and of how late its
    clock is; 0: not estimated."""
    way: Float[np.ndarray, "k 3"]  # as `Legs.mean`
    seconds: Float[np.ndarray, " k"]


class NoiseModel(NamedTuple):
    """Assumptions about measurements and moving callers."""

    believed: float  # Huber's bound in standard deviations, or infinity
    place_std: float  # of a moving caller when it joins the chain [m]
    speed_std: float  # of its velocity then, along an axis [m/s]
    walk_std: float  # of its velocity after 1 s [m/s]
    damping: float = 0.0  # information that holds every unknown at its point (Levenberg)


class Links(NamedTuple):
    """What elimination leaves of each node's predecessor: D beta + G x, with the covariance S."""

    D: Float[np.ndarray, "k d n"]
    G: Float[np.ndarray, "k d d"]
    S: Float[np.ndarray, "k d d"]


class Work(NamedTuple):
    """Arrays to work in."""

    F: Float[np.ndarray, "d d"]
    u: Float[np.ndarray, " d"]
    Q: Float[np.ndarray, "d d"]
    by: Float[np.ndarray, "d q"]  # slopes of a transition by the parameters of odometry
    T: Float[np.ndarray, "d d"]
    G: Float[np.ndarray, "d n"]
    C: Float[np.ndarray, "d n"]
    E: Float[np.ndarray, "d n"]
    M: Float[np.ndarray, "d d"]
    A: Float[np.ndarray, "d d"]
    B: Float[np.ndarray, "d d"]
    at: Int[np.ndarray, " e"]  # entries of one row: where they stand in the chain, then the border
    slope: Float[np.ndarray, " e"]
    alone: Bool[np.ndarray, "1"]  # whether each row corrects alone
    w: Float[np.ndarray, " n"]


Arrays = tuple[np.ndarray, ...]
"""A record as kernels are handed it: a plain tuple costs nothing at their door."""
PointArrays = tuple[Float[np.ndarray, "k d"], Float[np.ndarray, " n"]]
"""Points of linearisation: states of the chain, and the border (the first number is not used)."""


@kernel
def work_of(d: Whole, n: Whole, q: Whole) -> Work:
    """Return arrays to work in: a state of d numbers, a border of n, q parameters of odometry."""
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
