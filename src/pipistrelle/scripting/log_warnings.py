r"""Warnings on recorded logs: doubtful values, and the mistakes that explain why rows do not fit.

Each mistake in `MISTAKES` is corrected on the rows of some scans. Every row is then compared with
rows of earlier scans, by the motion of the odometry between them; with the right correction, rows
of one landmark coincide. It needs no map, and uses labels only if the log has some.

A row z that follows a scan with n possible partners has the density

.. math:: p(z) = \tfrac12 p_0 + \tfrac1{2n} \sum_i N(z;\ \hat z_i, S_i)

in the numbers of the log, so that units and columns do not matter: half the prior probability is
that the earlier scan lacks the landmark, and :math:`p_0` is uniform over the recorded numbers.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from math import ceil, floor, hypot, inf, log10, pi, radians, sqrt, tau
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.special import bdtrc, gammaincc

from pipistrelle.config import Config
from pipistrelle.detection.scans import OWN, UNLABELLED, WIDEST, columns_of
from pipistrelle.estimation.catalogue import GATE, gate_of, short_name
from pipistrelle.estimation.data_association.watch import POSE
from pipistrelle.estimation.motion import relative_motions
from pipistrelle.experiments.drives import NO_TRUTH, at_sensor, reckoned
from pipistrelle.experiments.named_settings import own_config
from pipistrelle.experiments.runs.replay import drive_of
from pipistrelle.geometry import carrying, wrap
from pipistrelle.scripting.arguments import has_excess_paths

if TYPE_CHECKING:
    from pipistrelle.detection.logs.recording import Log
    from pipistrelle.experiments.drives import Truth
    from pipistrelle.experiments.results.scores import TrialResult

MAX_IGNORED_SHARE = 0.2
"""Largest share of rows that do not fit; above it a warning asks about the units."""
MAX_GATED_SHARE = 0.01
"""Largest excess of the share of rows that the gate rejects; above it a warning is given."""
MAX_NIS = 2.0
"""Largest NIS without a warning; below 1 a filter is cautious, as with the paper's noise."""
MIN_EXCESS_PATH = 0.2
"""Excess paths in metres are rarely smaller, excess paths in seconds mostly [m]."""
UNSURE = {
    "bearing_std": ("angle", "bearings", "rad", WIDEST),
    "way_std": ("range", "ranges", "m", inf),
}
"""By the standard deviation for which an association discards rows: a word of the setting, the
measured numbers, their unit, and the largest one for which a larger value is advised."""
DEGREE = pi / 180.0
COMPARED = 32
"""Most scans, and most rows of a scan, that are compared with earlier scans."""
LAGS = 2 ** np.arange(10)
"""Distances to the earlier scans, in scans."""
CHANCE = 0.01
"""Probability of naming a mistake by chance."""
Question = tuple[str, str]
"""An observation, and the question or advice that follows."""


def labels_of(recorded: "Log") -> set[int]:
    """Return the set of landmark labels in a log."""
    return {*columns_of(recorded.scans)["landmark"].tolist()}


def distance_driven(recorded: "Log") -> float:
    """Return the distance [m] that a log's odometry covers, forwards and backwards."""
    if recorded.motion == "poses":
        return sum(hypot(*step) for step in recorded.controls[:, :2].tolist())
    return float(abs(recorded.controls[:, 0] * recorded.dt).sum())


def log_warnings(recorded: "Log", truth: "Truth", log: Path) -> list[str]:
    """Return warnings about a log before it is solved: doubtful values, ignored rows, jumps."""
    return [f"{log}: {note}" for note in _doubts(recorded, truth)]


