"""Steps of the chain: how odometry and the walks of moving callers lead from node to node."""

import math

import numpy as np
from jaxtyping import Float

from pipistrelle.estimation.smoother.records import (
    CALLER,
    POSE,
    Legs,
    Noise,
    Places,
    Points,
    Work,
)
from pipistrelle.estimation.smoother.small_matrices import congruent, write
from pipistrelle.geometry import wrap_angle
from pipistrelle.jit import Whole, no_alloc

LEAST_STD = 1e-4
"""Added in quadrature to the noise of a caller's velocity [m/s] and place [m] in a step."""


@no_alloc
def transition(
    work: Work,
    k: Whole,
    legs: Legs,
    places: Places,
    points: Points,
    noise: Noise,
) -> float:
    """Write F, u, Q and the slopes by parameters of the step to node k.

    Returns what the step costs at the points, times two.
    """
    F, u, Q, at, (mx, my, mh) = work.F, work.u, work.Q, points[0], _motion(legs, k, points[1])
    F[:], Q[:] = 0.0, 0.0
    x, y, heading = at[k - 1, 0], at[k - 1, 1], at[k - 1, 2]
    dx, dy, c, s = at[k, 0] - x, at[k, 1] - y, math.cos(heading), math.sin(heading)
    for a in range(POSE):
        F[a, a] = 1.0
    F[0, 2], F[1, 2] = -dy, dx
    off = c * dx + s * dy - mx, c * dy - s * dx - my, wrap_angle(at[k, 2] - heading - mh)
    for e in range(work.by.shape[1]):
        ahead, aside = legs.slopes[k, 0, e], legs.slopes[k, 1, e]
        work.by[0, e], work.by[1, e] = c * ahead - s * aside, s * ahead + c * aside
        work.by[2, e] = legs.slopes[k, 2, e]
    if legs.scale[0] > 0:
        scale = 1.0 + points[1][legs.scale[0]]
        work.by[0, 0] += (c * off[0] - s * off[1]) / scale
        work.by[1, 0] += (s * off[0] + c * off[1]) / scale
        _stretch(legs.noise[k], scale, work.A)
        cost = _odometry(work.A, off, (c, s), u, Q)
    else:
        cost = _odometry(legs.noise[k], off, (c, s), u, Q)
    for v in range(places.first.size):
        cost += _transition_of_caller(work, k, v, legs.seconds[k], places, at, noise)
    return cost


@no_alloc
def _stretch(
    N: Float[np.ndarray, "3 3"], scale: float, stretched: Float[np.ndarray, "d d"]
) -> None:
    """Write the noise of a motion of which x and y are multiplied by a scale."""
    for a in range(POSE):
        for b in range(POSE):
            stretched[a, b] = N[a, b] * (scale if a < 2 else 1.0) * (scale if b < 2 else 1.0)


@no_alloc
def _motion(legs: Legs, k: Whole, border: Float[np.ndarray, " n"]) -> tuple[float, float, float]:
    """Return the motion to node k by the parameters at their points."""
    x, y, turn = legs.mean[k, 0], legs.mean[k, 1], legs.mean[k, 2]
    for e in range(legs.slopes.shape[2]):
        x += legs.slopes[k, 0, e] * border[1 + e]
        y += legs.slopes[k, 1, e] * border[1 + e]
        turn += legs.slopes[k, 2, e] * border[1 + e]
    return x, y, turn


@no_alloc
def write_start(work: Work, legs: Legs, at: Float[np.ndarray, "k d"]) -> float:
    """Write u and Q of the start; return what it costs at its point, times two."""
    turn = wrap_angle(at[0, 2] - legs.mean[0, 2])
    off = at[0, 0] - legs.mean[0, 0], at[0, 1] - legs.mean[0, 1], turn
    return _odometry(legs.noise[0], off, (1.0, 0.0), work.u, work.Q)


@no_alloc
def _odometry(
    N: Float[np.ndarray, "3 3"],
    off: tuple[float, float, float],
    axes: tuple[float, float],
    u: Float[np.ndarray, " d"],
    Q: Float[np.ndarray, "d d"],
) -> float:
    r"""Write how far a motion leads from a point, u, and its noise Q; return what it costs, twice.

    The misfit is the logarithm of SE(2), :math:`r = V^{-1}(\theta)\,(x, y)` and :math:`\theta`,
    of what a motion of noise N is off at the points; ``axes``: cosine and sine of their heading.
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
    """Return (x, y, z) N^-1 (x, y, z); 0 of a step without noise."""
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
    noise: Noise,
) -> float:
    """Write F, u and Q of moving caller v; return what its step costs at the points, times two."""
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
    """Write F M F^T + Q; P is not M."""
    write(work.Q, P)
    congruent(work.F, M, work.A, P)
