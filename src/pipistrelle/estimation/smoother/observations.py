r"""What a sensor on the vehicle should measure, and the slopes of that by all unknowns.

A row of slopes is written to the work's entries: three by the pose, further ones by moving callers,
one that is left for the misfit, and those by the border. What the vehicle does not know of its
sensor stands there, too: with an offset l and a turn :math:`\delta` in the axes of a pose
(p, :math:`\theta`), the sensor is at :math:`p + R(\theta) l` and looks along
:math:`\theta + \delta`. Where its clock is late by :math:`\tau`, it heard while the vehicle
where it was :math:`\tau` before, by the velocities v ahead and to the left and :math:`\omega` that
lead along the way to the node:
:math:`p - \tau R(\theta - \tfrac12 \tau \omega) v`, :math:`\theta - \tau \omega`; callers count as
standing meanwhile. Where the true speed of sound is k times the one that ranges r and excess
paths were computed with, these measure r / k, and a bearing is off by its slope (`Scan`) times
k - 1 and what else leans on that slope.
"""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from pipistrelle.detection.scans import BEARING, SLOPE
from pipistrelle.estimation.measurement import excess_path_slopes
from pipistrelle.estimation.smoother.records import CALLER, POSE, Places, Points, Work
from pipistrelle.jit import Whole, no_alloc

MISFIT = POSE
"""Entry of a row that is left for its misfit, before places of the chain are inserted."""
Point = tuple[Whole, float, float]
"""Where a place stands among the unknowns, and its x and y [m]."""
Seen = tuple[float, float, float, float, float]
"""Of a point: what `estimation.measurement.observe` returns."""


class View(NamedTuple):
    """The sensor's pose at a node, and what of it is not known."""

    x: float
    y: float
    heading: float
    c: float  # of the vehicle's heading
    s: float
    away_x: float  # of the sensor from the vehicle, in the world's axes
    away_y: float
    by_late: tuple[float, float, float]  # slopes of the sensor's pose by how late its clock is
    scale: float  # true speed of sound over the one that was assumed, k
    lean: float  # by which slopes of bearings are multiplied, about k - 1
    columns: tuple[Whole, Whole, Whole, Whole]  # as `Places.sensor`
    known: bool  # whether nothing of the sensor is estimated


@no_alloc
def view_of(
    pose: Float[np.ndarray, " d"], border: Float[np.ndarray, " n"], places: Places, k: Whole
) -> View:
    """Return the view from a pose of node k."""
    sensor = places.sensor
    sound, turned, place, clock = sensor[0], sensor[1], sensor[2], sensor[3]
    heading, x, y = pose[2], 0.0, 0.0
    back = (0.0, 0.0, 0.0, 0.0, 0.0)
    if clock > 0 and places.seconds[k] > 0.0:
        back = _steps_back(heading, border[clock], places.way[k], places.seconds[k])
        heading += border[clock] * back[4]
    c, s = math.cos(heading), math.sin(heading)
    if place > 0:
        x = c * border[place] - s * border[place + 1]
        y = s * border[place] + c * border[place + 1]
    by_late = back[2] - back[4] * y, back[3] + back[4] * x, back[4]
    if clock > 0:
        x, y = x + back[0], y + back[1]
    heading += border[turned] if turned > 0 else 0.0
    off = border[sound] if sound > 0 else 0.0
    lean = off + border[sound + 1] if sound > 0 else 0.0
    at = pose[0] + x, pose[1] + y, heading
    columns, known = (sound, turned, place, clock), sound + turned + place + clock == 0
    return View(*at, c, s, x, y, by_late, 1.0 + off, lean, columns, known)


@no_alloc
def _steps_back(
    heading: float, late: float, way: Float[np.ndarray, " 3"], seconds: float
) -> tuple[float, float, float, float, float]:
    """Return how far a vehicle was back along the way to a node, by how late a clock is.

    First in the world's axes, then the slopes of that and of the heading.
    """
    half = 0.5 * way[2]
    along = half / math.tan(half) if abs(half) > 1e-9 else 1.0
    ahead = (along * way[0] + half * way[1]) / seconds
    left = (along * way[1] - half * way[0]) / seconds
    turn = 0.5 * late * way[2] / seconds
    c, s = math.cos(heading - turn), math.sin(heading - turn)
    x, y = -(c * ahead - s * left), -(s * ahead + c * left)
    return late * x, late * y, x + turn * y, y - turn * x, -way[2] / seconds