def _doubts(recorded: "Log", truth: "Truth") -> Iterator[str]:
    """Yield the warnings about a log before it is solved, without the log's path."""
    yield from recorded.doubts
    if ignored := recorded.ignored_rows:
        reasons = (f"{count} {reason.replace('_', ' ')}" for reason, count in ignored.items())
        yield f"rows left out: {', '.join(reasons)}"
    for name in ("initial_pose", "sensor_pose"):
        heading = getattr(recorded, name)[2]
        if abs(heading) > tau:
            yield (
                f"the heading of {name}, {heading:g} rad, is beyond a turn; is it in degrees? "
                f"{heading:g} degrees are {radians(heading):.4g} rad"
            )
    if recorded.motion == "poses":
        yield from _jumps(recorded)
    labels = labels_of(recorded)
    if labels != {UNLABELLED}:  # else the association finds the callers
        yield from _unheard(recorded, labels)
    if truth.path is not None:
        steps = len(truth.time) - 1
        known_steps = sum(1 for pose in truth.path[1:] if pose[0] == pose[0])
        if known_steps < steps:
            yield f"the truth covers {known_steps} of {steps} steps; only these are scored"


def _jumps(recorded: "Log") -> Iterator[str]:
    """Yield a warning if some odometry steps are far larger than the others (a changed frame)."""
    from pipistrelle.detection.logs.poses import jumps

    far_steps = jumps(recorded.controls, recorded.dt)
    if far_steps.size:
        step = int(far_steps[0])
        ahead, aside, turn = recorded.controls[step, :3].tolist()
        others = f", and {far_steps.size - 1} more such steps" * (far_steps.size > 1)
        yield (
            f"the odometry moves by {hypot(ahead, aside):.3g} m and turns by {turn:.3g} rad "
            f"in the {recorded.dt[step]:.3g} s from {recorded.time[step]:.15g} s on{others}; "
            "did its frame change?"
        )


def _unheard(recorded: "Log", labels: set[int]) -> Iterator[str]:
    """Yield a warning for each caller that has excess paths but no known or measured position."""
    rows = columns_of(recorded.scans)
    timed = {*rows["caller"][~np.isnan(rows["excess_path"])].tolist()}
    for number, caller in enumerate(recorded.callers, start=1):
        if number in timed and caller.landmark not in labels and caller.place is None:
            yield (
                f"no row measures landmark {caller.landmark}, the caller {caller.name!r}, so its "
                "excess paths say nothing; correct its number, or say its place"
            )


def fit_warnings(
    recorded: "Log", trials: "Sequence[TrialResult]", log: Path, config: Config
) -> list[str]:
    """Return warnings about the solution of a log if many measurements do not fit it.

    They name the mistake in its columns that explains the misfit, else ask about units and labels.
    """
    odd = _out_of_bounds(recorded)
    questions, unmapped, wide = odd["bearings"] + odd["ranges"], [], []
    notes = [
        f"none of the {rows} rows of {trial.strategy} sensing is of a landmark, nothing is mapped: "
        "without a label, a bearing needs a range or excess paths, and a range a bearing"
        if (rows := sum(scan.landmark.size for scan in trial.heard))
        else f"nothing in it is heard by {trial.strategy} sensing, so it maps nothing"
        for trial in trials
        if not any(len(scan.landmark) for scan in trial.scans)
    ]
    for trial in () if odd["bearings"] else trials:
        misfits = _rejected(trial, recorded, config)
        questions += misfits
        if trial.track.labels:
            labels = np.concatenate(trial.track.labels)
            mapped = np.count_nonzero(np.isin(labels, trial.track.landmarks.landmark))
            if 2 * mapped < labels.size:
                found = f"{mapped} of {labels.size} rows are of landmarks of the map at the end"
                case = f"{trial.strategy} {short_name(trial.filter)}"
                unmapped.append((f"{found} ({case})", _units(recorded)))
            wide += [*_refuted(trial, recorded)]
        wide += [] if misfits else [*_corrected(trial)]
    if questions or unmapped:
        mistake, fits = misreading(recorded)
        questions += [] if fits else unmapped
        if mistake:
            questions = [(questions[0][0], mistake)]
    questions += wide + odd["excess paths"]
    notes += [f"{found}; {question}" for found, question in questions]
    return [f"{log}: {note}" for note in (*notes, *dict.fromkeys(_unsure(trials, config)))]


