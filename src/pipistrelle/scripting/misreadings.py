r"""Mistakes in a log that explain why its rows do not fit: in its columns, and in its sight.

Each mistake in `MISTAKES` is undone on the rows of some scans. Every row is then compared with rows
of earlier scans, from which the odometry leads to it. Undone rightly, rows of one landmark
coincide. No map is needed, and labels are used only if the log has some.

A row z that follows a scan with n possible partners has the density

.. math:: p(z) = \tfrac12 p_0 + \tfrac1{2n} \sum_i N(z;\ \hat z_i, S_i)

in the numbers of the log, whose unit and column thus do not matter: half the prior probability is
that the earlier scan lacks the landmark, and :math:`p_0` is uniform over the recorded numbers.
"""

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from pipistrelle.config import Config
from pipistrelle.detection.scans import BEARING, NUMBERS, OWN, RANGE, UNLABELLED
from pipistrelle.estimation.beliefs import placed
from pipistrelle.estimation.data_association.existence import BEFORE, WITHIN
from pipistrelle.estimation.motion import relative_motions
from pipistrelle.estimation.session import REMEMBERED
from pipistrelle.experiments.drives import carried
from pipistrelle.experiments.runs.replay import motion_of
from pipistrelle.geometry import range_and_bearing, wrap

if TYPE_CHECKING:
    from pipistrelle.detection.logs.recording import Log
    from pipistrelle.experiments.results.scores import TrialResult

DEGREE = math.pi / 180.0
SCANS = 32
"""Scans that are compared with earlier scans, spread over the log."""
LAGS = 2 ** np.arange(10)
"""How many scans earlier those are."""
CHANCE = 0.01
"""Probability that chance names a mistake."""
REACH, QUESTIONED = 0.99, 1e-3
"""Share of the rows within which a sensor surely sees, and probability of questioning a sound one
by chance."""
ROWS = 32
"""Rows of a scan that are compared with earlier scans, at most."""


class Mistake(NamedTuple):
    """A mistake in a log's columns, and how it is undone."""

    cause: str
    undone: str
    fix: str
    turn: float = 1.0
    """Factor of the bearing, after which it is in radians, counter-clockwise."""
    offset: float = 0.0
    """Added to the bearing then [rad]."""
    from_map: bool = False
    """Whether the heading is subtracted from the bearing."""
    scale: float = 1.0
    """Factor of the range, after which it is in metres."""
    swapped: bool = False
    """Whether the range is in the column of the bearing, and the reverse."""
    rate: float = 1.0
    """Factor of the angular rate or the steering angle."""


NONE = Mistake("", "", "")
MISTAKES = (
    Mistake(
        "bearings seem to be clockwise", "negated",
        "negate the bearings (or the turns of the odometry, if these are clockwise)", turn=-1.0,
    ),
    Mistake(
        "bearings seem to be in degrees", "in radians", "multiply them by pi / 180", turn=DEGREE
    ),
    Mistake(
        "bearings seem to be in degrees and clockwise", "in radians and negated",
        "multiply them by -pi / 180", turn=-DEGREE,
    ),
    Mistake(
        "bearings and ranges seem to be swapped", "exchanged", "exchange the two columns",
        swapped=True,
    ),
    Mistake(
        "bearings and ranges seem to be swapped, and bearings in degrees", "exchanged, in radians",
        "exchange the two columns, and multiply the bearings by pi / 180", turn=DEGREE,
        swapped=True,
    ),
    Mistake(
        "bearings seem to be from the rear of the vehicle", "turned by pi",
        "add pi to them, or to the angle of sensor_pose", offset=math.pi,
    ),
    Mistake(
        "bearings seem to be from the x axis of the map", "less the heading",
        "subtract the vehicle's heading", from_map=True,
    ),
    Mistake(
        "bearings seem to be of a compass, clockwise from the y axis", "from the heading",
        "subtract them and the vehicle's heading from pi / 2", turn=-1.0, offset=0.5 * math.pi,
        from_map=True,
    ),
    Mistake(
        "bearings seem to be of a compass, in degrees from the y axis", "from the heading",
        "subtract them and the vehicle's heading from 90 degrees, in radians", turn=-DEGREE,
        offset=0.5 * math.pi, from_map=True,
    ),
    Mistake("ranges seem to be in millimetres", "in metres", "divide them by 1000", scale=1e-3),
    Mistake("ranges seem to be in centimetres", "in metres", "divide them by 100", scale=1e-2),
    Mistake("ranges seem to be in kilometres", "in metres", "multiply them by 1000", scale=1e3),
    Mistake(
        "the odometry seems to turn in degrees", "in radians",
        "multiply its angles by pi / 180", rate=DEGREE,
    ),
)  # fmt: skip
"""The mistakes that are tried."""


