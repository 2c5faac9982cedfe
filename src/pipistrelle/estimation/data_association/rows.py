"""Measurements of a scan as data association uses them, and its memory between scans.

`compared` computes the costs of a caller's measurements against all landmarks; a method of `pairs`
matches them, and `label_matched` applies the matches. Precise measurements near no landmark begin
landmarks, except close to a louder measurement or where two echoes may have merged (bearing of the
first, delay of the second).

**Tracks** of a caller's measurements replace landmarks while its position is unknown. World bearing
and excess path of a landmark change slowly and evenly between scans. A measurement continues the
track of least cost (`pairs.nearest`); a precise measurement that continues none begins a track.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from pipistrelle.detection.scans import (
    BEARING,
    BEARING_STD,
    EXCESS_PATH,
    EXCESS_PATH_STD,
    LEVEL,
    OWN,
    RANGE,
    RANGE_STD,
    UNLABELLED,
    Scan,
)
from pipistrelle.estimation.beliefs import Gaussian, is_among
from pipistrelle.estimation.data_association.existence import GATE, LEVEL_STD, Known, nobody
from pipistrelle.estimation.data_association.pairs import (
    NOTHING,
    UNPLACED,
    PlainChances,
    Rows,
    nearest,
    pair_costs,
)
from pipistrelle.estimation.data_association.watch import Watched, of_calls
from pipistrelle.geometry import wrap, wrap_angle
from pipistrelle.jit import Flag, Whole, kernel, no_alloc

SIGHTINGS = 3
"""Last sightings kept per track, for its extrapolation."""
AT_SCAN, AT_BEARING, AT_WAY, AT_BEARING_STD, AT_WAY_STD, AT_LEVEL, AT_X, AT_Y = range(8)
"""Columns of a sighting; the bearing is in the world, and x and y are the vehicle's."""
SILENT, EVEN = 4, 6
"""Scans without sightings that end a track, and scans over which its change counts as linear."""
NEW_BEARING_STD, NEW_WAY_STD = 0.05, 0.3
"""Largest stds of a first sighting [rad, m]."""
Model = tuple[float, float, float, float, float]
"""Stds of the change of a pose's error in a scan [m, rad], stds of a caller's initial velocity
[m/s] and of its change in a second [m/s], and clutter density over detection probability."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Tracks:
    """Echoes of a caller with unknown position, grouped over scans into a track per landmark."""

    poses: Float[np.ndarray, "k 3"] = field(default_factory=lambda: np.empty((0, 3)))
    """Predicted vehicle pose at each scan."""
    times: Float[np.ndarray, " k"] = field(default_factory=lambda: np.empty(0))
    """Times of the scans [s]."""
    direct: Float[np.ndarray, "k 2"] = field(default_factory=lambda: np.empty((0, 2)))
    """World bearing of the direct call and its std [rad], or NaN."""
    rows: tuple[Float[np.ndarray, "r 5"], ...] = ()
    """For each scan: track number, world bearing, excess path, and their standard deviations."""
    last: Float[np.ndarray, "t 3 8"] = field(default_factory=lambda: np.empty((0, SIGHTINGS, 8)))
    """Last sightings of each track, newest first; NaN before the first."""


def followed(
    tracks: Tracks,
    time: float,
    pose: Float[np.ndarray, "3"],
    direct: Float[np.ndarray, "2"],
    rows: Rows,
    model: Model,
) -> Tracks:
    """Return a caller's tracks of echoes extended by a scan.

    ``direct``: bearing of its direct call and std, or NaN.
    """
    now, (x, y, heading) = len(tracks.poses), pose
    ones = np.ones(len(rows.bearing))
    seen = np.column_stack(
        (now * ones, rows.bearing + heading, *rows[2:3], *rows[1:2], *rows[3:], x * ones, y * ones)
    )
    going = np.flatnonzero(now - tracks.last[:, 0, AT_SCAN] <= SILENT)
    of = nearest(_costs(seen, tracks.last[going], (now, x, y), model))
    track = np.where(of == NOTHING, NOTHING, going[of] if going.size else NOTHING)
    fresh = (track == NOTHING) & (seen[:, AT_BEARING_STD] < NEW_BEARING_STD)
    fresh &= seen[:, AT_WAY_STD] < NEW_WAY_STD
    track[fresh] = len(tracks.last) + np.arange(fresh.sum())
    more = np.full((fresh.sum(), SIGHTINGS, 8), np.nan)
    last, kept = np.concatenate([tracks.last, more]), track != NOTHING
    last[track[kept], 1:] = last[track[kept], :-1]
    last[track[kept], 0] = seen[kept]
    columns = seen[kept][:, [AT_BEARING, AT_WAY, AT_BEARING_STD, AT_WAY_STD]]
    return replace(
        tracks,
        poses=np.vstack([tracks.poses, pose]),
        times=np.append(tracks.times, time),
        direct=np.vstack([tracks.direct, direct + np.array([heading, 0.0])]),
        rows=(*tracks.rows, np.column_stack((track[kept], columns))),
        last=last,
    )


def _costs(
    seen: Float[np.ndarray, "m 8"],
    last: Float[np.ndarray, "t 3 8"],
    here: tuple[int, float, float],
    model: Model,
) -> Float[np.ndarray, "m t"]:
    """Return the cost of continuing each track by each measurement; infinite beyond the gate."""
    latest, earlier, (now, x, y) = last[:, 0], last[:, -1], here
    scans = now - latest[:, AT_SCAN]
    gone = np.hypot(x - latest[:, AT_X], y - latest[:, AT_Y])
    even = now - earlier[:, AT_SCAN] <= EVEN  # False where NaN
    share = np.where(even, scans / (latest[:, AT_SCAN] - earlier[:, AT_SCAN]), 0.0)
    turned = wrap(latest[:, AT_BEARING] - earlier[:, AT_BEARING])
    bearing = latest[:, AT_BEARING] + np.where(even, share * turned, 0.0)
    way = latest[:, AT_WAY] + np.where(even, share * (latest[:, AT_WAY] - earlier[:, AT_WAY]), 0.0)
    off = wrap(seen[:, [AT_BEARING]] - bearing), seen[:, [AT_WAY]] - way
    strayed = gone / np.where(even, 15.0, 6.0), gone * np.where(even, 0.3, 1.0)
    across = seen[:, [AT_BEARING_STD]] ** 2 + latest[:, AT_BEARING_STD] ** 2
    across = across + model[1] ** 2 * scans + strayed[0] ** 2
    along = seen[:, [AT_WAY_STD]] ** 2 + latest[:, AT_WAY_STD] ** 2 + strayed[1] ** 2
    along = along + model[0] ** 2 * scans
    squared = off[0] ** 2 / across + off[1] ** 2 / along
    squared = squared + ((seen[:, [AT_LEVEL]] - latest[:, AT_LEVEL]) / LEVEL_STD) ** 2
    costs = squared + np.log(across * along) + 2.0 * np.log(2.0 * np.pi * model[4])
    return np.where(squared < GATE, costs, np.inf)


def in_window(
    tracks: Tracks, scans: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray, Float[np.ndarray, "t k 4"]]:
    """Return times, poses, direct bearings and tracks of a caller's last scans.

    Tracks with a single measurement are left out: they contain no information.
    """
    window = tracks.rows[-scans:]
    table = np.full((len(tracks.last), len(window), 4), np.nan)
    for k, rows in enumerate(window):
        table[rows[:, 0].astype(np.int64), k] = rows[:, 1:]
    often = np.count_nonzero(~np.isnan(table[..., 0]), axis=1) > 1
    return tracks.times[-scans:], tracks.poses[-scans:], tracks.direct[-scans:], table[often]


BESIDE, ASIDE = 0.96, 0.5
"""A measurement begins no landmark within this range [m] and bearing [rad] of a louder measurement.
"""
OVERLAP_STD, OVERLAP_GATE = 0.7, 9.2
"""Standard deviation of the path of an overlapping echo [m], and gate, exceeded by 1 in 100."""
SURE_SHARE, ASSUMED = 0.65, 0.75
"""Share of the bearing limit up to which surety is 1, and surety of a default standard deviation.
"""
RARE_SHARE, RAREST = 0.4, 0.01
"""Share of the bearing limit below which clutter is rarer, by the squared std, and least factor."""


class ScanRows(NamedTuple):
    """Measurements of a scan, with flags for their use in data association."""

    caller: Int[np.ndarray, " m"]
    bearing: Float[np.ndarray, " m"]
    bearing_std: Float[np.ndarray, " m"]
    way: Float[np.ndarray, " m"]
    """Range for the vehicle's own call, excess path for another's [m], or NaN."""
    way_std: Float[np.ndarray, " m"]
    level_db: Float[np.ndarray, " m"]
    usable: Bool[np.ndarray, " m"]
    with_way: Bool[np.ndarray, " m"]
    """Usable, and with range or excess path."""
    sure: Bool[np.ndarray, " m"]
    """Whether range or excess path is precise enough to begin a landmark."""
    surety: Float[np.ndarray, " m"]
    """Weight of a detection by its bearing's precision, from 0 to 1."""
    clutter: Float[np.ndarray, " m"]
    """Relative clutter density, as in `pairs.Rows`."""