def early_warnings(recorded: "Log", truth: "Truth", log: Path) -> list[str]:
    """Return all warnings about a log that need no solution, with a mistake in its columns."""
    lines, odd = log_warnings(recorded, truth, log), fit_warnings(recorded, (), log, Config())
    mistake = "" if odd else misreading(recorded)[0]
    return [*lines, *odd, *([f"{log}: {mistake}"] if mistake else [])]


def _units(recorded: "Log") -> str:
    """Return a question for the user on the units and the sense of a log's angles and ranges."""
    metric = f"ranges{' and excess paths' * has_excess_paths(recorded)} in metres"
    angles = f"bearings{' and headings' * (recorded.motion == 'poses')} in radians"
    labels = ", all labels right" * (labels_of(recorded) != {UNLABELLED})
    return f"are {angles} and counter-clockwise, {metric}{labels}, and stated noise large enough?"


def _rejected(trial: "TrialResult", recorded: "Log", config: Config) -> list[Question]:
    """Return warnings if the gate rejects many of a trial's measurements, or the NIS is large."""
    from pipistrelle.experiments.results.scores import is_placed, judged

    heard = judged(trial.scans)
    if not heard or not is_placed(trial):
        return []
    gated, who = trial.scores.gated, f"{trial.strategy} {short_name(trial.filter)}"
    if MAX_IGNORED_SHARE * heard < gated:
        found = f"{gated} of {heard} measurements do not fit what was expected ({who})"
        return [(found, _units(recorded))]
    if not trial.track.labels and (strayed := _strayed(trial, who)):
        return strayed
    expected = 1.0 - gate_of(trial.filter, own_config(config, trial.filter))
    if (MAX_GATED_SHARE + expected) * heard < gated:
        found = (
            f"the gate rejects {gated / heard:.1%} of the measurements ({who}), expected "
            f"{expected:.1%}: they are less sure than they say, or something was placed wrong "
            "before"
        )
        fix = 'larger standard deviations help, or a gate of 1 with filter.robust = "huber"'
        return [(found, fix)]
    found, _, advice = nis_warning(trial).partition("; ")
    return [(found, advice)] if found else []


def _strayed(trial: "TrialResult", who: str) -> list[Question]:
    """Return a warning if successive measurements of a landmark are far from the final map."""
    from pipistrelle.evaluation.consistency import strayed_landmarks

    strayed = strayed_landmarks(trial.track, trial.scans, GATE, MAX_GATED_SHARE + 1.0 - GATE)
    if not strayed:
        return []
    label, (first, last, count) = max(strayed.items(), key=lambda item: item[1][2])
    others = f", and {len(strayed) - 1} more landmarks likewise" * (len(strayed) > 1)
    found = (
        f"{count} measurements of landmark {label} in a row, from {first:.15g} to {last:.15g} s, "
        f"are far from the map and path at the end{others} ({who})"
    )
    return [(found, "was it moved, is its label right, or was a loop not closed?")]


def _refuted(trial: "TrialResult", recorded: "Log") -> Iterator[Question]:
    """Yield a warning for each cause of alarms in a trial."""
    alarms = trial.track.report.get("alarms", ())
    who = f"{trial.strategy} {short_name(trial.filter)}"
    for call, repaired in dict.fromkeys(alarm[1:] for alarm in alarms):
        times = [f"{time:.15g}" for time, *alarm in alarms if alarm == [call, repaired]]
        since = f"from {', '.join(times[:4])}{', ...' * (len(times) > 4)} s on"
        if call == POSE:
            found = "no measurements fit the map from where the odometry leads"
            then = "its pose was found again on the map"
            asked = "did it skid, slip, was it moved, or is its odometry less precise than stated?"
        elif call == OWN:
            found = "the ranges to the map's landmarks do not fit, other calls' paths do"
            then, asked = "", "was the sensor moved, or another range setting used?"
        else:
            found = f"the measurements by {recorded.callers[call - 1].name!r} do not fit"
            then, asked = "it was searched for again", "was it moved, or its name given to another?"
        then = then if repaired else "path and map are not to be trusted from then on"
        yield f"{since}, {found} ({who}); {then}", asked


