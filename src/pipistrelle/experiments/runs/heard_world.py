"""A simulated world with its scans: the measurements of each strategy, and the bound on estimates.

Missions and the cases of a study use the same `HeardWorld`, so their scans and bounds are equal.
`Mission` is the record of a simulated or replayed mission.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from pipistrelle.acoustics.paths import Caller
from pipistrelle.arithmetic.random_stream import stream_key
from pipistrelle.config import (
    AssociationConfig,
    Config,
    FilterConfig,
    InputError,
    ListeningConfig,
    Strategy,
)
from pipistrelle.detection.front_end import FrameMeasurements
from pipistrelle.detection.logs.recording import Log
from pipistrelle.detection.noise import noise_of, without_hidden
from pipistrelle.detection.scans import Scan, scan_of
from pipistrelle.estimation.beliefs import KNOWN, Gaussian
from pipistrelle.evaluation.association import Causes, causes_of
from pipistrelle.evaluation.bound import bound_of_drawn_start
from pipistrelle.experiments.drives import Drive, Truth
from pipistrelle.experiments.hearing.scenario import (
    Scenario,
    World,
    assumed_motion,
    caller_labels,
    moving_callers,
    standing_landmarks,
)
from pipistrelle.experiments.hearing.trajectories import true_motion
from pipistrelle.experiments.results.scores import TrialResult, drive_bound
from pipistrelle.geometry import wrap_angle


@dataclass(frozen=True, slots=True, kw_only=True)
class Mission:
    """A mission, simulated or from a log: its drive, measurements and estimates."""

    config: Config
    """For a log only the sections of the estimators apply."""
    drive: Drive
    trials: tuple[TrialResult, ...]
    beamwidth: float | None
    """Full half-power beamwidth of the vehicle's call; for a log, the beamwidth outside which
    ranges were hidden [rad]."""
    callers: tuple[Caller, ...] = ()
    """Callers besides the vehicle; empty for a log."""
    scenario: Scenario | None = None
    world: World | None = None
    heard: tuple[FrameMeasurements, ...] = ()
    log: Log | None = None
    source: Mapping[str, object] | None = None
    """Entry of the log in ``summary.json`` (`log_entry`)."""
    notes: Callable[[], Iterable[str]] = tuple
    """Returns the warnings for the user; called after the results are written."""
    difference: str = ""
    """Difference of a rerun mission's tracks from its folder's, in a line."""


_NOISE = ("noise", "range_std", "bearing_std", "excess_path_std", "calibrate")
_CALLERS = ("caller_speed_std", "caller_walk_std")
"""Settings of a filter that change its measurement noise, and its model of moving callers."""
_Key = tuple[float, Strategy, FilterConfig, ListeningConfig, AssociationConfig]
"""Piston radius [m], strategy, and settings of noise, listening and association."""
_LABELS = {"association": AssociationConfig(method=KNOWN)}


def scans_of(
    heard: Sequence[FrameMeasurements], strategy: Strategy, config: Config
) -> tuple[Scan, ...]:
    """Return the scans of a sensing strategy, with the noise of the settings.

    Frames between the vehicle's calls are omitted if they have no measurement for the strategy.
    With a data association (``association.method``) scans have no labels and only their measured
    noise; constant noise is set after measurements of a landmark were merged.
    """
    known = config.association.method == KNOWN
    noise = noise_of(config.filter) if known else (lambda scan: scan)
    rows = (
        without_hidden(
            frame.rows if known else _unlabelled(frame),
            config.filter,
            timing=config.listening.excess_paths,
            known=known,
        )
        for frame in heard
    )
    scans = zip(heard, (scan_of(scan, strategy) for scan in rows), strict=True)
    return tuple(noise(scan) for frame, scan in scans if scan.landmark.size or not frame.between)


def _unlabelled(frame: FrameMeasurements) -> Scan:
    """Return a frame's measurements without labels; raise if the frame has only labelled ones."""
    if frame.unlabelled is None:
        why = "found frames that were heard with labels alone"
        raise InputError(f"association.method: {why}; expected some of listen(..., labels=False)")
    return frame.unlabelled


