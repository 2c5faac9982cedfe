"""A world of a study: drawn, its sound simulated once, every case tried, and its tables stored.

Cases share the drawing and the simulated sound if they differ only in settings of estimators and in
the vehicle's piston.

Each table is written under a temporary name, and renamed once all tables of the world are complete.
The table of trials is last and marks the world as finished. It contains the SHA-256 of all three,
which reveals files that are damaged, truncated or of another world.
"""

import contextlib
import io
import json
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from hashlib import sha256
from itertools import chain, groupby, product
from math import degrees
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Bool, Float, Int

from pipistrelle import jit
from pipistrelle.acoustics.emitter import beamwidth_of
from pipistrelle.config import Config, InputError
from pipistrelle.estimation.beliefs import KNOWN, Track, revises_path
from pipistrelle.estimation.catalogue import SECTIONS
from pipistrelle.estimation.smoother.preintegration import numbers_of
from pipistrelle.evaluation.accuracy import heaviest, landmark_error, pose_error, position_error
from pipistrelle.evaluation.bound import nees_of_exact_start
from pipistrelle.evaluation.consistency import track_nees
from pipistrelle.experiments.hearing.listening import listen
from pipistrelle.experiments.hearing.scenario import Scenario, World, standing_landmarks, world_of
from pipistrelle.experiments.hearing.trajectories import true_motion
from pipistrelle.experiments.results.scores import OF_ASSOCIATION, Scores, with_bound
from pipistrelle.experiments.results.writing import calibration_of
from pipistrelle.experiments.runs.heard_world import HeardWorld, drive_of
from pipistrelle.experiments.runs.trial import run_trial
from pipistrelle.experiments.runs.validate import failure_text, first_belief
from pipistrelle.experiments.studies.plan import Plan, PlannedCase, cases_of, kept_plan
from pipistrelle.files import (
    check_ordinary,
    held,
    partial_of,
    put_in_place,
    read_file,
    whole_name,
    write_down,
)
from pipistrelle.settings import RADIUS_KEY, RENAMED

if TYPE_CHECKING:
    import polars as pl

ONLINE = ("position_rmse_m", "heading_rmse_rad", "nees_mean", "nees_max")
"""Scores that are also stored for the online path, if the filter revises its path."""