def _corrected(trial: "TrialResult") -> Iterator[Question]:
    """Yield a warning if scans correct the pose by more than the estimator expects."""
    squared, degrees = trial.track.corrections
    times = f"{sqrt(squared / max(degrees, 1.0)):.1f}"
    if float(times) > 1.0 and gammaincc(0.5 * degrees, 0.5 * squared) < CHANCE:
        found = f"scans correct the pose {times} times as much as the estimator expects"
        why = "is the odometry or a measurement less precise than stated, or a label wrong?"
        yield f"{found} ({trial.strategy} {short_name(trial.filter)})", why


def _unsure(trials: "Sequence[TrialResult]", config: Config) -> Iterator[str]:
    """Yield a warning if an association discards most measurements as uncertain, with a remedy."""
    for trial in trials:
        settings = own_config(config, trial.filter).association
        rows = sum(scan.landmark.size for scan in trial.heard)
        for name, stds in trial.left_out.items():
            if stds.size < (1.0 - MAX_IGNORED_SHARE) * rows:
                continue
            word, measured, unit, most = UNSURE[name]
            limit, taken = getattr(settings, f"max_{word}_std"), stds[stds <= most]
            spread = dict.fromkeys(f"{std:.2g}" for std in (stds.min(), stds.max()))
            note = (
                f"{stds.size} rows of {trial.strategy} sensing are left out: the standard "
                f"deviation of their {measured}, {' to '.join(spread)} {unit}, is above "
                f"association.max_{word}_std, {limit:g} {unit}"
            )
            if taken.size:
                digit = 10.0 ** floor(log10(taken.max()))
                flag = f"--association.max-{word}-std"
                value = ceil(taken.max() / digit) * digit
                whole = "them" if taken.size == stds.size else f"{taken.size} of them"
                note += f"; {flag} {value:g} takes {whole}"
            yield note


def nis_warning(trial: "TrialResult") -> str:
    """Return a warning if a trial's innovations are much larger than predicted, else ""."""
    nis = trial.scores.nis_mean
    if nis is None or not MAX_NIS < nis < inf:
        return ""
    return (
        f"{trial.strategy} {short_name(trial.filter)}: its innovations are {sqrt(nis):.1f} times "
        f"what it expects (NIS {nis:.3g}, 1 where it believes rightly): measurements or odometry "
        "are less sure than they say, or labels are wrong; larger standard deviations help"
    )


def _out_of_bounds(recorded: "Log") -> dict[str, list[Question]]:
    """Return warnings about each kind of measurement with many values outside plausible bounds."""
    near, far = recorded.range_bounds
    bounds = f"range_bounds ({near:g} to {far:g} m)"
    bearing, rows = recorded.recorded_bearings(), columns_of(recorded.scans)
    distance, excess = (rows[name][~np.isnan(rows[name])] for name in ("range", "excess_path"))
    few, most = MAX_IGNORED_SHARE, 1.0 - MAX_IGNORED_SHARE
    checks = (
        ("bearings", abs(bearing) > tau, few, "beyond a turn"),
        ("ranges", (distance < near) | (distance > far), few, f"not within {bounds}"),
        ("excess paths", excess > 2.0 * far, few, f"more than twice the far end of {bounds}"),
        ("excess paths", excess < MIN_EXCESS_PATH, most, f"below {MIN_EXCESS_PATH:g} m"),
    )
    questions: dict[str, list[Question]] = {name: [] for name, *_ in checks}
    for name, rows, share, where in checks:
        if np.count_nonzero(rows) > share * rows.size:
            fix = "are they in radians?" if name == "bearings" else f"are {name} in metres?"
            found = f"{np.count_nonzero(rows)} of {rows.size} {name} are {where}"
            questions[name].append((found, fix))
    return questions


