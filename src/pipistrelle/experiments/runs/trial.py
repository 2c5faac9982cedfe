"""Simulated missions: draw a world, simulate scans, run each estimator, score the estimates.

Read this file first: `run_mission` is the paper's workflow, `run_trial` an estimate and its scores,
`run_filter` an estimator over a drive, scan by scan.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import product
from math import nan

import numpy as np
from jaxtyping import Float

from pipistrelle import jit
from pipistrelle.acoustics.emitter import beamwidth_of
from pipistrelle.acoustics.paths import VEHICLE
from pipistrelle.arithmetic.random_stream import stream_key
from pipistrelle.config import Config, InputError, Strategy
from pipistrelle.detection.noise import ConstantNoise, noise_of
from pipistrelle.detection.scans import Scan, rows_of
from pipistrelle.estimation.beliefs import (
    KNOWN,
    NO_INNOVATIONS,
    Association,
    B,
    Belief,
    Estimator,
    Gaussian,
    Innovations,
    Track,
    at_steps,
    completed,
    in_sight,
    no_landmarks,
)
from pipistrelle.estimation.catalogue import CATALOGUE, entry, short_name
from pipistrelle.estimation.data_association.sequential import association_of
from pipistrelle.estimation.session import Session, check_poses
from pipistrelle.estimation.smoother.preintegration import OF_ODOMETRY
from pipistrelle.evaluation.association import Causes, associated, matched, renamed
from pipistrelle.experiments.drives import Drive, at_sensor, at_step_ends, at_vehicle, split_at
from pipistrelle.experiments.hearing.listening import Keep, Progress, listen
from pipistrelle.experiments.hearing.scenario import ALL_DRAWN, World, standing_landmarks
from pipistrelle.experiments.machine import check_memory
from pipistrelle.experiments.named_settings import Case, each_its_own
from pipistrelle.experiments.results.scores import (
    TrialResult,
    map_motion,
    position_floor,
    score,
    score_path,
    with_association,
    with_bound,
    with_shared,
)
from pipistrelle.experiments.runs.heard_world import HeardWorld, Mission, drive_of
from pipistrelle.experiments.runs.validate import (
    check_filters,
    checked_scenario,
    let_interruptions_pass,
    located,
)

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
    """Simulate the scans of a world once, and run each estimator with each sensing strategy.

    `keep` receives the sound of each frame (`listen`), `watch` each scan and the belief after it.
    Invalid settings, estimators and worlds, or a lack of memory, raise an `InputError` first.

    >>> from pipistrelle.config import ScenarioConfig
    >>> mission = run_mission(Config(scenario=ScenarioConfig(steps=40)), ["fused"])
    >>> len(mission.heard), len(mission.trials[0].track.time)
    (10, 41)
    """
    kept = {"strategies": len(strategies), "filters": len(filters)}
    scenario = checked_scenario(config, world=world, **kept)
    passive, drive = any(one != "active" for one in strategies), drive_of(scenario, config)
    groups = tuple(each_its_own(config, filters))
    for own, names in groups:
        check_memory(names, len(standing_landmarks(scenario)[0]), own, passive=passive)
        check_filters(names, drive.motion, own, drive.moving.values())

    labels = all(own.association.method == KNOWN for own, _ in groups)
    radius = config.emitter.radius
    (heard,) = listen(scenario, config, (radius,), labels=labels, keep=keep, progress=progress)

    there = HeardWorld(scenario, config, {radius: heard})
    trials: dict[tuple[str, str], TrialResult] = {}
    for (own, names), strategy in product(groups, strategies):
        scans, causes = there.scans(own, strategy), there.causes(own, strategy)
        given, bound = drive_of(scenario, own), there.bound(own, strategy)
        for name in names:
            case = Case(strategy=strategy, filter=name)
            trial = try_trial(
                case, given, scans, own, causes=causes, progress=progress, watch=watch
            )
            trials[strategy, name] = replace(trial, scores=with_bound(trial.scores, bound))
    return Mission(
        config=config,
        drive=drive,
        trials=with_shared([trials[pair] for pair in product(strategies, filters)], drive.truth),
        beamwidth=beamwidth_of(config),
        callers=scenario.callers[VEHICLE + 1 :],
        scenario=scenario,
        world=None if world is ALL_DRAWN else world,
        heard=heard,
    )


def try_trial(
    case: Case,
    drive: Drive,
    scans: Sequence[Scan],
    config: Config,
    *,
    causes: Causes | None = None,
    progress: Progress | None = None,
    watch: Watch | None = None,
) -> TrialResult:
    """Run a trial; if an external estimator fails, return NaN poses and the error's message."""
    try:
        return run_trial(case, drive, scans, config, causes=causes, progress=progress, watch=watch)
    except Exception as error:
        if isinstance(error, InputError) and case.filter in CATALOGUE:
            raise  # a user's mistake
        let_interruptions_pass(error)
        k, scans = drive.time.size, tuple(scans)
        nowhere = Gaussian(mean=np.full((k, 3), nan), covariance=np.full((k, 3, 3), nan))
        track = Track(time=drive.time, pose=nowhere, landmarks=no_landmarks(), gated=0)
        return TrialResult(
            strategy=case.strategy,
            filter=case.filter,
            track=track,
            heard=scans,
            scans=scans,
            scores=score(track, drive.truth, scans, 0.0),
            wall_s=0.0,
            error=located(error),
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
    """Run an estimator on the scans of a sensing strategy, and score its path and map.

    Parameters
    ----------
    case : Case
    drive : Drive
    scans : sequence of Scan
        From `scans_of`. Measurements labelled as moving callers are removed, unless the settings
        use excess paths and the estimator tracks callers.
    config : Config
    association : Association, optional
        Labels the measurements; by default from the settings, if these name a method. Its labels
        differ from the true ones. Merged measurements have the settings' noise.
    causes : sequence of (m), optional
        True label of each measurement, to score the association; without them the map is matched
        with the true landmarks by position.
    progress, watch : callable, optional
    """
    strategy, name, heard, estimator = case.strategy, case.filter, tuple(scans), entry(case.filter)
    stated = (max(scan.landmark.max(initial=0), scan.callers.max(initial=0)) for scan in scans)
    association = association or association_of(config, int(max(stated, default=0)))
    follows = estimator.follows and config.listening.excess_paths
    scans = with_moving(scans, drive, follows=follows, known=association is None)

    used: list[Scan] = []

    def look(scan: Scan, belief: Belief) -> None:
        used.append(scan)
        if watch:
            watch(strategy, name, scan, belief)

    if name not in CATALOGUE or {*config.filter.calibrate} & {*OF_ODOMETRY}:  # need its controls
        scans = at_step_ends(drive, scans)
    began = jit.wall_s()
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
    wall_s = jit.wall_s() - began
    track = _named(at_vehicle(at_steps(whole, steps), drive.sensor), used, drive)
    truth, limit, found, mapped = drive.truth, estimator.nees_limit, None, None
    if association is not None and causes is not None:
        found = associated(track.labels, causes, [*drive.moving])
    elif association is not None and truth.landmarks is not None:
        found = matched(track.landmarks, *truth.landmarks, map_motion(track, truth))
    if found is None:
        scores = score(track, truth, used, limit)
    else:
        mapped = renamed(track.landmarks, found)
        scores = score(replace(track, landmarks=mapped), truth, used, limit)
        motion = map_motion(track, truth)
        scores = with_association(scores, track.landmarks, found, truth, motion)
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
        online=None if track.online is None else score_path(track.online, truth.path),
    )


