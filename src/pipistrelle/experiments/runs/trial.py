"""A mission on one screen: draw a world, listen along the path, estimate, score.

Read this file first: each call is a box of the paper's workflow.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import product

import numpy as np
from jaxtyping import Float

from pipistrelle import kernel_clock
from pipistrelle.acoustics.callers import VEHICLE
from pipistrelle.acoustics.emitter import beamwidth_of
from pipistrelle.arithmetic.random_stream import stream_key
from pipistrelle.config import Config, InputError, Strategy
from pipistrelle.detection.noise import noise_of
from pipistrelle.detection.scans import Scan, rows_of
from pipistrelle.estimation.association import KNOWN, Association
from pipistrelle.estimation.beliefs import Belief, Landmarks, Track, at_steps
from pipistrelle.estimation.catalogue import CATALOGUE, entry, short_name
from pipistrelle.estimation.data_association.methods import association_of
from pipistrelle.evaluation.association import Causes, associated, matched, renamed
from pipistrelle.experiments.cases import Case
from pipistrelle.experiments.drives import Drive, at_sensor, at_vehicle, split_at
from pipistrelle.experiments.hearing.listening import Keep, Progress, listen
from pipistrelle.experiments.hearing.scenario import standing_landmarks
from pipistrelle.experiments.hearing.world import ALL_DRAWN, World
from pipistrelle.experiments.machine import check_memory
from pipistrelle.experiments.named_settings import each_its_own
from pipistrelle.experiments.results.scores import (
    Scores,
    TrialResult,
    map_motion,
    position_floor,
    score,
    score_path,
    with_association,
    with_bound,
)
from pipistrelle.experiments.runs.filtering import run_filter
from pipistrelle.experiments.runs.heard_world import HeardWorld, drive_of
from pipistrelle.experiments.runs.mission import Mission
from pipistrelle.experiments.runs.validate_filters import check_filters, failed_trial
from pipistrelle.experiments.runs.validate_mission import checked_scenario

NOT_KNOWN: Mapping[Strategy, None] = {}
"""What caused rows, where nobody tells."""
Watch = Callable[[str, str, Scan, Belief], None]
"""Called with strategy, filter, scan and the belief after it."""


def run_mission(
    config: Config,
    strategies: Sequence[Strategy],
    filters: Sequence[str] = ("ekf",),
    *,
    world: World = ALL_DRAWN,
    keep: Keep | None = None,
    progress: Progress | None = None,
    watch: Watch | None = None,
) -> Mission:
    """Draw a world, listen along its path once, and let each filter map it by each strategy.

    `keep` is given the sound of each frame (`listen`), `watch` each scan and the belief after it.
    Settings, filters and worlds that cannot be used, or need more memory than there is, raise
    `InputError` before anything is heard.

    >>> from pipistrelle.config import ScenarioConfig
    >>> mission = run_mission(Config(scenario=ScenarioConfig(steps=40)), ["fused"])
    >>> len(mission.heard), len(mission.trials[0].track.time)
    (10, 41)
    """
    kept = {"strategies": len(strategies), "filters": len(filters)}
    scenario = checked_scenario(config, world=world, **kept)
    passive, drive = any(one != "active" for one in strategies), drive_of(scenario, config)
    apart = tuple(each_its_own(config, filters))
    for own, names in apart:
        check_memory(names, len(standing_landmarks(scenario)[0]), own, passive=passive)
        check_filters(names, drive.motion, own, drive.moving.values())
    labels = all(own.association.method == KNOWN for own, _ in apart)
    radius = config.emitter.radius
    (heard,) = listen(scenario, config, (radius,), labels=labels, keep=keep, progress=progress)
    there, trials = HeardWorld(scenario, config, {radius: heard}), []
    for own, names in apart:
        scans = {strategy: there.scans(own, strategy) for strategy in strategies}
        causes = {strategy: there.causes(own, strategy) for strategy in strategies}
        bounds: dict[str, Float[np.ndarray, "t 3 3"]] = {
            strategy: there.bound(own, strategy) for strategy in strategies
        }
        done = run_trials(
            names, drive_of(scenario, own), scans, own, causes=causes, progress=progress,
            watch=watch,
        )  # fmt: skip
        trials += [replace(t, scores=with_bound(t.scores, bounds[t.strategy])) for t in done]
    return Mission(
        config=config,
        drive=drive,
        trials=in_order(trials, strategies, filters),
        beamwidth=beamwidth_of(config),
        callers=scenario.callers[VEHICLE + 1 :],
        scenario=scenario,
        world=None if world is ALL_DRAWN else world,
        heard=heard,
    )


def in_order(
    trials: Sequence[TrialResult], strategies: Sequence[Strategy], filters: Sequence[str]
) -> tuple[TrialResult, ...]:
    """Return trials by strategy, and of each by filter."""
    done = {(trial.strategy, trial.filter): trial for trial in trials}
    return tuple(done[pair] for pair in product(strategies, filters))


def run_trials(
    filters: Sequence[str],
    drive: Drive,
    heard: Mapping[Strategy, Sequence[Scan]],
    config: Config,
    *,
    causes: Mapping[Strategy, Causes | None] = NOT_KNOWN,
    progress: Progress | None = None,
    watch: Watch | None = None,
) -> tuple[TrialResult, ...]:
    """Let each filter map the scans of each strategy; one result for each pair, by strategy.

    `causes`: see `run_trial`.

    A filter of the user's may fail: its path is then NaN, and the result says why.
    """

    def tried(case: Case, scans: Sequence[Scan]) -> TrialResult:
        try:
            return run_trial(
                case, drive, scans, config, causes=causes.get(case.strategy), progress=progress,
                watch=watch,
            )  # fmt: skip
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
    association: Association | None = None,
    causes: Causes | None = None,
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
    association : Association, optional
        Labels the rows of scans; that of the settings by default, where they have one. The noise of
        rows that it merges is the settings'. Its labels are not the truth's.
    causes : sequence of (m), optional
        What caused the rows of each scan, to score an association by; without them the map is
        matched with the true landmarks by position.
    progress, watch : callable, optional

    Returns
    -------
    TrialResult
    """
    strategy, name, heard, estimator = case.strategy, case.filter, tuple(scans), entry(case.filter)
    association = association or association_of(config)
    follows = estimator.follows and config.listening.timing
    scans = with_moving(scans, drive, follows=follows, known=association is None)

    used: list[Scan] = []

    def look(scan: Scan, belief: Belief) -> None:
        used.append(scan)
        if watch:
            watch(strategy, name, scan, belief)

    began = kernel_clock.wall_s()
    parted, steps = split_at(drive, [scan.time for scan in scans])
    parted = at_sensor(parted)
    whole = run_filter(
        estimator.build(config, parted.motion),
        parted,
        scans,
        np.random.default_rng(stream_key(config.seed, case.iteration, name)),
        association=association,
        noise=noise_of(config.filter),
        progress=partial(progress, f"{strategy} {short_name(name)}") if progress else None,
        watch=look,
    )
    wall_s = kernel_clock.wall_s() - began
    track = _named(at_vehicle(at_steps(whole, steps), drive.sensor), used, drive)
    scores, mapped = _scored(track, drive, used, estimator.nees_limit, causes, association)
    return TrialResult(
        strategy=strategy,
        filter=name,
        track=track,
        heard=heard,
        scans=tuple(used),
        scores=replace(scores, position_floor_m=position_floor(drive, used)),
        mapped=mapped,
        causes=causes,
        wall_s=wall_s,
        online=None if track.online is None else score_path(track.online, drive.truth.path),
    )