STEPS = ("position_error_m", "heading_error_rad", "nees", "nees_expected", "nees_variance")
"""Columns for each frame: errors, NEES, and mean and variance of a consistent filter's NEES."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TrialRecord:
    """Results of a trial as a study stores them: scores, errors at each frame, landmarks."""

    case: PlannedCase
    row: Mapping[str, Any]
    """Columns of the table of trials besides those of the case. A failed trial has only its
    ``error``, a traceback with the message as its last line."""
    steps: Float[np.ndarray, "k 5"] = field(default_factory=lambda: np.empty((0, len(STEPS))))
    """Columns `STEPS` at each frame."""
    landmark: Int[np.ndarray, " n"] = field(default_factory=lambda: np.empty(0, int))
    full: Bool[np.ndarray, " n"] = field(default_factory=lambda: np.empty(0, bool))
    """Whether each landmark of the map is fully initialised."""
    landmark_error: Float[np.ndarray, " n"] = field(default_factory=lambda: np.empty(0))
    """Distance of each from the true position [m]."""


def run_world(plan: Plan, iteration: int) -> tuple[TrialRecord, ...]:
    """Generate a world, simulate its sound once for all beamwidths, and run all cases of a plan.

    A trial that raises an exception becomes a failed record, as do all trials of a world that does.
    """
    records = [
        record
        for cases in heard_together(plan)
        for record in _run_cases(cases, iteration, plan.world(cases[0].config))
    ]
    return tuple(sorted(records, key=lambda record: record.case.number))


def heard_together(plan: Plan) -> tuple[tuple[PlannedCase, ...], ...]:
    """Group the cases of a plan that can use the same random world and simulated sound."""
    together: dict[str, list[PlannedCase]] = {}
    for case in cases_of(plan):
        together.setdefault(heard_settings(case.config), []).append(case)
    return tuple(map(tuple, together.values()))


def failed_records(plan: Plan, error: str) -> tuple[TrialRecord, ...]:
    """Return a failed record for every case of a plan in a world that could not be computed."""
    return tuple(TrialRecord(case=case, row={"error": error}) for case in cases_of(plan))


def world_tables(
    plan: Plan, iteration: int, records: Sequence[TrialRecord]
) -> "dict[str, pl.DataFrame]":
    """Return the tables of a world (trials, steps and landmarks), by name."""
    import polars as pl

    schemas = world_schemas(plan)
    rows = [_row(iteration, record) for record in records]
    rows = [{column: row.get(column) for column in schemas["trials"]} for row in rows]

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
    """Return the Polars type of each column of a study's tables, by table and column."""
    import polars as pl

    world = {"iteration": pl.Int32, "case": pl.Int16}
    grid = {
        name: pl.Float64 if isinstance(cell_of(values[0]), (int, float)) else pl.String
        for name, values in plan.grid.items()
    }
    configs = [case.config for case in cases_of(plan)]
    # Older studies lack these columns and can still be read.
    known = all(config.association.method == KNOWN for config in configs)
    left = {"nis_mean", "map_rmse_shared_m", *(OF_ASSOCIATION if known else ())}
    kept = (field.name for field in fields(Scores) if field.name not in left)
    scores = dict.fromkeys(kept, pl.Float64)
    motion = true_motion(plan.config.motion)
    beliefs = (first_belief(name, motion, plan.config) for name in plan.filters)
    online = any(revises_path(belief) for belief in beliefs)
    estimated = numbers_of({name for config in configs for name in config.filter.calibrate})
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
            **dict.fromkeys((f"online_{score}" for score in ONLINE if online), pl.Float64),
            **dict.fromkeys((c for n in estimated for c in (n, f"{n}_std")), pl.Float64),
        },
        "steps": {**world, "frame": pl.UInt16, **dict.fromkeys(STEPS, pl.Float32)},
        "landmarks": {**world, "landmark": pl.Int16, "full": pl.Boolean, "error_m": pl.Float32},
    }


def heard_settings(config: Config) -> str:
    """Return as JSON all settings that affect a world and its sound, except the beam's radius."""
    settings = config.model_dump(mode="json", exclude={*SECTIONS, "bag"})
    section, radius = RADIUS_KEY
    del settings[section][radius]
    settings["assumed"] = config.assumed_sound_speed  # the others affect estimators only
    return json.dumps(settings)


def _run_cases(cases: Sequence[PlannedCase], iteration: int, world: World) -> list[TrialRecord]:
    """Generate and simulate a world once for several cases, and run each case."""
    config = cases[0].config
    radii = sorted({case.config.emitter.radius for case in cases})
    try:
        scenario = world_of(config, iteration, world)
        labels = all(case.config.association.method == KNOWN for case in cases)
        heard = listen(scenario, config, radii, iteration=iteration, labels=labels)
    except Exception as failure:
        error = {"error": failure_text(failure)}
        return [TrialRecord(case=case, row=error) for case in cases]
    shared = HeardWorld(scenario, config, dict(zip(radii, heard, strict=True)))
    return [_try_case(case, shared, iteration) for case in cases]


def _try_case(case: PlannedCase, shared: HeardWorld, iteration: int) -> TrialRecord:
    """Run a case in a simulated world; an exception becomes a failed record."""
    config, strategy, scenario = case.config, case.strategy, shared.scenario
    try:
        drive, scans = drive_of(scenario, config, iteration), shared.scans(config, strategy)
        heard, causes = shared.beams[config.emitter.radius], shared.causes(config, strategy)
        began = jit.cpu_s()
        result = run_trial(replace(case, iteration=iteration), drive, scans, config, causes=causes)
        cpu_s = jit.cpu_s() - began
        estimate = heaviest(result.mapped or result.track.landmarks)
        scores, full = result.scores, result.track.full
        clutter = sum(frame.clutter for frame in heard) / len(heard) if heard else None
        row = {
            **asdict(with_bound(scores, shared.bound(config, strategy))),
            "landmarks_full_mean": float(scores.landmarks_full if full is None else full),
            "clutter_per_frame": clutter,
            "wall_s": result.wall_s,
            "cpu_s": cpu_s,
            **{f"online_{name}": result.online and result.online[name] for name in ONLINE},
            **calibration_of(result.track),
        }
        errors = _frame_errors(result.track, scenario, config)
        return TrialRecord(
            case=case,
            row=row,
            steps=np.column_stack([errors, _consistent(case, shared)]),
            landmark=estimate.landmark,
            full=estimate.full,
            landmark_error=landmark_error(estimate, *standing_landmarks(scenario)),
        )
    except Exception as failure:
        return TrialRecord(case=case, row={"error": failure_text(failure)})


