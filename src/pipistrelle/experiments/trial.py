"""A mission on one screen: draw a world, listen along the path, estimate, score.

Read this file first. Each call below is a box of the paper's workflow.
"""

import time as clock
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Complex, Float

from pipistrelle.acoustics.arrivals import (
    ACTIVE,
    Arrivals,
    arrivals_of_emission,
    rows_of,
    through_piston,
)
from pipistrelle.arrays.layout import Layout, square_of_four
from pipistrelle.arrays.noise import stream_key
from pipistrelle.arrays.receiver import (
    BLOCK,
    Sampling,
    add_echo_blocks,
    blocks_to_hear,
    noise_blocks,
    record_samples,
    sampling,
)
from pipistrelle.config import Config, InputError, ScenarioConfig, Strategy
from pipistrelle.detection.scans import Heard, Scan, average_faces, scan_of
from pipistrelle.detection.snapshots import (
    Detections,
    Detector,
    detect,
    detector,
    filter_blocks,
    filter_samples,
)
from pipistrelle.estimation.ekf import EkfBelief, EkfSlam
from pipistrelle.estimation.models import Gaussian, Motion, Track
from pipistrelle.evaluation.consistency import EKF_LIMIT
from pipistrelle.experiments.association import faintest_level_db, label_detections
from pipistrelle.experiments.results import TrialResult, score
from pipistrelle.experiments.scenario import Scenario, bicycle, draw_scenario

Progress = Callable[[str, int, int], None]
"""Called with a stage's name, the frames done and their number."""
Watch = Callable[[str, str, Scan, EkfBelief], None]
"""Called with strategy, filter, scan and the belief after it."""
LIMITS = {"ekf": EKF_LIMIT}
"""The filters by name, with the NEES above which each counts as diverged."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Mission:
    """One world, what was heard in it, and what each strategy and filter made of it."""

    config: Config
    scenario: Scenario
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
    filters : sequence of "ekf"
    progress, watch : callable, optional

    Returns
    -------
    Mission

    Raises
    ------
    InputError
        When the world, the sampling or a filter cannot be had.
    """
    scenario = draw_scenario(config, _generator(config.seed, 0, "scenario"))
    (heard,) = listen(scenario, config, (config.emitter.radius,), progress=progress)
    trials = []
    for strategy in strategies:
        scans = tuple(scan_of(frame, strategy) for frame in heard)
        for name in filters:
            trials.append(
                run_trial(
                    strategy, name, scenario, scans, config, progress=progress, watch=watch
                )
            )
    return Mission(config=config, scenario=scenario, heard=heard, trials=tuple(trials))


def listen(
    scenario: Scenario,
    config: Config,
    radii: Sequence[float],
    *,
    iteration: int = 0,
    progress: Progress | None = None,
) -> tuple[tuple[Heard, ...], ...]:
    """Hear every frame of a path, once for all beamwidths.

    The noise and the beacon's sound are those of the world and shared by all beams.

    Parameters
    ----------
    scenario : Scenario
    config : Config
    radii : sequence of [m]
        Radii of the vehicle's piston; ``config.emitter.radius`` is not used.
    iteration : int
        Number of the world, part of the noise's key.
    progress : callable, optional

    Returns
    -------
    tuple, one per radius, of tuples of Heard, one per frame
    """
    layout, settled = square_of_four(config.receiver), sampling(config)
    finder = detector(config, layout)
    faintest_db = faintest_level_db(
        finder.threshold,
        elements=layout.position.size,
        samples=settled.pulse * settled.block,
        noise_std=settled.noise_std,
        margin_db=config.association.margin_db,
    )
    beams: tuple[list[Heard], ...] = tuple([] for _ in radii)
    frames = _frames(scenario, config.scenario)
    for done, k in enumerate(frames, start=1):
        velocity = (scenario.path[k, :2] - scenario.path[k - 1, :2]) / config.scenario.step
        emission = arrivals_of_emission(
            scenario.path[k], velocity, scenario.landmarks, scenario.beacon, config
        )
        key = stream_key(config.seed, iteration, "noise", done)
        record = _dense if config.receiver.engine == "dense" else _blocks
        for beam, (arrivals, detections) in zip(
            beams, record(emission, radii, layout, settled, finder, config, key), strict=True
        ):
            label = label_detections(
                detections,
                arrivals,
                layout,
                config.association,
                pulse=config.emitter.pulse,
                faintest_db=faintest_db,
            )
            beam.append(
                average_faces(
                    float(scenario.time[k]),
                    detections,
                    label,
                    averaging=config.detection.averaging,
                    speed_of_sound=config.air.speed_of_sound,
                )
            )
        if progress:
            progress("listening", done, len(frames))
    return tuple(tuple(beam) for beam in beams)


