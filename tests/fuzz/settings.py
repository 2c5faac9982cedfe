"""Odd settings, in files, flags and the environment, for `run`, `slam` and plans of `study`."""

import os
import shutil
import tomllib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, get_args

from numpy.random import Generator

from fuzz.judging import Tried, contents, faults_of, lost, unsound_results
from fuzz.logs import DATA, DRAWN
from fuzz.mutations import FACTORS, HUGE, NUMBERS, VALUES, WORDS, one_of, short, spoiled
from fuzz.running import Ending, command, undrawn
from pipistrelle.experiments import named_settings
from pipistrelle.settings import CALLERS, OWN, SETTINGS, Key, known_settings

COUNTS = ("-1", "0", "1", "2", "3", "1.5", "1e12", "9223372036854775807", "9223372036854775808")
"""Of things that each take time: none that would rightly take long."""
SHORT = {"beamwidth": 33.3, "landmarks": 3, "duration": 1.0, "particles": 10}
"""Names of their own on the command line, with sound values."""
TINY: dict[Key, str] = {
    ("scenario", "steps"): "8",
    ("scenario", "landmarks"): "4",
    ("scenario", "radius"): "10.0",
    ("fastslam", "particles"): "10",
}
"""A world that takes no time."""
VERBS = ("run", "slam", "study")
KNOWN = tuple(".".join(key) for key in known_settings())
"""A refusal may name another setting than the odd one: what is too much is so for another."""
HEAD = {
    "format": "1",
    "name": '"tiny"',
    "iterations": "1",
    "strategies": '["fused", "passive"]',
    "filters": '["ekf", "fastslam"]',
}
NAMES = ("x/y", "..", ".", "", "é", "-o", "a b", "con", "x" * 300, "\n", "report", "trials")
HEADS = {
    "format": ("0", "2", "1.0", '"1"', "true", *NUMBERS),
    "name": (*(f"'''{name}'''" for name in NAMES), "1", "[]"),
    "iterations": ("0", "-1", "2", "1.0", '"1"', "true", "9223372036854775808", HUGE, "nan"),
    "strategies": ("[]", '"fused"', '["fused", "fused"]', '["loud"]', "[1]", "[[]]", "{}"),
    "filters": ("[]", '"ekf"', '["ekf", "ekf"]', '["ukf"]', '["os:path"]', "[1]", '["nowhere:It"]'),
}
"""What a plan's own keys may be given."""


CALLER = {
    "name": ("'boat'", "'a b'", "'vehicle'", "''", "1", "[]"),
    "frequency": ("25e3", "25000", "26e3", "35e3", "0", "-5e3", "1e12", "nan", "'high'"),
    "level_db": ("40", "-301", "inf", "'loud'", "[]"),
    "place": ("[1, 2]", "[0.0, -7.408]", "[1e9, 0]", "[1e12, 0]", "[1]", "3", "[nan, 0]"),
    "distance": ("4", "7.4", "0", "1e-300", "1e9"),
    "course": ("'circle'", "'walk'", "'line'", "1"),
    "radius": ("5.0", "1e-9", "1e9", "-1"),
    "centre": ("[1, 2]", "[]"),
    "speed": ("0.5", "-0.5", "0", "343.0", "1e9"),
    "speed_std": ("0.3", "1e9", "0"),
    "memory": ("3.0", "1e-9", "1e9"),
    "waypoints": ("[[1, 2], [3, 4]]", "[[1, 2]]", "[]", "[1, 2]", "[[1, 2], [1, 2]]"),
    "route": ("'nowhere.csv'", "'.'", "'odd.toml'", "[[0, 1, 2], [1, 3, 4]]", "[[0, 1, 2]]"),
    "colour": ("1",),
}
"""What a caller may be told to be."""


@dataclass(frozen=True, slots=True)
class Odd:
    """A setting, and what it is given: as a file has it."""

    key: Key
    value: str

    def __str__(self) -> str:
        return f"{'.'.join(self.key)} = {short(self.value)}"


