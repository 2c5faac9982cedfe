"""Tracks of a caller's measurements while its position is unknown.

World bearing and excess path of a landmark change slowly and evenly between scans. A measurement
continues the track of least cost (`pairs.nearest`); a precise measurement that continues none
begins a track.
"""

from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float

from pipistrelle.estimation.data_association.pairs import NOTHING, Rows, nearest
from pipistrelle.geometry import wrap

SIGHTINGS = 3
"""Last sightings kept per track, for its extrapolation."""
SCAN, BEARING, WAY, BEARING_STD, WAY_STD, LEVEL, X, Y = range(8)
"""Columns of a sighting; the bearing is in the world, and x and y are the vehicle's."""
SILENT, EVEN = 4, 6
"""Scans without sightings that end a track, and scans over which its change counts as linear."""
TURN = 0.03
"""Drift of the dead-reckoned heading per scan [rad]."""
CLUTTER, NEW_BEARING_STD, NEW_WAY_STD, GATE, LEVEL_STD = 0.075, 0.05, 0.3, 12.0, 5.0
"""Clutter per rad and m over the detection probability; largest stds of a first sighting [rad, m];
gate on the squared distance; std of levels [dB]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Tracks:
    """Measurements of a caller that is not on the map."""

    poses: Float[np.ndarray, "k 3"] = field(default_factory=lambda: np.empty((0, 3)))
    """Predicted vehicle pose at each scan."""
    times: Float[np.ndarray, " k"] = field(default_factory=lambda: np.empty(0))
    """Times of the scans [s]."""
    direct: Float[np.ndarray, " k"] = field(default_factory=lambda: np.empty(0))
    """World bearing of the direct call [rad], or NaN."""
    rows: tuple[Float[np.ndarray, "r 5"], ...] = ()
    """For each scan: track number, world bearing, excess path, and their standard deviations."""
    last: Float[np.ndarray, "t 3 8"] = field(default_factory=lambda: np.empty((0, SIGHTINGS, 8)))
    """Last sightings of each track, newest first; NaN before the first."""


def followed(
    tracks: Tracks, time: float, pose: Float[np.ndarray, "3"], direct: float, rows: Rows
) -> Tracks:
    """Extend tracks by the measurements of a scan; ``direct``: direct bearing, or NaN."""
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
    """Return the cost of continuing each track by each measurement; infinite beyond the gate."""
    latest, earlier, (now, x, y) = last[:, 0], last[:, -1], here
    scans = now - latest[:, SCAN]
    gone = np.hypot(x - latest[:, X], y - latest[:, Y])
    even = now - earlier[:, SCAN] <= EVEN  # False where NaN
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
    """Return tracks with enough recent sightings (NaN if missed), poses and direct bearings."""
    window = tracks.rows[-scans:]
    table = np.full((len(tracks.last), len(window), 4), np.nan)
    for k, rows in enumerate(window):
        table[rows[:, 0].astype(np.int64), k] = rows[:, 1:]
    often = np.count_nonzero(~np.isnan(table[..., 0]), axis=1) >= sightings
    return table[often], tracks.poses[-scans:], tracks.direct[-scans:]
