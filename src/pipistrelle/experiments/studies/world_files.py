"""One world's tables in a study's folder: written whole, checked by their sums, read.

Results are written where they were computed, under a name of their own, and renamed when all of
a world's tables are whole; the table of trials goes last and means that the world is done. It
bears the sums of all three, so a file that a disk changed, that was cut, or that is of another
world is noticed.
"""

import contextlib
import io
import json
import os
from collections.abc import Iterable, Mapping, Sequence
from hashlib import sha256
from itertools import chain, product
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from pipistrelle.config import InputError
from pipistrelle.experiments.studies.plan import Plan
from pipistrelle.experiments.studies.world import (
    TrialRecord,
    world_schemas,
    world_tables,
)
from pipistrelle.files import (
    check_ordinary,
    partial_of,
    put_in_place,
    read_file,
    whole_name,
    write_down,
)

if TYPE_CHECKING:
    import polars as pl

TABLES = ("steps", "landmarks", "trials")
"""In the order in which a world's are put in place."""
_SUM = "pipistrelle.sha256.{}"
"""Where a table's sum stands among what the file of trials says of itself."""
_NO_SUM = "-" * 64
"""In place of the sum of the file of trials, when that is taken."""
_WORLD, _PLAN = "pipistrelle.iteration", "pipistrelle.plan"
"""Which world it is, and the sum of the plan by which it was computed."""


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
    files = with_sums(world_tables(plan, iteration, records), plan, iteration)
    paths = [world_file(folder, name, iteration) for name in TABLES]
    partials = {path: partial_of(path) for path in paths}
    try:
        for path, partial in partials.items():
            write_down(partial, files[path.parent.name])
        _make_way(folder, iteration, files)
        for path, partial in partials.items():
            put_in_place(partial, path)
    except OSError as error:
        raise unusable(folder, error) from error
    finally:
        for partial in partials.values():
            with contextlib.suppress(OSError):
                partial.unlink(missing_ok=True)
        sweep(folder, [iteration] if paths[-1].exists() else [])


def refuse_strange(folder: Path, plan: Plan, iterations: Iterable[int]) -> None:
    """Refuse to compute worlds in whose tables' place somebody else's files stand.

    What a killed writer left without its trials is whole and ours, known by its columns.

    Parameters
    ----------
    folder : Path
    plan : Plan
    iterations : iterable of int

    Raises
    ------
    InputError
        With the file.
    """
    schemas = world_schemas(plan)
    for iteration, name in product(iterations, TABLES[:-1]):
        path = world_file(folder, name, iteration)
        if os.path.lexists(path) and not _is_table(path, schemas[name]):
            raise InputError(
                f"{path}: is no table of this study as Pipistrelle wrote it, so it is not "
                "replaced; move it away, or name another folder with -o DIR"
            )


def _is_table(path: Path, schema: "Mapping[str, pl.DataType]") -> bool:
    """Whether a file is a whole table of these columns, and no link."""
    import polars as pl

    with contextlib.suppress(OSError, pl.exceptions.PolarsError):
        return not path.is_symlink() and schema == pl.read_parquet_schema(
            io.BytesIO(read_file(path))
        )
    return False


def with_sums(tables: "Mapping[str, pl.DataFrame]", plan: Plan, iteration: int) -> dict[str, bytes]:
    """Make files of a world's tables; that of the trials bears the sums of all, and of the plan.

    Parameters
    ----------
    tables : mapping of DataFrame
        By the names in `TABLES`.
    plan : Plan
    iteration : int

    Returns
    -------
    dict of bytes
    """
    files = {name: _parquet(tables[name]) for name in TABLES[:-1]}
    said = {_SUM.format(name): sha256(file).hexdigest() for name, file in files.items()}
    said |= {_SUM.format("trials"): _NO_SUM, _WORLD: str(iteration), _PLAN: _plan_sum(plan)}
    trials = _parquet(tables["trials"], said)
    own = sha256(trials).hexdigest()
    return files | {"trials": trials.replace(_NO_SUM.encode(), own.encode())}


def _parquet(table: "pl.DataFrame", said: dict[str, str] | None = None) -> bytes:
    """Return a table as a Parquet file, with what it says of itself."""
    buffer = io.BytesIO()
    table.write_parquet(buffer, metadata=said)
    return buffer.getvalue()


def _make_way(folder: Path, iteration: int, files: dict[str, bytes]) -> None:
    """Declare a world not done whose other tables are about to change under its trials."""
    trials = world_file(folder, "trials", iteration)
    for name in TABLES[:-1]:
        with contextlib.suppress(FileNotFoundError):
            if read_file(world_file(folder, name, iteration)) != files[name]:
                trials.unlink(missing_ok=True)


def sweep(folder: Path, iterations: Iterable[int]) -> None:
    """Remove what killed writers left of worlds that are done."""
    names = {world_file(folder, "", iteration).name for iteration in iterations}
    for path in chain.from_iterable((folder / name).glob("*.partial") for name in TABLES):
        if whole_name(path.name) in names:
            with contextlib.suppress(OSError):
                path.unlink(missing_ok=True)