class Mistake(NamedTuple):
    """A possible mistake in the columns of a log, such as wrong units, and its correction."""

    cause: str
    undone: str
    fix: str
    turn: float = 1.0
    """Factor of the bearing, after which it is in radians, counter-clockwise."""
    offset: float = 0.0
    """Added to the bearing after `turn` [rad]."""
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
        "add pi to them, or to the angle of sensor_pose", offset=pi,
    ),
    Mistake(
        "bearings seem to be from the x axis of the map", "less the heading",
        "subtract the vehicle's heading", from_map=True,
    ),
    Mistake(
        "bearings seem to be of a compass, clockwise from the y axis", "from the heading",
        "subtract them and the vehicle's heading from pi / 2", turn=-1.0, offset=0.5 * pi,
        from_map=True,
    ),
    Mistake(
        "bearings seem to be of a compass, in degrees from the y axis", "from the heading",
        "subtract them and the vehicle's heading from 90 degrees, in radians", turn=-DEGREE,
        offset=0.5 * pi, from_map=True,
    ),
    Mistake("ranges seem to be in millimetres", "in metres", "divide them by 1000", scale=1e-3),
    Mistake("ranges seem to be in centimetres", "in metres", "divide them by 100", scale=1e-2),
    Mistake("ranges seem to be in kilometres", "in metres", "multiply them by 1000", scale=1e3),
    Mistake(
        "the odometry seems to turn in degrees", "in radians",
        "multiply its angles by pi / 180", rate=DEGREE,
    ),
)  # fmt: skip
"""The mistakes that `misreading` tries."""
_UNDONE = np.array([(m.turn, m.offset, m.from_map, m.scale, m.swapped) for m in (NONE, *MISTAKES)])
"""Their corrections of bearings and ranges, as rows of numbers; first, the columns as recorded."""


_Path = tuple[Float[np.ndarray, "t 3"], Float[np.ndarray, "t 3"], Float[np.ndarray, "t-1 3 3"]]
"""Poses of sensor and vehicle by dead reckoning, and the covariance of each step's motion in the
axes of the map."""
_Driven = tuple[_Path, Float[np.ndarray, "3 3"]]
"""A path, and the covariance of the sensor's motion between two steps (`_drift`)."""


class _Rows(NamedTuple):
    """Measurements of a scan as recorded, for the search for mistakes; NaN if missing."""

    bearing: Float[np.ndarray, " m"]
    range: Float[np.ndarray, " m"]
    variance: Float[np.ndarray, "2 m"]
    """Of bearing and range."""
    label: Int[np.ndarray, " m"]
    step: int
    """Index of the scan in the times of the odometry."""