Joint = tuple[Int[np.ndarray, " n"], Float[np.ndarray, " d"], Float[np.ndarray, "d d"]]
"""Labels, mean and covariance of a `JointGaussian`."""


def rows_of_scan(
    scan: Scan, limits: tuple[float, float, float], assumed: tuple[float, ...]
) -> ScanRows:
    """Convert a scan for data association; ``assumed``: default stds, exempt from all limits.

    ``limits``: largest stds of bearing, of range or excess path, and of the latter for new
    landmarks.
    """
    numbers = np.ascontiguousarray(scan.numbers)
    return ScanRows(*_read(scan.caller, numbers, limits, np.array(assumed, float)))


@kernel
def _read(
    caller: Int[np.ndarray, " m"],
    numbers: Float[np.ndarray, "8 m"],
    limits: tuple[float, float, float],
    assumed: Float[np.ndarray, " a"],
) -> tuple[np.ndarray, ...]:
    """Return the columns of `ScanRows`: a scan's measurements, with flags by the limits on stds."""
    size, (limit, way_limit, birth_limit) = caller.size, limits
    bearing_std, way, way_std = numbers[BEARING_STD], np.empty(size), np.empty(size)
    usable, with_way, sure = np.empty((3, size), np.bool_)
    surety, clutter = np.full(size, ASSUMED), np.ones(size)
    for m in range(size):
        own = caller[m] == OWN
        way[m] = numbers[RANGE if own else EXCESS_PATH, m]
        way_std[m] = numbers[RANGE_STD if own else EXCESS_PATH_STD, m]
        bare, within = math.isnan(way[m]), _within(way_std[m], way_limit, assumed)
        aimed = not math.isnan(numbers[BEARING, m])
        usable[m] = within and own
        if aimed:
            usable[m] = _within(bearing_std[m], limit, assumed) and (bare or within)
        with_way[m] = usable[m] and not bare
        sure[m] = aimed and _within(way_std[m], birth_limit, assumed)
        if bearing_std[m] not in assumed:
            share = SURE_SHARE * limit / bearing_std[m]
            surety[m] = share if share < 1.0 else 1.0  # also for NaN
            rare = bearing_std[m] / (RARE_SHARE * limit)
            clutter[m] = max(rare * rare, RAREST) if rare < 1.0 else 1.0
    bearing, told = numbers[BEARING], (usable, with_way, sure, surety, clutter)
    return caller, bearing, bearing_std, way, way_std, numbers[LEVEL], *told


