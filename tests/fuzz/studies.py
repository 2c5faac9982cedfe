"""Damaged folders of studies, met by `study` and by `report`."""

import contextlib
import io
import json
import os
import pickle
import re
import shutil
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from numpy.random import Generator

from fuzz.judging import Tried, contents, faults_of, lost
from fuzz.mutations import BYTES, one_of, spoiled
from fuzz.running import Ending, command, end_of, made, undrawn
from reference.studies import TIMINGS

if TYPE_CHECKING:
    import polars as pl

PLAN = """\
format = 1
name = "tiny"
iterations = 2
[config.scenario]
steps = 16
landmarks = 8
[config.fastslam]
particles = 10
[grid]
"emitter.radius" = [0.0025, 0.025]
"""
"""Two worlds of four frames, ten cases in each."""
AGAIN = ("study", "tiny.toml", "--workers", "1", "--quiet", "-o", "study")
REPORT = ("report", "study", "--quiet")
WORLDS = ("iteration_00000.parquet", "iteration_00001.parquet")
FILES = tuple(f"{table}/{world}" for table in ("trials", "steps", "landmarks") for world in WORLDS)
TEXTS = ("plan.toml", "config.toml", "README.md")
USERS = (
    *("notes.txt", "trials/notes.txt", "steps/mine/notes.txt", "plan.toml.partial", ".DS_Store"),
    *("trials/iteration_00009.parquet.old", "trials/iteration_abc.parquet", "report/notes.txt"),
    *("plan.toml~", "steps/iteration_00009.parquet", "trials/Iteration_00000.parquet"),
)
"""Names that a user's own files may have."""
OURS = (
    *("trials/iteration_00000.parquet.0123abcd.partial", "plan.toml.0123abcd.partial"),
    *("steps/iteration_00001.parquet.0123abcd.partial", "README.md.0123abcd.partial"),
)
"""Names that a killed writer leaves."""
FOLDER = ("study: holds", "study: lacks", "study: no world is done yet")
"""What is said of the folder itself."""
KEPT = "results.pickle"
PATIENCE = 5
"""How often a refusal's advice is taken."""
SLOW = 60.0
"""Limit of what draws or computes a whole study [s]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Damage:
    """What was done to a study's folder."""

    told: str
    names: tuple[str, ...] = ()
    users: tuple[str, ...] = ()
    forged: bool = False


def put(path: Path, data: bytes) -> None:
    """Put a file in another's place, or in that of a link to one."""
    path.unlink()
    path.write_bytes(data)


# The study before any damage


def prepare(base: Path) -> Path:
    """Make a study, its report, and files that are like its own and are not."""
    sound = base / "sound"
    sound.mkdir()
    (sound / "tiny.toml").write_text(PLAN)
    for words in (AGAIN, REPORT):
        made(sound, *words, limit=SLOW)
    for action in (partial(keep, sound / "study", sound / KEPT), partial(make_strange, sound)):
        ending = end_of(action, sound)
        if ending.how != "returned":
            raise RuntimeError(ending.said)
    return sound


def keep(study: Path, file: Path) -> None:
    """Keep what a study found."""
    file.write_bytes(pickle.dumps(tables(study)))


def same(study: Path, file: Path) -> bool:
    """Tell whether a study found what was kept."""
    found, kept = tables(study), pickle.loads(file.read_bytes())
    alike = (found[name].equals(kept[name], null_equal=True) for name in kept)
    return found.keys() == kept.keys() and all(alike)


def tables(study: Path) -> "dict[str, pl.DataFrame]":
    """Return the tables of a study's own worlds, but for the time that they took."""
    import polars as pl

    from pipistrelle.experiments.studies.plan import read_plan
    from pipistrelle.experiments.studies.world import TABLES, world_file

    found = {}
    for world in range(read_plan(study / "plan.toml").iterations):
        for name in TABLES:
            table = pl.read_parquet(world_file(study, name, world))
            found[f"{name} of {world}"] = table.drop(TIMINGS, strict=False)
    return found


