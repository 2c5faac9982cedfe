"""Rows of one caller, followed from scan to scan before it is known where the caller is.

Bearing (in the world) and excess path of a landmark change little from scan to scan, and evenly. A
row goes on with the track that it continues best (`matching.nearest`); a sure row that continues
none begins one.
"""

from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float

from pipistrelle.estimation.data_association.pairs import NOTHING, Rows, nearest
from pipistrelle.geometry import wrap

SIGHTINGS = 3
"""How many of the last sightings say how a track goes on."""
SCAN, BEARING, WAY, BEARING_STD, WAY_STD, LEVEL, X, Y = range(8)
"""Numbers of a sighting; the bearing is one in the world, x and y are the vehicle's."""
SILENT, EVEN = 4, 6
"""Scans after which a track has ended, and over which its last sightings are taken for even."""
TURN = 0.03
"""How much dead reckoning loses of the heading from scan to scan [rad]."""
CLUTTER, NEW_BEARING_STD, NEW_WAY_STD, GATE, LEVEL_STD = 0.075, 0.05, 0.3, 12.0, 5.0
"""Clutter per rad and m over the probability of detection; least certainty of a first sighting
[rad, m]; largest squared distance; of levels [dB]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Tracks:
    """All that was heard of a caller that is not on the map."""

    poses: Float[np.ndarray, "k 3"] = field(default_factory=lambda: np.empty((0, 3)))
    """Of the vehicle at each scan, as it was believed then."""
    times: Float[np.ndarray, " k"] = field(default_factory=lambda: np.empty(0))
    """[s]"""
    direct: Float[np.ndarray, " k"] = field(default_factory=lambda: np.empty(0))
    """World bearing of the caller itself, or NaN."""
    rows: tuple[Float[np.ndarray, "r 5"], ...] = ()
    """Of each scan number of the track, world bearing, excess path, and their deviations."""
    last: Float[np.ndarray, "t 3 8"] = field(default_factory=lambda: np.empty((0, SIGHTINGS, 8)))
    """Last sightings of each track, the newest first; NaN before the first."""


def followed(
    tracks: Tracks, time: float, pose: Float[np.ndarray, "3"], direct: float, rows: Rows
) -> Tracks:
    """Return tracks with one scan more.

    ``direct``: bearing of the caller's own call, or NaN.
    """
    now, (x, y, heading) = len(tracks.poses), pose
    ones = np.ones(len(rows.bearing))
    seen = np.column_stack(
        (now * ones, rows.bearing + heading, *rows[2:3], *rows[1:2], *rows[3:], x * ones, y * ones)
    )
    going = np.flatnonzero(now - tracks.last[:, 0, SCAN] <= SILENT)
    of = nearest(_costs(seen, tracks.last[going], (now, x, y)))
    track = np.where(of == NOTHING, NOTHING, going[of] if going.size else NOTHING)
    fresh = (track == NOTHING) & (seen[:, BEARING_STD] < NEW_BEARING_STD)
    fresh &= seen[:, WAY_STD] < NEW_WAY_STD
    track[fresh] = len(tracks.last) + np.arange(fresh.sum())
    more = np.full((fresh.sum(), SIGHTINGS, 8), np.nan)
    last, kept = np.concatenate([tracks.last, more]), track != NOTHING
    last[track[kept], 1:] = last[track[kept], :-1]
    last[track[kept], 0] = seen[kept]
    columns = seen[kept][:, [BEARING, WAY, BEARING_STD, WAY_STD]]
    return replace(
        tracks,
        poses=np.vstack([tracks.poses, pose]),
        times=np.append(tracks.times, time),
        direct=np.append(tracks.direct, direct + heading),
        rows=(*tracks.rows, np.column_stack((track[kept], columns))),
        last=last,
    )


def _costs(
    seen: Float[np.ndarray, "m 8"],
    last: Float[np.ndarray, "t 3 8"],
    here: tuple[int, float, float],
) -> Float[np.ndarray, "m t"]:
    """Return what it costs that a row continues a track; infinite where it does not.

    ``here``: number of the scan, and where the vehicle is.
    """
    latest, earlier, (now, x, y) = last[:, 0], last[:, -1], here
    scans = now - latest[:, SCAN]
    gone = np.hypot(x - latest[:, X], y - latest[:, Y])
    even = now - earlier[:, SCAN] <= EVEN  # not where NaN
    share = np.where(even, scans / (latest[:, SCAN] - earlier[:, SCAN]), 0.0)
    turned = wrap(latest[:, BEARING] - earlier[:, BEARING])
    bearing = latest[:, BEARING] + np.where(even, share * turned, 0.0)
    way = latest[:, WAY] + np.where(even, share * (latest[:, WAY] - earlier[:, WAY]), 0.0)
    off = wrap(seen[:, [BEARING]] - bearing), seen[:, [WAY]] - way
    strayed = gone / np.where(even, 15.0, 6.0), gone * np.where(even, 0.3, 1.0)
    across = seen[:, [BEARING_STD]] ** 2 + latest[:, BEARING_STD] ** 2
    across = across + TURN**2 * scans + strayed[0] ** 2
    along = seen[:, [WAY_STD]] ** 2 + latest[:, WAY_STD] ** 2 + strayed[1] ** 2 + TURN**2
    squared = off[0] ** 2 / across + off[1] ** 2 / along
    squared = squared + ((seen[:, [LEVEL]] - latest[:, LEVEL]) / LEVEL_STD) ** 2
    costs = squared + np.log(across * along) + 2.0 * np.log(2.0 * np.pi * CLUTTER)
    return np.where(squared < GATE, costs, np.inf)


def in_window(
    tracks: Tracks, scans: int, sightings: int
) -> tuple[Float[np.ndarray, "t k 4"], Float[np.ndarray, "k 3"], Float[np.ndarray, " k"]]:
    """Return the last scans of the tracks that were seen so often in them, poses and direct calls.

    A track has NaN where it was not seen.
    """
    window = tracks.rows[-scans:]
    table = np.full((len(tracks.last), len(window), 4), np.nan)
    for k, rows in enumerate(window):
        table[rows[:, 0].astype(np.int64), k] = rows[:, 1:]
    often = np.count_nonzero(~np.isnan(table[..., 0]), axis=1) >= sightings
    return table[often], tracks.poses[-scans:], tracks.direct[-scans:]
