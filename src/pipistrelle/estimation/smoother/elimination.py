r"""Elimination of the pose chain, with landmarks and parameters as its separator (`border`).

Odometry links consecutive poses to a chain; landmarks, stationary callers and parameters form the
separator b. Given b, the chain is a linear Gaussian process, so a Kalman filter runs along it with
a mean affine in b. With all unknowns as differences from their linearisation points, and
:math:`\beta = (1, b)`:

.. math:: x_k \mid b \sim N(C_k \beta,\, P_k), \qquad
          \bar C = F C_k + u, \quad \bar P = F P_k F^T + Q .

The measurements of a node, :math:`r = H x + G \beta` in standard deviations, update both and leave
information on the separator (:math:`T = H^T H`, :math:`E = T \bar C + H^T G`):

.. math:: P = (\bar P^{-1} + T)^{-1}, \quad C = \bar C - P E, \quad
          \Lambda \leftarrow \Lambda + G^T G + G^T H \bar C + C^T E .

:math:`\tfrac12 \beta^T \Lambda \beta` is the minimal cost of the chain as a function of b
(`solution` solves for b). Neither Q nor the prior is inverted, so that both may be singular. Each
step leaves the conditional of the previous state, for the backward pass:

.. math:: x_k \mid x_{k+1}, b \sim N(D_k \beta + G_k x_{k+1},\, S_k), \qquad
          G_k = P_k F^T \bar P^{-1}, \quad D_k = C_k - G_k \bar C .

Landmarks without recent measurements may leave the separator by elimination (`leave`). Moving
callers join the chain: their positions and velocities follow the pose in the state.
"""

import math

import numpy as np
from jaxtyping import Float, Int

from pipistrelle.estimation.smoother.observations import hear
from pipistrelle.estimation.smoother.records import (
    CALLER,
    POSE,
    Arrays,
    Front,
    Legs,
    Links,
    NoiseModel,
    Places,
    PointArrays,
    Rows,
    Work,
    add,
    add_product,
    cholesky,
    congruent,
    multiply,
    posterior,
    solve_with,
    work_of,
    write,
)
from pipistrelle.geometry import wrap_angle
from pipistrelle.jit import Whole, no_alloc, optimised_once

LEAST_STD = 1e-4
"""Added in quadrature to a caller's velocity [m/s] and position [m] noise in a step."""


@no_alloc
def transition(
    work: Work,
    k: Whole,
    legs: Legs,
    places: Places,
    points: PointArrays,
    noise: NoiseModel,
) -> float:
    """Linearise the motion to node k (F, u, Q, parameter Jacobian); return twice its cost."""
    F, u, Q, (at, border) = work.F, work.u, work.Q, points
    F[:], Q[:] = 0.0, 0.0
    x, y, heading = at[k - 1, 0], at[k - 1, 1], at[k - 1, 2]
    dx, dy, c, s = at[k, 0] - x, at[k, 1] - y, math.cos(heading), math.sin(heading)
    for a in range(POSE):
        F[a, a] = 1.0
    F[0, 2], F[1, 2] = -dy, dx
    mx, my, mh = legs.mean[k, 0], legs.mean[k, 1], legs.mean[k, 2]
    for e in range(work.by.shape[1]):
        ahead, aside, turn = legs.slopes[k, 0, e], legs.slopes[k, 1, e], legs.slopes[k, 2, e]
        mx, my, mh = (
            mx + ahead * border[1 + e],
            my + aside * border[1 + e],
            mh + turn * border[1 + e],
        )
        work.by[0, e], work.by[1, e] = c * ahead - s * aside, s * ahead + c * aside
        work.by[2, e] = turn
    off = c * dx + s * dy - mx, c * dy - s * dx - my, wrap_angle(at[k, 2] - heading - mh)
    if legs.scale > 0:
        scale = 1.0 + border[legs.scale]
        work.by[0, 0] += (c * off[0] - s * off[1]) / scale
        work.by[1, 0] += (s * off[0] + c * off[1]) / scale
        for a in range(POSE):
            for b in range(POSE):
                by_a, by_b = scale if a < 2 else 1.0, scale if b < 2 else 1.0
                work.A[a, b] = legs.noise[k, a, b] * by_a * by_b
        cost = _odometry(work.A, off, (c, s), u, Q)
    else:
        cost = _odometry(legs.noise[k], off, (c, s), u, Q)
    for v in range(places.first.size):
        cost += _transition_of_caller(work, k, v, legs.seconds[k], places, at, noise)
    return cost


