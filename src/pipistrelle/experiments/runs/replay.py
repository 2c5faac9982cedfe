"""Recorded logs on trial: the log, the truth beside it, and what a strategy may hear of it."""

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from pipistrelle.config import Config, Strategy
from pipistrelle.detection.logs.folder import read_log
from pipistrelle.detection.logs.mrclam import read_mrclam
from pipistrelle.detection.logs.recording import Log
from pipistrelle.detection.logs.text_tables import refusal
from pipistrelle.detection.noise import noise_of
from pipistrelle.detection.scans import Scan, rows_of
from pipistrelle.estimation.beliefs import Gaussian
from pipistrelle.estimation.motion import Motion
from pipistrelle.experiments.drives import Drive
from pipistrelle.experiments.hearing.listening import Progress
from pipistrelle.experiments.results.scores import TrialResult
from pipistrelle.experiments.runs.trial import Case, Watch, run_trial
from pipistrelle.experiments.runs.truth_files import (
    Truth,
    poses_at,
    read_landmarks,
    read_path,
    read_truth,
)


def is_mrclam(folder: Path) -> bool:
    """Tell whether a folder is a MRCLAM set, by its files; ``log.toml`` makes it a log.

    Examples
    --------
    >>> is_mrclam(Path("/nowhere"))
    False
    """
    if (folder / "log.toml").exists():
        return False
    return (folder / "Barcodes.dat").exists() or any(folder.glob("Robot*_Odometry.dat"))


def load(folder: Path, robot: int | None = None) -> tuple[Log, Truth | None]:
    """Read a log folder or one robot's log of a MRCLAM set, and the truth where it is given.

    A MRCLAM track starts at the true pose and ends where the truth ends.

    Parameters
    ----------
    folder : Path
    robot : 1 to 5
        For a MRCLAM set, and only there.

    Returns
    -------
    Log
    Truth or None

    Raises
    ------
    InputError
        With the file and the line or key, what was found, what was expected and the fix.
    """
    if not folder.is_dir():
        raise refusal(folder, "no such folder", "a log folder or a MRCLAM set", "check the path")
    if is_mrclam(folder):
        return _load_mrclam(folder, robot)
    if robot is not None:
        found = f"a log of one vehicle, but robot {robot} was asked for"
        raise refusal(folder, found, "a MRCLAM set", "leave out --robot")
    log = read_log(folder)
    return log, read_truth(folder, log.time)


def hide(
    scans: Sequence[Scan], strategy: Strategy, beamwidth: float | None = None
) -> tuple[Scan, ...]:
    """Leave what a strategy would have heard of recorded scans.

    Inside the beam, where the absolute bearing is at most half its width, range and bearing are
    heard actively. Outside it only the bearing is heard, passively. Fused takes both, active what
    has a range, passive all bearings and no range. Without a beam nothing is outside it.

    Parameters
    ----------
    scans : sequence of Scan
    strategy : "active", "fused" or "passive"
    beamwidth : [rad], optional
        Full width of the beam about the heading.

    Returns
    -------
    tuple of Scan
        As many; some may be empty.

    Examples
    --------
    >>> from pipistrelle.detection.scans import make_scan
    >>> scan = make_scan(0.0, np.array([3, 8]), np.array([0.1, 0.4]), range=np.array([2.0, 5.0]))
    >>> hide([scan], "fused", 0.5)[0].range
    array([ 2., nan])
    >>> hide([scan], "active", 0.5)[0].landmark
    array([3])
    """
    limit = math.inf if beamwidth is None else beamwidth / 2.0
    heard = []
    for scan in scans:
        hidden = (np.abs(scan.bearing) > limit) | (strategy == "passive")
        distance = np.where(hidden, np.nan, scan.range)
        kept = np.isfinite(distance) | (strategy != "active")
        heard.append(rows_of(replace(scan, range=distance), kept))
    return tuple(heard)


def motion_of(log: Log) -> Motion:
    """Return the motion model of a log, as the filters take it."""
    return Motion(
        model=log.motion,
        control_std=log.control_std,
        wheelbase=log.wheelbase,
        noise_at_rest=log.noise_at_rest,
    )


def start_of(log: Log) -> Gaussian:
    """Return the pose at which a log starts, (3) and (3, 3), as the filters take it."""
    variance = np.square(np.array(log.initial_pose_std, dtype=float))
    return Gaussian(mean=np.array(log.initial_pose, dtype=float), covariance=np.diag(variance))


def replay(
    log: Log,
    truth: Truth | None,
    strategies: Sequence[Strategy],
    filters: Sequence[str],
    beamwidth: float | None,
    config: Config,
    *,
    progress: Progress | None = None,
    watch: Watch | None = None,
) -> tuple[TrialResult, ...]:
    """Let each filter map a recorded log by each strategy.

    Parameters
    ----------
    log : Log
    truth : Truth or None
    strategies : sequence of "active", "fused", "passive"
    filters : sequence of "ekf"
    beamwidth : [rad], optional
        See `hide`.
    config : Config
        Its sections filter and rays, which must agree with the log.
    progress, watch : callable, optional

    Returns
    -------
    tuple of TrialResult

    Raises
    ------
    InputError
        For an unknown filter.
    """
    drive = Drive(
        motion=motion_of(log),
        start=start_of(log),
        time=log.time,
        controls=log.controls,
        true_path=None if truth is None else truth.path,
        true_landmarks=None if truth is None else truth.landmarks,
    )
    noise, trials = noise_of(config.filter), []
    for strategy in strategies:
        scans = tuple(map(noise, hide(log.scans, strategy, beamwidth)))
        for name in filters:
            case = Case(strategy=strategy, filter=name)
            trials.append(run_trial(case, drive, scans, config, progress=progress, watch=watch))
    return tuple(trials)


def _load_mrclam(folder: Path, robot: int | None) -> tuple[Log, Truth]:
    """Read one robot's log from where the truth begins to where it ends, and the truth."""
    files = sorted(path.name for path in folder.glob("Robot*_Odometry.dat"))
    robots = [name.removeprefix("Robot").removesuffix("_Odometry.dat") for name in files]
    if robot is None or str(robot) not in robots:
        found = "no robot" if robot is None else f"robot {robot}"
        expected = f"one whose odometry is there ({', '.join(robots) or 'none is'})"
        raise refusal(f"{folder}, option --robot", found, expected, "name another")
    time, path = read_path(folder / f"Robot{robot}_Groundtruth.dat", None)
    columns = ("subject", "x", "y", "x_std", "y_std")
    landmarks = read_landmarks(folder / "Landmark_Groundtruth.dat", columns, None)
    log = read_mrclam(folder, robot, span=(time[0].item(), time[-1].item()))
    path = poses_at(log.time, time, path)
    x, y, heading = path[0].tolist()
    truth = Truth(time=log.time, path=path, landmarks=landmarks)
    return replace(log, initial_pose=(x, y, heading)), truth
