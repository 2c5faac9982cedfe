r"""Range of a point: derivatives, the rule that a range is certain, and places by ranges only.

A landmark is initialised when its range, or its place seen from the vehicle, is certain: beyond a
standard deviation of a fifth (`MAX_RELATIVE_RANGE_STD`) its position is not Gaussian.

**Trilateration.** Ranges :math:`d_i` with variances :math:`\sigma_i^2` from positions :math:`p_i`
of error covariance P place a landmark at a minimum of

.. math:: c(l) = r^T R^{-1} r, \quad r_i = |l - p_i| - d_i, \quad
          R = \operatorname{diag}(f_i \sigma_i^2) + U P U^T

with the directions :math:`u_i` from the positions in U and the factors :math:`f_i` of a robust loss
(`rows.robust_loss`). There :math:`dl = A^{-1} U^T R^{-1} (U\,dp + dd)` with the covariance
:math:`A^{-1} = (U^T R^{-1} U)^{-1}`. Errors that all positions share move the landmark, but do not
change c; P is therefore of the positions relative to the newest.

Positions on a line leave two minima, mirrored at the line; after a turn their depths differ. In
the axes of the positions, along and across their line, with the origin at their mean,
:math:`d_i^2 - |p_i|^2 = u^2 + h^2 - 2 u a_i - 2 h b_i` for a landmark at (u, h) and a position at
(a, b). For small b its regression on a has the slope -2 u and the mean :math:`u^2 + h^2`, hence the
two starts (u, h) and (u, -h) of a Levenberg-Marquardt search, first with the diagonal of R. A
mirrored place is excluded if the other is a million times as likely.

**Misfit.** Of n ranges as precise as stated, the least c is near n - 2. Where it is larger, because
of gross or skewed errors, all variances are multiplied by c / (n - 2), the Birge ratio (Birge,
Physical Review 40, 1932), so that a place waits for more ranges.
"""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from pipistrelle.estimation.observations.rows import robust_loss
from pipistrelle.jit import Whole, kernel, no_alloc

NEAREST = 1e-3
"""Distance [m] below which a measurement is not linearised."""
MAX_RELATIVE_RANGE_STD = 0.2
"""Largest standard deviation of a range that initialises a landmark, relative to the range."""
Slopes = tuple[float, float, float]
"""Derivatives by x, y and heading of the pose; by a point they are minus the first two."""
MIN_SPACING = 3.0
"""Least distance between positions, in standard deviations of the range."""
EXCLUDED = 2.0 * math.log(1e6)
"""Excess cost that excludes a mirrored place: odds of a million, as each range asks again, and a
landmark on the wrong side bends the map."""
SAME = 0.01
"""Largest squared distance of equal places [standard deviations]. Two places near the line are less
than 1 from each other, but a Gaussian of the first is wrong on the other side."""
PASSES, REFINED = 50, 3
"""Most steps of a search, and steps with the whole covariance after it."""
Place = tuple[float, float, float, float, float, float]
"""Position [m], cost, and covariance xx, xy, yy [m^2]."""


class Ranges(NamedTuple):
    """Ranges of a landmark, the positions where they were measured, and a workspace."""

    points: Float[np.ndarray, " 2n"]  # x, y of each position in turn [m]
    distance: Float[np.ndarray, " n"]  # [m]
    variance: Float[np.ndarray, " n"]  # [m^2]
    at: Int[np.ndarray, " n"]  # index of each position in P
    P: Float[np.ndarray, "m m"]  # covariance of positions; the newest is at index 0
    count: Whole
    work: Float[np.ndarray, "w n"]  # of n + 3 rows


@kernel
def range_slopes(c: float, s: float) -> Slopes:
    """Return the derivatives of a range by the pose, from the numbers of `observe`."""
    return -c, -s, 0.0


@no_alloc
def is_certain(distance: float, variance: float) -> bool:
    """Return whether a range's std is small enough to initialise a landmark; False for NaN."""
    return variance <= MAX_RELATIVE_RANGE_STD * MAX_RELATIVE_RANGE_STD * distance * distance


