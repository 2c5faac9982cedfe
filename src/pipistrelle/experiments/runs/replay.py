"""Recorded logs on trial: the log, the truth beside it, and what a strategy may hear of it."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from pipistrelle.config import Config, Strategy
from pipistrelle.detection.logs.readers import READERS, Reader, reader_of
from pipistrelle.detection.logs.recording import Log
from pipistrelle.detection.noise import noise_of
from pipistrelle.detection.scans import Scan, rows_of
from pipistrelle.estimation.beliefs import Gaussian
from pipistrelle.estimation.motion import Motion
from pipistrelle.experiments.drives import Drive, Truth
from pipistrelle.experiments.hearing.listening import Progress
from pipistrelle.experiments.results.scores import TrialResult
from pipistrelle.experiments.runs.outside import check_filters
from pipistrelle.experiments.runs.trial import Watch, run_trials
from pipistrelle.experiments.runs.truth_files import TRUTHS, WithTruth, with_files_beside
from pipistrelle.refusals import refusal


def load(
    folder: Path,
    robot: int | None = None,
    *,
    readers: Sequence[Reader] = (),
    truths: Mapping[str, WithTruth] = TRUTHS,
) -> tuple[Log, Truth]:
    """Read a recorded log, and what is known of its truth.

    Parameters
    ----------
    folder : Path
    robot : int
        Where the format holds the logs of several, as a MRCLAM set does, and only there.
    readers : sequence of Reader
        Of formats that the package does not know; they are asked before its own.
    truths : mapping of a reader's name to the function that reads its log with the truth
        Without one, the truth is ``truth.csv`` and ``landmarks.csv`` beside the log.

    Returns
    -------
    Log
    Truth

    Raises
    ------
    InputError
        With the file and the line or key, what was found, what was expected and the fix.
    """
    known = (*readers, *READERS)
    if not folder.is_dir():
        titles = " or ".join(reader.title for reader in known)
        raise refusal(folder, "no such folder", titles, "check the path")
    reader = reader_of(folder, readers)
    whose = _whose(reader, folder, robot, known)
    with_truth = {**TRUTHS, **truths}.get(reader.name, with_files_beside)
    return with_truth(reader.read, folder, *whose)


def as_heard_by(
    scans: Sequence[Scan], strategy: Strategy, beamwidth: float | None = None
) -> tuple[Scan, ...]:
    """Leave of recorded scans what a strategy would have heard.

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
    >>> as_heard_by([scan], "fused", 0.5)[0].range
    array([ 2., nan])
    >>> as_heard_by([scan], "active", 0.5)[0].landmark
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
    truth: Truth,
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
    truth : Truth
    strategies : sequence of "active", "fused", "passive"
    filters : sequence of str
        The names of estimators.
    beamwidth : [rad], optional
        See `as_heard_by`.
    config : Config
        Its sections filter and rays, which must agree with the log.
    progress, watch : callable, optional

    Returns
    -------
    tuple of TrialResult

    Raises
    ------
    InputError
        For an estimator that cannot be had or built.
    """
    drive = Drive(
        motion=motion_of(log),
        start=start_of(log),
        time=log.time,
        controls=log.controls,
        truth=truth,
    )
    check_filters(filters, drive.motion, config)
    noise = noise_of(config.filter)
    heard = {
        strategy: tuple(map(noise, as_heard_by(log.scans, strategy, beamwidth)))
        for strategy in strategies
    }
    return run_trials(filters, drive, heard, config, progress=progress, watch=watch)


def _whose(
    reader: Reader, folder: Path, robot: int | None, known: Sequence[Reader]
) -> tuple[int, ...]:
    """Return the robot for a reader that must be told, and nothing for one that must not."""
    if reader.robots is None:
        if robot is None:
            return ()
        found = f"a log of one vehicle, but robot {robot} was asked for"
        expected = " or ".join(other.title for other in known if other.robots is not None)
        raise refusal(folder, found, expected, "leave out --robot")
    robots = reader.robots(folder)
    if robot is None or str(robot) not in robots:
        found = "no robot" if robot is None else f"robot {robot}"
        expected = f"one whose odometry is there ({', '.join(robots) or 'none is'})"
        raise refusal(f"{folder}, option --robot", found, expected, "name another")
    return (robot,)
