"""One world of a study: drawn once, heard once for all beamwidths, tried in every case.

What a case is: `studies.plan`. Cases whose settings differ in nothing that is seen or heard
(filters, rays and the vehicle's piston aside) share the drawing and the recording.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from math import degrees
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Bool, Float, Int

from pipistrelle import kernel_clock
from pipistrelle.acoustics.emitter import beamwidth_of
from pipistrelle.config import Config
from pipistrelle.estimation.association import KNOWN
from pipistrelle.estimation.beliefs import Track
from pipistrelle.estimation.catalogue import SECTIONS
from pipistrelle.estimation.smoother.calibration import numbers_of
from pipistrelle.evaluation.accuracy import (
    heaviest,
    landmark_error,
    pose_error,
    position_error,
)
from pipistrelle.evaluation.bound import (
    nees_of_exact_start,
)
from pipistrelle.evaluation.consistency import track_nees
from pipistrelle.experiments.hearing.listening import listen
from pipistrelle.experiments.hearing.scenario import Scenario, standing_landmarks, world_of
from pipistrelle.experiments.hearing.trajectories import motion_of
from pipistrelle.experiments.hearing.world import World
from pipistrelle.experiments.results.scores import (
    OF_ASSOCIATION,
    PathScores,
    Scores,
    with_bound,
)
from pipistrelle.experiments.results.writing import calibration_of
from pipistrelle.experiments.runs.heard_world import HeardWorld, drive_of
from pipistrelle.experiments.runs.trial import run_trial
from pipistrelle.experiments.runs.validate_filters import failure_text, first_belief
from pipistrelle.experiments.studies.plan import Plan, PlannedCase, cases_of
from pipistrelle.settings import RADIUS_KEY

if TYPE_CHECKING:
    import polars as pl

ONLINE = ("position_rmse_m", "heading_rmse_rad", "nees_mean", "nees_max")
"""Scores that a table also has for the path as it was believed at its time, if it was revised."""

NEES_OF_DRAWN_START = (3.0, 6.0)
"""Mean and variance of a consistent filter's NEES: chi-square of three numbers."""
STEPS = ("position_error_m", "heading_error_rad", "nees", "nees_expected", "nees_variance")
"""Columns for each frame: errors, NEES, and mean and variance of a consistent filter's NEES."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TrialRecord:
    """What a study keeps of one trial."""

    case: PlannedCase
    beamwidth_deg: float | None
    """Half-power width of the vehicle's call; None for passive."""
    error: str | None = None
    """The traceback and, last, what it says in a line, if it failed; then there are neither scores
    nor rows of the other tables."""
    scores: Scores | None = None
    online: PathScores | None = None
    calibration: Mapping[str, float] = field(default_factory=dict)
    """Scores of the path as it was believed at its time, where the filter revises it."""
    landmarks_full_mean: float | None = None
    """Mean over the particles, where the filter has some."""
    clutter_per_frame: float | None = None
    """Mean number of detections without a label."""
    wall_s: float = 0.0
    cpu_s: float = 0.0
    steps: Float[np.ndarray, "k 5"]
    """Position error, heading error and NEES at each frame; of a consistent filter's NEES the mean
    and the variance [m, rad, 1, 1, 1]."""
    landmark: Int[np.ndarray, " n"]
    """Labels of the landmarks on the map."""
    full: Bool[np.ndarray, " n"]
    """Whether each is fully initialised."""
    landmark_error: Float[np.ndarray, " n"]
    """Distance from the true position [m]."""


def run_world(plan: Plan, iteration: int) -> tuple[TrialRecord, ...]:
    """Draw a world, listen once for all beamwidths, and try every case of a plan in it.

    A trial that raises an exception, and every trial of a world that does, is a failed record.

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

    >>> grid = {"filter.gate": (0.9, 1.0), "emitter.radius": (0.0025, 0.025)}
    >>> ways = {"strategies": ("fused",), "filters": ("ekf",)}
    >>> plan = Plan(name="four", iterations=1, config=Config(), grid=grid, **ways)
    >>> [len(cases) for cases in heard_together(plan)]
    [4]
    """
    together: dict[str, list[PlannedCase]] = {}
    for case in cases_of(plan):
        together.setdefault(heard_settings(case.config), []).append(case)
    return tuple(map(tuple, together.values()))


def failed_records(plan: Plan, error: str) -> tuple[TrialRecord, ...]:
    """Return a failed record for every case of a world that could not be tried."""
    return tuple(_failed(case, error) for case in cases_of(plan))