def misreading(recorded: "Log") -> tuple[str, bool]:
    """Return the mistake that best explains a log's rows ("" for none), and whether they fit.

    A mistake is named if, by a sign test over scans at the level `CHANCE`, the rows are more
    probable with it corrected than as recorded, than with any other mistake corrected, and than
    without landmarks. The recorded rows fit if they are more probable than without landmarks, or
    than with any correction; with too few scans for the test they count as fitting.
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
    """Return the probability that at least this many differences are positive by chance."""
    positive, n = np.count_nonzero(difference > 0.0), np.count_nonzero(difference)
    return float(bdtrc(positive - 1, n, 0.5))


def _fits(recorded: "Log") -> tuple[Int[np.ndarray, " k"], Float[np.ndarray, "k h"]]:
    """Return scan number and fit to earlier scans of each row: as recorded, and as corrected.

    The fit is the sum over earlier scans of log p(z) / p_0.
    """
    every, edges = _recorded_rows(recorded)
    spans, count = [], len(recorded.scans)
    for values, least in ((every.bearing, recorded.bearing_std), (every.range, recorded.range_std)):
        values = values[~np.isnan(values)]
        spans.append(max(float(np.ptp(values)) if values.size else 0.0, least))
    rates = np.array([mistake.rate for mistake in (NONE, *MISTAKES)])
    tried = [(rates == rate, _path(recorded, rate)) for rate in np.unique(rates).tolist()]
    scans, fits = [], []

    def rows(n: int) -> _Rows:
        step = int(np.searchsorted(recorded.time, recorded.scans[n].time))
        return _some(every, np.arange(edges[n], edges[n + 1]))._replace(step=step)

    chosen = np.linspace(1, count - 1, COMPARED if count > 1 else 0)
    for n in np.unique(chosen.round().astype(int)):
        later = rows(n)
        later = _some(later, np.linspace(0, later.label.size - 1, COMPARED))
        fit = np.zeros((later.label.size, 1 + len(MISTAKES)))
        for earlier in (rows(n - lag) for lag in LAGS if lag <= n):
            for mistakes, path in tried:
                driven = path, _drift(path, earlier.step, later.step)
                fit[:, mistakes] += _log_ratio(earlier, later, _UNDONE[mistakes], driven, spans)
        scans.append(np.full(len(fit), n))
        fits.append(fit)
    scan, fit = np.concatenate([np.empty(0, int), *scans]), np.concatenate(fits) if fits else []
    compared = np.any(fit, axis=1) if len(scan) else np.empty(0, bool)
    return scan[compared], np.reshape(fit, (len(scan), 1 + len(MISTAKES)))[compared]


def _recorded_rows(recorded: "Log") -> tuple[_Rows, Int[np.ndarray, " s+1"]]:
    """Return the measurements with a bearing, and the first of each scan, the last scan's end too.

    Direct calls and moving callers are left out.
    """
    rows, bearing = columns_of(recorded.scans), recorded.recorded_bearings()
    stated = np.array([rows["bearing_std"], rows["range_std"]])
    general = np.array([[recorded.bearing_std], [recorded.range_std]])
    stds, label = np.where(np.isnan(stated), general, stated), rows["landmark"]
    edges = np.cumsum([0, *(scan.landmark.size for scan in recorded.scans)])
    moving = [caller.landmark for caller in recorded.callers if caller.moves]
    usable = ~np.isnan(bearing) & ~np.isin(label, moving)
    for scan, begin in zip(recorded.scans, edges.tolist(), strict=False):
        if scan.direct.size:
            usable[begin + scan.direct[scan.direct >= 0]] = False
    whole = _Rows(bearing, rows["range"], stds**2, label, 0)
    return _some(whole, np.flatnonzero(usable)), np.append(0, np.cumsum(usable))[edges]


def _some(rows: _Rows, chosen: np.ndarray) -> _Rows:
    """Select measurements of a scan by their indices, which are rounded first."""
    n = np.unique(chosen.round().astype(int)) if rows.label.size else np.empty(0, int)
    return _Rows(rows.bearing[n], rows.range[n], rows.variance[:, n], rows.label[n], rows.step)


def _path(recorded: "Log", rate: float) -> _Path:
    """Dead-reckon a log's path, with angular rate or steering angle multiplied by `rate`."""
    controls = recorded.controls.copy()
    if recorded.motion != "poses":
        controls[:, 1] *= rate
    drive = replace(drive_of(recorded, NO_TRUTH), controls=controls)
    vehicle, sensor = (reckoned(one).mean for one in (drive, at_sensor(drive)))
    _, noise = relative_motions(drive.motion, controls, recorded.dt)
    axes = carrying(np.zeros((len(noise), 2)), vehicle[:-1, 2])
    return sensor, vehicle, axes @ noise @ axes.transpose(0, 2, 1)


def _drift(path: _Path, begin: int, step: int) -> Float[np.ndarray, "3 3"]:
    """Return the covariance of the sensor's motion between two steps, in the axes of the map."""
    sensor, vehicle, noise = path
    lever = sensor[step, :2] - vehicle[begin + 1 : step + 1, :2]
    J = carrying(lever)
    return np.tensordot(J @ noise[begin:step], J, axes=((0, 2), (0, 2)))


def _undone(
    rows: _Rows, mistakes: Float[np.ndarray, "h 5"], heading: float
) -> tuple[Float[np.ndarray, "h m"], Float[np.ndarray, "h m"]]:
    """Correct mistakes (`_UNDONE`) in the measurements of a scan; return bearings and ranges."""
    turn, offset, from_map, scale, swapped = mistakes.T[:, :, np.newaxis]
    bearing = np.where(swapped, rows.range, rows.bearing)
    distance = np.where(swapped, rows.bearing, rows.range)
    return wrap(turn * bearing + offset - heading * from_map), scale * distance


