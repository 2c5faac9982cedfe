"""A mission on one screen: draw a world, listen along the path, estimate, score.

Read this file first: each call is a box of the paper's workflow.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from pipistrelle import kernel_clock
from pipistrelle.arithmetic.random_stream import stream_key
from pipistrelle.config import Config, InputError, Strategy
from pipistrelle.detection.faces import FrameMeasurements
from pipistrelle.detection.merging import scan_of
from pipistrelle.detection.noise import as_told, noise_of
from pipistrelle.detection.scans import Scan, rows_of
from pipistrelle.estimation.association import Associate, known_labels
from pipistrelle.estimation.beliefs import Belief, Gaussian, at_steps
from pipistrelle.estimation.catalogue import CATALOGUE, entry, short_name
from pipistrelle.evaluation.bound import bound_of_drawn_start
from pipistrelle.experiments.cases import Case
from pipistrelle.experiments.drives import Drive, Truth, split_at
from pipistrelle.experiments.hearing.listening import Progress, listen
from pipistrelle.experiments.hearing.scenario import (
    Scenario,
    assumed_motion,
    moving_callers,
    standing_landmarks,
)
from pipistrelle.experiments.hearing.trajectories import motion_of
from pipistrelle.experiments.hearing.world import ANY, World
from pipistrelle.experiments.machine import check_memory
from pipistrelle.experiments.results.scores import (
    TrialResult,
    drive_bound,
    position_floor,
    score,
    score_path,
    with_bound,
)
from pipistrelle.experiments.runs.checking import check_filters, failed_trial
from pipistrelle.experiments.runs.filtering import run_filter
from pipistrelle.experiments.runs.preparing import prepared
from pipistrelle.geometry import wrap_angle

Watch = Callable[[str, str, Scan, Belief], None]
"""Called with strategy, filter, scan and the belief after it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Mission:
    """One world, what was heard in it, and what each strategy and filter made of it."""

    config: Config
    scenario: Scenario
    drive: Drive
    heard: tuple[FrameMeasurements, ...]
    trials: tuple[TrialResult, ...]