@no_alloc
def _odometry(
    N: Float[np.ndarray, "3 3"],
    off: tuple[float, float, float],
    axes: tuple[float, float],
    u: Float[np.ndarray, " d"],
    Q: Float[np.ndarray, "d d"],
) -> float:
    r"""Write offset u and noise Q of a motion with residual ``off``; return twice its cost.

    The residual is the logarithm of SE(2), :math:`r = V^{-1}(\theta)\,(x, y)` and :math:`\theta`;
    ``axes``: cosine and sine of the heading.
    """
    (x, y, turn), (c, s) = off, axes
    if abs(turn) < 1e-4:
        A, B = 1.0 - turn * turn / 6.0, 0.5 * turn
        by_A, by_B = -turn / 3.0, 0.5 - turn * turn / 8.0
    else:
        A, B = math.sin(turn) / turn, (1.0 - math.cos(turn)) / turn
        by_A, by_B = (math.cos(turn) - A) / turn, (math.sin(turn) - B) / turn
    det = A * A + B * B
    rx, ry = (A * x + B * y) / det, (A * y - B * x) / det
    mx, my = by_B * ry - by_A * rx, -by_B * rx - by_A * ry
    p, q = c * A - s * B, s * A + c * B
    mx, my = c * mx - s * my, s * mx + c * my
    u[0] = s * y - c * x + mx * turn
    u[1] = -s * x - c * y + my * turn
    u[2] = -turn
    xx, xy, yy = N[0, 0], N[0, 1], N[1, 1]
    xh = p * N[0, 2] - q * N[1, 2]
    yh = q * N[0, 2] + p * N[1, 2]
    hh = N[2, 2]
    Q[0, 0] = p * p * xx - 2.0 * p * q * xy + q * q * yy - 2.0 * mx * xh + mx * mx * hh
    Q[1, 1] = q * q * xx + 2.0 * p * q * xy + p * p * yy - 2.0 * my * yh + my * my * hh
    Q[0, 1] = p * q * (xx - yy) + (p * p - q * q) * xy - my * xh - mx * yh + mx * my * hh
    Q[0, 2], Q[1, 2], Q[2, 2] = xh - mx * hh, yh - my * hh, hh
    Q[1, 0], Q[2, 0], Q[2, 1] = Q[0, 1], Q[0, 2], Q[1, 2]
    return _misfit(N, rx, ry, turn)


@no_alloc
def _misfit(N: Float[np.ndarray, "3 3"], x: float, y: float, z: float) -> float:
    """Return (x, y, z) N^-1 (x, y, z), or 0 for a step without noise."""
    if N[2, 2] == 0.0:
        return 0.0
    z /= math.sqrt(N[2, 2])
    a, b = N[0, 2] / math.sqrt(N[2, 2]), N[1, 2] / math.sqrt(N[2, 2])
    yy = math.sqrt(N[1, 1] - b * b)
    xy = (N[0, 1] - a * b) / yy
    y = (y - b * z) / yy
    x = (x - a * z - xy * y) / math.sqrt(N[0, 0] - a * a - xy * xy)
    return x * x + y * y + z * z


@no_alloc
def _transition_of_caller(
    work: Work,
    k: Whole,
    v: Whole,
    seconds: float,
    places: Places,
    at: Float[np.ndarray, "k d"],
    noise: NoiseModel,
) -> float:
    """Write F, u and Q of moving caller v; return twice the cost of its step."""
    F, u, Q, cost, i = work.F, work.u, work.Q, 0.0, POSE + CALLER * v
    for a in range(i, i + CALLER):
        u[a] = 0.0
    if k < places.first[v]:
        return 0.0
    if k == places.first[v]:
        for a in range(2):
            Q[i + a, i + a], Q[i + 2 + a, i + 2 + a] = noise.place_std**2, noise.speed_std**2
            u[i + a], u[i + 2 + a] = places.begun[v, a] - at[k, i + a], -at[k, i + 2 + a]
            cost += (u[i + a] / noise.place_std) ** 2 + (u[i + 2 + a] / noise.speed_std) ** 2
        return cost
    q, least = noise.walk_std * noise.walk_std, LEAST_STD * LEAST_STD if seconds > 0.0 else 0.0
    stray, sway = q * seconds + least, q * seconds**3 / 12.0 + least
    for a in range(2):
        b, w = i + a, i + 2 + a
        F[b, b], F[w, w], F[b, w] = 1.0, 1.0, seconds
        u[b] = at[k - 1, b] + seconds * at[k - 1, w] - at[k, b]
        u[w] = at[k - 1, w] - at[k, w]
        Q[b, b], Q[w, w] = 0.25 * seconds * seconds * stray + sway, stray
        Q[b, w] = Q[w, b] = 0.5 * seconds * stray
        if seconds > 0.0:
            cost += u[w] * u[w] / stray + (u[b] - 0.5 * seconds * u[w]) ** 2 / sway
    return cost