def odd_setting(rng: Generator) -> Odd:
    """Draw a setting, and an odd value for it."""
    key = one_of(rng, [*known_settings(), CALLERS, CALLERS])
    field = known_settings()[key]
    if key == CALLERS and rng.random() < 0.9:
        return Odd(
            key, f"[{', '.join(_caller(rng) for _ in range(one_of(rng, [0, 1, 2, 2, 3, 8])))}]"
        )
    if key == SETTINGS:
        names = map(repr, (*named_settings.NAMES, "bset", ""))
        return Odd(key, one_of(rng, [*names, "1", "nan", "[]"]))
    if key == OWN and rng.random() < 0.9:
        inner = odd_setting(rng)
        name = one_of(rng, ["ekf", "fastslam", "ikef"])
        return Odd(key, f"{{{name}.{'.'.join(inner.key)} = {inner.value}}}")
    if isinstance(field.default, str):
        choices = [*map(repr, get_args(field.annotation)), "''", "'x'", "1", "true", "[]"]
        return Odd(key, one_of(rng, choices))
    if isinstance(field.default, tuple) and field.default:
        given = [_number(rng, key, part) for part in field.default]
        sound = [repr(part) for part in field.default]
        at = int(rng.integers(len(sound)))
        one = [*sound[:at], given[at], *sound[at + 1 :]]
        few, many = sound[1:], [*sound, sound[0]]
        return Odd(key, f"[{', '.join(one_of(rng, [given, one, one, sound[::-1], few, many]))}]")
    if rng.random() < 0.1:
        return Odd(
            key, one_of(rng, VALUES if field.annotation is float else VALUES[len(NUMBERS) :])
        )
    number = field.default if isinstance(field.default, (int, float)) else 1.0
    return Odd(key, _number(rng, key, number))


def _caller(rng: Generator) -> str:
    """Draw a table of a caller, odd or not."""
    keys = rng.permutation([*CALLER])[: one_of(rng, [0, 1, 2, 3])].tolist()
    return f"{{{', '.join(f'{key} = {one_of(rng, CALLER[key])}' for key in keys)}}}"


def _number(rng: Generator, key: Key, default: float) -> str:
    """Draw an odd number in place of another."""
    if isinstance(default, int) and key != ("seed",):
        return one_of(rng, COUNTS)
    scaled = repr(float(default) * one_of(rng, FACTORS))
    return one_of(rng, [one_of(rng, NUMBERS), scaled])


def toml(values: dict[Key, str], above: str = "") -> str:
    """Lay settings out as a file, a dotted line each."""
    return "".join(f"{above}{'.'.join(key)} = {value}\n" for key, value in values.items())


def flags(odd: Odd) -> list[str]:
    """Give a setting as a flag."""
    if odd.key in (CALLERS, OWN):
        return [f"--{odd.key[0]}", odd.value]
    words = odd.value.strip("[]").replace(",", " ").split() if odd.value[:1] == "[" else [odd.value]
    words = [word.strip("'\"") for word in words]
    return ["--" + ".".join(odd.key).replace("_", "-"), *words]


def variable(odd: Odd) -> tuple[str, str]:
    """Give a setting as a variable of the environment."""
    return "PIPISTRELLE_" + "__".join(odd.key).upper(), odd.value


def spellings(key: Key) -> list[str]:
    """Return how a refusal may name a setting."""
    dotted = ".".join(key)
    return [dotted, dotted.replace("_", "-"), variable(Odd(key, ""))[0], f"--{key[-1]}"]


# A try


@dataclass(frozen=True, slots=True, kw_only=True)
class Given:
    """What a command line is given: words, files, variables."""

    told: tuple[str, ...] = ()
    words: tuple[str, ...] = ()
    settings: tuple[tuple[Key, str], ...] = tuple(TINY.items())
    variables: tuple[tuple[str, str], ...] = ()
    names: tuple[str, ...] = ()

    def with_odd(self, rng: Generator, odd: Odd) -> "Given":
        """Give one setting more, somewhere."""
        place = one_of(rng, ["file", "flag", "variable", "file"])
        rest = tuple(pair for pair in self.settings if pair[0] != odd.key)
        there = replace(
            self,
            told=(*self.told, f"{place}: {odd}"),
            names=(*self.names, *spellings(odd.key)),
            settings=rest,
        )
        if place == "file":
            return replace(there, settings=(*rest, (odd.key, odd.value)))
        if place == "variable" and "\0" not in odd.value and len(odd.value) < 100_000:
            return replace(there, variables=(*self.variables, variable(odd)))
        left_over = tuple(f"{verb}: found {word!r}" for verb in VERBS for word in flags(odd))
        return replace(there, words=(*self.words, *flags(odd)), names=(*there.names, *left_over))


def attempt(rng: Generator, place: Path, _: None) -> Tried:
    """Give odd settings to a command."""
    way = one_of(rng, [_run, _run, _run, _run, _plan, _plan, _plan, _spoiled_plan, _slam])
    given = Given()
    for _ in range(one_of(rng, [1, 1, 2])):
        given = given.with_odd(rng, odd_setting(rng))
    return way(rng, place, given)


def _obey(rng: Generator, place: Path, given: Given, *words: str) -> Ending:
    """Obey a command line with what is given."""

    def before() -> None:
        os.environ.update(given.variables)
        if not drawn:
            undrawn()

    drawn = rng.random() < DRAWN
    return command(place, *words, *given.words, "--quiet", "-o", "out", before=before)