def _plan_sum(plan: Plan) -> str:
    """Sum up what a plan's worlds depend on; a setting that is new has its default in old plans."""
    config = plan.config.model_dump(mode="json", exclude_defaults=True)
    air = config.pop("air", {})
    air["speed_of_sound"] = plan.config.air.sound_speed  # given or not
    grid = {name: list(values) for name, values in plan.grid.items()}
    own = {name: dict(settings) for name, settings in plan.own.items()}
    parts = [plan.strategies, plan.filters, config, air, grid, *([own] if own else [])]
    said = json.dumps(parts, sort_keys=True)
    return sha256(said.encode()).hexdigest()


def read_ended_trials(folder: Path, plan: Plan, iteration: int) -> list[EndedTrial]:
    """Tell how the trials of a world that is done ended.

    Parameters
    ----------
    folder : Path
    plan : Plan
        By which it should have been computed.
    iteration : int

    Returns
    -------
    list of EndedTrial

    Raises
    ------
    InputError
        Where one of the world's files is not as it was written.
    """
    import polars as pl

    file = check_world(folder, plan, iteration)
    try:
        trials = pl.read_parquet(file, columns=[*EndedTrial._fields])
        return [EndedTrial(*row) for row in trials.rows()]
    except pl.exceptions.PolarsError:
        flaw = "has not the columns of this study"
        raise damaged(folder, "trials", iteration, flaw) from None


def check_world(folder: Path, plan: Plan, iteration: int) -> bytes:
    """Refuse a world that is done, but of which a file is not as it was written.

    Parameters
    ----------
    folder : Path
    plan : Plan
        By which it should have been computed.
    iteration : int

    Returns
    -------
    bytes
        The file of trials.

    Raises
    ------
    InputError
        With the file, and how to have the world anew.
    """
    found: dict[str, bytes] = {}
    for name in reversed(TABLES):
        path = world_file(folder, name, iteration)
        try:
            found[name] = read_file(path)
            flaw = _flaw(name, found, plan, iteration)
        except FileNotFoundError:
            flaw = "is missing"
        except OSError as error:
            flaw = f"could not be read ({error.strerror})"
        if flaw:
            raise damaged(folder, name, iteration, flaw)
    return found["trials"]


def damaged(folder: Path, table: str, iteration: int, flaw: str) -> InputError:
    """Say what is wrong with a world's file, and how to have the world anew.

    Parameters
    ----------
    folder : Path
    table : one of `TABLES`
    iteration : int
    flaw : str

    Returns
    -------
    InputError
    """
    return InputError(
        f"{world_file(folder, table, iteration)}: {flaw}; remove "
        f"{world_file(Path(), 'trials', iteration)} from {folder} and run the study again: its "
        "world is done anew"
    )


def _flaw(name: str, found: dict[str, bytes], plan: Plan, iteration: int) -> str | None:
    """Tell what is wrong with a file, by what that of the trials says; the trials come first."""
    import polars as pl

    try:
        said = pl.read_parquet_metadata(io.BytesIO(found["trials"]))
    except (OSError, pl.exceptions.PolarsError):
        return "could not be read: it is no whole Parquet file"
    if _WORLD not in said:
        return "bears no sums: it is of an earlier version, or not Pipistrelle's"
    if said[_WORLD] != str(iteration):
        return f"is the file of world {said[_WORLD]}"
    if name == "trials" and _PLAN in said and said[_PLAN] != _plan_sum(plan):
        return "was computed by another plan than the plan.toml that is here now"
    expected, file = said.get(_SUM.format(name), _NO_SUM), found[name]
    if name == "trials":
        file = file.replace(expected.encode(), _NO_SUM.encode())
    return None if sha256(file).hexdigest() == expected else "is not as it was written"


def scan_tables(folder: Path, table: str, worlds: Sequence[int]) -> "pl.LazyFrame":
    """Open one table of some worlds, one after another.

    Parameters
    ----------
    folder : Path
    table : one of `TABLES`
    worlds : sequence of int
        At least one.

    Returns
    -------
    LazyFrame
    """
    import polars as pl

    paths = [world_file(folder, table, world).absolute() for world in worlds]
    for path in paths:
        check_ordinary(path)
    try:
        os.fspath(folder.absolute()).encode()
    except UnicodeEncodeError:  # a name that Polars could not have
        return pl.scan_parquet([read_file(path) for path in paths])
    return pl.scan_parquet(paths, glob=False)


def unusable(folder: Path, error: OSError) -> InputError:
    """Say that a study's folder cannot be written, and that nothing is lost.

    Parameters
    ----------
    folder : Path
    error : OSError

    Returns
    -------
    InputError
    """
    return InputError(
        f"{error.filename or folder}: could not be written ({error.strerror}); worlds that are "
        "done are kept: mend this, or copy the folder elsewhere, and run the same command again"
    )
