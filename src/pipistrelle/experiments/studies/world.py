"""One world of a study: drawn once, heard once for all beamwidths, tried in every case.

What a case is: `studies.plan`. Cases whose settings differ in nothing that is seen or heard
(filters, rays and the vehicle's piston aside) share the drawing and the recording.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from math import degrees
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Bool, Float, Int

from pipistrelle import kernel_clock
from pipistrelle.acoustics.emitter import beamwidth_of
from pipistrelle.config import Config, FilterConfig, ListeningConfig, Strategy
from pipistrelle.detection.faces import FrameMeasurements
from pipistrelle.detection.scans import Scan
from pipistrelle.estimation.beliefs import Track
from pipistrelle.estimation.catalogue import SECTIONS
from pipistrelle.evaluation.accuracy import (
    heaviest,
    landmark_error,
    pose_error,
    position_error,
)
from pipistrelle.evaluation.bound import (
    bound_of_drawn_start,
    nees_of_exact_start,
)
from pipistrelle.evaluation.consistency import track_nees
from pipistrelle.experiments.hearing.listening import listen
from pipistrelle.experiments.hearing.scenario import Scenario, standing_landmarks, world_of
from pipistrelle.experiments.hearing.trajectories import motion_of
from pipistrelle.experiments.hearing.world import World
from pipistrelle.experiments.results.scores import PathScores, Scores, drive_bound, with_bound
from pipistrelle.experiments.runs.checking import failure_text, first_belief
from pipistrelle.experiments.runs.trial import drive_of, run_trial, scans_of
from pipistrelle.experiments.studies.plan import Plan, PlannedCase, cases_of

if TYPE_CHECKING:
    import polars as pl

ONLINE = ("position_rmse_m", "heading_rmse_rad", "nees_mean", "nees_max")
"""Scores that a table has of the path as it was believed at its time, too, if it was revised."""

NEES_OF_DRAWN_START = (3.0, 6.0)
"""Mean and variance of a consistent filter's NEES: chi-square of three numbers."""
STEPS = ("position_error_m", "heading_error_rad", "nees", "nees_expected", "nees_variance")
"""What a table has of each frame: errors and NEES; of a consistent filter, mean and variance."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TrialRecord:
    """What is kept of a trial.

    Attributes
    ----------
    case : PlannedCase
    beamwidth_deg : float or None
        Of the vehicle's call; None for passive.
    error : str or None
        The traceback and, last, what it says in a line, if it failed; then there are neither
        scores nor rows of the other tables.
    scores : Scores or None
    online : PathScores or None
        Of the path as it was believed at its time, where the filter revises it.
    landmarks_full_mean : float or None
        Over the particles, where the filter has some.
    clutter_per_frame : float or None
        Detections without a label.
    wall_s, cpu_s : [s]
        Time that the filter took.
    steps : (k, 5) [m, rad, 1, 1, 1]
        Position error, heading error and NEES at each frame; of a consistent filter's NEES the
        mean and the variance.
    landmark : (n)
        Labels.
    full : (n)
        Whether each is fully initialised.
    landmark_error : (n) [m]
    """

    case: PlannedCase
    beamwidth_deg: float | None
    error: str | None = None
    scores: Scores | None = None
    online: PathScores | None = None
    landmarks_full_mean: float | None = None
    clutter_per_frame: float | None = None
    wall_s: float = 0.0
    cpu_s: float = 0.0
    steps: Float[np.ndarray, "k 5"]
    landmark: Int[np.ndarray, " n"]
    full: Bool[np.ndarray, " n"]
    landmark_error: Float[np.ndarray, " n"]


def run_world(plan: Plan, iteration: int) -> tuple[TrialRecord, ...]:
    """Draw a world, listen once for all beamwidths, and try every case of a plan in it.

    A trial that raises an exception, and every trial of a world that does, is a failed record.

    Parameters
    ----------
    plan : Plan
    iteration : int
        Number of the world.

    Returns
    -------
    tuple of TrialRecord, one per case, in their order

    Examples
    --------
    >>> from pipistrelle.config import ScenarioConfig
    >>> ways = {"strategies": ("fused",), "filters": ("ekf",)}
    >>> config = Config(scenario=ScenarioConfig(steps=8, landmarks=12))
    >>> plan = Plan(name="one", iterations=1, config=config, grid={}, **ways)
    >>> [record.steps.shape for record in run_world(plan, 0)]
    [(2, 5)]
    """
    records = [
        record
        for cases in heard_together(plan)
        for record in _run_cases(cases, iteration, plan.world(cases[0].config))
    ]
    return tuple(sorted(records, key=lambda record: record.case.number))


def heard_together(plan: Plan) -> tuple[tuple[PlannedCase, ...], ...]:
    """Group the cases of a plan that share the drawing and the recording of a world.

    Parameters
    ----------
    plan : Plan

    Returns
    -------
    tuple of tuples of PlannedCase

    Examples
    --------
    >>> grid = {"filter.gate": (0.9, 1.0), "emitter.radius": (0.0025, 0.025)}
    >>> ways = {"strategies": ("fused",), "filters": ("ekf",)}
    >>> plan = Plan(name="four", iterations=1, config=Config(), grid=grid, **ways)
    >>> [len(cases) for cases in heard_together(plan)]
    [4]
    """
    together: dict[str, list[PlannedCase]] = {}
    for case in cases_of(plan):
        together.setdefault(_heard_settings(case), []).append(case)
    return tuple(map(tuple, together.values()))


def failed_records(plan: Plan, error: str) -> tuple[TrialRecord, ...]:
    """Record that a world could not be tried.

    Parameters
    ----------
    plan : Plan
    error : str

    Returns
    -------
    tuple of TrialRecord, one per case
    """
    return tuple(_failed(case, error) for case in cases_of(plan))


def world_tables(
    plan: Plan, iteration: int, records: Sequence[TrialRecord]
) -> "dict[str, pl.DataFrame]":
    """Lay out a world's tables.

    Parameters
    ----------
    plan : Plan
    iteration : int
    records : sequence of TrialRecord

    Returns
    -------
    dict of DataFrame
        By the names of `world_schemas`.
    """
    import polars as pl

    schemas = world_schemas(plan)
    rows = [_row(iteration, record, list(schemas["trials"])) for record in records]

    def joined(name: str, columns: dict[str, list[np.ndarray]]) -> pl.DataFrame:
        lengths = [len(part) for part in next(iter(columns.values()))]
        case = np.repeat([record.case.number for record in records], lengths)
        world = {"iteration": np.full(len(case), iteration), "case": case}
        data = {column: np.concatenate(parts) for column, parts in columns.items()}
        kinds = schemas[name].items()
        return pl.DataFrame(world | data).select(pl.col(c).cast(kind) for c, kind in kinds)

    steps = {"frame": [np.arange(1, len(record.steps) + 1) for record in records]}
    for i, column in enumerate(STEPS):
        steps[column] = [record.steps[:, i] for record in records]
    landmarks = {
        "landmark": [record.landmark for record in records],
        "full": [record.full for record in records],
        "error_m": [record.landmark_error for record in records],
    }
    return {
        "trials": pl.DataFrame(rows, schema=schemas["trials"]),
        "steps": joined("steps", steps),
        "landmarks": joined("landmarks", landmarks),
    }


def world_schemas(plan: Plan) -> "dict[str, dict[str, Any]]":
    """Name the columns of each table and what they hold.

    Parameters
    ----------
    plan : Plan

    Returns
    -------
    dict of table to dict of column to polars type
    """
    import polars as pl

    world = {"iteration": pl.Int32, "case": pl.Int16}
    grid = {
        name: pl.Float64 if isinstance(_cell(values[0]), (int, float)) else pl.String
        for name, values in plan.grid.items()
    }
    # Worlds of a study that was begun before have no such column, and go on being read.
    kept = (field.name for field in fields(Scores) if field.name != "nis_mean")
    scores = dict.fromkeys(kept, pl.Float64)
    counts = dict.fromkeys(("landmarks_full", "landmarks_total", "gated"), pl.Int32)
    last = ("landmarks_full_mean", "clutter_per_frame", "wall_s", "cpu_s")
    return {
        "trials": {
            **world,
            "strategy": pl.String,
            "filter": pl.String,
            **grid,
            "beamwidth_deg": pl.Float64,
            "seed": pl.Int64,
            "status": pl.String,
            "error": pl.String,
            **(scores | counts | {"diverged": pl.Boolean}),
            **dict.fromkeys(last, pl.Float64),
            **dict.fromkeys(_online_columns(plan), pl.Float64),
        },
        "steps": {
            **world,
            "frame": pl.UInt16,
            **dict.fromkeys(STEPS, pl.Float32),
        },
        "landmarks": {**world, "landmark": pl.Int16, "full": pl.Boolean, "error_m": pl.Float32},
    }


def _online_columns(plan: Plan) -> tuple[str, ...]:
    """Name the columns that a plan has only if one of its filters revises its path."""
    motion = motion_of(plan.config.motion)
    for name in plan.filters:
        if hasattr(first_belief(name, motion, plan.config), "path"):
            return tuple(f"online_{score}" for score in ONLINE)
    return ()


def _heard_settings(case: PlannedCase) -> str:
    """Return as text all settings that bear on a case's world and on what is heard in it."""
    settings = case.config.model_dump(mode="json", exclude=set(SECTIONS))
    del settings["emitter"]["radius"]
    settings["assumed"] = case.config.assumed_sound_speed  # the rest is the filters' alone
    return json.dumps(settings)