def _consistent(case: PlannedCase, shared: HeardWorld) -> Float[np.ndarray, "k 2"]:
    """Return mean and variance of the NEES that a consistent filter has at each frame."""
    config, settings = case.config, case.config.filter
    frames = slice(None, None, config.scenario.steps_per_frame)
    path = shared.scenario.path[frames]
    if settings.first_pose == "drawn":  # chi-square with three degrees of freedom
        return np.tile(np.array((3.0, 6.0), np.float32), (len(path) - 1, 1))
    bound = shared.stated_bound(config, case.strategy)[frames]
    start_covariance = np.diag(np.square(settings.initial_pose_std))
    expected = nees_of_exact_start(bound, path, start_covariance)
    return np.column_stack(expected)[1:].astype(np.float32)


@np.errstate(over="ignore", invalid="ignore")
def _frame_errors(track: Track, scenario: Scenario, config: Config) -> Float[np.ndarray, "k 3"]:
    """Return a track's position error [m], heading error [rad] and NEES at each frame."""
    every = config.scenario.steps_per_frame
    frames = slice(every, None, every)
    epsilon = track_nees(track.pose, scenario.path)[frames]
    mean, true = track.pose.mean[frames], scenario.path[frames]
    columns = (position_error(mean, true), pose_error(mean, true)[:, 2], epsilon)
    return np.column_stack(columns).astype(np.float32)


def _row(iteration: int, record: TrialRecord) -> dict[str, Any]:
    """Return a trial's row for the table of trials, as values by column."""
    case = record.case
    return {
        "iteration": iteration,
        "case": case.number,
        "strategy": case.strategy,
        "filter": case.filter,
        **{name: cell_of(value) for name, value in case.values.items()},
        "beamwidth_deg": None if case.strategy == "passive" else degrees(beamwidth_of(case.config)),
        "seed": case.config.seed,
        "status": "failed" if record.row.get("error") else "done",
        **{"wall_s": 0.0, "cpu_s": 0.0},
        **record.row,
    }


def cell_of(value: Any) -> Any:
    """Convert a varied value to a table cell: a number, or text."""
    return value if value is None or isinstance(value, (int, float, str)) else json.dumps(value)


TABLES = ("steps", "landmarks", "trials")
"""Names of the tables, in the order of writing."""
_SUM = "pipistrelle.sha256.{}"
"""Key of a table's SHA-256 in the metadata of the trials' file."""
_NO_SUM = "-" * len(sha256().hexdigest())
"""Placeholder for the SHA-256 of the trials' file while it is computed."""
_WORLD, _PLAN = "pipistrelle.iteration", "pipistrelle.plan"
"""Metadata keys of the world's number and the plan's SHA-256."""


Outcome = tuple[str, str | None]
"""Strategy and error of a trial, as returned by a worker."""


def world_file(folder: Path, table: str, iteration: int) -> Path:
    """Return the path of a world's table, such as ``trials/iteration_00007.parquet``."""
    return folder / table / f"iteration_{iteration:05d}.parquet"


def done_worlds(folder: Path) -> set[int]:
    """Return the set of finished worlds' numbers in a study's folder."""
    files = (folder / "trials").glob("iteration_*.parquet")
    names = (path.stem.partition("_")[2] for path in files)
    return {int(name) for name in names if name.isdecimal()}


