"""A mission on one screen: draw a world, listen along the path, estimate, score.

Read this file first: each call is a box of the paper's workflow.
"""

import time as clock
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from pipistrelle.arithmetic.noise import stream_key
from pipistrelle.config import Config, InputError, Strategy
from pipistrelle.detection.faces import Heard
from pipistrelle.detection.merging import labelled, scan_of
from pipistrelle.detection.noise import noise_of
from pipistrelle.detection.scans import Scan, rows_of
from pipistrelle.estimation.association import Associate, told
from pipistrelle.estimation.beliefs import (
    B,
    Belief,
    Estimator,
    Gaussian,
    ParticleCloud,
    Track,
    Trajectory,
)
from pipistrelle.estimation.catalogue import CATALOGUE, entry, short_name
from pipistrelle.experiments.cases import Case
from pipistrelle.experiments.drives import Drive, Truth
from pipistrelle.experiments.hearing.listening import Progress, listen
from pipistrelle.experiments.hearing.scenario import (
    Scenario,
    bicycle,
    moving_labels,
    standing_landmarks,
    world_of,
)
from pipistrelle.experiments.machine import check_length, check_memory
from pipistrelle.experiments.results.scores import TrialResult, score, score_path
from pipistrelle.experiments.runs.outside import check_filters, failed_trial

