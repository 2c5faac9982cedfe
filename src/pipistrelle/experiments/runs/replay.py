"""Missions that are solved again: recorded logs, and missions of result folders.

Equal settings give equal bits, so a folder stores the settings and, for a recorded log, its path,
sums and options (`log_entry`), but no belief of every frame.
"""

import math
import warnings
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from hashlib import file_digest
from itertools import product
from os import fsencode
from pathlib import Path
from typing import Any

import numpy as np

from pipistrelle.config import BagConfig, Config, InputError, Strategy
from pipistrelle.detection.logs.readers import (
    READERS,
    Reader,
    Robot,
    kind_of,
    reader_of,
    wrong_kind,
)
from pipistrelle.detection.logs.recording import Log
from pipistrelle.detection.noise import noise_of, without_hidden
from pipistrelle.detection.scans import (
    UNLABELLED,
    Scan,
    labelled,
    rows_of,
    with_columns,
    without_excess_paths,
    without_labels,
)
from pipistrelle.estimation.beliefs import KNOWN, Gaussian, Landmarks
from pipistrelle.estimation.catalogue import CATALOGUE, short_name
from pipistrelle.estimation.data_association.sequential import METHODS, left_out
from pipistrelle.estimation.motion import Motion
from pipistrelle.estimation.smoother.preintegration import OF_ODOMETRY
from pipistrelle.evaluation.association import Causes, causes_of
from pipistrelle.experiments.drives import Drive, Truth
from pipistrelle.experiments.hearing.listening import Progress
from pipistrelle.experiments.hearing.scenario import ALL_DRAWN
from pipistrelle.experiments.hearing.world_folder import read_world
from pipistrelle.experiments.named_settings import Case, each_its_own
from pipistrelle.experiments.results.reading import SUMMARY, Summary, read_summary
from pipistrelle.experiments.results.scores import TrialResult, with_shared
from pipistrelle.experiments.results.writing import settings_hash, tum_text
from pipistrelle.experiments.runs import truth_files
from pipistrelle.experiments.runs.heard_world import Mission
from pipistrelle.experiments.runs.trial import Watch, run_mission, try_trial
from pipistrelle.experiments.runs.truth_files import TRUTHS, WithTruth, with_files_beside
from pipistrelle.experiments.runs.validate import check_filters
from pipistrelle.files import read_file, text_of
from pipistrelle.refusals import refusal
from pipistrelle.settings import from_file, read_toml, resolve
from pipistrelle.version import find_version

NO_BAG = BagConfig()
LEAST_STD = 1e-6
"""Least standard deviation of a given position [m]; a smaller one gives a singular covariance."""


def load(
    folder: Path,
    robot: Robot | None = None,
    *,
    bag: BagConfig = NO_BAG,
    readers: Sequence[Reader] = (),
    truths: Mapping[str, WithTruth] = {},
) -> tuple[Log, Truth]:
    """Read a recorded log, and its truth if it has any.

    `folder` may be a file for formats of a single file. `robot`, a number or a name, is needed only
    for formats with several, such as MRCLAM sets. `readers` of other formats are tried before the
    package's. `truths` are functions, by a reader's name, that read its log with the truth; the
    default reads ``truth.csv`` and ``landmarks.csv`` in the log's folder. An InputError names the
    file and the line or key, the value found, the value expected and the fix.

    Examples
    --------
    >>> from dataclasses import replace
    >>> walk = Log(
    ...     name="walk", time=np.array([0.0, 1.0]), controls=np.array([[1.0, 0.0]]),
    ...     dt=np.array([1.0]), scans=(), motion="unicycle", control_std=(0.1, 0.1),
    ...     initial_pose=(0.0, 0.0, 0.0), initial_pose_std=(0.0, 0.0, 0.0), range_std=0.2,
    ...     bearing_std=0.06, range_bounds=(0.5, 20.0), ignored_rows={},
    ... )
    >>> herd = Reader(
    ...     name="herd", title="walks of a herd", recognises=lambda folder: True,
    ...     read=lambda folder, robot: replace(walk, name=robot),
    ...     robots=lambda folder: ["ant", "bee"],
    ... )
    >>> log, truth = load(Path(), "bee", readers=[herd])
    >>> log.name, truth.path
    ('bee', None)
    """
    formats = (*readers, *READERS)
    titles = " or ".join(reader.title for reader in formats)
    reader = reader_of(folder, readers)
    recognised = reader.recognises(folder) and (folder.exists() or reader.configured)
    if not recognised and (kind_of(folder) or not folder.is_dir()):
        raise wrong_kind(folder, titles, "log.toml")
    whose = (*((bag,) if reader.configured else ()), *_whose(reader, folder, robot, formats))
    with_truth = {**TRUTHS, **truths}.get(reader.name, with_files_beside)
    return with_truth(reader.read, folder, *whose)