class _Path(NamedTuple):
    """The sensor's poses by the odometry, and how each step's noise grows with what follows."""

    sensor: Float[np.ndarray, "t 3"]
    vehicle: Float[np.ndarray, "t 3"]
    noise: Float[np.ndarray, "t-1 3 3"]
    """Covariance of each step's motion, in the axes of the map."""


class _Rows(NamedTuple):
    """Rows of one scan as they are recorded; NaN where nothing was."""

    bearing: Float[np.ndarray, " m"]
    range: Float[np.ndarray, " m"]
    variance: Float[np.ndarray, "2 m"]
    """Of bearing and range."""
    label: Int[np.ndarray, " m"]
    step: int
    """Number of the scan's time."""


def misreading(recorded: "Log") -> tuple[str, bool]:
    """Return the one mistake that explains a log's rows, in words, and whether they fit without.

    A mistake is named if, scan by scan, the rows are more probable with it undone than as they are
    recorded, than with any other mistake undone, and than if no row had a landmark. By the sign
    test over scans, chance names one with a probability of `CHANCE` at most. Else the words are
    empty. Rows fit without if they are more probable so than without landmarks, or than with any
    mistake undone; and rows of so few scans that nothing could be named count as fitting.
    """
    scan, fits = _fits(recorded)
    scans = np.unique(scan)
    if 2.0**scans.size * CHANCE < len(MISTAKES):
        return "", True
    total = np.array([fits[scan == one].sum(axis=0) for one in scans])
    best = int(np.argmax(total.sum(axis=0)))
    rivals = np.delete(total, best, axis=1).T
    chance = max(_sign_test(total[:, best] - rival) for rival in rivals)
    by_chance = max(chance, _sign_test(total[:, best])) * len(MISTAKES)
    if best == 0 or by_chance > CHANCE:
        return "", min(_sign_test(total[:, 0]), 1.0 if best else chance) <= CHANCE
    mistake, better = MISTAKES[best - 1], np.count_nonzero(fits[:, best] > fits[:, 0])
    return (
        f"{mistake.cause}: {mistake.undone}, {better} of {len(fits)} rows in {scans.size} scans "
        f"fit earlier scans better; {mistake.fix}"
    ), False


def _sign_test(difference: Float[np.ndarray, " n"]) -> float:
    """Return the probability that so many signs are positive by chance, or more."""
    positive, n = int(np.sum(difference > 0.0)), int(np.sum(difference != 0.0))
    return sum(math.comb(n, k) for k in range(positive, n + 1)) / 2**n


def _fits(recorded: "Log") -> tuple[Int[np.ndarray, " k"], Float[np.ndarray, "k h"]]:
    """Return how well each compared row fits earlier scans: as recorded, each mistake undone.

    The scan of each row, and the sum over earlier scans of the logarithm of p(z) / p_0.
    """
    rows = _recorded_rows(recorded)
    spans = _spans(rows, recorded)
    paths = {mistake.rate: _path(recorded, mistake.rate) for mistake in (NONE, *MISTAKES)}
    scans, fits = [], []
    chosen = np.linspace(1, len(rows) - 1, SCANS if len(rows) > 1 else 0)
    for n in np.unique(chosen.round().astype(int)):
        later = _some(rows[n], np.linspace(0, rows[n].label.size - 1, ROWS))
        fit = np.zeros((later.label.size, 1 + len(MISTAKES)))
        for earlier in (rows[n - lag] for lag in LAGS if lag <= n):
            for h, mistake in enumerate((NONE, *MISTAKES)):
                fit[:, h] += _log_ratio(earlier, later, mistake, paths[mistake.rate], spans)
        scans.append(np.full(len(fit), n))
        fits.append(fit)
    scan, fit = np.concatenate([np.empty(0, int), *scans]), np.concatenate(fits) if fits else []
    compared = np.any(fit, axis=1) if len(scan) else np.empty(0, bool)
    return scan[compared], np.reshape(fit, (len(scan), 1 + len(MISTAKES)))[compared]