Watch = Callable[[str, str, Scan, Belief], None]
"""Called with strategy, filter, scan and the belief after it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Mission:
    """One world, what was heard in it, and what each strategy and filter made of it."""

    config: Config
    scenario: Scenario
    drive: Drive
    heard: tuple[Heard, ...]
    trials: tuple[TrialResult, ...]


def run_mission(
    config: Config,
    strategies: Sequence[Strategy],
    filters: Sequence[str] = ("ekf",),
    *,
    progress: Progress | None = None,
    watch: Watch | None = None,
) -> Mission:
    """Draw a world, listen along its path once, and let each filter map it by each strategy.

    Parameters
    ----------
    config : Config
    strategies : sequence of "active", "fused", "passive"
    filters : sequence of str
        The names of estimators.
    progress, watch : callable, optional

    Returns
    -------
    Mission

    Raises
    ------
    InputError
        When the world, the sampling or a filter cannot be had, or memory for it.

    Examples
    --------
    >>> from pipistrelle.config import ScenarioConfig
    >>> mission = run_mission(Config(scenario=ScenarioConfig(steps=40)), ["fused"])
    >>> len(mission.heard), len(mission.trials[0].track.time)
    (10, 41)
    """
    check_length(config.scenario, strategies=len(strategies), filters=len(filters))
    scenario = world_of(config)
    check_memory(
        filters,
        len(standing_landmarks(scenario)[0]),
        config,
        passive=any(strategy != "active" for strategy in strategies),
    )
    drive = drive_of(scenario, config)
    check_filters(filters, drive.motion, config)
    (heard,) = listen(scenario, config, (config.emitter.radius,), progress=progress)
    scans = {strategy: scans_of(heard, strategy, config) for strategy in strategies}
    trials = run_trials(filters, drive, scans, config, progress=progress, watch=watch)
    return Mission(config=config, scenario=scenario, drive=drive, heard=heard, trials=trials)


def scans_of(heard: Sequence[Heard], strategy: Strategy, config: Config) -> tuple[Scan, ...]:
    """Tell what a strategy takes of each frame, and how surely the settings say it was measured.

    Parameters
    ----------
    heard : sequence of Heard
    strategy : "active", "fused" or "passive"
    config : Config

    Returns
    -------
    tuple of Scan
        As many.
    """
    noise = noise_of(config.filter)
    return tuple(noise(scan_of(frame, strategy)) for frame in heard)


def drive_of(scenario: Scenario, config: Config) -> Drive:
    """Tell what a filter may know of a world, and the truth to score it by.

    Parameters
    ----------
    scenario : Scenario
    config : Config

    Returns
    -------
    Drive
        Its true landmarks are the landmarks and then the callers that stand: the beacon is last.
    """
    return Drive(
        motion=bicycle(config.motion),
        start=Gaussian(
            mean=scenario.path[0],
            covariance=np.diag(np.square(config.filter.initial_pose_std)),
        ),
        time=scenario.time,
        controls=scenario.controls,
        truth=Truth(time=scenario.time, path=scenario.path, landmarks=standing_landmarks(scenario)),
        moving=moving_labels(scenario),
    )


def run_trials(
    filters: Sequence[str],
    drive: Drive,
    heard: Mapping[Strategy, Sequence[Scan]],
    config: Config,
    *,
    progress: Progress | None = None,
    watch: Watch | None = None,
) -> tuple[TrialResult, ...]:
    """Let each filter map what each strategy heard.

    A filter from outside may fail: its path is then not a number, and the result says why.

    Parameters
    ----------
    filters : sequence of str
        The names of estimators.
    drive : Drive
    heard : dict
        The scans of each strategy.
    config : Config
    progress, watch : callable, optional

    Returns
    -------
    tuple of TrialResult
        For each strategy, one per filter.
    """

    def tried(case: Case, scans: Sequence[Scan]) -> TrialResult:
        try:
            return run_trial(case, drive, scans, config, progress=progress, watch=watch)
        except Exception as error:
            if case.filter in CATALOGUE:
                raise
            return failed_trial(case, drive, scans, error)

    return tuple(
        tried(Case(strategy=strategy, filter=name), scans)
        for strategy, scans in heard.items()
        for name in filters
    )


def run_trial(
    case: Case,
    drive: Drive,
    scans: Sequence[Scan],
    config: Config,
    *,
    associate: Associate = told,
    progress: Progress | None = None,
    watch: Watch | None = None,
) -> TrialResult:
    """Estimate path and map from one strategy's scans, and score them.

    Parameters
    ----------
    case : Case
    drive : Drive
    scans : sequence of Scan
        As `scans_of` gives them; what they hold of callers that move is left out.
    config : Config
    associate : Associate
        Says who is who, between prediction and correction.
    progress, watch : callable, optional

    Returns
    -------
    TrialResult
    """
    strategy, name = case.strategy, case.filter
    if drive.moving:
        scans = [rows_of(scan, ~np.isin(scan.landmark, drive.moving)) for scan in scans]

    def report(done: int, total: int) -> None:
        if progress:
            progress(f"{strategy} {short_name(name)}", done, total)

    def look(scan: Scan, belief: Belief) -> None:
        if watch:
            watch(strategy, name, scan, belief)

    known = entry(name)
    began = clock.perf_counter()
    track = run_filter(
        known.build(config, drive.motion),
        drive,
        scans,
        _generator(config.seed, case.iteration, name),
        associate=associate,
        progress=report,
        watch=look,
    )
    wall_s = clock.perf_counter() - began
    return TrialResult(
        strategy=strategy,
        filter=name,
        track=track,
        scans=tuple(scans),
        scores=score(track, drive.truth, scans, known.nees_limit),
        wall_s=wall_s,
        online=None if track.online is None else score_path(track.online, drive.truth.path),
    )


def run_filter(
    estimator: Estimator[B],
    drive: Drive,
    scans: Sequence[Scan],
    rng: np.random.Generator,
    *,
    associate: Associate = told,
    progress: Callable[[int, int], None] | None = None,
    watch: Callable[[Scan, B], None] | None = None,
) -> Track:
    """Predict to each scan, say who is who in it, update with it, and keep the pose of every step.

    Where the belief revises its path (`Trajectory`), the track is the path as it is believed at
    the end, and the poses that were kept are beside it.

    Parameters
    ----------
    estimator : Estimator
    drive : Drive
    scans : sequence of Scan
        In order; the time of each is one of the drive's.
    rng : Generator
    associate : Associate
    progress : callable, optional
        Given the scans done and their number.
    watch : callable, optional
        Given each scan and the belief after it.

    Returns
    -------
    Track

    Raises
    ------
    InputError
        For a bearing or range that is no number, a time that is not one of the drive's, or a
        revised path that is not one of the drive's steps.
    """
    time, controls = drive.time, drive.controls
    steps = _steps_of(scans, time)
    mean, covariance = np.empty((time.size, 3)), np.empty((time.size, 3, 3))
    mean[0], covariance[0] = drive.start.mean, drive.start.covariance
    dt, belief, done = np.diff(time), estimator.init(drive.start), 0
    for number, (k, scan) in enumerate(zip(steps, scans, strict=True), start=1):
        if k > done:
            belief, poses = estimator.predict(belief, controls[done:k], dt[done:k], rng)
            mean[done + 1 : k + 1], covariance[done + 1 : k + 1] = poses.mean, poses.covariance
            done = k
        scan = labelled(scan, associate(belief, scan))
        belief = estimator.update(belief, scan, rng)
        pose = belief.pose()
        mean[k], covariance[k] = pose.mean, pose.covariance
        if watch:
            watch(scan, belief)
        if progress:
            progress(number, len(scans))
    if done < len(controls):
        belief, poses = estimator.predict(belief, controls[done:], dt[done:], rng)
        mean[done + 1 :], covariance[done + 1 :] = poses.mean, poses.covariance
    online = Gaussian(mean=mean, covariance=covariance)
    cloud = belief if isinstance(belief, ParticleCloud) else None
    revised = _whole(belief.path(), time.size) if isinstance(belief, Trajectory) else None
    return Track(
        time=time,
        pose=revised or online,
        landmarks=belief.landmarks(),
        gated=belief.gated,
        cloud=cloud.cloud() if cloud else None,
        full=cloud.full if cloud else None,
        online=online if revised else None,
    )


def _whole(path: Gaussian, poses: int) -> Gaussian:
    """Refuse a revised path that lacks poses, or their covariances."""
    found = path.mean.shape, path.covariance.shape
    expected = (poses, 3), (poses, 3, 3)
    if found != expected:
        raise InputError(
            f"path: found arrays of {found[0]} and {found[1]}, expected {expected[0]} and "
            f"{expected[1]}: the start and every control step"
        )
    return path


def _steps_of(scans: Sequence[Scan], time: Float[np.ndarray, " t"]) -> list[int]:
    """Find the step that ends at each scan; refuse scans that a filter could not use."""
    heard = np.array([scan.time for scan in scans], dtype=float)
    steps = np.searchsorted(time, heard)
    known = time[np.minimum(steps, time.size - 1)] == heard
    if not known.all():
        stray = scans[int(np.argmin(known))]
        raise InputError(f"scan at {stray.time} s: expected the time of the end of a step")
    bearing, distance, bearing_std, range_std = (
        np.concatenate([np.empty(0), *(getattr(scan, name) for scan in scans)])
        for name in ("bearing", "range", "bearing_std", "range_std")
    )
    passive = np.isnan(distance)
    usable = np.isfinite(bearing) & (passive | (distance > 0.0) & (distance < np.inf))
    _refuse(
        scans,
        usable,
        "numbers that no filter can use, for the landmarks {}; expected finite bearings [rad] and "
        "ranges above 0 [m], NaN where passive",
    )
    stated = (bearing_std > 0.0) & (bearing_std < np.inf)
    stated &= passive | ((range_std > 0.0) & (range_std < np.inf))
    _refuse(
        scans,
        stated,
        "no standard deviations above 0 for the landmarks {}; expected bearing_std [rad], and "
        "range_std [m] where there is a range, as pipistrelle.detection.noise states them",
    )
    return steps.tolist()


def _refuse(scans: Sequence[Scan], good: Bool[np.ndarray, " m"], found: str) -> None:
    """Refuse scans of which not all rows are good; those of all scans follow one another."""
    if good.all():
        return
    owner = np.repeat(np.arange(len(scans)), [scan.landmark.size for scan in scans])
    first = owner[~good][0]
    labels = scans[first].landmark[~good[owner == first]].tolist()
    raise InputError(f"scan at {scans[first].time} s: found {found.format(labels)}")


def _generator(seed: int, iteration: int, purpose: str) -> np.random.Generator:
    """Return the generator of a purpose in a world."""
    return np.random.default_rng(stream_key(seed, iteration, purpose))