@no_alloc
def predicted(work: Work, M: Float[np.ndarray, "d d"], P: Float[np.ndarray, "d d"]) -> None:
    """Write the predicted covariance F M F^T + Q to P, which must not be M."""
    write(work.Q, P)
    congruent(work.F, M, work.A, P)


@optimised_once
def eliminate(
    front: Arrays,
    legs: Arrays,
    rows: Arrays,
    places: Arrays,
    points: PointArrays,
    links: Arrays,
    noise: NoiseModel,
    span: tuple[Whole, Whole, Whole, Whole, Whole],
) -> float:
    """Eliminate the chain between two nodes, in place; return the added chi-square cost.

    ``span``: node of the front, first node to update, end of the nodes, columns, node of link 0.
    """
    front, legs, rows, places = Front(*front), Legs(*legs), Rows(*rows), Places(*places)
    links, (stands, first, last, n, base) = Links(*links), span
    work, cost = work_of(front.C.shape[0], n, legs.slopes.shape[2]), 0.0
    for k in range(first, last):
        if k > stands:
            cost += transition(work, k, legs, places, points, noise)
            step(front, work, links, k - base, n)
        heard = k, legs.rows[k, 0], legs.rows[k, 1]
        cost += hear(work, front, heard, rows, places, points, noise)
        correct(front, work, n)
    return cost


@optimised_once
def step_to(
    front: Arrays,
    legs: Arrays,
    places: Arrays,
    points: PointArrays,
    links: Arrays,
    noise: NoiseModel,
    span: tuple[Whole, Whole, Whole],
) -> float:
    """Predict the frontal state to a node without its measurements; return twice the cost."""
    front, legs, (k, n, base) = Front(*front), Legs(*legs), span
    work = work_of(front.C.shape[0], n, legs.slopes.shape[2])
    cost = transition(work, k, legs, Places(*places), points, noise)
    step(front, work, Links(*links), k - base, n)
    return cost


@optimised_once
def begin(
    front: Arrays, legs: Arrays, at: Float[np.ndarray, "k d"], border: Float[np.ndarray, " n"],
    parameters: Float[np.ndarray, " p"], damping: float,
) -> float:  # fmt: skip
    """Initialise the frontal state with the start and parameter priors; return twice the cost."""
    front[0][:], front[1][:], front[2][:] = 0.0, 0.0, 0.0
    work, start = work_of(POSE, 1, 0), Legs(*legs)
    mean, turn = start.mean[0], wrap_angle(at[0, 2] - start.mean[0, 2])
    off = at[0, 0] - mean[0], at[0, 1] - mean[1], turn
    cost = _odometry(start.noise[0], off, (1.0, 0.0), work.u, work.Q)
    for a in range(POSE):
        front[0][a, 0] = work.u[a]
        for b in range(POSE):
            front[1][a, b] = work.Q[a, b]
    for i in range(1, 1 + parameters.size):
        sure, information = parameters[i - 1] ** -2, front[2]
        information[i, i] = sure + damping
        information[i, 0] = sure * border[i]
        information[0, 0] += sure * border[i] ** 2
        cost += sure * border[i] ** 2
    return cost


@optimised_once
def enter(
    information: Float[np.ndarray, "n n"],
    column: Int[np.ndarray, " l"],
    known: tuple[Float[np.ndarray, "l 2"], Float[np.ndarray, "l 3"]],
    border: Float[np.ndarray, " n"],
    damping: float,
) -> float:
    """Add landmarks with priors (xx, xy, yy of information); return twice their cost."""
    cost = 0.0
    for number in range(column.size):
        i, mean, by = column[number], known[0][number], known[1][number]
        x, y = border[i] - mean[0], border[i + 1] - mean[1]
        by_x, by_y = by[0] * x + by[1] * y, by[1] * x + by[2] * y
        information[i, i] += by[0] + damping
        information[i + 1, i] += by[1]
        information[i + 1, i + 1] += by[2] + damping
        information[i, 0] += by_x
        information[i + 1, 0] += by_y
        information[0, 0] += x * by_x + y * by_y
        cost += x * by_x + y * by_y
    return cost


