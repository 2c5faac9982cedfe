r"""Kernels on a block's landmarks that are tied to a caller: correct, place, gate by a detour.

A detour is of two landmarks, the one that echoes and the caller. Given the path, the landmarks that
one caller lights up are independent *given the caller*, too: a star. So a map stays as small as it
was, where each of them says how it moves with the caller b,

.. math:: l \mid b \sim N(m + A b,\; C), \qquad b \sim N(\hat b, B).

``tie`` (4 rows) are the slopes A, row by row; where A is zero a landmark is as it ever was.
``member`` holds what a landmark is for itself, :math:`m + A \hat b` and :math:`C + A B A^T`, but
m and C while a frame corrects the map (`shift`): then what is measured of one landmark changes
itself and the caller, and nothing need be written of the others. It is the joint Gaussian of all.

``turn`` is one in the lanes that are meant and zero elsewhere, ``timed`` where detours count.
"""

import math

import numpy as np
from jaxtyping import Float

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
from pipistrelle.estimation.measurement import NEAREST, SOME, detour_slopes, range_by_detour
from pipistrelle.jit import Flag, Whole, inlined, no_alloc

AXX, AXY, AYX, AYY = range(0, 4 * LANES, LANES)
TIE = 4 * LANES
"""Numbers of a landmark's tie in a block."""
SURE = 0.2
"""A caller's detours count where its place is known to this share of how far away it is, and place
a landmark where they tell its range to this share: beyond, no Gaussian has the ellipse's shape."""
Tie = Float[np.ndarray, " slopes"]


@no_alloc
def joined(count: Counts, callers: Counts, turn: Lanes) -> Whole:
    """Tell lanes in which a landmark and its caller have one member each, and how many."""
    turns = 0
    for i in range(LANES):
        has = count[i] == 1 and callers[i] == 1
        turn[i] = 1.0 if has else 0.0
        turns += has
    return turns


@no_alloc
def known_surely(pose: Poses, caller: Member, callers: Counts, timed: Lanes) -> None:
    """Tell lanes in which a caller's detours count: it has one member, known surely enough."""
    for i in range(LANES):
        dx, dy = caller[X + i] - pose[X + i], caller[Y + i] - pose[Y + i]
        sure = caller[XX + i] + caller[YY + i] <= SURE * SURE * (dx * dx + dy * dy)
        timed[i] = 1.0 if sure and callers[i] == 1 else 0.0


@no_alloc
def shift(caller: Member, member: Member, tie: Tie, sign: float) -> None:
    """Add to a landmark given its caller what the caller adds; or, the sign being -1, take it."""
    for i in range(LANES):
        Axx, Axy, Ayx, Ayy = tie[AXX + i], tie[AXY + i], tie[AYX + i], tie[AYY + i]
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
def _place(caller: Member, member: Member, tie: Tie, i: Whole) -> tuple[float, float]:
    """Where a landmark is, its caller being where it is."""
    bx, by = caller[X + i], caller[Y + i]
    return (
        member[X + i] + tie[AXX + i] * bx + tie[AXY + i] * by,
        member[Y + i] + tie[AYX + i] * bx + tie[AYY + i] * by,
    )


@inlined
def _take(
    caller: Member,
    member: Member,
    tie: Tie,
    measured: tuple[float, float, float],
    slopes: tuple[float, float, float, float],
    i: Whole,
) -> None:
    """Correct a landmark given its caller, and the caller, by one number.

    ``measured`` are innovation, variance and a part, all or nothing; ``slopes`` are by landmark and
    by caller.
    """
    innovation, variance, part = measured
    q0, q1, f0, f1 = slopes
    g0 = f0 + q0 * tie[AXX + i] + q1 * tie[AYX + i]
    g1 = f1 + q0 * tie[AXY + i] + q1 * tie[AYY + i]
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
    tie[AXX + i] -= k0 * g0
    tie[AXY + i] -= k0 * g1
    tie[AYX + i] -= k1 * g0
    tie[AYY + i] -= k1 * g1
    whole = part / (g0 * t0 + g1 * t1 + inside)
    caller[X + i] += t0 * whole * innovation
    caller[Y + i] += t1 * whole * innovation
    caller[XX + i] -= t0 * t0 * whole
    caller[XY + i] -= t0 * t1 * whole
    caller[YY + i] -= t1 * t1 * whole


@no_alloc
def take_bearing(
    pose: Poses,
    caller: Member,
    member: Member,
    tie: Tie,
    bearing: float,
    variance: float,
    turn: Lanes,
) -> None:
    """Correct a landmark and its caller by the landmark's bearing from certain poses."""
    for i in range(LANES):
        lx, ly = _place(caller, member, tie, i)
        dx, dy = lx - pose[X + i], ly - pose[Y + i]
        near = math.sqrt(dx * dx + dy * dy)
        k = 1.0 / max(near, NEAREST)
        innovation = wrapped(pose[HEADING + i] + bearing - arctangent(dy, dx))
        part = turn[i] if near >= NEAREST else 0.0
        slopes = -dy * k * k, dx * k * k, 0.0, 0.0
        _take(caller, member, tie, (innovation, variance, part), slopes, i)


@no_alloc
def take_range(
    pose: Poses,
    caller: Member,
    member: Member,
    tie: Tie,
    distance: float,
    variance: float,
    turn: Lanes,
) -> None:
    """Correct a landmark and its caller by the landmark's range from certain poses."""
    for i in range(LANES):
        lx, ly = _place(caller, member, tie, i)
        dx, dy = lx - pose[X + i], ly - pose[Y + i]
        near = math.sqrt(dx * dx + dy * dy)
        k = 1.0 / max(near, NEAREST)
        part = turn[i] if near >= NEAREST else 0.0
        slopes = dx * k, dy * k, 0.0, 0.0
        _take(caller, member, tie, (distance - near, variance, part), slopes, i)


