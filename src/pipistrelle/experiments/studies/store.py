"""A study's folder: one file per world and table, whole or not there.

Results are written where they were computed, under a name of their own, and renamed when all of
a world's tables are whole; the table of trials goes last and means that the world is done. So a
study can be killed anywhere, continued, and written to by many processes at once.
"""

import contextlib
import io
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from tempfile import TemporaryFile
from typing import TYPE_CHECKING, NamedTuple
from uuid import uuid4

from pipistrelle import __version__
from pipistrelle.config import InputError
from pipistrelle.experiments.results.folder import put_in_place, write_down, write_whole
from pipistrelle.experiments.studies.plan import Plan
from pipistrelle.experiments.studies.plan_file import changed_settings, plan_text, read_plan
from pipistrelle.experiments.studies.world import TrialRecord, world_schemas, world_tables
from pipistrelle.settings import to_toml

if TYPE_CHECKING:
    import polars as pl

TABLES = ("steps", "landmarks", "trials")
"""In the order in which a world's are put in place."""
README = """\
# A study: {name}

`pipistrelle study ... -o` this folder, with the same plan, goes on where it stopped;
`pipistrelle report` on it draws the figures. Written by Pipistrelle {version}. SI units and
radians; what ends in _deg is in degrees.

| file | what it holds |
|---|---|
| plan.toml | what is tried: every setting, and the grid of those that vary |
| config.toml | the settings alone |
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


class EndedTrial(NamedTuple):
    """How a trial ended, as a worker reports it.

    Attributes
    ----------
    strategy : "active", "fused" or "passive"
    error : str or None
        What is recorded of a trial that failed.
    """

    strategy: str
    error: str | None


@dataclass(frozen=True, slots=True, kw_only=True)
class StoredStudy:
    """A study as far as it is done: its plan, and its tables, not yet read."""

    plan: Plan
    trials: "pl.LazyFrame"
    steps: "pl.LazyFrame"
    landmarks: "pl.LazyFrame"


def open_store(folder: Path, plan: Plan) -> None:
    """Make a study's folder, or accept one of the same plan.

    Parameters
    ----------
    folder : Path
    plan : Plan
        With more iterations than the folder's it goes on beyond them.

    Raises
    ------
    InputError
        Where the folder holds another plan or something else, or cannot be written.

    Examples
    --------
    >>> import tempfile
    >>> from pipistrelle.experiments.studies.plan_file import find_plan
    >>> with tempfile.TemporaryDirectory() as name:
    ...     open_store(Path(name), read_plan(find_plan("paper")))
    ...     sorted(path.name for path in Path(name).iterdir())
    ['README.md', 'config.toml', 'landmarks', 'plan.toml', 'steps', 'trials']
    """
    kept = folder / "plan.toml"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        there = read_plan(kept) if kept.exists() else None
        strange = [p for p in folder.iterdir() if p.suffix != ".partial"] if there is None else []
        if strange:
            raise InputError(
                f"{folder}: holds {strange[0].name} and no plan.toml, so it is no study's folder; "
                "name another with -o DIR"
            )
        if there is not None and (found := changed_settings(there, plan)):
            told = "".join(f"\n  {line}" for line in found)
            raise InputError(
                f"{kept}: is the plan of another study; name a new folder with -o DIR{told}"
            )
        if there is None or there.iterations < plan.iterations:
            _put(kept, plan_text(plan))
        readme = README.format(name=plan.name, version=__version__)
        for name, text in (("config.toml", to_toml(plan.config)), ("README.md", readme)):
            if not (folder / name).exists():
                _put(folder / name, text)
        for table in TABLES:
            (folder / table).mkdir(exist_ok=True)
            TemporaryFile(dir=folder / table).close()
        for left in folder.glob("*.partial"):
            left.unlink(missing_ok=True)
    except OSError as error:
        raise _unusable(folder, error) from error


def done_worlds(folder: Path) -> set[int]:
    """Return the numbers of the worlds that are done.

    Parameters
    ----------
    folder : Path

    Returns
    -------
    set of int
    """
    names = (
        path.stem.partition("_")[2] for path in (folder / "trials").glob("iteration_*.parquet")
    )
    return {int(name) for name in names if name.isdecimal()}


def read_ended_trials(folder: Path, iteration: int) -> list[EndedTrial]:
    """Tell how the trials of a world that is done ended.

    Parameters
    ----------
    folder : Path
    iteration : int

    Returns
    -------
    list of EndedTrial

    Raises
    ------
    InputError
        Where the file cannot be read.
    """
    import polars as pl

    path = world_file(folder, "trials", iteration)
    try:
        table = pl.read_parquet(path, columns=list(EndedTrial._fields))
    except (OSError, pl.exceptions.PolarsError) as error:
        raise InputError(
            f"{path}: could not be read ({error}); remove it and run the study again to have this "
            "world anew"
        ) from error
    return [EndedTrial(*row) for row in table.rows()]


def world_file(folder: Path, table: str, iteration: int) -> Path:
    """Return the place of one world's table.

    Parameters
    ----------
    folder : Path
    table : one of `TABLES`
    iteration : int

    Returns
    -------
    Path

    Examples
    --------
    >>> world_file(Path("study"), "trials", 7).as_posix()
    'study/trials/iteration_00007.parquet'
    """
    return folder / table / f"iteration_{iteration:05d}.parquet"


def write_world(folder: Path, plan: Plan, iteration: int, records: Sequence[TrialRecord]) -> None:
    """Write a world's tables, in place of earlier ones, and sweep up after killed writers.

    Parameters
    ----------
    folder : Path
        As `open_store` made it.
    plan : Plan
    iteration : int
    records : sequence of TrialRecord
        One per case.

    Raises
    ------
    InputError
        Where they cannot be written; earlier ones are then as they were.
    """
    tables = world_tables(plan, iteration, records)
    partial = f".{uuid4().hex[:8]}.partial"
    paths = [world_file(folder, name, iteration) for name in TABLES]
    try:
        for path in paths:
            buffer = io.BytesIO()
            tables[path.parent.name].write_parquet(buffer)
            write_down(path.with_name(path.name + partial), buffer.getvalue())
        for path in paths:
            put_in_place(path.with_name(path.name + partial), path)
    except OSError as error:
        raise _unusable(folder, error) from error
    finally:
        sweep(folder, [iteration] if paths[-1].exists() else [], partial)


def sweep(folder: Path, iterations: Iterable[int], partial: str = "") -> None:
    """Remove what killed writers left of worlds that are done.

    Parameters
    ----------
    folder : Path
    iterations : iterable of int
    partial : str
        Remove the files that end so, too.
    """
    stems = tuple(f"iteration_{iteration:05d}." for iteration in iterations)
    for path in chain.from_iterable((folder / name).glob("*.partial") for name in TABLES):
        if (partial and path.name.endswith(partial)) or path.name.startswith(stems):
            with contextlib.suppress(OSError):
                path.unlink(missing_ok=True)


def load_study(folder: Path) -> StoredStudy:
    """Open what a study has done so far; worlds that are not done are left out.

    Parameters
    ----------
    folder : Path

    Returns
    -------
    StoredStudy

    Raises
    ------
    InputError
        Where the folder holds no plan.
    """
    import polars as pl

    if not (folder / "plan.toml").is_file():
        raise InputError(f"{folder}: holds no plan.toml; expected the folder of a study")
    plan = read_plan(folder / "plan.toml")
    worlds = sorted(done_worlds(folder))
    frames = {}
    for name in TABLES:
        paths = [world_file(folder, name, world) for world in worlds]
        # The files know their columns, even where an estimator from outside is not at hand.
        frames[name] = (
            pl.scan_parquet(paths) if paths else pl.LazyFrame(schema=world_schemas(plan)[name])
        )
    return StoredStudy(plan=plan, **frames)


def _put(path: Path, text: str) -> None:
    """Write a file that many processes may write at once."""
    write_whole(path, text.encode(), writer=f".{uuid4().hex[:8]}")


def _unusable(folder: Path, error: OSError) -> InputError:
    """Say that a folder cannot be written, and that nothing is lost."""
    return InputError(
        f"{error.filename or folder}: could not be written ({error.strerror}); worlds that are "
        "done are kept: mend this, or copy the folder elsewhere, and run the same command again"
    )