def _recorded_rows(recorded: "Log") -> list[_Rows]:
    """Return the rows of each scan that may be of landmarks."""
    ends = np.cumsum([scan.landmark.size for scan in recorded.scans])
    bearings = np.split(recorded.recorded_bearings(), ends[:-1])
    moving = [caller.landmark for caller in recorded.callers if caller.moves]
    rows = []
    for scan, bearing in zip(recorded.scans, bearings, strict=True):
        stds = np.array(
            [
                np.where(np.isnan(scan.bearing_std), recorded.bearing_std, scan.bearing_std),
                np.where(np.isnan(scan.range_std), recorded.range_std, scan.range_std),
            ]
        )
        step = int(np.searchsorted(recorded.time, scan.time))
        whole = _Rows(bearing, scan.range, stds**2, scan.landmark, step)
        usable = ~np.isnan(bearing) & ~np.isin(scan.landmark, moving)
        usable[scan.direct[scan.direct >= 0]] = False
        rows.append(_some(whole, np.flatnonzero(usable)))
    return rows


def _some(rows: _Rows, chosen: np.ndarray) -> _Rows:
    """Return some rows of a scan, by their rounded numbers."""
    n = np.unique(chosen.round().astype(int)) if rows.label.size else np.empty(0, int)
    return _Rows(rows.bearing[n], rows.range[n], rows.variance[:, n], rows.label[n], rows.step)


def _spans(rows: list[_Rows], recorded: "Log") -> tuple[float, float]:
    """Return the spans of the recorded bearings and ranges."""
    spans = []
    for name, least in (("bearing", recorded.bearing_std), ("range", recorded.range_std)):
        values = np.concatenate([getattr(one, name) for one in rows])
        values = values[~np.isnan(values)]
        spans.append(max(float(np.ptp(values)) if values.size else 0.0, least))
    return spans[0], spans[1]


def _path(recorded: "Log", rate: float) -> _Path:
    """Reckon the path, the angular rate or the steering angle times a factor."""
    controls = recorded.controls.copy()
    if recorded.motion != "poses":
        controls[:, 1] *= rate
    steps, noise = relative_motions(motion_of(recorded), controls, recorded.dt)
    heading = recorded.initial_pose[2] + np.concatenate([[0.0], np.cumsum(steps[:, 2])])
    c, s = np.cos(heading), np.sin(heading)
    ahead = np.array([[c[:-1], -s[:-1]], [s[:-1], c[:-1]]])
    moved = np.einsum("ijt,tj->ti", ahead, steps[:, :2])
    place = np.concatenate([np.zeros((1, 2)), np.cumsum(moved, axis=0)])
    axes = np.zeros((len(steps), 3, 3))
    axes[:, :2, :2], axes[:, 2, 2] = ahead.transpose(2, 0, 1), 1.0
    x, y, turn = recorded.sensor_pose
    sensor = place + np.column_stack((c * x - s * y, s * x + c * y))
    return _Path(
        sensor=np.column_stack((sensor, heading + turn)),
        vehicle=np.column_stack((place, heading)),
        noise=axes @ noise @ axes.transpose(0, 2, 1),
    )