def _named(track: Track, used: Sequence[Scan], drive: Drive) -> Track:
    """Return a track whose callers have their own labels, not those of an association."""
    if not track.callers:
        return track
    pairs = (zip(scan.callers.tolist(), drive.callers.tolist(), strict=False) for scan in used)
    own = {name: label for both in pairs for name, label in both}
    return replace(track, callers={own.get(name, name): of for name, of in track.callers.items()})


def _scored(
    track: Track,
    drive: Drive,
    used: Sequence[Scan],
    limit: float,
    causes: Causes | None,
    association: Association | None,
) -> tuple[Scores, Landmarks | None]:
    """Return the scores of a track, and its map by the names of the truth where it has others."""
    truth = drive.truth
    if association is None:
        return score(track, truth, used, limit), None
    motion = map_motion(track, truth)
    if causes is not None:
        found = associated(track.labels, causes, [*drive.moving])
    elif truth.landmarks is not None:
        found = matched(track.landmarks, *truth.landmarks, motion)
    else:
        return score(track, truth, used, limit), None
    mapped = renamed(track.landmarks, found)
    scores = score(replace(track, landmarks=mapped), truth, used, limit)
    return with_association(scores, track.landmarks, found, truth, motion), mapped


def with_moving(
    scans: Sequence[Scan], drive: Drive, *, follows: bool, known: bool = True
) -> Sequence[Scan]:
    """Mark the callers that move in scans, or leave out their rows.

    `known`: whether labels are; if not, callers are marked by their numbers, and nothing is left
    out.
    """
    if not drive.moving:
        return scans
    moving = np.array([*drive.moving])
    if not known:
        numbers = np.flatnonzero(np.isin(drive.callers, moving))
        return [replace(scan, moving=numbers) if scan.direct.size else scan for scan in scans]
    if follows:
        return [replace(scan, moving=moving) for scan in scans]
    return [rows_of(scan, ~np.isin(scan.landmark, moving)) for scan in scans]