def as_heard_by(
    scans: Sequence[Scan], strategy: Strategy, beamwidth: float | None = None
) -> tuple[Scan, ...]:
    """Reduce the scans of a log to the measurements that a sensing strategy provides.

    Inside the beam, of full width `beamwidth` [rad] about the heading, range and bearing are
    measured actively. Outside it only the bearing is measured, passively; excess paths are measured
    everywhere. Fused keeps both, active only rows with a range and no excess paths, passive all
    bearings and no range. Without a beamwidth all ranges are kept.
    """
    limit = math.inf if beamwidth is None else beamwidth / 2.0
    heard = []
    for scan in scans:
        hidden = (np.abs(scan.bearing) > limit) | (strategy == "passive")
        distance = np.where(hidden, np.nan, scan.range)
        kept = np.isfinite(distance) | (strategy != "active")
        taken = rows_of(with_columns(scan, range=distance), kept)
        heard.append(without_excess_paths(taken) if strategy == "active" else taken)
    return tuple(heard)


def log_motion(log: Log) -> Motion:
    """Return the motion model of a recorded log's odometry."""
    return Motion(
        model=log.motion,
        control_std=log.control_std,
        wheelbase=log.wheelbase,
        speed_offset=log.speed_offset,
        noise_at_rest=log.noise_at_rest,
    )


def replay(
    log: Log,
    truth: Truth,
    strategies: Sequence[Strategy],
    filters: Sequence[str],
    beamwidth: float | None,
    config: Config,
    *,
    progress: Progress | None = None,
    watch: Watch | None = None,
) -> Mission:
    """Estimate path and map of a recorded log with each strategy and filter.

    Ranges outside `beamwidth` [rad] are hidden (`as_heard_by`). Only the estimators' sections of
    the settings apply, and they must agree with the log. "constant" noise ignores the standard
    deviations in the log; an association ignores its labels. Raises InputError for an estimator
    that cannot be found or built.

    A post 2 m ahead, after a drive of 1 m, is at 3 m:

    >>> from pipistrelle.detection.scans import make_scan
    >>> ahead = make_scan(1.0, np.array([7]), np.array([0.0]), range=np.array([2.0]))
    >>> log = Log(
    ...     name="walk", time=np.array([0.0, 1.0]), controls=np.array([[1.0, 0.0]]),
    ...     dt=np.array([1.0]), scans=(ahead,), motion="unicycle", control_std=(0.1, 0.1),
    ...     initial_pose=(0.0, 0.0, 0.0), initial_pose_std=(0.0, 0.0, 0.0), range_std=0.2,
    ...     bearing_std=0.06, range_bounds=(0.5, 20.0), ignored_rows={},
    ... )
    >>> mission = replay(log, Truth(time=log.time), ["active"], ["ekf"], None, Config())
    >>> (trial,) = mission.trials
    >>> trial.track.landmarks.landmark, trial.track.landmarks.mean
    (array([7]), array([[3., 0.]]))
    """
    drive = drive_of(log, truth)
    groups = tuple(each_its_own(config, filters))
    for own, names in groups:
        check_filters(names, drive.motion, own, drive.moving.values())
        check_calibrated(log, own)
    bare = any((scan.landmark == UNLABELLED).any() for scan in log.scans)
    trials: dict[tuple[str, str], TrialResult] = {}
    for (own, names), strategy in product(groups, strategies):
        known = own.association.method == KNOWN
        if known and bare:
            raise refusal(log.name, "rows without labels", LABELS, UNKNOWN)
        used = [without_unused(rows, own) for rows in log.scans]
        scans = tuple(with_noise(scan, own) for scan in as_heard_by(used, strategy, beamwidth))
        causes: Causes | None = None
        if not (known or bare):
            pairs = zip(scans, log.scans, strict=True)
            causes = [causes_of(scan, rows, rows.landmark) for scan, rows in pairs]
        unsure: Any = left_out(own, map(noise_of(own.filter), scans))
        for name in names:
            case = Case(strategy=strategy, filter=name)
            trial = try_trial(
                case, drive, scans, own, causes=causes, progress=progress, watch=watch
            )
            trials[strategy, name] = replace(trial, left_out=unsure)
    ordered = with_shared([trials[pair] for pair in product(strategies, filters)], truth)
    return Mission(config=config, drive=drive, trials=ordered, beamwidth=beamwidth, log=log)