@kernel
def _within(std: float, limit: float, assumed: Float[np.ndarray, " a"]) -> Flag:
    """Return whether a standard deviation is within a limit or is a default."""
    return std <= limit or std in assumed


@kernel
def place_of(label: Whole, landmark: Int[np.ndarray, " n"]) -> int:
    """Return the index of a labelled landmark in the joint mean of pose and map, or -1."""
    for n in range(landmark.size):
        if landmark[n] == label:
            return 3 + 2 * n
    return -1


@kernel
def places_of(
    labels: Int[np.ndarray, " l"], landmark: Int[np.ndarray, " n"]
) -> Int[np.ndarray, " l"]:
    """Return landmarks' joint-mean indices, or -1 if absent."""
    at = np.empty(labels.size, np.int64)
    for n in range(labels.size):
        at[n] = place_of(labels[n], landmark)
    return at


@kernel
def compared(
    rows: tuple[np.ndarray, ...],
    joint: Joint,
    moving: Int[np.ndarray, " v"],
    caller: tuple[Whole, Whole, Whole],
    chances: PlainChances,
) -> tuple[Int[np.ndarray, " r"], Float[np.ndarray, "r n"], Bool[np.ndarray, " r"]]:
    """Compare a caller's measurements with all landmarks: return costs, and which are within gates.

    ``moving``: labels excluded from matching; ``caller``: number, index of its direct call, and of
    its position.
    """
    heard, (landmark, mean, covariance), (number, direct, at) = ScanRows(*rows), joint, caller
    used = np.flatnonzero(heard.caller == number)
    used = used[used != direct]
    there, usable = 3 + 2 * np.arange(landmark.size), heard.usable
    costs = pair_costs(part_of(heard, used, 0.0), mean, covariance, there, at, chances)
    for n in np.flatnonzero(is_among(landmark, moving)):
        costs[:, n] = math.inf
    if at != UNPLACED:
        usable = heard.with_way
    size, close = 0, np.zeros(used.size, np.bool_)
    for k in range(used.size):
        costs[size] = costs[k]
        used[size], close[size] = used[k], (costs[k] < np.inf).any()
        if usable[used[k]]:
            size += 1
    return used[:size], costs[:size], close[:size]