@no_alloc
def take_detour(
    pose: Poses,
    caller: Member,
    member: Member,
    tie: Tie,
    detour: float,
    variance: float,
    turn: Lanes,
    timed: Lanes,
) -> None:
    """Correct a landmark and its caller by a detour to certain poses, where detours count."""
    for i in range(LANES):
        lx, ly = _place(caller, member, tie, i)
        e, q0, q1, f0, f1 = detour_slopes(
            pose[X + i], pose[Y + i], lx, ly, caller[X + i], caller[Y + i]
        )
        part = turn[i] * timed[i]
        _take(caller, member, tie, (detour - e, variance, part), (q0, q1, f0, f1), i)


@inlined
def _steady(
    dx: float, dy: float, direction: float, detour: float, off: tuple[float, float], distance: float
) -> Flag:
    """Whether a range stays the same, but for a share `SURE`, where direction or detour is off."""
    steady, most = True, SURE * distance
    for sign in (-1.0, 1.0):
        c, s = cosine_and_sine(direction + sign * off[0])
        steady = steady and abs(range_by_detour(detour, dx, dy, c, s) - distance) <= most
        c, s = cosine_and_sine(direction)
        later = range_by_detour(detour + sign * off[1], dx, dy, c, s)
        steady = steady and abs(later - distance) <= most
    return steady


@no_alloc
def place_by_detour(
    pose: Poses,
    caller: Member,
    member: Member,
    tie: Tie,
    heard: tuple[float, float, float, float],
    count: Counts,
    timed: Lanes,
) -> None:
    """Place landmarks of not one member by bearing and detour, where these are sure enough.

    ``heard`` are bearing and detour, then their variances. The landmark is tied to the caller; what
    was known of its ray is let go. Where caller and landmark are in line a slope tells nothing, so
    both errors are tried, too; and what may be no detour (`SOME`) places nothing.
    """
    bearing, detour, bearing_variance, detour_variance = heard
    off = math.sqrt(bearing_variance), math.sqrt(detour_variance)
    if detour <= SOME * off[1]:
        return
    for i in range(LANES):
        if timed[i] == 0.0 or count[i] == 1:
            continue
        direction, x, y = pose[HEADING + i] + bearing, pose[X + i], pose[Y + i]
        c, s = cosine_and_sine(direction)
        bx, by = caller[X + i], caller[Y + i]
        r = range_by_detour(detour, bx - x, by - y, c, s)
        if not (NEAREST < r < math.inf and _steady(bx - x, by - y, direction, detour, off, r)):
            continue
        _, q0, q1, f0, f1 = detour_slopes(x, y, x + r * c, y + r * s, bx, by)
        steep = q0 * c + q1 * s  # of the detour along the ray: none between vehicle and caller
        if steep <= NEAREST:
            continue
        turned, along = r * (q0 * s - q1 * c) / steep, detour_variance / (steep * steep)
        ax, ay = -f0 / steep, -f1 / steep
        spread = ax * ax * caller[XX + i] + 2.0 * ax * ay * caller[XY + i]
        spread += ay * ay * caller[YY + i] + along + turned * turned * bearing_variance
        if spread > SURE * SURE * r * r:
            continue
        count[i] = 1
        tx, ty, still = c * turned - s * r, s * turned + c * r, r - ax * bx - ay * by
        member[X + i], member[Y + i] = x + c * still, y + s * still
        member[XX + i] = c * c * along + tx * tx * bearing_variance
        member[XY + i] = c * s * along + tx * ty * bearing_variance
        member[YY + i] = s * s * along + ty * ty * bearing_variance
        member[LOG_WEIGHT + i] = 0.0
        tie[AXX + i], tie[AXY + i], tie[AYX + i], tie[AYY + i] = c * ax, c * ay, s * ax, s * ay


@no_alloc
def detour_beyond(
    pose: Poses,
    caller: Member,
    member: Member,
    tie: Tie,
    detour: float,
    variance: float,
    turn: Lanes,
    bound: float,
) -> bool:
    """Whether a detour is beyond the bound for every lane; one that has no turn lets it in."""
    beyond = 0
    for i in range(LANES):
        e, q0, q1, f0, f1 = detour_slopes(
            pose[X + i], pose[Y + i], member[X + i], member[Y + i], caller[X + i], caller[Y + i]
        )
        p0, p1 = -q0 - f0, -q1 - f1
        g0 = f0 + 2.0 * (q0 * tie[AXX + i] + q1 * tie[AYX + i])
        g1 = f1 + 2.0 * (q0 * tie[AXY + i] + q1 * tie[AYY + i])
        S = p0 * p0 * pose[PXX + i] + 2.0 * p0 * p1 * pose[PXY + i] + p1 * p1 * pose[PYY + i]
        S += q0 * q0 * member[XX + i] + 2.0 * q0 * q1 * member[XY + i] + q1 * q1 * member[YY + i]
        S += f0 * (caller[XX + i] * g0 + caller[XY + i] * g1)
        S += f1 * (caller[XY + i] * g0 + caller[YY + i] * g1) + variance
        beyond += 0 if turn[i] == 0.0 or (detour - e) * (detour - e) <= bound * S else 1
    return beyond == LANES