def _reckoned(path: _Path, begin: int, end: int) -> Float[np.ndarray, "3 3"]:
    """Return the covariance of the sensor's pose at one time, given that at an earlier time."""
    lever = path.sensor[end, :2] - path.vehicle[begin + 1 : end + 1, :2]
    J = np.tile(np.eye(3), (len(lever), 1, 1))
    J[:, 0, 2], J[:, 1, 2] = -lever[:, 1], lever[:, 0]
    return np.einsum("tij,tjk,tlk->il", J, path.noise[begin:end], J)


def _undone(
    rows: _Rows, mistake: Mistake, heading: float
) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, " m"]]:
    """Return the bearings and ranges of rows with a mistake undone."""
    bearing, distance = rows.bearing, rows.range
    if mistake.swapped:
        bearing, distance = distance, bearing
    bearing = mistake.turn * bearing + mistake.offset - heading * mistake.from_map
    return wrap(bearing), mistake.scale * distance


class _Expected(NamedTuple):
    """Rows that are expected of an earlier scan's landmarks, and their covariance."""

    bearing: Float[np.ndarray, " n"]
    range: Float[np.ndarray, " n"]
    bb: Float[np.ndarray, " n"]
    rb: Float[np.ndarray, " n"]
    rr: Float[np.ndarray, " n"]


def _expected(
    earlier: _Rows, mistake: Mistake, path: _Path, step: int
) -> tuple[_Expected, Int[np.ndarray, " n"]]:
    """Return what the landmarks of an earlier scan's ranges look like later, and their labels."""
    here, there = path.sensor[step], path.sensor[earlier.step]
    b, r = _undone(earlier, mistake, there[2])
    known = np.isfinite(b) & (r > 0.0)
    b, r, variance = b[known], r[known], earlier.variance[:, known]
    ray = np.column_stack((np.cos(there[2] + b), np.sin(there[2] + b)))
    off = there[:2] - here[:2] + r[:, np.newaxis] * ray
    distance = np.maximum(np.hypot(*off.T), np.finfo(float).tiny)
    u = off / distance[:, np.newaxis]
    normal = np.column_stack((-u[:, 1], u[:, 0]))
    c, s = (ray * u).sum(axis=1), (ray * normal).sum(axis=1)
    along, across = variance[1], r**2 * variance[0]
    to_range = np.column_stack((-u, np.zeros(len(u))))
    to_bearing = np.column_stack((-normal / distance[:, np.newaxis], -np.ones(len(u))))
    P = _reckoned(path, earlier.step, step)

    def moved(one: np.ndarray, other: np.ndarray) -> np.ndarray:
        return np.einsum("ni,ij,nj->n", one, P, other)

    expected = _Expected(
        bearing=np.arctan2(off[:, 1], off[:, 0]) - here[2],
        range=distance,
        bb=(s * s * along + c * c * across) / distance**2 + moved(to_bearing, to_bearing),
        rb=c * s * (along - across) / distance + moved(to_range, to_bearing),
        rr=c * c * along + s * s * across + moved(to_range, to_range),
    )
    return expected, earlier.label[known]


@np.errstate(over="ignore", under="ignore")
def _log_ratio(
    earlier: _Rows, later: _Rows, mistake: Mistake, path: _Path, spans: tuple[float, float]
) -> Float[np.ndarray, " m"]:
    """Return log p(z) / p_0 of each row of a scan by those of an earlier scan; 0 without any."""
    expected, label = _expected(earlier, mistake, path, later.step)
    bearing, distance = _undone(later, mistake, path.sensor[later.step, 2])
    db = wrap(bearing[:, np.newaxis] - expected.bearing)
    dr = distance[:, np.newaxis] - expected.range
    bb, rr = (var[:, np.newaxis] for var in later.variance)
    bb, rr, rb = bb + expected.bb, rr + expected.rr, expected.rb
    determinant = rr * bb - rb * rb
    squared = (bb * dr * dr - 2.0 * rb * dr * db + rr * db * db) / determinant
    both = mistake.scale * np.exp(-0.5 * squared) / (2.0 * math.pi * np.sqrt(determinant))
    angle_only = np.exp(-0.5 * db * db / bb) / np.sqrt(2.0 * math.pi * bb)
    density = np.where(np.isnan(dr), angle_only, both * spans[1]) * spans[0] * abs(mistake.turn)
    turns = abs(mistake.turn) * spans[1 if mistake.swapped else 0] / (2.0 * math.pi)
    unlabelled = label.size and (label == UNLABELLED).all()
    partner = np.full(db.shape, True) if unlabelled else later.label[:, np.newaxis] == label
    partners = partner.sum(axis=1)
    mean = np.where(partner, density, 0.0).sum(axis=1) / np.maximum(partners, 1)
    known = (partners > 0) & ~np.isnan(bearing)
    return np.where(known, np.log(0.5 + 0.5 * mean / max(turns, 1.0)), 0.0)