def drive_of(log: Log, truth: Truth) -> Drive:
    """Return a recorded log as the input of an estimator, with the truth for scoring."""
    placed = {label: (place, log.landmark_std) for label, place in log.landmarks.items()}
    whose = [who for who in log.callers if who.place]
    placed |= {who.landmark: (who.place, who.place_std or log.landmark_std) for who in whose}
    stds = [np.maximum(std, LEAST_STD) for _, std in placed.values()]
    variance = np.square(np.array(log.initial_pose_std, dtype=float))
    return Drive(
        motion=log_motion(log),
        start=Gaussian(mean=np.array(log.initial_pose, dtype=float), covariance=np.diag(variance)),
        time=log.time,
        controls=log.controls,
        truth=truth,
        known=Landmarks(
            landmark=np.array([*placed], dtype=np.int64),
            mean=np.array([place for place, _ in placed.values()], dtype=float).reshape(-1, 2),
            covariance=np.array([np.eye(2) * std**2 for std in stds]).reshape(-1, 2, 2),
            weight=np.ones(len(placed)),
        ),
        callers=np.array([UNLABELLED, *(who.landmark for who in log.callers)]),
        moving={who.landmark: who.name for who in log.callers if who.moves},
        sensor=log.sensor_pose,
    )


def without_unused(scan: Scan, config: Config) -> Scan:
    """Remove from a recorded scan the labels, noise and excess paths that the settings exclude."""
    known = config.association.method == KNOWN
    rows = scan if known or scan.direct.size else without_labels(scan, scan.callers)
    timing = config.listening.excess_paths
    return without_hidden(rows, config.filter, timing=timing, known=known)


def with_noise(scan: Scan, config: Config) -> Scan:
    """Merge a scan's measurements of each landmark and set their noise, if labels are known."""
    if config.association.method != KNOWN:
        return scan
    return noise_of(config.filter)(labelled(scan, scan.landmark))


def check_calibrated(log: Log, config: Config) -> None:
    """Raise if odometry is to be calibrated with a sensor off the vehicle's origin."""
    asked = [name for name in config.filter.calibrate if name in OF_ODOMETRY]
    if asked and any(log.sensor_pose):
        expected = f"none of {', '.join(OF_ODOMETRY)} beside a sensor_pose"
        raise refusal("filter.calibrate", repr(asked[0]), expected, "leave it out")


LABELS = "labels of landmarks, or an association"
UNKNOWN = 'add --association.method marginal, in Python association__method="marginal"'
"""Expected labels of a log, and the fix if it has none."""


def _whose(
    reader: Reader, folder: Path, robot: Robot | None, formats: Sequence[Reader]
) -> tuple[Robot, ...]:
    """Return the robot to read from a log, in a tuple; empty if the format has a single robot."""
    if reader.robots is None:
        if robot is None:
            return ()
        found = f"a log of one vehicle, but robot {robot} was asked for"
        expected = " or ".join(other.title for other in formats if other.robots is not None)
        raise refusal(folder, found, expected, "leave out --robot")
    robots = {str(there): there for there in reader.robots(folder)}
    if robot is None or str(robot) not in robots:
        found = "no robot" if robot is None else f"robot {robot}"
        expected = f"one whose odometry is there ({', '.join(robots) or 'none is'})"
        raise refusal(f"{folder}, option --robot", found, expected, "name another")
    return (robots[str(robot)],)


def rerun(
    folder: Path,
    *,
    log: Path | None = None,
    trusted: Collection[str] = (),
    progress: Progress | None = None,
    watch: Watch | None = None,
) -> Mission:
    """Repeat a mission from its result folder, and compare its tracks with the stored tracks.

    `log` is the new path of a log that was moved. Estimators and associations from outside
    (``module:Class``) run only if `trusted` lists them, as the folder may be another person's.
    """
    summary = read_summary(folder)

    def trust(place: str, name: str, known: Collection[str], flag: str, keyword: str) -> None:
        if name not in (*known, *trusted):
            found = f"{name!r}, whose code is not Pipistrelle's"
            fix = f"add --{flag} {name} (in Python: {keyword}={name!r}) to run it"
            raise refusal(place, found, "one that you trust", fix)

    for run in summary.runs:
        trust(f"{folder / SUMMARY}: runs.filter", run.filter, CATALOGUE, "filter", "filters")
    with warnings.catch_warnings(action="ignore", category=FutureWarning):
        config = resolve(from_file(folder / "config.toml"))  # old names need no change there
    place, method = f"{folder / 'config.toml'}: association.method", config.association.method
    trust(place, method, (KNOWN, *METHODS), "association.method", "association")
    strategies = list(dict.fromkeys(run.strategy for run in summary.runs))
    filters = list(dict.fromkeys(run.filter for run in summary.runs))
    if summary.log is None:
        if "scenario" not in read_toml(folder / "config.toml"):
            found = "which log was solved (it is the folder of an earlier version)"
            fix = "solve it again, `pipistrelle slam LOG -o DIR`, and name DIR"
            raise refusal(f"{folder / SUMMARY}: log", "nothing", found, fix)
        if log is not None:
            expected = "none, for `pipistrelle run` simulated this mission"
            raise refusal(f"{folder}, option --log", f"{log}", expected, "leave it out")
        world = ALL_DRAWN if (kept := config.scenario.world) is None else read_world(Path(kept))
        mission = run_mission(
            config, strategies, filters, world=world, progress=progress, watch=watch
        )
    else:
        recorded, truth = load(_log_of(folder, summary, log), summary.log.robot, bag=config.bag)
        beam, asked = summary.log.beamwidth_rad, (strategies, filters)
        mission = replay(recorded, truth, *asked, beam, config, progress=progress, watch=watch)
        mission = replace(mission, source=summary.log.model_dump(exclude_defaults=True))
    return replace(mission, difference=_difference(folder, summary, mission.trials))