def with_moving(
    scans: Sequence[Scan], drive: Drive, *, follows: bool, known: bool = True
) -> Sequence[Scan]:
    """Mark moving callers in scans; remove their measurements if they cannot be tracked.

    Without known labels callers are marked by their numbers, and nothing is removed.
    """
    if not drive.moving:
        return scans
    moving = np.array([*drive.moving])
    if not known:
        numbers = np.flatnonzero(np.isin(drive.callers, moving))
        unlabelled = {"moving_callers": numbers}
        return [replace(scan, **unlabelled) if scan.direct.size else scan for scan in scans]
    if follows:
        return [replace(scan, moving=moving) for scan in scans]
    return [rows_of(scan, ~np.isin(scan.landmark, moving)) for scan in scans]


def _named(track: Track, used: Sequence[Scan], drive: Drive) -> Track:
    """Replace the association's labels of a track's callers by the labels of the drive."""
    if not track.callers:
        return track
    pairs = (zip(scan.callers.tolist(), drive.callers.tolist(), strict=False) for scan in used)
    own = {name: label for both in pairs for name, label in both}
    return replace(track, callers={own.get(name, name): of for name, of in track.callers.items()})


def run_filter(
    estimator: Estimator[B],
    drive: Drive,
    scans: Sequence[Scan],
    rng: np.random.Generator,
    *,
    association: Association | None = None,
    noise: ConstantNoise | None = None,
    progress: Callable[[int, int], None] | None = None,
    watch: Callable[[Scan, B], None] | None = None,
) -> Track:
    """Run an estimator over a drive: predict to each scan, update with it, store every pose.

    If the belief revises its path (it has ``path``), the track is the final revised path, and the
    poses estimated at each time are kept as ``online``. Revised tracks of callers (``tracks``)
    replace the online ones.

    Parameters
    ----------
    estimator : Estimator
    drive : Drive
    scans : sequence of Scan
        In order, at times of the drive.
    rng : Generator
    association, noise : optional
        See `Session`.
    progress, watch : callable, optional
        Called with the number of scans done and the total, and with each scan, as the estimator
        used it, and the belief after it.

    Raises
    ------
    InputError
        For an unusable measurement or label, scans out of order or at other times than the drive's,
        moving landmarks known beforehand, or a wrong number of poses.
    """
    time = drive.time
    steps = _steps_of(scans, time)
    moving = {*drive.moving, *(label for scan in scans for label in scan.moving.tolist())}
    if roving := sorted(moving.intersection(drive.known.landmark.tolist())):
        found = f"found {roving}, which move; expected some that stand"
        raise InputError(f"landmarks known beforehand: {found}")
    session = Session(
        estimator, drive.start, rng, known=drive.known, callers=drive.callers,
        association=association, noise=noise,
    )  # fmt: skip
    path = Gaussian(mean=np.empty((time.size, 3)), covariance=np.empty((time.size, 3, 3)))
    path.mean[0], path.covariance[0] = drive.start.mean, drive.start.covariance
    callers: dict[int, Gaussian] = {}
    done = 0
    for number, (k, scan) in enumerate(zip(steps, scans, strict=True), start=1):
        _move(session, drive, done, k, path)
        done, used = k, session.hear(scan)
        pose = session.belief.pose()
        path.mean[k], path.covariance[k] = pose.mean, pose.covariance
        _follow(callers, scan, session.belief, (k, time.size))
        if watch:
            watch(used, session.belief)
        if progress:
            progress(number, len(scans))
    _move(session, drive, done, len(drive.controls), path)
    track = _track_of(session.belief, time, path, callers)
    if association is None:
        return track
    found = {"labels": tuple(session.labels), "report": session.report()}
    return replace(track, landmarks=session.landmarks(), **found)