def _run_cases(cases: Sequence[PlannedCase], iteration: int, world: World) -> list[TrialRecord]:
    """Draw and hear a world for cases that share it, and try each."""
    config = cases[0].config
    radii = sorted({case.config.emitter.radius for case in cases})
    try:
        scenario = world_of(config, iteration, world)
        heard = listen(scenario, config, radii, iteration=iteration)
    except Exception as failure:
        error = failure_text(failure)
        return [_failed(case, error) for case in cases]
    shared = _Shared(scenario, config, dict(zip(radii, heard, strict=True)))
    return [_try_case(case, shared, iteration) for case in cases]


_NOISE = ("noise", "range_std", "bearing_std", "detour_std")
_CALLERS = ("caller_speed_std", "caller_walk_std")
"""Settings of a filter that state noise, of what is heard and of how callers move."""
_Told = tuple[float, Strategy, FilterConfig, ListeningConfig]
"""Of which beam, by which strategy, with which noise, and what is listened for."""


class _Shared:
    """What the cases of a world share: each is worked out once."""

    def __init__(
        self, scenario: Scenario, config: Config, beams: Mapping[float, Sequence[FrameMeasurements]]
    ) -> None:
        self.scenario, self.beams, self._config = scenario, beams, config
        self._drive = drive_of(scenario, config)
        # No `cache` of a method: it would hold what holds it, and a world's sound for long.
        self._scans_known: dict[_Told, tuple[Scan, ...]] = {}
        self._bound_known: dict[_Told, Float[np.ndarray, "t 3 3"]] = {}

    def scans(self, case: PlannedCase) -> tuple[Scan, ...]:
        """Return what a strategy takes of a beam's frames, and how surely, as a filter is told."""
        return self._scans(_told(case))

    def consistent(self, case: PlannedCase) -> Float[np.ndarray, "k 2"]:
        """Return mean and variance of a consistent filter's NEES at each frame."""
        frames = slice(None, None, self._config.scenario.steps_per_frame)
        path, told = self.scenario.path[frames], case.config.filter
        if told.first_pose == "drawn":
            return np.tile(np.array(NEES_OF_DRAWN_START, np.float32), (len(path) - 1, 1))
        bound = self._bound(_told(case))[frames]
        expected = nees_of_exact_start(bound, path, _start_covariance(told))
        return np.column_stack(expected)[1:].astype(np.float32)

    def bound(self, case: PlannedCase) -> Float[np.ndarray, "t 3 3"]:
        """Return the bound of the pose at every step, the noise as the signal tells it."""
        radius, strategy, noise, listening = _told(case)
        measured, told = noise.model_copy(update={"noise": "measured"}), case.config.filter
        bound = self._bound((radius, strategy, measured, listening))
        if told.first_pose == "drawn":
            return bound_of_drawn_start(bound, self.scenario.path, _start_covariance(told))
        return bound

    def _scans(self, told: _Told) -> tuple[Scan, ...]:
        """Take the scans of a beam, which nothing that is told of callers changes."""
        radius, strategy, told_of, listening = told
        noise = _alone(told_of, _NOISE)
        key = (radius, strategy, noise, listening)
        if key not in self._scans_known:
            config = self._config.model_copy(update={"filter": noise, "listening": listening})
            self._scans_known[key] = scans_of(self.beams[radius], strategy, config)
        return self._scans_known[key]

    def _bound(self, told: _Told) -> Float[np.ndarray, "t 3 3"]:
        """Work out the bound of the pose at every step."""
        if told not in self._bound_known:
            _, _, noise, listening = told
            config = self._config.model_copy(update={"filter": noise, "listening": listening})
            known = replace(self._drive, motion=motion_of(config.motion))
            bound = drive_bound(known, self._scans(told), config)
            assert bound is not None, "the truth of a world is known"
            self._bound_known[told] = bound
        return self._bound_known[told]


