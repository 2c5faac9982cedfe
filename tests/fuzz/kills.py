"""Studies that are killed at any moment, and gone on with."""

import os
import re
import signal
import subprocess
import sys
import time
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from numpy.random import Generator

from fuzz.judging import Tried, faults_of, kind_of
from fuzz.mutations import one_of
from fuzz.running import Ending, command, end_of
from fuzz.studies import KEPT, keep, same

PLAN = """\
format = 1
name = "short"
iterations = 5
[config.scenario]
steps = 40
landmarks = 10
[config.fastslam]
particles = 20
[grid]
"emitter.radius" = [0.0025, 0.025]
"""
"""Five worlds of ten frames, ten cases in each."""
SIGNALS = (signal.SIGKILL, signal.SIGTERM, signal.SIGINT)
WHOM = ("group", "group", "parent", "parent", "worker")
PATIENCE = 60.0
"""Within this time all ends that should [s]."""


@dataclass(frozen=True, slots=True)
class Sound:
    """What a study that nobody killed found, and how long it took [s]."""

    results: Path
    seconds: float


def words(workers: int) -> tuple[str, ...]:
    """Return the command line."""
    return ("study", "short.toml", "--workers", str(workers), "--quiet", "-o", "study")


def prepare(base: Path) -> Sound:
    """Run a study that nobody kills."""
    (base / "short.toml").write_text(PLAN)
    began = time.monotonic()
    ending, _ = _ended(_started(base, 2), base, 2)
    if ending.found != 0:
        raise RuntimeError(f"a sound study ends with {ending}")
    seconds = time.monotonic() - began
    kept = end_of(partial(keep, base / "study", base / KEPT), base)
    if kept.how != "returned":
        raise RuntimeError(kept.said)
    return Sound(base / KEPT, seconds)


def attempt(rng: Generator, place: Path, sound: Sound) -> Tried:
    """Kill a study once or more, and go on with it to its end."""
    (place / "short.toml").write_text(PLAN)
    told, endings, faults = [], [], []
    for _ in range(one_of(rng, [1, 1, 2])):
        what, ending, found = _killed(rng, place, sound)
        told.append(what)
        endings.append(ending)
        faults += found
    last = command(place, *words(1), limit=PATIENCE)
    faults += [f"after a death, {fault}" for fault in faults_of(last, (), statuses=(0,))]
    if last.how == "returned" and last.found == 0:
        alike = end_of(partial(same, place / "study", sound.results), place)
        if alike.found is not True:
            faults.append("after a death, the tables are not what they are without one")
        if list(place.rglob("*.partial")):
            faults.append("after a death, a partial file is left behind")
    return Tried(told=tuple(told), endings=(*endings, last), faults=tuple(faults))


def _killed(rng: Generator, place: Path, sound: Sound) -> tuple[str, Ending, list[str]]:
    """Start a study, and kill it or a part of it."""
    whom, number = one_of(rng, WHOM), one_of(rng, SIGNALS)
    workers, at_work = one_of(rng, [1, 2, 2]), bool(rng.integers(2))
    moment = float(rng.uniform(0.0, sound.seconds * (0.3 if at_work else 1.0)))
    started = _started(place, workers)
    while at_work and started.poll() is None and not any(place.glob("study/steps/*")):
        time.sleep(0.005)
    time.sleep(moment)
    reached = _kill(started, whom, number, rng)
    ending, orphans = _ended(started, place, workers)
    name = signal.Signals(number).name
    since = "the first file" if at_work else "the start"
    told = f"{moment:.2f} s after {since} {name} to the {reached}; {workers} workers"
    faults = _judged(ending, reached, number)
    if orphans:
        faults.append(f"leaves a process behind after {name} to the {reached}")
    for orphan in orphans:
        with suppress(ProcessLookupError):
            os.kill(orphan, signal.SIGKILL)
    return told, ending, [f"study: {fault}" for fault in faults]


def _judged(ending: Ending, reached: str, number: signal.Signals) -> list[str]:
    """Name what is wrong with the end of a study that was killed."""
    name = signal.Signals(number).name
    right = {0} if reached == "worker" else {0, -number}  # the latter before and after Python
    right |= {130} if number == signal.SIGINT else {143} if number == signal.SIGTERM else set()
    faults = []
    if ending.how == "hung":
        faults.append(f"does not end after {name} to the {reached}")
    elif ending.found not in right:
        faults.append(f"ends with status {ending.found} after {name} to the {reached}")
    warned = re.findall(r"\w*Warning: .*", ending.said)
    if warned and number != signal.SIGKILL:  # of which nothing can be told but by others
        faults.append(f"warns after {name} to the {reached}: {kind_of(warned[0])}")
    if "Traceback" in ending.said:
        last = ending.said.strip().splitlines()[-1]
        faults.append(f"says a traceback after {name} to the {reached}: {last[:60]}")
    if ending.found == 130 and "pipistrelle: interrupted" not in ending.said:
        faults.append("is interrupted without a word")
    return faults


# Processes


def _started(place: Path, workers: int) -> subprocess.Popen[bytes]:
    """Start a study in a session of its own."""
    with (place / "said").open("wb") as said:
        return subprocess.Popen(
            [sys.executable, "-m", "pipistrelle", *words(workers)],
            cwd=place,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=said,
            start_new_session=True,
        )


def _ended(started: subprocess.Popen[bytes], place: Path, workers: int) -> tuple[Ending, list[int]]:
    """Wait for a study's end; tell how it ended, and which of its processes did not."""
    try:
        found, how = started.wait(PATIENCE), "returned"
    except subprocess.TimeoutExpired:
        os.killpg(started.pid, signal.SIGKILL)
        found, how = started.wait(), "hung"
    orphans = _members_later(started.pid)
    said = (place / "said").read_text(errors="backslashreplace")
    return Ending(how=how, found=found, words=words(workers), printed="", said=said), orphans


def _kill(
    started: subprocess.Popen[bytes], whom: str, number: signal.Signals, rng: Generator
) -> str:
    """Send a signal; tell who was reached: without workers, their parent is."""
    with suppress(ProcessLookupError):
        if whom == "group":
            os.killpg(started.pid, number)
            return whom
        if whom == "worker" and (workers := _workers(started.pid)):
            os.kill(one_of(rng, workers), number)
            return whom
        os.kill(started.pid, number)
    return "parent"


def _members(session: int) -> list[int]:
    """List the processes of a session that still run."""
    found = []
    for path in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):
            state, _, _, its, *_ = (path / "stat").read_text().rpartition(")")[2].split()
            if int(its) == session and state != "Z":
                found.append(int(path.name))
    return found


def _members_later(session: int, patience: float = 10.0) -> list[int]:
    """List the processes of a session that still run after a while."""
    end = time.monotonic() + patience
    while (found := _members(session)) and time.monotonic() < end:
        time.sleep(0.05)
    return found


def _workers(session: int) -> list[int]:
    """List the processes of a session that do a study's work."""
    found = []
    for process in _members(session):
        with suppress(OSError):
            if b"spawn_main" in Path(f"/proc/{process}/cmdline").read_bytes():
                found.append(process)
    return sorted(found)