def world_tables(
    plan: Plan, iteration: int, records: Sequence[TrialRecord]
) -> "dict[str, pl.DataFrame]":
    """Lay out a world's tables, by the names of `world_schemas`."""
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
    """Return the columns of each table and their polars types."""
    import polars as pl

    world = {"iteration": pl.Int32, "case": pl.Int16}
    grid = {
        name: pl.Float64 if isinstance(_cell(values[0]), (int, float)) else pl.String
        for name, values in plan.grid.items()
    }
    # Worlds of a study that was begun before have no such columns, and go on being read.
    known = all(case.config.association.method == KNOWN for case in cases_of(plan))
    left = {"nis_mean", *(OF_ASSOCIATION if known else ())}
    kept = (field.name for field in fields(Scores) if field.name not in left)
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
            **dict.fromkeys(_calibration_columns(plan), pl.Float64),
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


def _calibration_columns(plan: Plan) -> tuple[str, ...]:
    """Name the columns of what the filters of a plan estimate of the vehicle itself."""
    asked = {name for case in cases_of(plan) for name in case.config.filter.calibrate}
    return tuple(column for name in numbers_of(asked) for column in (name, f"{name}_std"))


def heard_settings(config: Config) -> str:
    """Return as text all settings on which a world and its recording depend."""
    settings = config.model_dump(mode="json", exclude={*SECTIONS, "bag"})
    section, radius = RADIUS_KEY
    del settings[section][radius]
    settings["assumed"] = config.assumed_sound_speed  # the rest is the filters' alone
    return json.dumps(settings)


def _run_cases(cases: Sequence[PlannedCase], iteration: int, world: World) -> list[TrialRecord]:
    """Draw and hear a world for cases that share it, and try each."""
    config = cases[0].config
    radii = sorted({case.config.emitter.radius for case in cases})
    try:
        scenario = world_of(config, iteration, world)
        labels = all(case.config.association.method == KNOWN for case in cases)
        heard = listen(scenario, config, radii, iteration=iteration, labels=labels)
    except Exception as failure:
        error = failure_text(failure)
        return [_failed(case, error) for case in cases]
    shared = HeardWorld(scenario, config, dict(zip(radii, heard, strict=True)))
    return [_try_case(case, shared, iteration) for case in cases]


def _consistent(case: PlannedCase, shared: HeardWorld) -> Float[np.ndarray, "k 2"]:
    """Return mean and variance of a consistent filter's NEES at each frame."""
    config, settings = case.config, case.config.filter
    frames = slice(None, None, config.scenario.steps_per_frame)
    path = shared.scenario.path[frames]
    if settings.first_pose == "drawn":
        return np.tile(np.array(NEES_OF_DRAWN_START, np.float32), (len(path) - 1, 1))
    bound = shared.stated_bound(config, case.strategy)[frames]
    start_covariance = np.diag(np.square(settings.initial_pose_std))
    expected = nees_of_exact_start(bound, path, start_covariance)
    return np.column_stack(expected)[1:].astype(np.float32)


def _try_case(case: PlannedCase, shared: HeardWorld, iteration: int) -> TrialRecord:
    """Run a trial; an error becomes a failed record."""
    try:
        scenario = shared.scenario
        drive, scans = (
            drive_of(scenario, case.config, iteration),
            shared.scans(case.config, case.strategy),
        )
        heard = shared.beams[case.config.emitter.radius]
        causes = shared.causes(case.config, case.strategy)
        began = kernel_clock.cpu_s()
        result = run_trial(
            replace(case, iteration=iteration), drive, scans, case.config, causes=causes
        )
        cpu_s = kernel_clock.cpu_s() - began
        estimate = heaviest(result.mapped or result.track.landmarks)
        full = result.track.full
        frames = _frame_errors(result.track, scenario, case.config)
        return TrialRecord(
            case=case,
            beamwidth_deg=_beamwidth_deg(case),
            scores=with_bound(result.scores, shared.bound(case.config, case.strategy)),
            online=result.online,
            calibration=calibration_of(result.track),
            landmarks_full_mean=float(result.scores.landmarks_full if full is None else full),
            clutter_per_frame=sum(h.clutter for h in heard) / len(heard) if heard else None,
            wall_s=result.wall_s,
            cpu_s=cpu_s,
            steps=np.column_stack([frames, _consistent(case, shared)]),
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
    """Return the half-power beamwidth of the vehicle's call [deg]; None for passive."""
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
        **record.calibration,
    }
    return {column: row.get(column) for column in columns}


def _cell(value: Any) -> Any:
    """Return a grid's value as a table holds it: a number, or text."""
    return value if value is None or isinstance(value, (int, float, str)) else json.dumps(value)