def _steps_of(scans: Sequence[Scan], time: Float[np.ndarray, " t"]) -> list[int]:
    """Return the time step of each scan; raise if scans are out of order or between steps."""
    heard = np.array([scan.time for scan in scans], dtype=float)
    steps = np.searchsorted(time, heard)
    on_time = time[np.minimum(steps, time.size - 1)] == heard
    if not on_time.all():
        stray = scans[int(np.argmin(on_time))]
        raise InputError(f"scan at {stray.time} s: expected the time of the end of a step")
    if np.any(np.diff(steps) < 0):
        late = int(np.argmax(np.diff(steps) < 0))
        late = f"scan at {scans[late + 1].time} s: follows one at {scans[late].time} s"
        raise InputError(f"{late}; expected scans in the order of time")
    return steps.tolist()


def _move(session: Session[B], drive: Drive, first: int, last: int, path: Gaussian) -> None:
    """Predict an estimator over some control steps, and store the pose after each in `path`."""
    if last == first:
        return
    dt = np.diff(drive.time[first : last + 1])
    poses, after = session.move(drive.controls[first:last], dt), slice(first + 1, last + 1)
    path.mean[after], path.covariance[after] = poses.mean, poses.covariance


def _follow(callers: dict[int, Gaussian], scan: Scan, belief: Belief, at: tuple[int, int]) -> None:
    """Store the estimated positions of moving callers in sight at the present step."""
    if not (scan.moving.size or scan.moving_callers.size):
        return
    moving, (k, steps) = in_sight(completed(belief, Belief).moving()), at
    for row in range(moving.landmark.size):
        nowhere = Gaussian(mean=np.full((steps, 2), nan), covariance=np.full((steps, 2, 2), nan))
        track = callers.setdefault(int(moving.landmark[row]), nowhere)
        track.mean[k], track.covariance[k] = moving.mean[row], moving.covariance[row]


def _track_of(
    belief: Belief, time: Float[np.ndarray, " k"], path: Gaussian, callers: dict[int, Gaussian]
) -> Track:
    """Return a drive's track, from the final belief and the estimates made at each time."""
    belief = completed(belief, Belief)
    online = replace(path, invariant=belief.pose().invariant)
    revised, cloud, sums = belief.path(), belief.cloud(), (belief.innovations, belief.corrections)
    innovations, corrections = (x if isinstance(x, Innovations) else NO_INNOVATIONS for x in sums)
    if revised is not None:
        check_poses("path", revised, time.size)
    return Track(
        time=time,
        pose=revised or online,
        landmarks=belief.landmarks(),
        gated=belief.gated,
        innovations=innovations,
        corrections=corrections,
        cloud=cloud,
        full=None if cloud is None else belief.full,
        online=online if revised else None,
        calibration=belief.calibration(),
        callers=_retraced(callers, belief, time.size),
    )


def _retraced(callers: dict[int, Gaussian], belief: Belief, steps: int) -> Mapping[int, Gaussian]:
    """Replace online tracks of callers by revised tracks; fill gaps from the online tracks."""
    revised = belief.tracks() if callers else None
    if revised is None:
        return callers
    tracks = dict(revised)
    for label, track in tracks.items():
        found, expected = (np.shape(track.mean), np.shape(track.covariance)), (steps, 2)
        if found != (expected, (*expected, 2)):
            raise InputError(
                f"tracks: found arrays of {found[0]} and {found[1]} for caller {label}, expected "
                f"{expected} and {(*expected, 2)}: the start and every control step"
            )
        if label in callers:
            online, gap = callers[label], np.isnan(track.mean[:, :1])
            tracks[label] = Gaussian(
                mean=np.where(gap, online.mean, track.mean),
                covariance=np.where(gap[..., np.newaxis], online.covariance, track.covariance),
            )
    return tracks
