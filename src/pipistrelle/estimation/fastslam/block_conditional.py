r"""Kernels on a block's landmarks conditional on a caller: correct, place, gate by an excess path.

An excess path depends on two landmarks, the one that echoes and the caller. Given the path, the
landmarks that one caller lights up are independent *given the caller*. So each of them is kept as a
Gaussian that is linear in the place b of the caller, its *parent*,

.. math:: l \mid b \sim N(m + A b,\; C), \qquad b \sim N(\hat b, B),

which is the joint Gaussian of them all. ``slope`` (4 rows) is A, row by row; where it is zero, a
landmark has no parent. ``member`` holds the marginal, :math:`m + A \hat b` and
:math:`C + A B A^T`, but m and C while a frame corrects the map (`shift_by_parent`): then a
measurement changes one landmark and the caller, and no other landmark need be written.

``turn`` is one in the lanes that are corrected and zero elsewhere, ``usable`` where excess paths
count.
"""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from pipistrelle.arithmetic.elementary import arctangent, cosine_and_sine, wrapped
from pipistrelle.estimation.fastslam.block import (
    HEADING,
    LANES,
    LOG_WEIGHT,
    PXX,
    PXY,
    PYY,
    XX,
    XY,
    YY,
    Counts,
    Lanes,
    Member,
    Poses,
    X,
    Y,
)
from pipistrelle.estimation.measurement import (
    MIN_TDOA_SIGMAS,
    NEAREST,
    Row,
    excess_path_slopes,
    range_by_excess_path,
)
from pipistrelle.jit import Flag, Whole, inlined, no_alloc, no_alloc_inlined

AXX, AXY, AYX, AYY = range(0, 4 * LANES, LANES)
SLOPES = 4 * LANES
"""Numbers of a landmark's slopes in a block."""
MAX_RELATIVE_STD = 0.2
"""Excess paths are used where the caller's standard deviation is at most this share of its
distance, and place a landmark where that of the range is: beyond, no Gaussian has the ellipse's
shape."""
Slopes = Float[np.ndarray, " slopes"]


class Pairs(NamedTuple):
    """Landmarks of one block with their parents, and the excess paths of a scan."""

    parent: Int[np.ndarray, " n"]
    slope: Float[np.ndarray, "n slopes"]  # (n, 4 L)
    excess_path: Float[np.ndarray, " m"]
    """of each measurement, by its landmark's parent; NaN where there is none."""
    variance: Float[np.ndarray, " m"]
    turn: Lanes  # array to work with, as are the next two
    usable: Lanes
    row: Member


@no_alloc
def lanes_with_parent(count: Counts, callers: Counts, turn: Lanes) -> Whole:
    """Mark the lanes in which a landmark and its caller have one member each; return how many."""
    turns = 0
    for i in range(LANES):
        has = count[i] == 1 and callers[i] == 1
        turn[i] = 1.0 if has else 0.0
        turns += has
    return turns


@no_alloc
def lanes_with_sure_parent(pose: Poses, caller: Member, callers: Counts, usable: Lanes) -> None:
    """Mark the lanes in which a caller has one member, whose place is known well enough."""
    for i in range(LANES):
        dx, dy = caller[X + i] - pose[X + i], caller[Y + i] - pose[Y + i]
        sure = caller[XX + i] + caller[YY + i] <= MAX_RELATIVE_STD * MAX_RELATIVE_STD * (
            dx * dx + dy * dy
        )
        usable[i] = 1.0 if sure and callers[i] == 1 else 0.0


@no_alloc
def shift_by_parent(caller: Member, member: Member, slope: Slopes, sign: float) -> None:
    """Add the parent's part to a landmark given its parent; with a sign of -1, subtract it."""
    for i in range(LANES):
        Axx, Axy, Ayx, Ayy = slope[AXX + i], slope[AXY + i], slope[AYX + i], slope[AYY + i]
        bx, by = sign * caller[X + i], sign * caller[Y + i]
        Bxx, Bxy, Byy = sign * caller[XX + i], sign * caller[XY + i], sign * caller[YY + i]
        t0, t1 = Bxx * Axx + Bxy * Axy, Bxy * Axx + Byy * Axy
        u0, u1 = Bxx * Ayx + Bxy * Ayy, Bxy * Ayx + Byy * Ayy
        member[X + i] += Axx * bx + Axy * by
        member[Y + i] += Ayx * bx + Ayy * by
        member[XX + i] += Axx * t0 + Axy * t1
        member[XY + i] += Ayx * t0 + Ayy * t1
        member[YY + i] += Ayx * u0 + Ayy * u1