@optimised_once
def leave(
    front: Arrays,
    column: Int[np.ndarray, " g"],
    left: tuple[Float[np.ndarray, "g 2 n"], Float[np.ndarray, "g 2 d"], Float[np.ndarray, "g 2 2"]],
) -> None:
    r"""Eliminate landmarks from the separator in sequence, in place.

    With c the columns of a landmark, :math:`V = \Lambda_{cc}^{-1}`, :math:`H = -V \Lambda_c` and
    :math:`C_c` the derivatives of the state by it,

    .. math:: C \leftarrow C + C_c H, \quad P \leftarrow P + C_c V C_c^T, \quad
              \Lambda \leftarrow \Lambda + \Lambda_c^T H,

    and ``left`` gets its conditional :math:`(H - K C)\beta + K x` with :math:`K = V C_c^T P^{-1}`
    and covariance :math:`V - K C_c V`.
    """
    C, P, information = front
    d, n = C.shape
    L, V, by = np.zeros((d, d)), np.zeros((2, 2)), np.zeros((2, n))
    aside, own = np.zeros((2, n)), np.zeros((d, 2))
    for g in range(column.size):
        i, H, K = column[g], left[0][g], left[1][g]
        for e in range(2):
            for j in range(n):
                by[e, j] = information[max(i + e, j), min(i + e, j)]
            for a in range(d):
                own[a, e] = C[a, i + e]
                C[a, i + e] = 0.0
        for e in range(2):
            for j in range(n):
                information[max(i + e, j), min(i + e, j)] = 0.0
        det = by[0, i] * by[1, i + 1] - by[0, i + 1] * by[0, i + 1]
        V[0, 0], V[1, 1] = by[1, i + 1] / det, by[0, i] / det
        V[0, 1] = V[1, 0] = -by[0, i + 1] / det
        by[:, i : i + 2], H[:] = 0.0, 0.0
        add_product(V, by, H, -1.0)
        for j in range(n):
            for e in range(j + 1):
                information[j, e] += by[0, j] * H[0, e] + by[1, j] * H[1, e]
        add_product(own, H, C, 1.0)
        for e in range(2):
            for a in range(d):
                K[e, a] = V[e, 0] * own[a, 0] + V[e, 1] * own[a, 1]
        add_product(own, K, P, 1.0)
        cholesky(P, L)
        for e in range(2):
            solve_with(L, K[e])
        rest = left[2][g]
        for e in range(2):
            for f in range(e + 1):
                rest[e, f] = V[e, f]
                for a in range(d):
                    rest[e, f] -= K[e, a] * (own[a, 0] * V[0, f] + own[a, 1] * V[1, f])
                rest[f, e] = rest[e, f]
        multiply(K, C, aside)
        add(aside, H, -1.0)


@no_alloc
def advance(front: Front, work: Work, n: Whole) -> None:
    """Predict the frontal state in place; the previous C and P stay in the work's C and M."""
    write(front.P, work.M)
    for a in range(work.u.size):
        for j in range(n):
            work.C[a, j] = front.C[a, j]
            front.C[a, j] = 0.0
    add_product(work.F, work.C, front.C, 1.0)
    for a in range(work.u.size):
        row = front.C[a]
        row[0] += work.u[a]
        for e in range(work.by.shape[1]):
            row[1 + e] += work.by[a, e]
    predicted(work, work.M, front.P)


@no_alloc
def step(front: Front, work: Work, links: Links, k: Whole, n: Whole) -> None:
    """Predict the frontal state by a transition; write the conditional of the previous state."""
    advance(front, work, n)
    D, G, S, d = links.D[k], links.G[k], links.S[k], front.P.shape[0]
    multiply(work.F, work.M, work.A)
    cholesky(front.P, work.B)
    for a in range(d):
        for b in range(d):
            G[a, b] = work.A[b, a]
        solve_with(work.B, G[a])
        for j in range(n):
            D[a, j] = work.C[a, j]
    add_product(G, front.C, D, -1.0)
    multiply(G, work.F, work.A)
    for a in range(d):
        for b in range(d):
            work.A[a, b] = (1.0 if a == b else 0.0) - work.A[a, b]
            S[a, b] = 0.0
    congruent(work.A, work.M, work.B, S)
    congruent(G, work.Q, work.B, S)


@no_alloc
def correct(front: Front, work: Work, n: Whole) -> None:
    """Update the frontal state with the accumulated measurements of a node."""
    if work.alone[0]:
        return
    C, T, E, M = front.C, work.T, work.E, work.M
    for a in range(C.shape[0]):
        for j in range(n):
            E[a, j] = work.G[a, j]
    add_product(T, work.C, E, 1.0)
    posterior(front.P, T, (work.F, work.A, work.B), M)
    write(M, front.P)
    add_product(M, E, C, -1.0)
    _inform(front, work, E, n)


@no_alloc
def _inform(front: Front, work: Work, E: Float[np.ndarray, "d n"], n: Whole) -> None:
    """Add C^T E, with C updated, and G^T C, with C before, to the separator information."""
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