@no_alloc
def point_of(slot: Whole, k: Whole, places: Places, points: Points) -> Point:
    """Return where a slot stands among the unknowns (`Places`) and its place, from node k.

    A moving caller is nowhere before it joined the chain.
    """
    i, (at, border) = places.index[slot], points
    if i > 0:
        return i, border[i], border[i + 1]
    if i < 0 and k >= places.first[(-i - POSE) // CALLER]:
        return i, at[k, -i], at[k, -i + 1]
    return 0, 0.0, 0.0


@no_alloc
def bearing_of(view: View, seen: Seen, slope: float) -> float:
    """Return the bearing that is measured of a point; ``slope``: that by the speed of sound."""
    return seen[1] if math.isnan(slope) else seen[1] - slope * view.lean


@no_alloc
def direction_of(view: View, numbers: Float[np.ndarray, " 8"]) -> float:
    """Return the direction in the world from which a row's bearing was heard."""
    angle = view.heading + numbers[BEARING]
    return angle if math.isnan(numbers[SLOPE]) else angle + numbers[SLOPE] * view.lean


@no_alloc
def write_bearing(
    work: Work, view: View, seen: Seen, slope: float, i: Whole
) -> tuple[Whole, Whole]:
    """Write the slopes of the bearing of a point that stands at i.

    Returns how many of the entries are of the chain, and how many there are; so do the others.
    """
    _, _, c, s, inverse = seen
    lean = 0.0 if math.isnan(slope) else -slope
    size = _write_view(work, view, (s * inverse, -c * inverse, -1.0), lean, lean)
    return _write_point(work, POSE, size, i, -s * inverse, c * inverse)


@no_alloc
def write_range(work: Work, view: View, seen: Seen, i: Whole) -> tuple[Whole, Whole]:
    """Write the slopes of the range of a point that stands at i."""
    distance, _, c, s, _ = seen
    k = 1.0 / view.scale
    size = _write_view(work, view, (-k * c, -k * s, 0.0), -distance * k * k, 0.0)
    return _write_point(work, POSE, size, i, k * c, k * s)


@no_alloc
def write_excess_path(
    work: Work, view: View, ends: tuple[Point, Point]
) -> tuple[float, Whole, Whole]:
    """Write the slopes of an excess path over a point, from a caller; return it, too, first."""
    (i, px, py), (j, bx, by) = ends
    path, lx, ly, cx, cy = excess_path_slopes(view.x, view.y, px, py, bx, by)
    k = 1.0 / view.scale
    size = _write_view(work, view, (-k * (lx + cx), -k * (ly + cy), 0.0), -path * k * k, 0.0)
    chain, size = _write_point(work, POSE, size, i, k * lx, k * ly)
    chain, size = _write_point(work, chain, size, j, k * cx, k * cy)
    return path * k, chain, size


@no_alloc
def _write_view(
    work: Work, view: View, by_pose: tuple[float, float, float], by_scale: float, by_lean: float
) -> Whole:
    """Write slopes by the sensor's pose as those by the vehicle's and by what is not known of it.

    Returns how many entries there are.
    """
    at, slope, size, (by_x, by_y, by_heading) = work.at, work.slope, MISFIT + 1, by_pose
    sound, turned, place, clock = view.columns
    for a in range(POSE):
        at[a] = a
    slope[0], slope[1] = by_x, by_y
    slope[2] = by_heading + (by_y * view.away_x - by_x * view.away_y)
    at[MISFIT], slope[MISFIT] = 0, 0.0
    if sound > 0:
        at[size], at[size + 1] = sound, sound + 1
        slope[size], slope[size + 1] = by_scale, by_lean
        size += 2
    if turned > 0:
        at[size], slope[size] = turned, by_heading
        size += 1
    if place > 0:
        at[size], at[size + 1] = place, place + 1
        slope[size] = view.c * by_x + view.s * by_y
        slope[size + 1] = view.c * by_y - view.s * by_x
        size += 2
    if clock > 0:
        late_x, late_y, turn = view.by_late
        at[size], slope[size] = clock, by_x * late_x + by_y * late_y + by_heading * turn
        size += 1
    return size


@no_alloc
def _write_point(
    work: Work, chain: Whole, size: Whole, i: Whole, by_x: float, by_y: float
) -> tuple[Whole, Whole]:
    """Add the slopes by a place to a row of so many entries, the first of them of the chain."""
    if i > 0:
        work.at[size], work.at[size + 1] = i, i + 1
        work.slope[size], work.slope[size + 1] = by_x, by_y
        return chain, size + 2
    for e in range(size - 1, chain - 1, -1):
        work.at[e + 2], work.slope[e + 2] = work.at[e], work.slope[e]
    work.at[chain], work.at[chain + 1] = -i, 1 - i
    work.slope[chain], work.slope[chain + 1] = by_x, by_y
    return chain + 2, size + 2