def _start_covariance(told: FilterConfig) -> Float[np.ndarray, "3 3"]:
    """Return how surely a filter is told the first pose."""
    return np.diag(np.square(told.initial_pose_std))


def _told(case: PlannedCase) -> _Told:
    """Return what tells a case's scans from those of others in its world."""
    config = case.config
    told = _alone(config.filter, _NOISE + _CALLERS)
    return config.emitter.radius, case.strategy, told, config.listening


def _alone(told: FilterConfig, names: Sequence[str]) -> FilterConfig:
    """Return some of a filter's settings, and of the others the defaults."""
    return FilterConfig(**{name: getattr(told, name) for name in names})


def _try_case(case: PlannedCase, shared: _Shared, iteration: int) -> TrialRecord:
    """Run a trial, whatever comes of it; filters share what a beam and a strategy bring."""
    try:
        scenario = shared.scenario
        drive, scans = drive_of(scenario, case.config, iteration), shared.scans(case)
        heard = shared.beams[case.config.emitter.radius]
        began = kernel_clock.cpu_s()
        result = run_trial(replace(case, iteration=iteration), drive, scans, case.config)
        cpu_s = kernel_clock.cpu_s() - began
        estimate = heaviest(result.track.landmarks)
        full = result.track.full
        frames = _frame_errors(result.track, scenario, case.config)
        return TrialRecord(
            case=case,
            beamwidth_deg=_beamwidth_deg(case),
            scores=with_bound(result.scores, shared.bound(case)),
            online=result.online,
            landmarks_full_mean=float(result.scores.landmarks_full if full is None else full),
            clutter_per_frame=sum(h.clutter or 0 for h in heard) / len(heard) if heard else None,
            wall_s=result.wall_s,
            cpu_s=cpu_s,
            steps=np.column_stack([frames, shared.consistent(case)]),
            landmark=estimate.landmark,
            full=estimate.full,
            landmark_error=landmark_error(estimate, *standing_landmarks(scenario)),
        )
    except Exception as failure:
        return _failed(case, failure_text(failure))


