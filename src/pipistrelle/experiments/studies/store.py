"""A study's folder: its plan, and per world and table a file that is complete or missing.

A study can therefore be killed at any time, continued, and written by many processes at once
(`pipistrelle.experiments.studies.world`).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryFile
from typing import TYPE_CHECKING

from pipistrelle.config import InputError
from pipistrelle.experiments.hearing.world_folder import kept_world
from pipistrelle.experiments.results.scores import OF_ASSOCIATION
from pipistrelle.experiments.studies.plan import Plan, changed_settings, plan_text, read_plan
from pipistrelle.experiments.studies.world import (
    TABLES,
    check_world,
    done_worlds,
    scan_tables,
    unusable,
    world_schemas,
)
from pipistrelle.files import read_file, whole_name, write_whole
from pipistrelle.settings import to_toml
from pipistrelle.version import find_version

if TYPE_CHECKING:
    import polars as pl

_FILES = ("plan.toml", "config.toml", "README.md")
README = """\
# A study: {name}

`pipistrelle study ... -o` this folder, with the same plan, goes on where it stopped;
`pipistrelle report` on it draws the figures. Written by Pipistrelle {version}. SI units and
radians; what ends in _deg is in degrees.

| file | what it holds |
|---|---|
| plan.toml | what is tried: every setting, and the grid of those that vary |
| config.toml | the settings alone |
| worlds/ | worlds of one's own that the plan names |
| trials/ | one row per case: the scores, or the error of a trial that failed |
| steps/ | errors and NEES at each frame (frame 1 is the first call; the start has no row) |
| landmarks/ | the final map: is a landmark fully initialised, and how far off is it |

In each folder one Parquet file per world (iteration). A world is done when its file of trials is
there. A case is one combination of the grid, a strategy and a filter, numbered in plan order; a
passive case has no radius, for the vehicle's beam is not its business. Null: nothing to score.
Infinite or NaN: the filter diverged. A partial landmark stands where its heaviest hypothesis is.
Two runs of one plan differ in wall_s and cpu_s alone.

    import polars
    polars.read_parquet("trials/*.parquet")
"""


@dataclass(frozen=True, slots=True, kw_only=True)
class StoredStudy:
    """The plan of a study, and lazy tables of its finished worlds."""

    plan: Plan
    trials: "pl.LazyFrame"
    steps: "pl.LazyFrame"
    landmarks: "pl.LazyFrame"


def open_store(folder: Path, plan: Plan) -> None:
    """Create a study's folder, or accept the folder of the same plan, also with fewer iterations.

    >>> import tempfile
    >>> from pipistrelle.experiments.studies.plan import find_plan
    >>> with tempfile.TemporaryDirectory() as name:
    ...     open_store(Path(name), read_plan(find_plan("paper")))
    ...     sorted(path.name for path in Path(name).iterdir())
    ['README.md', 'config.toml', 'landmarks', 'plan.toml', 'steps', 'trials']
    """
    kept = folder / "plan.toml"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        # Listed before the plan is read, as other processes that start now write their plan first.
        seen = list(folder.iterdir())
        there = read_plan(kept) if kept.exists() else None
        left = [path for path in seen if whole_name(path.name) in _FILES]
        kept_first = [folder / "worlds"]  # a plan needs its worlds first
        strange = [path.name for path in seen if path not in [*left, *kept_first]]
        _refuse_strange(folder, there, strange)
        if there is not None and (changes := changed_settings(there, plan)):
            differences = "".join(f"\n  {line}" for line in changes)
            raise InputError(
                f"{kept}: is the plan of another study; name a new folder with -o DIR{differences}"
            )
        if there is None or there.iterations < plan.iterations or there.planned < plan.planned:
            _keep_plan(folder, there, plan)
        readme = README.format(name=plan.name, version=find_version())
        config = plan.config
        if config.scenario.world is not None:
            config, _ = kept_world(config, plan.world(config))
        for name, text in (("config.toml", to_toml(config)), ("README.md", readme)):
            if not (folder / name).exists():
                write_whole(folder / name, text.encode())
        for table in TABLES:
            (folder / table).mkdir(exist_ok=True)
            TemporaryFile(dir=folder / table).close()
        for path in left:
            path.unlink(missing_ok=True)
    except OSError as error:
        raise unusable(folder, error) from error


def _keep_plan(folder: Path, there: Plan | None, plan: Plan) -> None:
    """Write a plan into its folder, with the larger of the old and new numbers of worlds."""
    kept = folder / "plan.toml"
    if there is not None:
        if not _is_ours(kept, there):
            if plan.iterations <= there.iterations:
                return
            raise InputError(
                f"{kept}: was changed since Pipistrelle wrote it, so it is not replaced; "
                f"set iterations = {plan.iterations} in it"
            )
        most = max(there.iterations, plan.iterations)
        plan = replace(plan, iterations=most, planned=max(there.planned, plan.planned))
    _keep_worlds(folder, plan)
    write_whole(kept, plan_text(plan).encode())


def _keep_worlds(folder: Path, plan: Plan) -> None:
    """Copy the worlds that a plan names into its folder."""
    for world in plan.worlds.values():
        _, files = kept_world(plan.config, world)
        for name, content in files.items():
            path = folder / name
            if path.exists() and read_file(path) != content:
                raise InputError(
                    f"{path}: is not the world that is asked for; name a new folder with -o DIR"
                )
            path.parent.mkdir(parents=True, exist_ok=True)
            write_whole(path, content)


def _refuse_strange(folder: Path, there: Plan | None, strange: Sequence[str]) -> None:
    """Raise if a folder has content but no plan written by Pipistrelle."""
    if there is None and strange:
        raise InputError(
            f"{folder}: holds {min(strange)} and no plan.toml, so it is no study's folder; "
            "name another with -o DIR"
        )
    if there and not (_is_ours(folder / "plan.toml", there) or (folder / "trials").is_dir()):
        raise InputError(
            f"{folder}: holds a plan.toml that is not Pipistrelle's and no trials, so it is no "
            "study's folder; name another with -o DIR"
        )


def _is_ours(kept: Path, plan: Plan) -> bool:
    """Return whether a plan file is exactly as Pipistrelle writes it."""
    return read_file(kept) == plan_text(plan).encode()


def load_study(folder: Path) -> StoredStudy:
    """Open the plan and the tables of a study's finished worlds."""
    import polars as pl

    if not (folder / "plan.toml").is_file():
        raise InputError(f"{folder}: holds no plan.toml; expected the folder of a study")
    plan = read_plan(folder / "plan.toml")
    worlds = sorted(done_worlds(folder))
    # The files contain their columns, also if an external estimator is not installed.
    frames = {
        name: scan_tables(folder, name, worlds)
        if worlds
        else pl.LazyFrame(schema=world_schemas(plan)[name])
        for name in TABLES
    }
    # Without an association in the plan, the columns of its scores are missing.
    try:
        there = frames["trials"].collect_schema().names()
    except (OSError, pl.exceptions.PolarsError):
        for world in worlds:
            check_world(folder, plan, world)
        raise
    none = [pl.lit(None, pl.Float64).alias(n) for n in OF_ASSOCIATION if n not in there]
    frames["trials"] = frames["trials"].with_columns(none)
    return StoredStudy(plan=plan, **frames)
