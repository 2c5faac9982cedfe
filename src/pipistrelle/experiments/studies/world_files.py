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
"""Tables, in the order in which a world's are put in place."""
_SUM = "pipistrelle.sha256.{}"
"""Key of a table's sum in the metadata of the trials' file."""
_NO_SUM = "-" * 64
"""Placeholder for the sum of the trials' file while that sum is computed."""
_WORLD, _PLAN = "pipistrelle.iteration", "pipistrelle.plan"
"""Keys of the world's number and of the plan's sum in the metadata."""


class EndedTrial(NamedTuple):
    """How a trial ended, as a worker reports it."""

    strategy: str
    error: str | None
    """What is recorded of a trial that failed."""


def world_file(folder: Path, table: str, iteration: int) -> Path:
    """Return the path of one world's table.

    >>> world_file(Path("study"), "trials", 7).as_posix()
    'study/trials/iteration_00007.parquet'
    """
    return folder / table / f"iteration_{iteration:05d}.parquet"


def done_worlds(folder: Path) -> set[int]:
    """Return the numbers of the worlds that are done."""
    names = (
        path.stem.partition("_")[2] for path in (folder / "trials").glob("iteration_*.parquet")
    )
    return {int(name) for name in names if name.isdecimal()}


def write_world(folder: Path, plan: Plan, iteration: int, records: Sequence[TrialRecord]) -> None:
    """Write a world's tables, in place of earlier ones, and delete what killed writers left.

    Where they cannot be written, the earlier ones are as they were.
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
    """Refuse to compute worlds where files that are not ours stand in their tables' place.

    Tables that a killed writer left without its trials are ours; their columns show it.
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
    """Return whether a file is a whole table of these columns, and no link."""
    import polars as pl

    with contextlib.suppress(OSError, pl.exceptions.PolarsError):
        return not path.is_symlink() and schema == pl.read_parquet_schema(
            io.BytesIO(read_file(path))
        )
    return False


def with_sums(tables: "Mapping[str, pl.DataFrame]", plan: Plan, iteration: int) -> dict[str, bytes]:
    """Return the files of a world's tables; that of the trials bears the sums of all."""
    files = {name: _parquet(tables[name]) for name in TABLES[:-1]}
    metadata = {_SUM.format(name): sha256(file).hexdigest() for name, file in files.items()}
    metadata |= {_SUM.format("trials"): _NO_SUM, _WORLD: str(iteration), _PLAN: _plan_sum(plan)}
    trials = _parquet(tables["trials"], metadata)
    own = sha256(trials).hexdigest()
    return files | {"trials": trials.replace(_NO_SUM.encode(), own.encode())}


def _parquet(table: "pl.DataFrame", metadata: dict[str, str] | None = None) -> bytes:
    """Return a table as a Parquet file with this metadata."""
    buffer = io.BytesIO()
    table.write_parquet(buffer, metadata=metadata)
    return buffer.getvalue()


def _make_way(folder: Path, iteration: int, files: dict[str, bytes]) -> None:
    """Delete a world's trials if its other tables are about to change: it is then not done."""
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
    """Return the SHA-256 of all on which a plan's worlds depend; defaults are left out."""
    config = plan.config.model_dump(mode="json", exclude_defaults=True)
    medium = config.pop(plan.config.scenario.medium, {})
    medium["speed_of_sound"] = plan.config.medium.sound_speed  # given or not
    grid = {name: list(values) for name, values in plan.grid.items()}
    own = {name: dict(settings) for name, settings in plan.own.items()}
    parts = [plan.strategies, plan.filters, config, medium, grid, *([own] if own else [])]
    text = json.dumps(parts, sort_keys=True)
    return sha256(text.encode()).hexdigest()


def read_ended_trials(folder: Path, plan: Plan, iteration: int) -> list[EndedTrial]:
    """Return how the trials of a finished world ended; refuse files that were changed."""
    import polars as pl

    file = check_world(folder, plan, iteration)
    try:
        trials = pl.read_parquet(file, columns=[*EndedTrial._fields])
        return [EndedTrial(*row) for row in trials.rows()]
    except pl.exceptions.PolarsError:
        flaw = "has not the columns of this study"
        raise damaged(folder, "trials", iteration, flaw) from None


def check_world(folder: Path, plan: Plan, iteration: int) -> bytes:
    """Refuse a finished world whose files are not as the plan's study wrote them.

    Returns the file of trials.
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
    """Return the refusal of a world's damaged file, with the way to compute the world again."""
    return InputError(
        f"{world_file(folder, table, iteration)}: {flaw}; remove "
        f"{world_file(Path(), 'trials', iteration)} from {folder} and run the study again: its "
        "world is done anew"
    )


def _flaw(name: str, found: dict[str, bytes], plan: Plan, iteration: int) -> str | None:
    """Return what is wrong with a file by the metadata of the trials' file, which comes first."""
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
    """Open one table of some worlds, at least one, as one lazy frame."""
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
    """Return the refusal of a study's folder that cannot be written; nothing is lost."""
    return InputError(
        f"{error.filename or folder}: could not be written ({error.strerror}); worlds that are "
        "done are kept: mend this, or copy the folder elsewhere, and run the same command again"
    )