@np.errstate(over="ignore", invalid="ignore")
def _frame_errors(track: Track, scenario: Scenario, config: Config) -> Float[np.ndarray, "k 3"]:
    """Return position error [m], heading error [rad] and NEES at each frame."""
    every = config.scenario.steps_per_frame
    frames = slice(every, None, every)
    epsilon = track_nees(track.pose, scenario.path)[frames]
    mean, true = track.pose.mean[frames], scenario.path[frames]
    columns = (position_error(mean, true), pose_error(mean, true)[:, 2], epsilon)
    return np.column_stack(columns).astype(np.float32)


def _failed(case: PlannedCase, error: str) -> TrialRecord:
    """Record that a trial failed."""
    return TrialRecord(
        case=case,
        beamwidth_deg=_beamwidth_deg(case),
        error=error,
        steps=np.empty((0, len(STEPS)), np.float32),
        landmark=np.empty(0, int),
        full=np.empty(0, bool),
        landmark_error=np.empty(0),
    )


def _beamwidth_deg(case: PlannedCase) -> float | None:
    """Return the half-power beamwidth of the vehicle's call, where it matters."""
    if case.strategy == "passive":
        return None
    return degrees(beamwidth_of(case.config))


def _row(iteration: int, record: TrialRecord, columns: Sequence[str]) -> dict[str, Any]:
    """Lay out a trial's row."""
    case, scores, online = record.case, record.scores, record.online
    nothing = dict.fromkeys(field.name for field in fields(Scores))
    row = {
        "iteration": iteration,
        "case": case.number,
        "strategy": case.strategy,
        "filter": case.filter,
        **{name: _cell(value) for name, value in case.values.items()},
        "beamwidth_deg": record.beamwidth_deg,
        "seed": case.config.seed,
        "status": "done" if record.error is None else "failed",
        "error": record.error,
        **(nothing if scores is None else asdict(scores)),
        "landmarks_full_mean": record.landmarks_full_mean,
        "clutter_per_frame": record.clutter_per_frame,
        "wall_s": record.wall_s,
        "cpu_s": record.cpu_s,
        **{f"online_{name}": online and getattr(online, name) for name in ONLINE},
    }
    return {column: row[column] for column in columns}


def _cell(value: Any) -> Any:
    """Return a grid's value as a table holds it: a number, or text."""
    return value if value is None or isinstance(value, (int, float, str)) else json.dumps(value)