@inlined
def _place(caller: Member, member: Member, slope: Slopes, i: Whole) -> tuple[float, float]:
    """Place of a landmark when its caller is at its mean."""
    bx, by = caller[X + i], caller[Y + i]
    return (
        member[X + i] + slope[AXX + i] * bx + slope[AXY + i] * by,
        member[Y + i] + slope[AYX + i] * bx + slope[AYY + i] * by,
    )


@inlined
def _take(
    caller: Member,
    member: Member,
    slope: Slopes,
    measured: tuple[float, float, float],
    slopes: tuple[float, float, float, float],
    i: Whole,
) -> None:
    """Correct a landmark given its caller, and the caller, by one number.

    ``measured`` is innovation, variance and 1 or 0: whether to use it. ``slopes`` are its
    derivatives by landmark and by caller.
    """
    innovation, variance, part = measured
    q0, q1, f0, f1 = slopes
    g0 = f0 + q0 * slope[AXX + i] + q1 * slope[AYX + i]
    g1 = f1 + q0 * slope[AXY + i] + q1 * slope[AYY + i]
    u0 = member[XX + i] * q0 + member[XY + i] * q1
    u1 = member[XY + i] * q0 + member[YY + i] * q1
    t0 = caller[XX + i] * g0 + caller[XY + i] * g1
    t1 = caller[XY + i] * g0 + caller[YY + i] * g1
    inside = q0 * u0 + q1 * u1 + variance  # were the caller's place known
    k0, k1 = u0 * part / inside, u1 * part / inside
    far = innovation + g0 * caller[X + i] + g1 * caller[Y + i]
    member[X + i] += k0 * far
    member[Y + i] += k1 * far
    member[XX + i] -= k0 * u0
    member[XY + i] -= k0 * u1
    member[YY + i] -= k1 * u1
    slope[AXX + i] -= k0 * g0
    slope[AXY + i] -= k0 * g1
    slope[AYX + i] -= k1 * g0
    slope[AYY + i] -= k1 * g1
    whole = part / (g0 * t0 + g1 * t1 + inside)
    caller[X + i] += t0 * whole * innovation
    caller[Y + i] += t1 * whole * innovation
    caller[XX + i] -= t0 * t0 * whole
    caller[XY + i] -= t0 * t1 * whole
    caller[YY + i] -= t1 * t1 * whole


@inlined
def _offset(
    pose: Poses, caller: Member, member: Member, slope: Slopes, turn: Lanes, i: Whole
) -> tuple[float, float, float, float, float]:
    """Return offset, range and inverse range of a landmark; 1 or 0: whether to correct it."""
    lx, ly = _place(caller, member, slope, i)
    dx, dy = lx - pose[X + i], ly - pose[Y + i]
    near = math.sqrt(dx * dx + dy * dy)
    return dx, dy, near, 1.0 / max(near, NEAREST), turn[i] if near >= NEAREST else 0.0


@no_alloc_inlined
def correct_pair(
    pose: Poses, caller: Member, callers: Counts, n: Whole, pairs: Pairs, row: Row, m: Whole
) -> None:
    """Correct landmark n, copied to ``pairs.row``, and its caller by all of measurement m."""
    member, slope, turn = pairs.row, pairs.slope[n], pairs.turn
    for i in range(LANES):
        dx, dy, _, k, part = _offset(pose, caller, member, slope, turn, i)
        innovation = wrapped(pose[HEADING + i] + row.bearing - arctangent(dy, dx))
        slopes = -dy * k * k, dx * k * k, 0.0, 0.0
        _take(caller, member, slope, (innovation, row.bearing_variance, part), slopes, i)
    if not math.isnan(row.range):
        for i in range(LANES):
            dx, dy, near, k, part = _offset(pose, caller, member, slope, turn, i)
            measured = row.range - near, row.range_variance, part
            _take(caller, member, slope, measured, (dx * k, dy * k, 0.0, 0.0), i)
    if not math.isnan(pairs.excess_path[m]):
        lanes_with_sure_parent(pose, caller, callers, pairs.usable)
        for i in range(LANES):
            lx, ly = _place(caller, member, slope, i)
            e, q0, q1, f0, f1 = excess_path_slopes(
                pose[X + i], pose[Y + i], lx, ly, caller[X + i], caller[Y + i]
            )
            measured = pairs.excess_path[m] - e, pairs.variance[m], turn[i] * pairs.usable[i]
            _take(caller, member, slope, measured, (q0, q1, f0, f1), i)