def run_trial(
    strategy: Strategy,
    name: str,
    scenario: Scenario,
    scans: Sequence[Scan],
    config: Config,
    *,
    iteration: int = 0,
    progress: Progress | None = None,
    watch: Watch | None = None,
) -> TrialResult:
    """Estimate path and map from one strategy's scans, and score them.

    Parameters
    ----------
    strategy : "active", "fused" or "passive"
    name : "ekf"
        Of the filter.
    scenario : Scenario
    scans : sequence of Scan
    config : Config
    iteration : int
        Number of the world, part of the filter's key.
    progress, watch : callable, optional

    Returns
    -------
    TrialResult
    """
    settings = config.filter
    start = Gaussian(
        mean=scenario.path[0], covariance=np.diag(np.square(settings.initial_pose_std))
    )
    began = clock.perf_counter()
    track = run_filter(
        estimator(name, bicycle(config.motion), config),
        start,
        scenario.time,
        scenario.controls,
        scans,
        _generator(config.seed, iteration, name),
        progress=progress and (lambda done, total: progress(f"{strategy} {name}", done, total)),
        watch=watch and (lambda scan, belief: watch(strategy, name, scan, belief)),
    )
    wall_s = clock.perf_counter() - began
    places = np.vstack((scenario.landmarks, scenario.beacon))
    truth = (np.arange(1, len(places) + 1), places)
    return TrialResult(
        strategy=strategy,
        filter=name,
        track=track,
        scans=tuple(scans),
        scores=score(track, scenario.path, truth, scans, LIMITS[name]),
        wall_s=wall_s,
    )


def estimator(name: str, motion: Motion, config: Config) -> EkfSlam:
    """Build a filter from the settings.

    Parameters
    ----------
    name : "ekf"
    motion : Motion
    config : Config

    Returns
    -------
    EkfSlam

    Raises
    ------
    InputError
        For an unknown name.
    """
    if name not in LIMITS:
        raise InputError(f"filter: found {name!r}, expected one of {', '.join(LIMITS)}")
    settings = config.filter
    return EkfSlam(
        motion=motion,
        range_std=settings.range_std,
        bearing_std=settings.bearing_std,
        rays=config.rays,
        gate=settings.gate,
    )