def log_entry(log: Path, robot: Robot | None, beamwidth: float | None) -> dict[str, object]:
    """Return a log's entry for ``summary.json``: path, robot, beamwidth, SHA-256 of the files."""
    path = str(log.resolve())
    entry: dict[str, object] = {"path": text_of(path), "robot": robot, "beamwidth_rad": beamwidth}
    entry |= {"files": _sums(log)}
    return entry if entry["path"] == path else entry | {"path_bytes": fsencode(path).hex()}


def _sums(log: Path) -> dict[str, str]:
    """Return the SHA-256 of each file of a log and its truth, by file name."""
    patterns = (*reader_of(log).files, *truth_files.FILES)
    found = {text_of(path.name): path for pattern in patterns for path in log.glob(pattern)}
    found |= {text_of(log.name): log} if log.is_file() else {}
    sums = {}
    for name, path in sorted(found.items()):
        if path.is_file():
            with path.open("rb") as file:
                sums[name] = file_digest(file, "sha256").hexdigest()
    return sums


def _log_of(folder: Path, summary: Summary, log: Path | None) -> Path:
    """Return the path of the log that a mission used; raise if it is missing or was changed."""
    assert summary.log
    path = summary.log.place if log is None else log
    where = f"{folder / SUMMARY}: log.path" if log is None else f"{folder}, option --log"
    if not path.exists():
        found, fix = f"{path}, which is not there", "restore it, or give its new path by --log"
        raise refusal(where, found, "the log that was solved", fix)
    then, now = summary.log.files, _sums(path)
    changed = [name for name in sorted({*then, *now}) if then.get(name) != now.get(name)]
    if changed:
        name = changed[0]
        how = "is new" if name not in then else "is gone" if name not in now else "was changed"
        others = f", and {len(changed) - 1} more" if len(changed) > 1 else ""
        found = f"not the log that was solved ({name} {how}{others})"
        fix = "restore the log, or solve it again, `pipistrelle slam LOG -o DIR`, and name DIR"
        raise refusal(path, found, f"it as {folder} was made of it", fix)
    return path


def _difference(folder: Path, summary: Summary, trials: Sequence[TrialResult]) -> str:
    """Describe in a line how new tracks differ from a folder's stored tracks; "" if equal."""
    differences = {}
    for trial in trials:
        track = trial.track
        name = f"track_{trial.strategy}_{short_name(trial.filter)}.tum"
        here = tum_text(track.time, track.pose.mean)
        try:
            there = read_file(folder / name).decode()
        except (OSError, UnicodeDecodeError, InputError):
            differences[name] = "cannot be read"
            continue
        if here != there:
            differences[name] = f"is not as it is found now{_apart(here, there)}"
    if not differences:
        return ""
    name, how = next(iter(differences.items()))
    others = f", nor are {len(differences) - 1} more" if len(differences) > 1 else ""
    reason = ""
    if settings_hash(read_toml(folder / "config.toml")) != summary.config_hash:
        reason = "; config.toml was changed since"
    elif summary.version != find_version():
        reason = f"; it was written by version {summary.version}, this is {find_version()}"
    return f"{folder / name}: {how}{others}{reason}"


def _apart(here: str, there: str) -> str:
    """Format the largest distance between two tracks in TUM text; "" if not comparable."""
    try:
        paths = [
            np.array([line.split()[1:3] for line in text.splitlines()], dtype=float)
            for text in (here, there)
        ]
        distance = float(np.hypot(*(paths[0] - paths[1]).T).max())
    except ValueError:  # unequal columns or rows, or not numbers
        return ""
    return f", by up to {distance:.2g} m" if math.isfinite(distance) else ""
