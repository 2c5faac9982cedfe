"""A campaign: tries at a target, one after another, and the faults that came of them."""

import gc
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from shutil import rmtree
from tempfile import TemporaryDirectory
from time import perf_counter
from types import ModuleType
from typing import NamedTuple

import numpy as np

from fuzz import (
    bags,
    kills,
    live,
    logs,
    ownership,
    results,
    settings,
    sounds,
    steps,
    studies,
    worlds,
)
from fuzz.judging import Tried
from fuzz.running import load_all

TARGETS: dict[str, ModuleType] = {
    "logs": logs,
    "settings": settings,
    "studies": studies,
    "kills": kills,
    "steps": steps,
    "ownership": ownership,
    "results": results,
    "worlds": worlds,
    "bags": bags,
    "sounds": sounds,
    "live": live,
}
"""Each has `prepare`, for all tries, and `attempt`. A number in the order keys their randomness."""
EVERY = 30.0
"""Time between two words of progress [s]."""


class Found(NamedTuple):
    """A try with faults, by its number."""

    number: int
    faults: tuple[str, ...]


def campaign(
    target: str,
    tries: int,
    seed: int,
    progress: Callable[[int, int, Sequence[Found]], None] = lambda *_: None,
) -> tuple[list[Found], Counter[str]]:
    """Make tries at a target."""
    _get_ready()
    found, ends, due = [], Counter[str](), perf_counter() + EVERY
    with TemporaryDirectory(prefix="fuzz-") as base:
        prepared = TARGETS[target].prepare(Path(base))
        for number in range(tries):
            tried = _attempt(target, seed, number, Path(base), prepared)
            ends[_end_of(tried)] += 1
            if tried.faults:
                found.append(Found(number, tried.faults))
            if perf_counter() >= due:
                due = perf_counter() + EVERY
                progress(number + 1, tries, found)
    return found, ends


def try_again(target: str, seed: int, number: int) -> Tried:
    """Make one try of a campaign, the same as in it."""
    _get_ready()
    with TemporaryDirectory(prefix="fuzz-") as base:
        return _attempt(target, seed, number, Path(base), TARGETS[target].prepare(Path(base)))


def _get_ready() -> None:
    """Load what every try needs, and keep it from being copied for each."""
    load_all()
    gc.collect()
    gc.freeze()


def _end_of(tried: Tried) -> str:
    """Word how a try's last command ended."""
    last = tried.endings[-1]
    return f"status {last.found}" if last.how == "returned" else last.how


def _attempt(target: str, seed: int, number: int, base: Path, prepared: object) -> Tried:
    """Make a try in a folder of its own."""
    rng = np.random.default_rng((seed, list(TARGETS).index(target), number))
    place = base / str(number)
    place.mkdir()
    try:
        return TARGETS[target].attempt(rng, place, prepared)
    finally:
        rmtree(place)


def grouped(found: Sequence[Found]) -> list[tuple[str, list[int]]]:
    """Put the numbers of the tries together that share a fault, the most frequent first."""
    groups: dict[str, list[int]] = {}
    for number, faults in found:
        for fault in dict.fromkeys(faults):
            groups.setdefault(fault, []).append(number)
    return sorted(groups.items(), key=lambda group: -len(group[1]))


def report(tried: Tried) -> str:
    """Tell all of a try."""
    lines = [*tried.told]
    for ending in tried.endings:
        lines += ["", "$ pipistrelle " + " ".join(ending.words)]
        lines += [f"{ending.how}: {ending.found}", ending.printed.rstrip(), ending.said.rstrip()]
    return "\n".join([*lines, "", *(f"FAULT {fault}" for fault in tried.faults or ["none"])])
