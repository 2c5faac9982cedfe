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
(`solve` solves for b). Neither Q nor the prior is inverted, so that both may be singular. Each
step leaves the conditional of the previous state, for the backward pass:

.. math:: x_k \mid x_{k+1}, b \sim N(D_k \beta + G_k x_{k+1},\, S_k), \qquad
          G_k = P_k F^T \bar P^{-1}, \quad D_k = C_k - G_k \bar C .

Landmarks without recent measurements may leave the separator by elimination (`leave`). Moving
callers join the chain: their positions and velocities follow the pose in the state.

**Solution for the separator.** The information is factored from its last row to its first,
:math:`\Lambda = R^T R` with R lower triangular, so that every loop runs along a row; the first
column of R is then the right-hand side. Unused columns have a pivot of 1. Elimination left each
state, and each landmark that has left the separator, with the conditional (`Links`, `leave`)

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

from pipistrelle.estimation.motion import PoseCovariance
from pipistrelle.estimation.observations.range import cholesky
from pipistrelle.estimation.smoother.observations import hear
from pipistrelle.estimation.smoother.records import (
    CALLER,
    POSE,
    Arrays,
    Border,
    ChainState,
    Factor,
    Front,
    Legs,
    Links,
    NoiseModel,
    Places,
    PlainLegs,
    PointArrays,
    Rows,
    Slopes,
    Span,
    Square,
    Work,
    add,
    add_image,
    add_multiple,
    add_product,
    congruent,
    multiply,
    posterior,
    solve_with,
    transpose,
    work_of,
    write,
    write_image,
)
from pipistrelle.geometry import wrap_angle
from pipistrelle.jit import Whole, kernel, no_alloc, optimised_once

LEAST_STD = 1e-4
"""Added in quadrature to a caller's velocity [m/s] and position [m] noise in a step."""


@no_alloc
def transition(
    work: Work, k: Whole, legs: Legs, places: Places, points: PointArrays, noise: NoiseModel
) -> float:
    """Linearise the motion of vehicle and callers between two scans; return its chi-square cost."""
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
    N: PoseCovariance,
    off: tuple[float, float, float],
    axes: tuple[float, float],
    u: ChainState,
    Q: Square,
) -> float:
    r"""Linearise an odometry step: write offset u and covariance Q; return its chi-square cost.

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
def _misfit(N: PoseCovariance, x: float, y: float, z: float) -> float:
    """Return the squared Mahalanobis length of a motion's residual, or 0 if it has no noise."""
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
    """Linearise a moving caller's motion between two scans; return its chi-square cost."""
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
def predicted(work: Work, M: Square, P: Square) -> None:
    """Predict a covariance M through a linearised motion, and write the result to P."""
    write(work.Q, P)
    congruent(work.F, M, work.A, P)


@optimised_once
def eliminate(
    front: Arrays,
    legs: PlainLegs,
    rows: Arrays,
    places: Arrays,
    points: PointArrays,
    links: Arrays,
    noise: NoiseModel,
    span: tuple[Whole, Whole, Whole, Whole, Whole],
) -> float:
    """Eliminate the poses of several scans from the smoother's equations; return their chi-square.

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
    legs: PlainLegs,
    places: Arrays,
    points: PointArrays,
    links: Arrays,
    noise: NoiseModel,
    span: Span,
) -> float:
    """Predict the newest state (pose, callers) to the next scan; return the step's chi-square."""
    front, legs, (k, n, base) = Front(*front), Legs(*legs), span
    work = work_of(front.C.shape[0], n, legs.slopes.shape[2])
    cost = transition(work, k, legs, Places(*places), points, noise)
    step(front, work, Links(*links), k - base, n)
    return cost


@optimised_once
def begin(
    front: Arrays, legs: PlainLegs, at: Float[np.ndarray, "k d"], border: Border,
    parameters: Float[np.ndarray, " p"], damping: float
) -> float:  # fmt: skip
    """Start a smoother's elimination by priors of pose and parameters; return their chi-square."""
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
    information: Factor,
    column: Int[np.ndarray, " l"],
    known: tuple[Float[np.ndarray, "l 2"], Float[np.ndarray, "l 3"]],
    border: Border,
    damping: float,
) -> float:
    """Add landmarks' Gaussian priors to an information matrix; return their chi-square cost."""
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
    r"""Eliminate landmarks from the smoother's equations; store each given the remaining unknowns.

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
    """Predict the newest state through a linearised motion in place; keep its prior in ``work``."""
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
    """Predict the newest state to the next scan; store the previous state's Gaussian given it."""
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
    """Update the newest state with all accumulated measurements of a scan, in place."""
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
def _inform(front: Front, work: Work, E: Slopes, n: Whole) -> None:
    """Add a scan's information on landmarks and parameters to their information matrix."""
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


Left = tuple[Float[np.ndarray, "g 2 n"], Float[np.ndarray, "g 2 d"], Float[np.ndarray, "g 2 2"]]
"""D, G and S of landmarks that have left the separator."""


@optimised_once
def trace_back(
    links: Arrays, beta: Border, last: ChainState, count: Whole
) -> Float[np.ndarray, "k d"]:
    """Solve for earlier states from the last by back substitution; return ``count`` + 1 states."""
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
    left: Left, column: Int[np.ndarray, " g"], beta: Border,
    state: ChainState
) -> None:  # fmt: skip
    """Solve for eliminated landmarks by back substitution, and write their offsets to ``beta``."""
    place = np.empty(2)
    for g in range(column.size - 1, -1, -1):
        beta[column[g]] = beta[column[g] + 1] = 0.0
        write_image(left[0][g], beta, place)
        add_image(left[1][g], state, place, 1.0)
        beta[column[g]], beta[column[g] + 1] = place[0], place[1]