@inlined
def _steady(
    dx: float,
    dy: float,
    direction: float,
    excess_path: float,
    off: tuple[float, float],
    distance: float,
) -> Flag:
    """Tell if errors of direction and excess path change a range by at most `MAX_RELATIVE_STD`."""
    steady, most = True, MAX_RELATIVE_STD * distance
    for sign in (-1.0, 1.0):
        c, s = cosine_and_sine(direction + sign * off[0])
        steady = steady and abs(range_by_excess_path(excess_path, dx, dy, c, s) - distance) <= most
        c, s = cosine_and_sine(direction)
        later = range_by_excess_path(excess_path + sign * off[1], dx, dy, c, s)
        steady = steady and abs(later - distance) <= most
    return steady


@no_alloc
def place_by_excess_path(
    pose: Poses,
    caller: Member,
    member: Member,
    slope: Slopes,
    heard: tuple[float, float, float, float],
    count: Counts,
    usable: Lanes,
) -> None:
    """Place landmarks that are rays by bearing and excess path, where their range is sure enough.

    ``heard`` is bearing and excess path, then their variances. The landmark gets the caller as its
    parent, and its ray is dropped. Where caller and landmark are in line a slope tells nothing, so
    both errors are tried, too; an excess path that may be 0 (`MIN_TDOA_SIGMAS`) places nothing.
    """
    bearing, excess_path, bearing_variance, excess_path_variance = heard
    off = math.sqrt(bearing_variance), math.sqrt(excess_path_variance)
    if excess_path <= MIN_TDOA_SIGMAS * off[1]:
        return
    for i in range(LANES):
        if usable[i] == 0.0 or count[i] == 1:
            continue
        direction, x, y = pose[HEADING + i] + bearing, pose[X + i], pose[Y + i]
        c, s = cosine_and_sine(direction)
        bx, by = caller[X + i], caller[Y + i]
        r = range_by_excess_path(excess_path, bx - x, by - y, c, s)
        if not (NEAREST < r < math.inf and _steady(bx - x, by - y, direction, excess_path, off, r)):
            continue
        _, q0, q1, f0, f1 = excess_path_slopes(x, y, x + r * c, y + r * s, bx, by)
        steep = q0 * c + q1 * s  # of the excess path along the ray: none between vehicle and caller
        if steep <= NEAREST:
            continue
        turned, along = r * (q0 * s - q1 * c) / steep, excess_path_variance / (steep * steep)
        ax, ay = -f0 / steep, -f1 / steep
        spread = ax * ax * caller[XX + i] + 2.0 * ax * ay * caller[XY + i]
        spread += ay * ay * caller[YY + i] + along + turned * turned * bearing_variance
        if spread > MAX_RELATIVE_STD * MAX_RELATIVE_STD * r * r:
            continue
        count[i] = 1
        tx, ty, still = c * turned - s * r, s * turned + c * r, r - ax * bx - ay * by
        member[X + i], member[Y + i] = x + c * still, y + s * still
        member[XX + i] = c * c * along + tx * tx * bearing_variance
        member[XY + i] = c * s * along + tx * ty * bearing_variance
        member[YY + i] = s * s * along + ty * ty * bearing_variance
        member[LOG_WEIGHT + i] = 0.0
        slope[AXX + i], slope[AXY + i], slope[AYX + i], slope[AYY + i] = (
            c * ax,
            c * ay,
            s * ax,
            s * ay,
        )


@no_alloc
def excess_path_beyond(
    pose: Poses,
    caller: Member,
    member: Member,
    slope: Slopes,
    excess_path: float,
    variance: float,
    turn: Lanes,
    bound: float,
) -> bool:
    """Tell whether an excess path is beyond the bound for every lane, and all have a turn."""
    beyond = 0
    for i in range(LANES):
        e, q0, q1, f0, f1 = excess_path_slopes(
            pose[X + i], pose[Y + i], member[X + i], member[Y + i], caller[X + i], caller[Y + i]
        )
        p0, p1 = -q0 - f0, -q1 - f1
        g0 = f0 + 2.0 * (q0 * slope[AXX + i] + q1 * slope[AYX + i])
        g1 = f1 + 2.0 * (q0 * slope[AXY + i] + q1 * slope[AYY + i])
        S = p0 * p0 * pose[PXX + i] + 2.0 * p0 * p1 * pose[PXY + i] + p1 * p1 * pose[PYY + i]
        S += q0 * q0 * member[XX + i] + 2.0 * q0 * q1 * member[XY + i] + q1 * q1 * member[YY + i]
        S += f0 * (caller[XX + i] * g0 + caller[XY + i] * g1)
        S += f1 * (caller[XY + i] * g0 + caller[YY + i] * g1) + variance
        beyond += 0 if turn[i] == 0.0 or (excess_path - e) * (excess_path - e) <= bound * S else 1
    return beyond == LANES