@kernel
def part_of(heard: ScanRows, rows: Int[np.ndarray, " r"], spread: float) -> tuple[np.ndarray, ...]:
    """Return selected measurements as columns of `pairs.Rows`; ``spread``: added range std [m]."""
    way_std = heard.way_std[rows]
    for k in range(rows.size):
        way_std[k] = math.hypot(way_std[k], spread)
    bearing, bearing_std, clutter = heard.bearing, heard.bearing_std, heard.clutter
    return bearing[rows], bearing_std[rows], heard.way[rows], way_std, clutter[rows]


@kernel
def label_matched(
    label: Int[np.ndarray, " m"],
    rows: tuple[np.ndarray, ...],
    joint: Joint,
    confirmed: Int[np.ndarray, " c"],
    matched: tuple[Int[np.ndarray, " r"], Int[np.ndarray, " r"], Bool[np.ndarray, " r"]],
    caller: tuple[Whole, Whole, Whole],
    chances: PlainChances,
) -> tuple[Int[np.ndarray, " b"], tuple[int, int]]:
    """Label a caller's matched measurements; return the unmatched to begin landmarks, and counts.

    The counts are of precise measurements: matched, and all.
    """
    heard, (landmark, mean, covariance), (number, _, at) = ScanRows(*rows), joint, caller
    (used, found, near), stray = matched, np.empty(label.size, np.int64)
    right, sure, size = 0, 0, 0
    for k in range(used.size):
        row, known = used[k], found[k] != NOTHING
        label[row] = landmark[found[k]] if known else UNLABELLED
        if heard.sure[row]:
            right, sure = right + (1 if known else 0), sure + 1
            if not near[k] and at != UNPLACED:
                stray[size], size = row, size + 1
    if size == 0:
        return stray[:0], (right, sure)
    silent = np.full(confirmed.size, -1)
    for n in range(confirmed.size):
        if confirmed[n] not in label:
            silent[n] = place_of(confirmed[n], landmark)
    stray, gated = stray[:size], (OVERLAP_GATE, *chances[1:])
    overlapping = part_of(heard, stray, OVERLAP_STD / (2.0 if number == OWN else 1.0))
    costs = pair_costs(overlapping, mean, covariance, silent[silent >= 0], at, gated)
    size = 0
    for k in range(stray.size):
        if not np.isfinite(costs[k]).any() and not _is_beside(heard, stray[k]):
            stray[size], size = stray[k], size + 1
    return stray[:size], (right, sure)