@optimised_once
def spread_back(
    links: Arrays, covariances: tuple[Square, Slopes, Factor], count: Whole
) -> tuple[Float[np.ndarray, "k d d"], Float[np.ndarray, "k d d"]]:
    """Return the covariances of the smoothed states, and of each with the next state.

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
def _make_symmetric(P: Square) -> None:
    """Make a matrix symmetric by averaging it with its transpose."""
    for a in range(P.shape[0]):
        for b in range(a):
            P[a, b] = P[b, a] = 0.5 * (P[a, b] + P[b, a])


@optimised_once
def spread_left(
    left: Left, column: Int[np.ndarray, " g"], covariances: tuple[Square, Slopes, Factor]
) -> Float[np.ndarray, "g 2 2"]:
    """Add eliminated landmarks to the covariances again, in place; return their 2 x 2 blocks."""
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
def _add_by_slopes(D: Float[np.ndarray, "e n"], X: Slopes, total: Float[np.ndarray, "e d"]) -> None:
    """Add the matrix product D X^T to ``total``, in place, without the first columns of D and X."""
    for e in range(total.shape[0]):
        for a in range(total.shape[1]):
            for j in range(1, D.shape[1]):
                total[e, a] += D[e, j] * X[a, j]


@no_alloc
def factor(R: Factor, n: Whole) -> None:
    """Factor an n x n information matrix in place into R^T R, with R lower triangular."""
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
def _factor_rows(R: Factor, i: Whole, count: Whole) -> None:
    """Factor rows i - count + 1 to i of an information matrix, without changing other rows."""
    for p in range(i, i - count, -1):
        row, inverse = R[p], 1.0 / math.sqrt(R[p, p])
        for j in range(p + 1):
            row[j] *= inverse
        for r in range(i - count + 1, p):
            share, other = row[r], R[r]
            for j in range(r + 1):
                other[j] -= share * row[j]


@no_alloc
def minimise(R: Factor, n: Whole, beta: Border) -> None:
    """Solve R (1, b) = 0 for b, with R a triangular factor, and write (1, b) to ``beta``."""
    beta[0] = 1.0
    for i in range(1, n):
        total = 0.0
        for j in range(i):
            total += R[i, j] * beta[j]
        beta[i] = -total / R[i, i]


@no_alloc
def rooted(R: Factor, w: Border, n: Whole) -> None:
    """Replace a vector w by the solution z of R^T z = w, for a lower triangular matrix R."""
    w[0] = 0.0
    for i in range(n - 1, 0, -1):
        if w[i] != 0.0:
            w[i] /= R[i, i]
            for j in range(i):
                w[j] -= w[i] * R[i, j]
    w[0] = 0.0


@optimised_once
def solve(front: Arrays, n: Whole, R: Factor, beta: Border) -> tuple[ChainState, Square]:
    """Solve for landmarks and parameters; return the newest state's correction and covariance."""
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
def write_lower(information: Float[np.ndarray, "w w"], n: Whole, R: Factor) -> None:
    """Copy the lower triangle of an information matrix to R, with diagonal 1 for unused columns."""
    for i in range(n):
        for j in range(i + 1):
            R[i, j] = information[i, j]
        if i > 0 and R[i, i] == 0.0:
            R[i, i] = 1.0


@no_alloc
def spread(
    C: Float[np.ndarray, "d w"], P: Square, R: Factor, n: Whole, Z: Slopes, covariance: Square
) -> None:
    """Write a state's total covariance: given the landmarks, plus the part due to their errors."""
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
    R: Factor,
    n: Whole,
    by_chain: Float[np.ndarray, "q d"],
    by_border: Float[np.ndarray, "q n"],
) -> Float[np.ndarray, "q q"]:
    """Return the covariance of linear functions of the newest state, landmarks and parameters."""
    C, P, _ = front
    (q, d), Z = by_chain.shape, by_border.copy()
    for e in range(q):
        for a in range(d):
            if by_chain[e, a] != 0.0:
                for j in range(n):
                    Z[e, j] += by_chain[e, a] * C[a, j]
        rooted(R, Z[e], n)
    covariance = np.empty((q, q))
    _write_gram(Z, np.empty((n, q)), covariance)
    for e in range(q):
        for a in range(d):
            if by_chain[e, a] != 0.0:
                for f in range(e + 1):
                    for b in range(d):
                        covariance[e, f] += by_chain[e, a] * P[a, b] * by_chain[f, b]
                    covariance[f, e] = covariance[e, f]
    return covariance


@no_alloc
def _write_gram(
    Z: Float[np.ndarray, "q n"], turned: Float[np.ndarray, "n q"], gram: Float[np.ndarray, "q q"]
) -> None:
    """Write the matrix product Z Z^T to ``gram``, a row at a time, and Z^T to ``turned``."""
    transpose(Z, turned)
    for e in range(gram.shape[0]):
        row = gram[e, e:]
        row[:] = 0.0
        for j in range(Z.shape[1]):
            if Z[e, j] != 0.0:
                add_multiple(turned[j, e:], Z[e, j], row)
        for f in range(row.size):
            gram[e + f, e] = row[f]


@optimised_once
def border_covariance(R: Factor) -> Factor:
    """Return the covariance of landmarks and parameters from the factor of their information."""
    Z = np.zeros(R.shape)
    for i in range(1, len(R)):
        Z[i, i] = 1.0
        rooted(R, Z[i], i + 1)
    covariance = np.empty(R.shape)
    _write_gram(Z, np.empty(R.shape), covariance)
    return covariance