def _expected(
    earlier: _Rows, mistakes: Float[np.ndarray, "h 5"], path: _Driven, step: int
) -> Float[np.ndarray, "5 h n"]:
    """Predict the measurements at a later step from an earlier scan, with mistakes corrected.

    The prediction is a bearing, a range, and the entries bb, rb and rr of their covariance; NaN
    without a range.
    """
    (sensor, *_), P = path
    now, before = sensor[step], sensor[earlier.step]
    b, r = _undone(earlier, mistakes, before[2])
    r = np.where(np.isfinite(b) & (r > 0.0), r, np.nan)
    ray = np.stack((np.cos(before[2] + b), np.sin(before[2] + b)))
    off = (before - now)[:2, np.newaxis, np.newaxis] + r * ray
    distance = np.maximum(np.hypot(*off), np.finfo(float).tiny)
    u = off / distance
    normal = np.stack((-u[1], u[0]))
    c, s = (ray * u).sum(axis=0), (ray * normal).sum(axis=0)
    across, along = earlier.variance[0] * r**2, earlier.variance[1]
    to_range = np.stack((*-u, np.zeros_like(r)))
    to_bearing = np.stack((*-normal / distance, -np.ones_like(r)))

    def moved(one: np.ndarray, other: np.ndarray) -> np.ndarray:
        return np.einsum("ihn,ij,jhn->hn", one, P, other)

    bb = (s * s * along + c * c * across) / distance**2 + moved(to_bearing, to_bearing)
    rb = c * s * (along - across) / distance + moved(to_range, to_bearing)
    rr = c * c * along + s * s * across + moved(to_range, to_range)
    return np.stack((np.arctan2(off[1], off[0]) - now[2], distance, bb, rb, rr))


@np.errstate(over="ignore", under="ignore", invalid="ignore")
def _log_ratio(
    earlier: _Rows, later: _Rows, mistakes: np.ndarray, path: _Driven, spans: Sequence[float]
) -> Float[np.ndarray, "m h"]:
    """Return a log-likelihood ratio per row and mistake: predicted by a scan, or by chance."""
    expected = _expected(earlier, mistakes, path, later.step)
    b, r, bb, rb, rr = expected[:, :, np.newaxis]
    bearing, distance = _undone(later, mistakes, path[0][0][later.step, 2])
    db, dr = wrap(bearing[..., np.newaxis] - b), distance[..., np.newaxis] - r
    bb, rr = later.variance[0][:, np.newaxis] + bb, later.variance[1][:, np.newaxis] + rr
    determinant = rr * bb - rb * rb
    squared = (bb * dr * dr - 2.0 * rb * dr * db + rr * db * db) / determinant
    turn, scale, swapped = abs(mistakes[:, [0, 3, 4]].T[..., np.newaxis, np.newaxis])
    both = scale * np.exp(-0.5 * squared) / (2.0 * pi * np.sqrt(determinant))
    angle_only = np.exp(-0.5 * db * db / bb) / np.sqrt(2.0 * pi * bb)
    density = np.where(np.isnan(dr), angle_only, both * spans[1]) * spans[0] * turn
    turns = turn * np.where(swapped, spans[1], spans[0]) / (2.0 * pi)
    ranged = ~np.isnan(r)
    labelled = (ranged & (earlier.label != UNLABELLED)).any(axis=2, keepdims=True)
    partner = ranged & (~labelled | (later.label[:, np.newaxis] == earlier.label))
    partners = partner.sum(axis=2)
    mean = np.where(partner, density, 0.0).sum(axis=2) / np.maximum(partners, 1)
    fit = np.log(0.5 + 0.5 * mean / np.maximum(turns[..., 0], 1.0))
    return np.where((partners > 0) & ~np.isnan(bearing), fit, 0.0).T