@no_alloc
def cholesky(A: Float[np.ndarray, "d d"], L: Float[np.ndarray, "d d"]) -> None:
    """Write the Cholesky factor L of a positive semidefinite A; pivots not above 0 become 0."""
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
def _relative(P: Float[np.ndarray, "m m"], i: Whole, j: Whole, a: Whole, b: Whole) -> float:
    """Return the covariance of axis a of position i and axis b of position j, from the newest."""
    return P[i + a, j + b] - P[i + a, b] - P[a, j + b] + P[a, b]


@no_alloc
def _starts(ranges: Ranges) -> tuple[float, float, float, float]:
    """Return the two mirrored starts of the search, as x, y of each [m]."""
    points, n = ranges.points, ranges.count
    x = y = xx = xy = yy = 0.0
    for i in range(n):
        x, y = x + points[2 * i] / n, y + points[2 * i + 1] / n
    for i in range(n):
        dx, dy = points[2 * i] - x, points[2 * i + 1] - y
        xx, xy, yy = xx + dx * dx, xy + dx * dy, yy + dy * dy
    line = 0.5 * math.atan2(2.0 * xy, xx - yy)
    c, s = math.cos(line), math.sin(line)
    square = slope = length = 0.0
    for i in range(n):
        dx, dy = points[2 * i] - x, points[2 * i + 1] - y
        along, power = c * dx + s * dy, ranges.distance[i] ** 2 - dx * dx - dy * dy
        square, slope = square + power / n, slope + along * power
        length += along * along
    u = -0.5 * slope / max(length, NEAREST * NEAREST)
    h = math.sqrt(max(square - u * u, ranges.variance[0]))
    return x + c * u - s * h, y + s * u + c * h, x + c * u + s * h, y + s * u - c * h


@no_alloc
def _normal(ranges: Ranges, x: float, y: float, loss: Whole) -> tuple[float, ...]:
    """Return cost, gradient (2), and information xx, xy, yy of a place by the diagonal of R."""
    cost = gx = gy = xx = xy = yy = 0.0
    for i in range(ranges.count):
        dx, dy = x - ranges.points[2 * i], y - ranges.points[2 * i + 1]
        away, at = max(math.sqrt(dx * dx + dy * dy), NEAREST), ranges.at[i]
        c, s, off = dx / away, dy / away, away - ranges.distance[i]
        along = 0.5 * _relative(ranges.P, at, at, 0, 0) + 0.5 * _relative(ranges.P, at, at, 1, 1)
        variance = ranges.variance[i] + max(along, 0.0)
        factor, lost = robust_loss(off * off / variance, loss)
        sure = 1.0 / (factor * variance)
        cost, gx, gy = cost + lost, gx + sure * off * c, gy + sure * off * s
        xx, xy, yy = xx + sure * c * c, xy + sure * c * s, yy + sure * s * s
    return cost, gx, gy, xx, xy, yy


@no_alloc
def _place_near(ranges: Ranges, x: float, y: float, loss: Whole) -> tuple[float, float]:
    """Return the place of least cost by the diagonal of R that a search from a start reaches."""
    cost, gx, gy, xx, xy, yy = _normal(ranges, x, y, loss)
    damping = 1e-3
    for _ in range(PASSES):
        a, b = xx * (1.0 + damping), yy * (1.0 + damping)
        det = a * b - xy * xy
        if not det > 0.0:
            break
        dx, dy = (xy * gy - b * gx) / det, (xy * gx - a * gy) / det
        tried = _normal(ranges, x + dx, y + dy, loss)
        if tried[0] <= cost:
            x, y, damping = x + dx, y + dy, 0.1 * damping
            cost, gx, gy, xx, xy, yy = tried
            if dx * dx * xx + 2.0 * dx * dy * xy + dy * dy * yy < 1e-6:
                break
        else:
            damping *= 10.0
    return x, y