@no_alloc
def _is_beside(heard: ScanRows, row: Whole) -> bool:
    """Return whether a measurement is close to a louder measurement of the same caller."""
    own = heard.caller[row]
    factor = 2.0 if own == OWN else 1.0
    for m in range(heard.caller.size):
        louder = heard.caller[m] == own and heard.level_db[m] > heard.level_db[row]
        close = factor * abs(heard.way[m] - heard.way[row]) < BESIDE
        if louder and close and abs(wrap_angle(heard.bearing[m] - heard.bearing[row])) < ASIDE:
            return True
    return False


class CallerPlace(NamedTuple):
    """Position and motion of a caller, as the search found them or a map states them."""

    x: float
    y: float
    """Position [m]."""
    motion: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    """Velocity [m/s], then acceleration [m/s^2], along x and y; 0 if stationary."""
    time: float = 0.0
    """Time of the position [s]."""
    since: float = -math.inf
    """First time at which position and motion are valid [s]."""
    std: float = 0.0
    """Std of its range, relative to it."""

    def at(self, time: float) -> tuple[float, float]:
        """Return the caller's position [m] at a time [s], by constant acceleration."""
        t, (vx, vy, ax, ay) = time - self.time, self.motion
        return self.x + t * (vx + 0.5 * t * ax), self.y + t * (vy + 0.5 * t * ay)


@dataclass(frozen=True, slots=True, kw_only=True)
class CallerState:
    """A caller's state in data association: label, position and tracks."""

    label: int
    place: CallerPlace | None = None
    """Position found by the search."""
    told: bool = False
    tracks: Tracks = field(default_factory=Tracks)
    failed: int = 0
    """Number of the scan since which its former position has failed (`watch`)."""
    former: tuple[int, ...] = ()
    """Labels of its former positions."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Memory:
    """Memory of data association between scans: landmarks and callers."""

    scan: int = 0
    labels: int = 0
    """Number of labels issued."""
    known: Known = field(default_factory=lambda: nobody(1))
    callers: Mapping[int, CallerState] = field(default_factory=dict)
    """Callers by number."""
    pose: Gaussian | None = None
    """Predicted pose of the last scan."""
    drift: tuple[float, float] = (0.0, 0.0)
    """Largest stds of the change of a predicted pose's error between two scans [m, rad]."""
    watch: Watched = field(default_factory=lambda: of_calls(1))


def drift_of(memory: Memory, pose: Gaussian) -> tuple[float, float]:
    r"""Return the largest stds of the change of a predicted pose's error up to a scan [m, rad].

    The change has the covariance :math:`P - F P^- F^T` before there is a map.
    """
    if memory.pose is None:
        return memory.drift
    (dx, dy, _), F = pose.mean - memory.pose.mean, np.eye(3)
    F[:2, 2] = -dy, dx
    grown = np.diag(pose.covariance - F @ memory.pose.covariance @ F.T)
    along, turn = math.sqrt(max(grown[0] + grown[1], 0.0)), math.sqrt(max(grown[2], 0.0))
    return max(along, memory.drift[0]), max(turn, memory.drift[1])