def write_world(folder: Path, plan: Plan, iteration: int, records: Sequence[TrialRecord]) -> None:
    """Write a world's tables over earlier ones, and delete the leftovers of killed processes.

    If writing fails, the earlier tables are unchanged. Raises if another study has taken the place
    of the folder.
    """
    files = with_sums(world_tables(plan, iteration, records), plan, iteration)
    try:
        with held(folder) as place:
            if _plan_sum(kept_plan(place)) != _plan_sum(plan):
                raise InputError(
                    f"{folder}: found the folder of another study, which took the place of this "
                    "one meanwhile; nothing in it is replaced; move it away and run the study again"
                )
            _write_held(place, iteration, files)
    except OSError as error:
        raise unusable(folder, error) from error


def _write_held(folder: Path, iteration: int, files: dict[str, bytes]) -> None:
    """Write a world's files under temporary names and rename them, the trials last."""
    paths = [world_file(folder, name, iteration) for name in TABLES]
    partials = {path: partial_of(path) for path in paths}
    try:
        for path, partial in partials.items():
            write_down(partial, files[path.parent.name])
        for path in paths[:-1]:  # without its trials, a world is unfinished
            with contextlib.suppress(FileNotFoundError):
                if read_file(path) != files[path.parent.name]:
                    paths[-1].unlink(missing_ok=True)
        for path, partial in partials.items():
            put_in_place(partial, path)
    finally:
        for partial in partials.values():
            with contextlib.suppress(OSError):
                partial.unlink(missing_ok=True)
        sweep(folder, [iteration] if paths[-1].exists() else [])


def refuse_strange(folder: Path, plan: Plan, iterations: Iterable[int]) -> None:
    """Raise if results of unfinished worlds would replace files that are no study's tables."""
    schemas = world_schemas(plan)
    for iteration, name in product(iterations, TABLES[:-1]):
        path = world_file(folder, name, iteration)
        if os.path.lexists(path) and schemas[name] != _columns(path):
            why = "is no table of this study as Pipistrelle wrote it, so it is not replaced"
            raise InputError(f"{path}: {why}; move it away, or name another folder with -o DIR")


def _columns(path: Path) -> "Mapping[str, pl.DataType]":
    """Return the columns of a table's file with their types; none of a link, or if unreadable."""
    import polars as pl

    with contextlib.suppress(OSError, pl.exceptions.PolarsError):
        if not path.is_symlink():
            return pl.read_parquet_schema(io.BytesIO(read_file(path)))
    return {}


def with_sums(tables: "Mapping[str, pl.DataFrame]", plan: Plan, iteration: int) -> dict[str, bytes]:
    """Return a world's tables as Parquet files; metadata of ``trials`` has the SHA-256 of each."""
    files = {name: _parquet(tables[name]) for name in TABLES[:-1]}
    metadata = {_SUM.format(name): sha256(file).hexdigest() for name, file in files.items()}
    metadata |= {_SUM.format("trials"): _NO_SUM, _WORLD: str(iteration), _PLAN: _plan_sum(plan)}
    trials = _parquet(tables["trials"], metadata)
    own = sha256(trials).hexdigest()
    return files | {"trials": trials.replace(_NO_SUM.encode(), own.encode())}


def _parquet(table: "pl.DataFrame", metadata: dict[str, str] | None = None) -> bytes:
    """Return a table as the bytes of a Parquet file with this metadata."""
    buffer = io.BytesIO()
    table.write_parquet(buffer, metadata=metadata)
    return buffer.getvalue()


def sweep(folder: Path, iterations: Iterable[int]) -> None:
    """Delete the temporary files of finished worlds that killed processes left behind."""
    names = {world_file(folder, "", iteration).name for iteration in iterations}
    for path in chain.from_iterable((folder / name).glob("*.partial") for name in TABLES):
        if whole_name(path.name) in names:
            with contextlib.suppress(OSError):
                path.unlink(missing_ok=True)


def _plan_sum(plan: Plan) -> str:
    """Return the SHA-256 of a plan's settings that affect its worlds, without default values.

    Settings have their first names (`RENAMED`), so that the sums of older studies remain valid.
    """
    names = {new: old for old, new in RENAMED.items()}
    names |= {new.split(".")[1]: old.split(".")[1] for old, new in RENAMED.items()}
    config = plan.config.model_dump(mode="json", exclude_defaults=True)
    medium = config.pop(plan.config.scenario.medium, {})
    medium["speed_of_sound"] = plan.config.medium.sound_speed  # also if it is derived
    own = [{name: dict(settings) for name, settings in plan.own.items()}] if plan.own else []
    parts = [plan.strategies, plan.filters, config, medium, dict(plan.grid), *own]
    hook = lambda pairs: {names.get(name, name): value for name, value in pairs}  # noqa: E731
    parts = json.loads(json.dumps(parts), object_pairs_hook=hook)
    return sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()