def _run(rng: Generator, place: Path, given: Given) -> Tried:
    """Drive through a tiny world."""
    if rng.random() < 0.15:
        name = one_of(rng, [*SHORT])
        value = one_of(rng, COUNTS if isinstance(SHORT[name], int) else (*NUMBERS, *WORDS[:9]))
        words = (*given.words, f"--{name}={value}")
        names = (*given.names, f"--{name}", f"{name}: ")
        told = (*given.told, f"--{name}={short(value)}")
        given = replace(given, words=words, names=names, told=told)
    (place / "odd.toml").write_text(toml(dict(given.settings)))
    before = contents(place)
    manner = ("--strategy", one_of(rng, ["all", "fused", "passive"]))
    manner += ("--filter", one_of(rng, ["ekf", "fastslam", "both"]))
    ending = _obey(rng, place, given, "run", "--config", "odd.toml", *manner)
    return _judged(place, given, ending, before)


def _slam(rng: Generator, place: Path, given: Given) -> Tried:
    """Solve a sound log."""
    shutil.copytree(DATA / "unicycle_log", place / "log")
    (place / "odd.toml").write_text(toml(dict(given.settings)))
    before = contents(place)
    manner = ("--filter", one_of(rng, ["ekf", "fastslam"]))
    ending = _obey(rng, place, given, "slam", "log", "--config", "odd.toml", *manner)
    return _judged(place, given, ending, before)


def _judged(place: Path, given: Given, ending: Ending, before: dict[str, Any]) -> Tried:
    """Judge a mission."""
    faults = faults_of(ending, (*given.names, *KNOWN, "odd.toml: "))
    faults += lost(before, contents(place), "a file of settings")
    if ending.how == "returned":
        faults += unsound_results(place / "out", ending.found)
    return Tried(told=given.told, endings=(ending,), faults=tuple(faults))


# Plans


def plan_text(rng: Generator, given: Given) -> tuple[tuple[str, ...], str]:
    """Lay a plan out, odd settings in its grid perhaps, or an odd key of its own."""
    told, head, settings, grid = [], dict(HEAD), dict(given.settings), {}
    odd = [key for key in settings if settings[key] != TINY.get(key)]
    for key in odd if rng.random() < 0.5 else []:
        value, other = settings.pop(key), repr(known_settings()[key].default).replace("(", "[")
        values = one_of(rng, [[value], [value, other], [value, value], [value, *VALUES[-9:-7]]])
        grid[key] = f"[{', '.join(values)}]".replace(")", "]")
        told.append(f"grid: {'.'.join(key)} = {short(grid[key])}")
    if rng.random() < 0.4:
        name = one_of(rng, [*HEADS])
        head[name] = one_of(rng, HEADS[name])
        told.append(f"{name} = {short(head[name])}")
    quoted = {(f'"{".".join(key)}"',): value for key, value in grid.items()}
    text = toml({(name,): value for name, value in head.items()})
    return tuple(told), f"{text}[config]\n{toml(settings)}[grid]\n{toml(quoted)}"


def _plan(rng: Generator, place: Path, given: Given) -> Tried:
    """Study a plan of odd settings."""
    told, text = plan_text(rng, given)
    return _studied(rng, place, replace(given, told=given.told + told), text.encode())


def _spoiled_plan(rng: Generator, place: Path, _: Given) -> Tried:
    """Study a plan that was sound, and is spoiled."""
    _, text = plan_text(rng, Given())
    what, data = spoiled(rng, "plan.toml", text.encode())
    return _studied(rng, place, Given(told=(what,)), data)


def _studied(rng: Generator, place: Path, given: Given, data: bytes) -> Tried:
    """Study a plan."""
    (place / "plan.toml").write_bytes(data)
    if _takes_long(data):
        data = b"iterations = 0\n"
        (place / "plan.toml").write_bytes(data)
    before = contents(place)
    ending = _obey(rng, place, given, "study", "plan.toml", "--workers", "1")
    faults = faults_of(ending, (*given.names, *KNOWN, "plan.toml: ", "filter "))
    faults += lost(before, contents(place), "a plan")
    if ending.found == 2 and (place / "out").exists():
        faults.append("study: refused, and leaves a folder behind")
    if ending.how == "returned" and list(place.rglob("*.partial")):
        faults.append("study: leaves a partial file behind")
    return Tried(told=given.told, endings=(ending,), faults=tuple(faults))


def _takes_long(data: bytes) -> bool:
    """Tell whether a plan rightly asks for more than a moment's work."""
    try:
        table = tomllib.loads(data.decode())
    except (ValueError, RecursionError):
        return False
    scenario = table.get("config", {})
    scenario = scenario.get("scenario", {}) if isinstance(scenario, dict) else {}
    asked = [table.get("iterations"), *(scenario.values() if isinstance(scenario, dict) else ())]
    return any(isinstance(number, int) and 20 < number < 2**31 for number in asked)


def prepare(_: Path) -> None:
    """Need nothing."""
