r"""The search for a caller's place by excess paths over landmarks that are not known either.

Given the caller's place, a row's bearing and excess path are a point; those of one landmark are one
point at all times only where the caller truly is. The search takes a grid of ranges and bearings
about the direct call, for each place the misfit of all tracks (`misfit`: points as robust means of
what their rows say, headings as medians over tracks, residuals that count no more than
:math:`3 \sigma`), goes downhill from the best, and believes it if what is at another range fits
clearly worse.
"""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from pipistrelle.estimation.data_association.tracks import TURN, Tracks, in_window
from pipistrelle.geometry import wrap_angle
from pipistrelle.jit import kernel, no_alloc

SCANS, SIGHTINGS, LEAST_TRACKS = 14, 4, 8
"""Scans that are looked at, sightings that make a track count, and how many of them it takes."""
RANGES = np.geomspace(2.5, 45.0, 22)
"""[m]"""
BEARINGS = np.array([-0.1, -0.05, 0.0, 0.05, 0.1])
"""Off the direct call [rad]."""
ANOTHER, CLEARLY, WELL = math.log(1.5), 25.0, 2.6
"""Factor of another range, by how much it must fit worse, and the most that a row may misfit."""
DIRECT_STD, LEAST_BEARING_STD, LEAST_WAY_STD = 0.05, 0.01, 0.05
"""Least deviations: of the direct call, of other bearings [rad], and of excess paths [m]."""
FARTHEST, NEAREST = 80.0, 0.05
"""Largest range of a landmark, and least distance from the caller [m]."""
CAP = 9.0
"""A row's misfit counts no more."""
PASSES, WEIGHINGS = 3, 2


class Found(NamedTuple):
    """A caller's place."""

    x: float
    y: float
    misfit: float
    """Per row."""
    ahead: float
    """By how much places at other ranges misfit more."""
    tracks: int

    @property
    def sure(self) -> bool:
        """Whether it is to be believed."""
        return self.ahead > CLEARLY and self.misfit < WELL and self.tracks >= LEAST_TRACKS


def find_caller(tracks: Tracks) -> Found | None:
    """Return where a caller is by its tracks; None where they are too few, or it was not heard."""
    table, poses, direct = in_window(tracks, SCANS, SIGHTINGS)
    heard = direct[~np.isnan(direct)]
    if len(table) < LEAST_TRACKS or not heard.size:
        return None
    here, towards = poses[-1, :2], heard[-1]
    grid = [(r, towards + b) for r in RANGES.tolist() for b in BEARINGS.tolist()]
    places = [here + r * np.array([math.cos(a), math.sin(a)]) for r, a in grid]
    misfits = np.array([misfit(place, poses, table, direct) for place in places])
    best = int(misfits.argmin())
    place, least = _downhill(
        places[best], misfits[best], 0.12 * grid[best][0], (poses, table, direct)
    )
    distance = math.hypot(*(place - here))
    others = np.abs(np.log(np.array([r for r, _ in grid]) / distance)) > ANOTHER
    rows = int(np.count_nonzero(~np.isnan(table[..., 0])))
    ahead = float(misfits[others].min(initial=math.inf) - least)
    return Found(float(place[0]), float(place[1]), least / rows, ahead, len(table))


def _downhill(
    place: Float[np.ndarray, "2"], least: float, step: float, seen: tuple[np.ndarray, ...]
) -> tuple[Float[np.ndarray, "2"], float]:
    """Return the place of the least misfit near a place, by a pattern search, and its misfit."""
    poses, table, direct = seen
    end = step / 12.0
    while step > end:
        for a in np.arange(8) * np.pi / 4.0:
            other = place + step * np.array([math.cos(a), math.sin(a)])
            value = misfit(other, poses, table, direct)
            if value < least:
                place, least = other, value
                break
        else:
            step *= 0.5
    return place, least


@kernel
def misfit(
    place: Float[np.ndarray, "2"],
    poses: Float[np.ndarray, "k 3"],
    table: Float[np.ndarray, "t k 4"],
    direct: Float[np.ndarray, " k"],
) -> float:
    """Return the misfit of all rows, were the caller at a place [squared deviations]."""
    tracks, scans = table.shape[0], table.shape[1]
    turn, off = np.zeros(scans), np.full((tracks, scans), np.nan)
    points, total = np.empty((scans, 5)), 0.0
    for number in range(PASSES):
        total = 0.0
        for t in range(tracks):
            total += _of_track(place, poses, table[t], turn, points, off[t])
        if number < PASSES - 1:
            _correct_headings(off, turn)
    for k in range(scans):
        if not math.isnan(direct[k]):
            towards = math.atan2(place[1] - poses[k, 1], place[0] - poses[k, 0])
            sight = wrap_angle(direct[k] + turn[k] - towards) / DIRECT_STD
            total += min(sight * sight, CAP)
        if k > 0:
            total += ((turn[k] - turn[k - 1]) / TURN) ** 2
    return total