def read_outcomes(folder: Path, plan: Plan, iteration: int) -> list[Outcome]:
    """Return strategy and error of a finished world's trials; raise if its files were changed."""
    import polars as pl

    file = check_world(folder, plan, iteration)
    try:
        return pl.read_parquet(file, columns=["strategy", "error"]).rows()
    except pl.exceptions.PolarsError:
        flaw = "has not the columns of this study"
        raise damaged(folder, "trials", iteration, flaw) from None


def check_world(folder: Path, plan: Plan, iteration: int) -> bytes:
    """Compare the files of a finished world with their SHA-256; return the file of trials.

    Raises InputError for a file that is missing, damaged or from another plan.
    """
    files: dict[str, bytes] = {}
    for name in reversed(TABLES):
        path = world_file(folder, name, iteration)
        try:
            files[name] = read_file(path)
            flaw = _flaw(name, files, plan, iteration)
        except FileNotFoundError:
            flaw = "is missing"
        except OSError as error:
            flaw = f"could not be read ({error.strerror})"
        if flaw:
            raise damaged(folder, name, iteration, flaw)
    return files["trials"]


def damaged(folder: Path, table: str, iteration: int, flaw: str) -> InputError:
    """Return the InputError for a damaged file of a world, with the way to compute it again."""
    return InputError(
        f"{world_file(folder, table, iteration)}: {flaw}; remove "
        f"{world_file(Path(), 'trials', iteration)} from {folder} and run the study again: its "
        "world is run again"
    )


def _flaw(name: str, found: dict[str, bytes], plan: Plan, iteration: int) -> str | None:
    """Return the fault of a world's file according to its stored SHA-256; None if intact."""
    import polars as pl

    try:
        metadata = pl.read_parquet_metadata(io.BytesIO(found["trials"]))
    except (OSError, pl.exceptions.PolarsError):
        return "could not be read: it is no whole Parquet file"
    if _WORLD not in metadata:
        return "bears no sums: it is of an earlier version, or not Pipistrelle's"
    if metadata[_WORLD] != str(iteration):
        return f"is the file of world {metadata[_WORLD]}"
    if name == "trials" and _PLAN in metadata and metadata[_PLAN] != _plan_sum(plan):
        return "was computed by another plan than the plan.toml that is here now"
    expected, file = metadata.get(_SUM.format(name), _NO_SUM), found[name]
    if name == "trials":
        file = file.replace(expected.encode(), _NO_SUM.encode())
    return None if sha256(file).hexdigest() == expected else "is not as it was written"


def scan_tables(folder: Path, table: str, worlds: Sequence[int]) -> "pl.LazyFrame":
    """Open a study's table as a lazy Polars frame over the files of several worlds."""
    import polars as pl

    paths = [world_file(folder, table, world).absolute() for world in worlds]
    for path in paths:
        check_ordinary(path)
    try:
        os.fspath(folder.absolute()).encode()
        sources: dict[Path, Any] = dict(zip(paths, paths, strict=True))
    except UnicodeEncodeError:  # Polars needs paths that are valid text
        sources = {path: read_file(path) for path in paths}
    # Worlds of older versions have columns with the old names of settings.
    parts = groupby(paths, lambda path: RENAMED.keys().isdisjoint(_columns(path)))
    frames = (pl.scan_parquet([sources[path] for path in part], glob=False) for _, part in parts)
    return pl.concat([frame.rename(RENAMED, strict=False) for frame in frames])


def unusable(folder: Path, error: OSError) -> InputError:
    """Return the error for a study's folder that cannot be written, with the fix."""
    return InputError(
        f"{error.filename or folder}: could not be written ({error.strerror}); worlds that are "
        "done are kept: mend this, or copy the folder elsewhere, and run the same command again"
    )