def run_filter(
    estimator: EkfSlam,
    start: Gaussian,
    time: Float[np.ndarray, " k+1"],
    controls: Float[np.ndarray, "k 2"],
    scans: Sequence[Scan],
    rng: np.random.Generator,
    *,
    progress: Callable[[int, int], None] | None = None,
    watch: Callable[[Scan, EkfBelief], None] | None = None,
) -> Track:
    """Predict to each scan, update with it, and keep the pose of every step.

    Parameters
    ----------
    estimator : Estimator
    start : Gaussian of (3) and (3, 3)
    time : (k + 1) [s]
        Of the start and of the end of each step.
    controls : (k, 2)
        Of each step.
    scans : sequence of Scan
        In order; the time of each is one of ``time``.
    rng : Generator
    progress : callable, optional
        Given the scans done and their number.
    watch : callable, optional
        Given each scan and the belief after it.

    Returns
    -------
    Track
    """
    mean, covariance = np.empty((time.size, 3)), np.empty((time.size, 3, 3))
    mean[0], covariance[0] = start.mean, start.covariance
    dt, belief, done = np.diff(time), estimator.init(start), 0
    at = np.searchsorted(time, [scan.time for scan in scans])
    for i, (scan, k) in enumerate(zip(scans, at, strict=True), start=1):
        if k > done:
            belief, poses = estimator.predict(belief, controls[done:k], dt[done:k], rng)
            mean[done + 1 : k + 1], covariance[done + 1 : k + 1] = poses.mean, poses.covariance
            done = int(k)
        belief = estimator.update(belief, scan, rng)
        pose = belief.pose()
        mean[k], covariance[k] = pose.mean, pose.covariance
        if watch:
            watch(scan, belief)
        if progress:
            progress(i, len(scans))
    if done < len(controls):
        belief, poses = estimator.predict(belief, controls[done:], dt[done:], rng)
        mean[done + 1 :], covariance[done + 1 :] = poses.mean, poses.covariance
    return Track(
        time=time,
        pose=Gaussian(mean=mean, covariance=covariance),
        landmarks=belief.landmarks(),
        gated=belief.gated,
    )


def compile_kernels() -> None:
    """Compile every kernel, or load it from the cache, by a mission of two frames."""
    tiny = Config(scenario=ScenarioConfig(steps=8, landmarks=4, radius=10.0))
    run_mission(tiny, ("active", "fused", "passive"))


def _generator(seed: int, iteration: int, purpose: str) -> np.random.Generator:
    """Return the generator of a purpose in a world."""
    return np.random.default_rng(stream_key(seed, iteration, purpose))


def _frames(scenario: Scenario, setup: ScenarioConfig) -> range:
    """Return the steps at whose end the vehicle and the beacon call."""
    return range(setup.steps_per_frame, len(scenario.path), setup.steps_per_frame)


def _blocks(
    emission: Arrivals,
    radii: Sequence[float],
    layout: Layout,
    settled: Sampling,
    finder: Detector,
    config: Config,
    key: int,
) -> Iterator[tuple[Arrivals, Detections]]:
    """Yield, per beam, the true arrivals and what is detected of them from block sums."""
    own = emission.source == ACTIVE
    shared = noise_blocks(blocks_to_hear(emission, settled), layout, settled, key)
    add_echo_blocks(shared, rows_of(emission, ~own), layout, settled)
    for radius in radii:
        arrivals = _aimed(emission, radius, config)
        signal: Complex[np.ndarray, "b f 2 e"] = shared.copy()
        add_echo_blocks(signal, rows_of(arrivals, own), layout, settled)
        matched = filter_blocks(
            signal, pulse=settled.pulse, block=settled.block, noise_std=settled.noise_std
        )
        yield arrivals, detect(
            matched, finder, start=settled.pulse * BLOCK, interval=BLOCK, pulse=settled.pulse
        )


def _dense(
    emission: Arrivals,
    radii: Sequence[float],
    layout: Layout,
    settled: Sampling,
    finder: Detector,
    config: Config,
    key: int,
) -> Iterator[tuple[Arrivals, Detections]]:
    """Yield the same from every sample."""
    length = settled.pulse * settled.block
    for radius in radii:
        arrivals = _aimed(emission, radius, config)
        samples = record_samples(
            blocks_to_hear(emission, settled), arrivals, layout, settled, np.random.default_rng(key)
        )
        matched = filter_samples(
            samples,
            tones=settled.tones,
            rate=settled.rate,
            length=length,
            noise_std=settled.noise_std,
        )
        start, interval = settled.pulse * BLOCK, 1.0 / settled.rate
        yield arrivals, detect(matched, finder, start=start, interval=interval, pulse=length)


def _aimed(emission: Arrivals, radius: float, config: Config) -> Arrivals:
    """Return the arrivals of an emission through the vehicle's piston."""
    return through_piston(
        emission,
        radius=radius,
        frequency=config.emitter.frequency,
        speed_of_sound=config.air.speed_of_sound,
    )
