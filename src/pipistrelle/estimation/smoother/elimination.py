r"""The arrow: poses eliminated along their chain, with landmarks as a border.

The normal equations of a drive have the shape of an arrow. Poses form a chain, each linked to the
next by odometry; landmarks and resting callers border it. Given the border b, the chain is a linear
Gaussian process, so a Kalman filter runs along it whose mean is affine in b: with all unknowns as
differences from the points of linearisation and :math:`\beta = (1, b)`,

.. math:: x_k \mid b \sim N(C_k \beta,\, P_k), \qquad
          C_k \leftarrow F C_k + u, \quad P_k \leftarrow F P_k F^T + Q .

What a frame measures, :math:`r = H x + G \beta` in standard deviations, corrects both and leaves
its evidence about the border behind (:math:`T = H^T H`, :math:`E = T C + H^T G`):

.. math:: M = (P^{-1} + T)^{-1}, \quad C \leftarrow C - M E, \quad
          \Lambda \leftarrow \Lambda + G^T G + G^T H C + (C - M E)^T E .

:math:`\tfrac12 \beta^T \Lambda \beta` is the least that poses so far cost, as a function of the
border: exact elimination, in 3 x 3 blocks and rank-3 updates of one small matrix. Neither Q nor the
prior is inverted, so both may be singular. `solution` solves for the border.

A moving caller joins the chain: place and velocity follow the pose in its state.
"""

import numpy as np
from jaxtyping import Float

from pipistrelle.estimation.smoother.records import (
    POSE,
    Arrays,
    Columns,
    Front,
    Legs,
    Noise,
    Places,
    Points,
    Rows,
    Trail,
    Work,
    work_of,
)
from pipistrelle.estimation.smoother.rows import hear
from pipistrelle.estimation.smoother.small_matrices import (
    add_product,
    multiply,
    posterior,
    write,
)
from pipistrelle.estimation.smoother.transition import predicted, transition, write_start
from pipistrelle.jit import Whole, kernel, no_alloc


@kernel
def eliminate(
    front: Arrays,
    legs: Arrays,
    rows: Arrays,
    places: Arrays,
    points: Points,
    trail: Arrays,
    noise: tuple[float, ...],
    span: tuple[Whole, Whole, Whole],
) -> float:
    """Carry a front on along the chain, in place; return twice what nodes and steps cost.

    ``span``: the node at which nothing is heard yet, the one after the last, and the columns. The
    front stands at the first node.
    """
    front, legs, rows, places = Front(*front), Legs(*legs), Rows(*rows), Places(*places)
    trail, noise, (first, last, n), cost = Trail(*trail), Noise(*noise), span, 0.0
    work = work_of(front.C.shape[0], n)
    for k in range(first, last):
        if k > first:
            cost += transition(work, k, legs, places, points[0], noise)
            advance(front, work, n)
        heard = k, legs.rows[k, 0], legs.rows[k, 1]
        cost += hear(work, front, heard, rows, places, points, noise)
        correct(front, work, trail, k, n)
    return cost


@kernel
def begin(
    front: Arrays,
    legs: Arrays,
    columns: Arrays,
    points: Points,
    damping: float,
) -> float:
    """Begin a front at the start, with what is known of the border; return twice its cost."""
    legs, columns = Legs(*legs), Columns(*columns)
    at, border = points
    front[0][:], front[1][:], front[2][:] = 0.0, 0.0, 0.0
    work = work_of(POSE, 1)
    cost = write_start(work, legs, at)
    for a in range(POSE):
        front[0][a, 0] = work.u[a]
        for b in range(POSE):
            front[1][a, b] = work.Q[a, b]
    for i in range(columns.mean.shape[0]):
        n = 1 + 2 * i
        cost += add_prior(front[2], n, columns.mean[i], columns.information[i], border)
        front[2][n, n] += damping
        front[2][n + 1, n + 1] += damping
    return cost


@no_alloc
def add_prior(
    information: Float[np.ndarray, "n n"],
    i: Whole,
    mean: Float[np.ndarray, "2"],
    known: Float[np.ndarray, "3"],
    border: Float[np.ndarray, " n"],
) -> float:
    """Add what is known of a place of the border: xx, xy, yy; return twice what it costs."""
    x, y = border[i] - mean[0], border[i + 1] - mean[1]
    by_x, by_y = known[0] * x + known[1] * y, known[1] * x + known[2] * y
    information[i, i] += known[0]
    information[i + 1, i] += known[1]
    information[i + 1, i + 1] += known[2]
    information[i, 0] += by_x
    information[i + 1, 0] += by_y
    information[0, 0] += x * by_x + y * by_y
    return x * by_x + y * by_y


@kernel
def step_to(
    front: Arrays,
    legs: Arrays,
    places: Arrays,
    at: Float[np.ndarray, "k d"],
    noise: tuple[float, ...],
    span: tuple[Whole, Whole],
) -> float:
    """Carry a front to a node, before anything is heard there; return twice what the step costs.

    ``span``: the node, the columns.
    """
    front, (k, n) = Front(*front), span
    work = work_of(front.C.shape[0], n)
    cost = transition(work, k, Legs(*legs), Places(*places), at, Noise(*noise))
    advance(front, work, n)
    return cost


@no_alloc
def advance(front: Front, work: Work, n: Whole) -> None:
    """Carry the front through a transition, in place."""
    multiply(work.F, front.C, work.C)
    for a in range(work.u.size):
        for j in range(n):
            front.C[a, j] = work.C[a, j]
        front.C[a, 0] += work.u[a]
    predicted(work, front.P, work.B)
    write(work.B, front.P)


@no_alloc
def correct(front: Front, work: Work, trail: Trail, k: Whole, n: Whole) -> None:
    """Correct the front with what was gathered at node k, and leave its trail."""
    C, T, G, E, M = front.C, work.T, work.G, trail.E[k], trail.M[k]
    before, d = work.C, C.shape[0]
    for a in range(d):
        for j in range(n):
            E[a, j] = G[a, j]
    add_product(T, before, E, 1.0)
    write(T, trail.T[k])
    if work.alone[0]:
        write(front.P, M)
        return
    posterior(front.P, T, (work.F, work.A, work.B), M)
    write(M, front.P)
    add_product(M, E, C, -1.0)
    _inform(front, work, E, n)


@no_alloc
def _inform(front: Front, work: Work, E: Float[np.ndarray, "d n"], n: Whole) -> None:
    """Add C^T E, with C corrected, and G^T C, with C before, to the information."""
    C, G, before = front.C, work.G, work.C
    for i in range(n):
        row = front.information[i]
        c0, c1, c2 = C[0, i], C[1, i], C[2, i]
        g0, g1, g2 = G[0, i], G[1, i], G[2, i]
        if g0 != 0.0 or g1 != 0.0 or g2 != 0.0:
            for j in range(i + 1):
                row[j] += (c0 * E[0, j] + c1 * E[1, j] + c2 * E[2, j]) + (
                    g0 * before[0, j] + g1 * before[1, j] + g2 * before[2, j]
                )
        else:
            for j in range(i + 1):
                row[j] += c0 * E[0, j] + c1 * E[1, j] + c2 * E[2, j]
        for a in range(POSE, C.shape[0]):
            c, g = C[a, i], G[a, i]
            if c != 0.0 or g != 0.0:
                for j in range(i + 1):
                    row[j] += c * E[a, j] + g * before[a, j]