@no_alloc
def refined(ranges: Ranges, x: float, y: float, loss: Whole) -> Place:
    """Return the place of least cost near a place; write its derivatives by ranges to work[:2]."""
    n, cost, xx, xy, yy = ranges.count, 0.0, 0.0, 0.0, 0.0
    gx, gy, off, R = ranges.work[0], ranges.work[1], ranges.work[2], ranges.work[3:]
    for _ in range(REFINED):
        for i in range(n):
            dx, dy = x - ranges.points[2 * i], y - ranges.points[2 * i + 1]
            away = max(math.sqrt(dx * dx + dy * dy), NEAREST)
            gx[i], gy[i], off[i] = dx / away, dy / away, away - ranges.distance[i]
        for i in range(n):
            for j in range(i + 1):
                a, b = ranges.at[i], ranges.at[j]
                x_by = gx[j] * _relative(ranges.P, a, b, 0, 0) + gy[j] * _relative(
                    ranges.P, a, b, 0, 1
                )
                y_by = gx[j] * _relative(ranges.P, a, b, 1, 0) + gy[j] * _relative(
                    ranges.P, a, b, 1, 1
                )
                R[i, j] = gx[i] * x_by + gy[i] * y_by
        for i in range(n):
            variance = ranges.variance[i]
            R[i, i] += variance * robust_loss(off[i] * off[i] / (R[i, i] + variance), loss)[0]
        cost = xx = xy = yy = hx = hy = 0.0
        for j in range(n):  # R = L L^T; U and r become L^-1 U and L^-1 r
            for e in range(j):
                R[j, j] -= R[j, e] * R[j, e]
                gx[j], gy[j] = gx[j] - R[j, e] * gx[e], gy[j] - R[j, e] * gy[e]
                off[j] -= R[j, e] * off[e]
            R[j, j] = math.sqrt(R[j, j])
            gx[j], gy[j], off[j] = gx[j] / R[j, j], gy[j] / R[j, j], off[j] / R[j, j]
            for i in range(j + 1, n):
                for e in range(j):
                    R[i, j] -= R[i, e] * R[j, e]
                R[i, j] /= R[j, j]
            cost, hx, hy = cost + off[j] * off[j], hx + gx[j] * off[j], hy + gy[j] * off[j]
            xx, xy, yy = xx + gx[j] * gx[j], xy + gx[j] * gy[j], yy + gy[j] * gy[j]
        det = max(xx * yy - xy * xy, 1e-300)
        xx, xy, yy = yy / det, -xy / det, xx / det
        x, y = x - xx * hx - xy * hy, y - xy * hx - yy * hy
        cost -= hx * (xx * hx + xy * hy) + hy * (xy * hx + yy * hy)
    for j in range(n - 1, -1, -1):  # L^-T L^-1 U
        for i in range(j + 1, n):
            gx[j], gy[j] = gx[j] - R[i, j] * gx[i], gy[j] - R[i, j] * gy[i]
        gx[j], gy[j] = gx[j] / R[j, j], gy[j] / R[j, j]
    for j in range(n):
        gx[j], gy[j] = xx * gx[j] + xy * gy[j], xy * gx[j] + yy * gy[j]
    ratio = misfit(cost, n)
    return x, y, cost, ratio * xx, ratio * xy, ratio * yy


@no_alloc
def misfit(cost: float, count: Whole) -> float:
    """Return the factor on all variances for which the cost of a number of ranges is credible."""
    return max(cost / max(count - 2, 1), 1.0)


@no_alloc
def _is_located(place: Place, x: float, y: float) -> bool:
    """Return whether a place's largest std is small against its distance from (x, y)."""
    px, py, _, xx, xy, yy = place
    largest = 0.5 * (xx + yy + math.sqrt((xx - yy) ** 2 + 4.0 * xy * xy))
    return is_certain(math.hypot(px - x, py - y), largest)


@no_alloc
def located(ranges: Ranges, x: float, y: float, loss: Whole) -> tuple[Whole, Place, Place]:
    """Return the number of places, 0 if uncertain from (x, y), and both, the likelier first."""
    ax, ay, bx, by = _starts(ranges)
    ax, ay = _place_near(ranges, ax, ay, loss)
    bx, by = _place_near(ranges, bx, by, loss)
    one, other = refined(ranges, ax, ay, loss), refined(ranges, bx, by, loss)
    if other[2] < one[2]:
        one, other = other, one
    dx, dy, det = one[0] - other[0], one[1] - other[1], one[3] * one[5] - one[4] * one[4]
    apart = (one[5] * dx * dx - 2.0 * one[4] * dx * dy + one[3] * dy * dy) / max(det, 1e-300)
    if ranges.count < 3 or not _is_located(one, x, y):
        return 0, one, other
    if apart < SAME or other[2] - one[2] > EXCLUDED * misfit(one[2], ranges.count):
        return 1, one, other
    return (2 if _is_located(other, x, y) else 0), one, other