@no_alloc
def _of_track(
    place: Float[np.ndarray, "2"],
    poses: Float[np.ndarray, "k 3"],
    rows: Float[np.ndarray, "k 4"],
    turn: Float[np.ndarray, " k"],
    points: Float[np.ndarray, "k 5"],
    off: Float[np.ndarray, " k"],
) -> float:
    """Return the misfit of a track; write how far its bearings are off.

    ``points``: room for each row's point, its direction and its variances along and across.
    """
    x, y, weight = 0.0, 0.0, 0.0
    for k in range(rows.shape[0]):
        _write_point(place, poses[k], rows[k], turn[k], points[k])
        if not math.isnan(points[k, 0]):
            share = 1.0 / (points[k, 3] + points[k, 4] + 4e-4)
            x, y, weight = x + share * points[k, 0], y + share * points[k, 1], weight + share
    for number in range(1 + WEIGHINGS if weight > 0.0 else 0):
        x, y = _weighed(points, x, y) if number else (x / weight, y / weight)
    total, onward = 0.0, math.hypot(x - place[0], y - place[1])
    for k in range(rows.shape[0]):
        if math.isnan(rows[k, 0]):
            continue
        if math.isnan(points[k, 0]):
            total += CAP
            continue
        dx, dy = x - poses[k, 0], y - poses[k, 1]
        straight = math.hypot(place[0] - poses[k, 0], place[1] - poses[k, 1])
        off[k] = wrap_angle(rows[k, 0] + turn[k] - math.atan2(dy, dx))
        path = onward + math.hypot(dx, dy) - straight
        across = off[k] / math.hypot(rows[k, 2], LEAST_BEARING_STD)
        along = (rows[k, 1] - path) / math.hypot(rows[k, 3], LEAST_WAY_STD)
        total += min(across * across + along * along, CAP)
    return total


@no_alloc
def _weighed(points: Float[np.ndarray, "k 5"], x: float, y: float) -> tuple[float, float]:
    """Return the mean of points, of which those far from another mean count less."""
    sx, sy, weight = 0.0, 0.0, 0.0
    for k in range(points.shape[0]):
        if math.isnan(points[k, 0]):
            continue
        c, s = math.cos(points[k, 2]), math.sin(points[k, 2])
        dx, dy = points[k, 0] - x, points[k, 1] - y
        along, across = c * dx + s * dy, c * dy - s * dx
        squared = along * along / points[k, 3] + across * across / (points[k, 4] + 1e-4)
        share = 1.0 / ((points[k, 3] + points[k, 4] + 4e-4) * (1.0 + 0.25 * squared))
        sx, sy, weight = sx + share * points[k, 0], sy + share * points[k, 1], weight + share
    return sx / weight, sy / weight


@no_alloc
def _write_point(
    place: Float[np.ndarray, "2"],
    pose: Float[np.ndarray, "3"],
    row: Float[np.ndarray, "4"],
    turn: float,
    point: Float[np.ndarray, "5"],
) -> None:
    """Write a row's point, direction and variances along and across; NaN where there is none."""
    point[0], angle = math.nan, row[0] + turn
    if math.isnan(row[0]):
        return
    c, s = math.cos(angle), math.sin(angle)
    wx, wy = pose[0] - place[0], pose[1] - place[1]
    straight = math.sqrt(wx * wx + wy * wy)
    whole = straight + max(row[1], 0.02)
    down = whole + wx * c + wy * s
    far = 0.5 * row[1] * (2.0 * straight + row[1]) / max(down, 1e-3)
    if not 0.0 < far < FARTHEST:
        return
    fx, fy = wx + far * c, wy + far * s
    onward = max(math.sqrt(fx * fx + fy * fy), NEAREST)
    by_range = max(1.0 + (fx * c + fy * s) / onward, 0.02)
    by_bearing = far * (c * fy - s * fx) / onward
    along = by_bearing / by_range * row[2], math.hypot(row[3], 0.03) / by_range
    point[0], point[1], point[2] = pose[0] + far * c, pose[1] + far * s, angle
    point[3] = along[0] * along[0] + along[1] * along[1]
    point[4] = (far * math.hypot(row[2], LEAST_BEARING_STD)) ** 2


@kernel
def _correct_headings(off: Float[np.ndarray, "t k"], turn: Float[np.ndarray, " k"]) -> None:
    """Turn each scan by the median of what its bearings are off, the last one by nothing."""
    scans = turn.size
    medians = np.zeros(scans)
    for k in range(scans):
        seen = off[:, k][~np.isnan(off[:, k])]
        if seen.size >= 3:
            medians[k] = np.median(seen)
    for k in range(scans):
        turn[k] -= min(max(medians[k] - medians[scans - 1], -0.1), 0.1)