def drive_of(scenario: Scenario, config: Config, iteration: int = 0) -> Drive:
    """Return the drive of a simulated world: an estimator's input, and the truth for scoring.

    `iteration`, the number of the world, is part of the key of a drawn start. The true landmarks
    are the world's, then the callers that do not move, so the beacon is last.
    """
    start, covariance = scenario.path[0], _start_covariance(config)
    if config.filter.first_pose == "drawn":
        rng = np.random.default_rng(stream_key(config.seed, iteration, "start"))
        start = start + np.array(config.filter.initial_pose_std) * rng.standard_normal(3)
        start[2] = wrap_angle(start[2])
    moving = moving_callers(scenario)
    return Drive(
        motion=assumed_motion(config),
        start=Gaussian(mean=start, covariance=covariance),
        time=scenario.time,
        controls=scenario.controls,
        truth=Truth(
            time=scenario.time,
            path=scenario.path,
            landmarks=standing_landmarks(scenario),
            callers={label: np.asarray(caller.place) for label, caller in moving.items()},
        ),
        callers=caller_labels(scenario),
        moving={label: caller.name for label, caller in moving.items()},
    )


class HeardWorld:
    """A simulated world, its frames for each beam, and a cache of derived scans and bounds.

    Configurations passed to its methods may differ only in settings that change neither the world
    nor its recording.
    """

    def __init__(
        self, scenario: Scenario, config: Config, beams: Mapping[float, Sequence[FrameMeasurements]]
    ) -> None:
        self.scenario = scenario
        self.beams = beams
        """Frames by the radius of the vehicle's piston [m]."""
        self._config = config
        self._drive = replace(drive_of(scenario, config), motion=true_motion(config.motion))
        # A `cache` of a method would keep this object, and so the world's sound, alive for long.
        self._scans: dict[_Key, tuple[Scan, ...]] = {}
        self._bounds: dict[_Key, Float[np.ndarray, "t 3 3"]] = {}

    def scans(self, config: Config, strategy: Strategy) -> tuple[Scan, ...]:
        """Return the scans of a sensing strategy, computed at most once for equal settings."""
        radius, noise = config.emitter.radius, _only(config.filter, _NOISE)
        key = (radius, strategy, noise, config.listening, config.association)
        if key not in self._scans:
            self._scans[key] = scans_of(self.beams[radius], strategy, self._with(key))
        return self._scans[key]

    def causes(self, config: Config, strategy: Strategy) -> Causes | None:
        """Return the true label of each measurement of a strategy; None if labels are known."""
        if config.association.method == KNOWN:
            return None
        frames = {frame.rows.time: frame for frame in self.beams[config.emitter.radius]}
        pairs = ((scan, frames[scan.time]) for scan in self.scans(config, strategy))
        return tuple(causes_of(scan, _unlabelled(frame), frame.causes) for scan, frame in pairs)

    def bound(self, config: Config, strategy: Strategy) -> Float[np.ndarray, "t 3 3"]:
        """Return the lower bound on the pose covariance at every step, for the measured noise."""
        noise = config.filter.model_copy(update={"noise": "measured"})
        bound = self.stated_bound(config.model_copy(update={"filter": noise}), strategy)
        if config.filter.first_pose == "drawn":
            return bound_of_drawn_start(bound, self.scenario.path, _start_covariance(config))
        return bound

    def stated_bound(self, config: Config, strategy: Strategy) -> Float[np.ndarray, "t 3 3"]:
        """Return the bound on the pose covariance for an exact start and the settings' noise.

        Labels count as known, also with a data association.
        """
        noise = _only(config.filter, _NOISE + _CALLERS)
        key = (config.emitter.radius, strategy, noise, config.listening, _LABELS["association"])
        if key not in self._bounds:
            scans = self.scans(config.model_copy(update=_LABELS), strategy)
            bound = drive_bound(self._drive, scans, self._with(key))
            assert bound is not None, "the truth of a world is known"
            self._bounds[key] = bound
        return self._bounds[key]

    def _with(self, key: _Key) -> Config:
        """Return the world's settings with filter, listening and association from a cache key."""
        _, _, *sections = key
        names = ("filter", "listening", "association")
        return self._config.model_copy(update=dict(zip(names, sections, strict=True)))


def _start_covariance(config: Config) -> Float[np.ndarray, "3 3"]:
    """Return the covariance of the first pose that the settings let a filter assume."""
    return np.diag(np.square(np.array(config.filter.initial_pose_std)))


def _only(settings: FilterConfig, names: Sequence[str]) -> FilterConfig:
    """Return a filter's settings with all except the settings in `names` at their defaults."""
    return FilterConfig(**{name: getattr(settings, name) for name in names})
