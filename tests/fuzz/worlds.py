"""Spoiled worlds, with the routes of their callers, for `pipistrelle run --world`."""

from pathlib import Path

from numpy.random import Generator

from fuzz.judging import Tried, contents, faults_of, lost, unsound_results
from fuzz.logs import Files, changed, lay
from fuzz.mutations import one_of
from fuzz.running import command, made, undrawn
from reference.command_line import SHORT

CALLERS = "[{name='bee',frequency=25000.0,course='circle'},{name='post',frequency=45000.0}]"
WAYPOINTS = b"x,y\n-3,0\n3,0\n3,3\n"
RUN = ("run", "--quiet", "--strategy", "fused", "--listening.excess-paths", "true")
LIMIT = 30.0


def prepare(base: Path) -> list[dict[str, bytes]]:
    """Draw two worlds: one with poses and a route, one with way-points."""
    words = (*RUN, *SHORT, "--callers", CALLERS, "-o", "out", "--save-world", "world")
    made(base, *words, limit=LIMIT)
    drawn = {path.name: path.read_bytes() for path in (base / "world").iterdir()}
    del drawn["SHA256SUMS"]
    short = b"[config.scenario]\nsteps = 32\n"
    walked = {"landmarks.csv": drawn["landmarks.csv"], "path.csv": WAYPOINTS}
    return [drawn, walked | {"world.toml": b"format = 1\n" + short}]


def attempt(rng: Generator, place: Path, sound: list[dict[str, bytes]]) -> Tried:
    """Spoil a world, and have it heard."""
    world = one_of(rng, [sound[0], sound[0], sound[1]])
    files: Files = dict(world)
    told = []
    for _ in range(min(int(rng.geometric(0.7)), 4)):
        what, files = changed(rng, files)
        told.append(what)
    lay(files, place / "world")
    before = contents(place / "world")
    words = (*RUN, "--world", "world", "-o", "out", "--scenario.steps", "16")
    words = words if rng.random() < 0.3 else words[:-2]
    ending = command(place, *words, before=undrawn, limit=LIMIT)
    places = [f"world/{file}" for file in {*world, *files}]
    faults = faults_of(ending, [*places, "world: ", "world ", "scenario.", "callers.", "motion."])
    faults += lost(before, contents(place / "world"), "a file of the world")
    status = ending.found if ending.how == "returned" else None
    faults += [f for f in unsound_results(place / "out", status) if "worlds among" not in f]
    return Tried(told=tuple(told), endings=(ending,), faults=tuple(faults))
