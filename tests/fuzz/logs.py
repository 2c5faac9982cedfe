"""Spoiled logs of both formats, for `pipistrelle slam`."""

import os
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Literal

from numpy.random import Generator

from fuzz.judging import Tried, contents, faults_of, lost, unsound_results
from fuzz.mutations import one_of, spoiled
from fuzz.running import command, undrawn

DATA = Path(__file__).resolve().parents[1] / "data"
LOGS: dict[str, tuple[str, ...]] = {
    "unicycle_log": (),
    "bicycle_log": (),
    "poses_log": (),
    "mrclam_made_up": ("--robot", "1"),
}
MANNERS = (
    *((), (), ("--strategy", "all"), ("--strategy", "passive"), ("--strategy", "active")),
    *(("--gate", "1"), ("--beamwidth", "60"), ("--filter", "both", "--strategy", "all")),
)
DRAWN = 0.02
"""Share of the tries with pictures, which take ten times as long."""


@dataclass(frozen=True, slots=True)
class Special:
    """What may stand where a file should: no file."""

    kind: Literal["folder", "pipe", "link"]
    target: str = ""


Files = dict[str, bytes | Special]


@cache
def sound(name: str) -> dict[str, bytes]:
    """Return the files of a sound log."""
    return {path.name: path.read_bytes() for path in sorted((DATA / name).iterdir())}


def replaced(rng: Generator, files: Files, name: str) -> tuple[str, Files]:
    """Put something else in a file's place, or nothing."""
    other = one_of(rng, sorted(files))
    strange: list[tuple[str, bytes | Special | None]] = [
        (f"{name} is gone", None),
        (f"{name} is gone", None),
        (f"{name} is empty", b""),
        (f"{name} holds what {other} does", files[other]),
        (f"{name} is a folder", Special("folder")),
        (f"{name} is a link to itself", Special("link", name)),
        (f"{name} is a link to nowhere", Special("link", "nowhere")),
        (f"{name} is a link to {other}", Special("link", other)),
        (f"{name} is a link to the null device", Special("link", os.devnull)),
        (f"{name} holds a thousand times as much", _repeated(files[name])),
    ]
    if rng.random() < 0.02:  # each takes as long as a try may
        endless = "/dev/zero"
        strange = [
            (f"{name} is a pipe", Special("pipe")),
            (f"{name} is a link to an endless device", Special("link", endless)),
        ]
    told, content = one_of(rng, strange)
    rest = {key: value for key, value in files.items() if key != name}
    return told, rest if content is None else rest | {name: content}


def _repeated(content: bytes | Special) -> bytes | Special:
    """Say the same a thousand times."""
    return content * 1000 if isinstance(content, bytes) else content


def added(rng: Generator, files: Files) -> tuple[str, Files]:
    """Lay a strange file beside the others."""
    name = one_of(rng, ["notes.txt", ".DS_Store", "Robot2_Odometry.dat", "log.toml", "truth.csv"])
    name = one_of(rng, [name, name, "landmarks.csv", "Barcodes.dat", "Robot_Odometry.dat"])
    return f"{name} is added", {name: b"a user's\n"} | files


def changed(rng: Generator, files: Files) -> tuple[str, Files]:
    """Spoil one file of a log, or its place."""
    name = one_of(rng, sorted(files))
    way, content = rng.random(), files[name]
    if way < 0.02:
        return added(rng, files)
    if way < 0.07 or isinstance(content, Special):
        return replaced(rng, files, name)
    told, rest = spoiled(rng, name, content)
    return told, files | {name: rest}


def lay(files: Files, folder: Path) -> None:
    """Make a folder of files, and of what is none."""
    folder.mkdir()
    for name, content in files.items():
        path = folder / name
        if isinstance(content, bytes):
            path.write_bytes(content)
        elif content.kind == "folder":
            path.mkdir()
        elif content.kind == "pipe":
            os.mkfifo(path)
        else:
            path.symlink_to(content.target)


def attempt(rng: Generator, place: Path, _: None) -> Tried:
    """Spoil a log, and have it solved."""
    name = one_of(rng, [*LOGS])
    files: Files = dict(sound(name))
    told = []
    for _ in range(min(int(rng.geometric(0.7)), 4)):
        what, files = changed(rng, files)
        told.append(what)
    lay(files, place / name)
    before = contents(place / name)
    estimator = one_of(rng, ["ekf", "fastslam"])
    words = ("slam", name, *LOGS[name], "--quiet", "-o", "out", "--filter", estimator)
    manner = one_of(rng, MANNERS)
    words = (*words[: -2 if "--filter" in manner else None], *manner)
    drawn = rng.random() < DRAWN
    ending = command(place, *words, before=(lambda: None) if drawn else undrawn)
    known = {*sound(name), *files}
    faults = faults_of(ending, [f"{name}/{file}" for file in known] + [f"{name}: ", "--robot"])
    faults += lost(before, contents(place / name), "a file of the log")
    status = ending.found if ending.how == "returned" else None
    faults += unsound_results(place / "out", status)
    return Tried(told=tuple(told), endings=(ending,), faults=tuple(faults))


def prepare(_: Path) -> None:
    """Need nothing."""