def wide_sight(trial: "TrialResult", recorded: "Log", config: Config) -> list[tuple[str, str]]:
    """Return questions, what was found and what is asked, of a sensor's stated sight.

    They are of a field of view or a range of the sensor that is stated wider than its rows.

    Landmarks of the map that are expected beyond nearly all rows (`REACH`), but within what is
    stated, must be heard with the probability ``association.detection``. It is questioned if by
    chance so few would be heard with a probability of `QUESTIONED` at most. Scans count that are as
    far apart as an association remembers, for in neighbours the same thing may hide a landmark.
    """
    stated = config.association
    if stated.max_range is None:
        return []
    far, bearing, heard = _expected_rows(trial, recorded)
    own = [scan.numbers[:, (scan.caller == OWN) & np.isnan(scan.level_db)] for scan in trial.heard]
    rows = np.concatenate([np.empty((NUMBERS, 0)), *own], axis=1)
    rows = rows[:, ~np.isnan(rows[RANGE])]
    if not rows.size:
        return []
    half, farthest = 0.5 * stated.field_of_view - BEFORE, WITHIN * stated.max_range
    wide, long = np.quantile(np.abs(rows[BEARING]), REACH), np.quantile(rows[RANGE], REACH)
    off = np.abs(bearing)
    asked = (
        (
            "field_of_view",
            "bearings",
            (far <= long) & (wide < off) & (off <= half),
            2.0 * wide,
            "rad",
        ),
        ("max_range", "ranges", (off <= wide) & (long < far) & (far <= farthest), long, "m"),
    )
    return [
        (
            f"association.{name} is {getattr(stated, name):.3g} {unit}, but {REACH:.0%} of the "
            f"{what} are within {value:.3g} {unit}, and of {beyond.sum()} times that landmarks "
            f"were expected beyond, they were heard {(beyond & heard).sum()} times",
            f"the map loses landmarks by that; does {value:.3g} fit?",
        )
        for name, what, beyond, value, unit in asked
        if _at_most(int((beyond & heard).sum()), int(beyond.sum()), stated.detection) <= QUESTIONED
    ]


def _at_most(heard: int, times: int, probability: float) -> float:
    """Return the probability that at most so many of some independent times succeed."""
    powers = ((1.0 - probability) ** (times - k) * probability**k for k in range(heard + 1))
    return sum(math.comb(times, k) * power for k, power in enumerate(powers))


def _expected_rows(
    trial: "TrialResult", recorded: "Log"
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"], Bool[np.ndarray, " n"]]:
    """Return range and bearing of all placed landmarks in some scans, and which were heard."""
    track, landmarks = trial.track, trial.track.landmarks
    there = placed(landmarks)
    points, label = landmarks.mean[there], landmarks.landmark[there]
    poses = carried(track.pose, recorded.sensor_pose).mean
    found: list[np.ndarray] = [np.empty((3, 0))]
    for n in range(0, len(track.labels), REMEMBERED):
        scan, labels = trial.heard[n], track.labels[n]
        step = np.searchsorted(track.time, scan.time)
        far, bearing = range_and_bearing(poses[step], points)
        found.append(np.vstack((far, bearing, np.isin(label, labels))))
    far, bearing, heard = np.concatenate(found, axis=1)
    return far, bearing, heard > 0.0