def make_strange(sound: Path) -> None:
    """Make tables of other columns, of nulls and of no rows, some with sums that are right."""
    import polars as pl

    from pipistrelle.experiments.studies.plan import read_plan
    from pipistrelle.experiments.studies.world import TABLES, with_sums

    (sound / "strange").mkdir()
    plan = read_plan(sound / "study" / "plan.toml")
    tables = {name: pl.read_parquet(sound / "study" / name / WORLDS[0]) for name in TABLES}
    for name, table in tables.items():
        column = table.columns[-1]
        strange = {
            "nulls": table.with_columns(pl.lit(None, table[column].dtype).alias(column)),
            "few": table.drop(column),
            "many": table.with_columns(pl.lit(1).alias("strange")),
            "text": table.with_columns(pl.all().cast(pl.String)),
            "none": table.clear(),
            "half": table.head(len(table) // 2),
            "other": pl.DataFrame({"x": [1, 2, 3]}),
        }
        for kind, other in strange.items():
            buffer = io.BytesIO()
            other.write_parquet(buffer)
            (sound / "strange" / f"{name}-{kind}").write_bytes(buffer.getvalue())
            if kind in ("few", "many", "text", "other"):
                for table_name, file in with_sums(tables | {name: other}, plan, 0).items():
                    place = sound / "strange" / f"{name}-{kind}-summed"
                    place.mkdir(exist_ok=True)
                    (place / table_name).write_bytes(file)


# Damage


def spoil(rng: Generator, study: Path, _: Path) -> Damage:
    """Spoil a file's bytes."""
    name = one_of(rng, [*FILES, *FILES, *TEXTS])
    path = study / name
    if name in FILES:
        told, data = one_of(rng, BYTES)(rng, path.read_bytes())
        told = f"{name}: {told}"
    else:
        told, data = spoiled(rng, name, path.read_bytes())
    put(path, data)
    return Damage(told=told, names=(name,))


def remove(rng: Generator, study: Path, _: Path) -> Damage:
    """Remove a file, or a folder."""
    name = one_of(rng, [*FILES, *FILES, *TEXTS, "trials", "steps", "landmarks"])
    path = study / name
    shutil.rmtree(path) if path.is_dir() else path.unlink()
    return Damage(told=f"{name} is gone", names=(name,))


def swap(rng: Generator, study: Path, _: Path) -> Damage:
    """Swap two files."""
    one, other = (study / one_of(rng, FILES) for _ in range(2))
    first, second = one.read_bytes(), other.read_bytes()
    put(one, second)
    put(other, first)
    names = tuple(path.relative_to(study).as_posix() for path in (one, other))
    return Damage(told=f"{names[0]} and {names[1]} are swapped", names=names)


def be_strange(rng: Generator, study: Path, sound: Path) -> Damage:
    """Put a table of other content in a table's place."""
    kind = one_of(rng, sorted(sound.glob("strange/*")))
    table = kind.name.partition("-")[0]
    if kind.is_dir():
        for path in kind.iterdir():
            put(study / path.name / WORLDS[0], path.read_bytes())
    else:
        put(study / table / WORLDS[0], kind.read_bytes())
    name = f"{table}/{WORLDS[0]}"
    return Damage(told=f"{name} is {kind.name}", names=(name,), forged=kind.is_dir())


def misplace(rng: Generator, study: Path, _: Path) -> Damage:
    """Put what is no file in a file's place."""
    name = one_of(rng, [*FILES, *TEXTS, "trials", "steps", "landmarks", "report"])
    path = study / name
    shutil.rmtree(path) if path.is_dir() else path.unlink()
    told, make = one_of(
        rng,
        [
            ("a folder", path.mkdir),
            ("a link to itself", lambda: path.symlink_to(path.name)),
            ("a link to nowhere", lambda: path.symlink_to("nowhere")),
            ("a file of a word", lambda: path.write_text("word")),
            ("a link to another's", lambda: path.symlink_to(study / FILES[1])),
            ("a pipe", lambda: os.mkfifo(path)),
            ("a link to a device", lambda: path.symlink_to("/dev/zero")),
        ],
    )
    make()
    return Damage(told=f"{name} is {told}", names=(name,))


def add(rng: Generator, study: Path, _: Path) -> Damage:
    """Lay a user's file among the study's."""
    name = one_of(rng, USERS)
    path = study / name
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(one_of(rng, [b"a user's\n", b"", (study / FILES[0]).read_bytes()]))
    return Damage(told=f"{name} is added", names=(name,), users=(name,))


def add_numbered(rng: Generator, study: Path, _: Path) -> Damage:
    """Lay a file among the study's whose name is that of a world that is not."""
    name = f"trials/iteration_0000{int(rng.integers(2, 10))}.parquet"
    content = one_of(rng, [b"", b"a user's\n", (study / FILES[0]).read_bytes()])
    (study / name).write_bytes(content)
    return Damage(told=f"{name} is added", names=(name,), users=(name,))


def leave(rng: Generator, study: Path, _: Path) -> Damage:
    """Leave what a killed writer does."""
    name = one_of(rng, OURS)
    (study / name).write_bytes(b"half a file")
    return Damage(told=f"{name} is left", names=(name,))


DAMAGES = (
    *(spoil, spoil, spoil, remove, swap, be_strange, be_strange, misplace),
    *(add, add_numbered, leave),
)


# A try


def attempt(rng: Generator, place: Path, sound: Path) -> Tried:
    """Damage a study's folder, and have it gone on with and reported."""
    shutil.copytree(sound / "study", place / "study")
    shutil.copy(sound / "tiny.toml", place)
    damages: list[Damage] = []
    for _ in range(one_of(rng, [1, 1, 1, 2])):
        with contextlib.suppress(OSError):  # where the one before it stands in its way
            damages.append(one_of(rng, DAMAGES)(rng, place / "study", sound))
    users = {f"study/{name}" for damage in damages for name in damage.users}
    forged = any(damage.forged for damage in damages)
    before = contents(place)
    named = [f"study/{name}" for damage in damages for name in damage.names]
    endings, faults = [], []
    for words in one_of(rng, [(AGAIN, REPORT), (REPORT, AGAIN, REPORT)]):
        endings.append(command(place, *words, before=undrawn, limit=SLOW))
        faults += faults_of(endings[-1], [*named, *FOLDER])
        if words == REPORT or not forged:
            faults += _untrue(endings[-1], place, sound, users)
    faults += lost({name: before[name] for name in users}, contents(place), "a user's file")
    if not users and (len(damages) == 1 or not forged):
        mended = _mended(place, endings[-1])
        for ending in mended:
            faults += faults_of(ending, ["study/"]) + _untrue(ending, place, sound, users)
        if len(mended) == PATIENCE and mended[-1].found == 2:
            faults.append("study: its advice does not help")
        endings += mended
    told = tuple(damage.told for damage in damages)
    return Tried(told=told, endings=tuple(endings), faults=tuple(faults))


def _untrue(ending: Ending, place: Path, sound: Path, users: set[str]) -> list[str]:
    """Name what a command says that is not so."""
    if ending.how != "returned" or ending.found == 2:
        return []
    if ending.found == 1:
        return [f"{ending.words[0]}: a damaged study counts as one of failed trials"]
    if ending.words == REPORT:
        true = _same_report(place / "study", sound / "study")
        return [] if true else ["report: says that all is well, and is not what it was"]
    faults = []
    if end_of(partial(same, place / "study", sound / KEPT), place).found is not True:
        faults.append("study: says that all is well, and the tables are not what they were")
    left = {path.relative_to(place).as_posix() for path in place.rglob("*.partial")}
    if left - users:
        faults.append("study: leaves a partial file behind")
    return faults


def _mended(place: Path, refused: Ending) -> list[Ending]:
    """Remove what a refusal says is to be removed, and have the study gone on with."""
    endings: list[Ending] = []
    for _ in range(PATIENCE):
        advice = re.search(r"remove (\S+) from study and run", refused.said)
        if refused.found != 2 or advice is None:
            break
        with contextlib.suppress(FileNotFoundError):
            path = place / "study" / advice.group(1)
            shutil.rmtree(path) if path.is_dir() and not path.is_symlink() else path.unlink()
        refused = command(place, *AGAIN, before=undrawn, limit=SLOW)
        endings.append(refused)
    return endings


def _same_report(study: Path, sound: Path) -> bool:
    """Tell whether a report says the same as another, or that it is partial."""
    found, expected = (_said(folder / "report") for folder in (study, sound))
    return bool(found["summary.json"]["partial"]) or found == expected


def _said(report: Path) -> dict[str, Any]:
    """Return a report's numbers, but for the time that they took."""
    summary = json.loads((report / "summary.json").read_text())
    del summary["filters_cpu_s"]
    figures = {path.name: path.read_bytes() for path in report.glob("figures/*.csv")}
    return {"summary.json": summary} | figures
