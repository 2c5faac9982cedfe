"""What is a fault: each is named so that its like have the same name."""

import csv
import json
import math
import os
import re
import signal
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np

from fuzz.running import Ending

_WARNING = re.compile(r"^(?:.*/)?([^/:]+):\d+: (\w*Warning): (.*)\n(?:  .*\n)?", re.MULTILINE)
_FRAME = re.compile(r'File "[^"]*/pipistrelle/([^"]+)", line \d+,? in (\S+)')
_RAISED = re.compile(r"^((?:\w+\.)*\w*(?:Error|Exception|Interrupt|Exit)\b.*)", re.MULTILINE)
_NUMBER = re.compile(r"[-+]?\d[\d.,_]*(?:e[-+]?\d+)?")
_QUOTED = re.compile(r"'[^']*'|\"[^\"]*\"")
ERROR, OWN = "pipistrelle: error: ", "pipistrelle: "


@dataclass(frozen=True, slots=True, kw_only=True)
class Tried:
    """A try: what was spoiled, the commands that met it, and what they did wrong."""

    told: tuple[str, ...]
    endings: tuple[Ending, ...]
    faults: tuple[str, ...]


def faults_of(
    ending: Ending, names: Iterable[str], statuses: Iterable[int] = (0, 1, 2)
) -> list[str]:
    """Name what no quiet command line may do, whatever it is given."""
    verb = ending.words[0] if ending.words else ""
    return [f"{verb}: {fault}" for fault in _faults_of(ending, names, statuses)]


def _faults_of(ending: Ending, names: Iterable[str], statuses: Iterable[int]) -> Iterator[str]:
    """Name them without the verb."""
    for place, kind, words in _WARNING.findall(ending.said):
        yield f"{kind} in {place}: {kind_of(words)}"
    if ending.how == "hung":
        yield f"hangs in {' < '.join(_frames(ending.said)[:1]) or 'no code of ours'}"
    elif ending.how == "raised":
        frames, raised = _frames(ending.said), _RAISED.findall(ending.said)
        what = kind_of(raised[-1]) if raised else "something"
        yield f"{what} in {frames[-1] if frames else 'no code of ours'}"
    elif ending.how == "died":
        number = -ending.found
        known = number in {*signal.Signals}
        how = f"of {signal.Signals(number).name}" if known else f"with status {ending.found}"
        yield f"dies {how} in {' < '.join(_frames(ending.said)[:1]) or 'no code of ours'}"
    elif ending.found not in statuses:
        yield f"ends with status {ending.found}"
    else:
        yield from _strange_words(ending, tuple(names))


def _strange_words(ending: Ending, names: tuple[str, ...]) -> Iterator[str]:
    """Name what is wrong with what a command says that ended as it may."""
    lines = _WARNING.sub("", ending.said).splitlines()
    errors = [line.removeprefix(ERROR) for line in lines if line.startswith(ERROR)]
    if strange := [line for line in lines if not line.startswith(OWN)]:
        yield f"says what is not its own: {kind_of(strange[0])}"
    if any(not character.isprintable() for line in lines for character in line):
        yield f"says what no terminal should show: {kind_of(repr(lines[0]))}"
    if ending.found == 2:
        if not errors:
            yield "refuses without a word"
        elif not any(name in error for name in names for error in errors):
            yield f"refuses without naming the place: {kind_of(errors[0])}"
        if ending.printed:
            yield "prints something, and refuses"
    elif errors:
        yield f"says error, with status {ending.found}"
    if ending.found == 1 and not any("warning: " in line for line in lines):
        yield "has status 1 without a word"


def kind_of(words: str) -> str:
    """Leave out of a message what differs from one of its kind to the next."""
    return _NUMBER.sub("N", _QUOTED.sub("'...'", words))[:140]


def _frames(said: str) -> list[str]:
    """List the functions of ours that a traceback names, as it does."""
    return [f"{place}:{function}" for place, function in _FRAME.findall(said)]


def contents(folder: Path) -> dict[str, Any]:
    """Return what stands in a folder, by its name: bytes, or what is no file."""
    found: dict[str, Any] = {}
    for path in sorted(folder.rglob("*")):
        name = os.fsdecode(os.fsencode(path.relative_to(folder)))
        if path.is_symlink():
            found[name] = path.readlink()
        elif path.is_file():
            found[name] = path.read_bytes()
        else:
            found[name] = path.lstat().st_mode
    return found


def lost(before: dict[str, Any], after: dict[str, Any], whose: str) -> list[str]:
    """Name somebody's files that are gone or changed."""
    return [f"loses or changes {whose}" for name in before if after.get(name) != before[name]][:1]


def unsound_results(folder: Path, status: Any) -> Iterator[str]:
    """Name what is wrong with a mission's result folder."""
    if status == 2 and os.path.lexists(folder):
        yield f"refused, and leaves {'an empty' if _is_empty(folder) else 'a filled'} folder behind"
    if status not in (0, 1):
        return
    for line in (folder / "SHA256SUMS").read_text().splitlines()[1:]:
        its_sum, name = line.split("  ", 1)
        if sha256((folder / name).read_bytes()).hexdigest() != its_sum:
            yield "a result is not what its sum says"
    if left := [path for path in folder.iterdir() if "partial" in path.name or path.is_dir()]:
        yield f"leaves {kind_of(left[0].name)} among the results"
    for run in json.loads((folder / "summary.json").read_text())["runs"]:
        yield from _unsound_run(folder, run, status)


def _unsound_run(folder: Path, run: dict[str, Any], status: int) -> Iterator[str]:
    """Name what is not finite in an estimate, and not said to be so."""
    name = f"{run['strategy']}_{run['filter']}"
    with np.errstate(all="ignore"):
        track = np.loadtxt(folder / f"track_{name}.tum", ndmin=2)
    finite = bool(np.isfinite(track).all())
    told = run["diverged"] is True
    if status == 0 and not finite:
        yield "status 0 with a track that is not finite"
    if not finite and not told:
        yield "a track that is not finite does not count as diverged"
    with (folder / f"map_{name}.csv").open() as file:
        cells = [cell for row in list(csv.reader(file))[1:] for cell in row]
    if status == 0 and not told and not all(_is_finite(cell) for cell in cells):
        yield "status 0, not diverged, with a map that is not finite"
    if status == 0 and not told and run["position_rmse_m"] is None and _is_scored(folder, track):
        yield "status 0, not diverged, with scores that are not finite"


def _is_scored(folder: Path, track: np.ndarray) -> bool:
    """Tell whether the truth knows more than the start."""
    path = folder / "truth.tum"
    known = np.loadtxt(path, ndmin=2) if path.exists() and path.stat().st_size else None
    return known is not None and bool(np.any(known[:, 0] > track[0, 0]))


def _is_finite(cell: str) -> bool:
    """Tell whether a cell is no number, or a finite one."""
    try:
        return math.isfinite(float(cell))
    except ValueError:
        return True


def _is_empty(folder: Path) -> bool:
    """Tell whether a folder holds nothing."""
    return folder.is_dir() and not any(folder.iterdir())