def run_mission(
    config: Config,
    strategies: Sequence[Strategy],
    filters: Sequence[str] = ("ekf",),
    *,
    world: World = ANY,
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
    world : World
        What is known of it beforehand.
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
    kept = {"strategies": len(strategies), "filters": len(filters)}
    scenario = prepared(config, world=world, **kept)
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
    bounds = _bounds(drive, heard, strategies, config)
    trials = tuple(replace(t, scores=with_bound(t.scores, bounds[t.strategy])) for t in trials)
    return Mission(config=config, scenario=scenario, drive=drive, heard=heard, trials=trials)


def scans_of(
    heard: Sequence[FrameMeasurements], strategy: Strategy, config: Config
) -> tuple[Scan, ...]:
    """Tell what a strategy takes of each frame, and how surely the settings say it was measured.

    Parameters
    ----------
    heard : sequence of FrameMeasurements
    strategy : "active", "fused" or "passive"
    config : Config

    Returns
    -------
    tuple of Scan
        As many.
    """
    noise, timing = noise_of(config.filter), config.listening.timing
    rows = (as_told(frame.rows, config.filter, timing=timing) for frame in heard)
    scans = zip(heard, (scan_of(scan, strategy) for scan in rows), strict=True)
    return tuple(noise(scan) for frame, scan in scans if scan.landmark.size or not frame.between)


def _bounds(
    drive: Drive, heard: Sequence[FrameMeasurements], strategies: Sequence[Strategy], config: Config
) -> dict[str, Float[np.ndarray, "t 3 3"] | None]:
    """Work out the bound of each strategy, of who knows the motion, and the noise by the signal."""
    noise = config.filter.model_copy(update={"noise": "measured"})
    told = config.model_copy(update={"filter": noise})
    known, bounds = replace(drive, motion=motion_of(config.motion)), {}
    for name in strategies:
        bound = drive_bound(known, scans_of(heard, name, told), config)
        if (
            bound is not None
            and config.filter.first_pose == "drawn"
            and drive.truth.path is not None
        ):
            bound = bound_of_drawn_start(bound, drive.truth.path, drive.start.covariance)
        bounds[name] = bound
    return bounds


def drive_of(scenario: Scenario, config: Config, iteration: int = 0) -> Drive:
    """Tell what a filter may know of a world, and the truth to score it by.

    Parameters
    ----------
    scenario : Scenario
    config : Config
    iteration : int
        Number of the world, part of the key of a start that is drawn.

    Returns
    -------
    Drive
        Its true landmarks are the landmarks and then the callers that stand: the beacon is last.
    """
    start, spread = scenario.path[0], np.array(config.filter.initial_pose_std)
    if config.filter.first_pose == "drawn":
        start = start + spread * _generator(config.seed, iteration, "start").standard_normal(3)
        start[2] = wrap_angle(start[2])
    moving = moving_callers(scenario)
    return Drive(
        motion=assumed_motion(config),
        start=Gaussian(mean=start, covariance=np.diag(np.square(spread))),
        time=scenario.time,
        controls=scenario.controls,
        truth=Truth(
            time=scenario.time,
            path=scenario.path,
            landmarks=standing_landmarks(scenario),
            callers={label: np.asarray(caller.place) for label, caller in moving.items()},
        ),
        moving={label: caller.name for label, caller in moving.items()},
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

    A filter may fail: its path is then not a number, and the result says why.

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

    Raises
    ------
    InputError
        For scans that no filter of the catalogue can use.
    """

    def tried(case: Case, scans: Sequence[Scan]) -> TrialResult:
        try:
            return run_trial(case, drive, scans, config, progress=progress, watch=watch)
        except Exception as error:
            if isinstance(error, InputError) and case.filter in CATALOGUE:
                raise  # a user's mistake
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
    associate: Associate = known_labels,
    progress: Progress | None = None,
    watch: Watch | None = None,
) -> TrialResult:
    """Estimate path and map from one strategy's scans, and score them.

    Parameters
    ----------
    case : Case
    drive : Drive
    scans : sequence of Scan
        As `scans_of` gives them. What is labelled as a caller that moves is left out, unless the
        settings have timing and the estimator follows.
    config : Config
    associate : Associate
        Says who is who, between prediction and correction. Of rows that it merges, the settings say
        how surely they were measured. Its labels are not the truth's, so the map is not scored.
    progress, watch : callable, optional

    Returns
    -------
    TrialResult
    """
    strategy, name, heard, known = case.strategy, case.filter, tuple(scans), entry(case.filter)
    scans = _told_who_moves(scans, drive, follows=known.follows and config.listening.timing)

    def report(done: int, total: int) -> None:
        if progress:
            progress(f"{strategy} {short_name(name)}", done, total)

    had: list[Scan] = []

    def look(scan: Scan, belief: Belief) -> None:
        had.append(scan)
        if watch:
            watch(strategy, name, scan, belief)

    began = kernel_clock.wall_s()
    parted, steps = split_at(drive, [scan.time for scan in scans])
    track = run_filter(
        known.build(config, parted.motion),
        parted,
        scans,
        _generator(config.seed, case.iteration, name),
        associate=associate,
        noise=noise_of(config.filter),
        progress=report,
        watch=look,
    )
    wall_s = kernel_clock.wall_s() - began
    track = at_steps(track, steps)
    truth = drive.truth if associate is known_labels else replace(drive.truth, landmarks=None)
    scores = score(track, truth, had, known.nees_limit)
    return TrialResult(
        strategy=strategy,
        filter=name,
        track=track,
        heard=heard,
        scans=tuple(had),
        scores=replace(scores, position_floor_m=position_floor(drive, had)),
        wall_s=wall_s,
        online=None if track.online is None else score_path(track.online, drive.truth.path),
    )


def _told_who_moves(scans: Sequence[Scan], drive: Drive, *, follows: bool) -> Sequence[Scan]:
    """Tell in scans who moves, or leave their rows out."""
    if not drive.moving:
        return scans
    moving = np.array([*drive.moving])
    if follows:
        return [replace(scan, moving=moving) for scan in scans]
    return [rows_of(scan, ~np.isin(scan.landmark, moving)) for scan in scans]


def _generator(seed: int, iteration: int, purpose: str) -> np.random.Generator:
    """Return the generator of a purpose in a world."""
    return np.random.default_rng(stream_key(seed, iteration, purpose))
