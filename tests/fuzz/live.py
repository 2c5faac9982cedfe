"""Odd calls of `Slam`: steps, scans, files and copies of a vehicle that drives now."""

import os
import warnings
from collections.abc import Iterator
from dataclasses import replace
from hashlib import sha256
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.random import Generator

from fuzz.judging import Tried, kind_of
from fuzz.mutations import BYTES, one_of
from fuzz.running import end_of
from fuzz.steps import NUMBERS_ODD, WHOLES_ODD, spoiled, strange
from pipistrelle import InputError, Slam
from pipistrelle.estimation.catalogue import CATALOGUE
from pipistrelle.scripting.saved_state import HEAD

ODD = 0.4
"""Share of the calls that are handed something odd."""
SENSOR = {"range_std": 0.1, "bearing_std": 0.02, "range_bounds": [0.5, 20.0]}
WHEELS = {"speed_std": 0.1, "steering_std": 0.03, "wheelbase": 0.2}
WAYS = {"forward_std": 0.05, "sideways_std": 0.03, "turn_std": 0.02}
MOTIONS: tuple[dict[str, Any], ...] = (
    {"motion": "unicycle", "velocity_std": 0.1, "angular_rate_std": 0.15},
    {"motion": "bicycle"} | WHEELS,
    {"motion": "ackermann", "speed_offset": 0.05} | WHEELS,
    {"motion": "poses"} | WAYS,
)
CALLERS: tuple[list[dict[str, Any]], ...] = (
    [],
    [{"name": "bat", "landmark": 3}, {"name": "boat", "landmark": 4}],
    [{"name": "bat", "landmark": 3, "place": [5.0, 1.0]}],
    [{"name": "bat", "landmark": 3, "moves": True}],
)
OPTIONS: tuple[dict[str, Any], ...] = (
    {},
    {"kept": 3, "filter__gate": 0.99},
    {"association__method": "marginal"},
    {"association__method": "nearest", "settings": "best"},
    {"filter__robust": "huber", "time": 100.0},
)
PAIRS = [
    (callers, options)
    for callers, options in product(CALLERS, OPTIONS)
    if "association__method" not in options or not any("moves" in one for one in callers)
]
"""Callers that move are not followed without labels."""
PLACES = np.random.default_rng(0).uniform(-9.0, 9.0, (17, 2))
"""Of the landmarks, by label [m]."""
STRANGERS = (None, "", "ekf ", b"ekf", 3, np.nan, [], {}, dict, ["a", 1], np.array(3))
"""What may stand for a word, and is none."""
SWARM = {"fastslam": {"particles": 20}}


class Call(NamedTuple):
    """A call of a method."""

    verb: str
    given: tuple[Any, ...]
    named: dict[str, Any]
    odd: bool = False
    misnamed: bool = False
    """Whether Python itself refuses the call."""


def numbers_of(slam: Slam) -> list[bytes | str]:
    """Return all that a vehicle answers, as bytes."""
    tables = slam.path, slam.map, slam.moving
    return [
        *(repr(table.rows()) for table in tables),
        repr(slam),
        np.array(slam.pose[:4]).tobytes(),
        slam.pose.covariance.tobytes(),
    ]


def unsound_numbers(slam: Slam) -> Iterator[str]:
    """Name the answers that are not finite."""
    for name, table in (("path", slam.path), ("map", slam.map), ("moving", slam.moving)):
        for column in table.select(one for one in table.columns if one != "status"):
            if not np.isfinite(column.to_numpy()).all():
                yield f"{name}: {column.name} is not finite"
    if not (np.isfinite(slam.pose[:4]).all() and np.isfinite(slam.pose.covariance).all()):
        yield "pose: is not finite"


def sound_move(rng: Generator, slam: Slam) -> Call:
    """Draw a step or some."""
    k, motion = int(rng.integers(1, 4)), slam._log.motion
    controls = rng.normal(0.2, 0.2, (k, 3 if motion == "poses" else 2))
    if motion == "poses" and rng.random() < 0.5:
        said = np.array([1e-4, 0.0, 0.0, 1e-4, 0.0, 1e-4]) * rng.random((k, 1))
        controls = np.hstack([controls, said])
    dt = rng.uniform(0.05, 0.5, k)
    if rng.random() < 0.5:
        return Call("move", (controls,), {"time": slam.time + np.cumsum(dt)})
    return Call("move", (controls, dt), {})


def sound_hear(rng: Generator, slam: Slam) -> Call:
    """Draw the rows of a scan, of echoes of one's own call and of others', perhaps timed."""
    m, names = int(rng.integers(0, 8)), [caller.name for caller in slam._log.callers]
    caller = np.array([None, *names])[rng.integers(0, 1 + len(names), m)]
    own = np.array([name is None for name in caller], dtype=bool)
    label = 5 + rng.permutation(12)[:m]
    where, at = PLACES[label].T, slam.pose
    bearing = np.arctan2(where[1] - at.y, where[0] - at.x) - at.heading
    far = np.where(own & (rng.random(m) < 0.7), np.hypot(where[0] - at.x, where[1] - at.y), np.nan)
    columns = {"landmark": label, "bearing": bearing, "range": far}
    if names:
        excess = np.where(~own & (rng.random(m) < 0.7), rng.uniform(0.5, 9.0, m), np.nan)
        columns |= {"caller": caller.tolist(), "excess_path": excess}
    for name in ("bearing_std", "range_std", "excess_path_std"):
        if rng.random() < 0.2:
            columns[name] = 10.0 ** rng.uniform(-3, 0, m)
    if slam._session._association is not None and rng.random() < 0.8:
        del columns["landmark"]
    return Call("hear", (), columns | ({"time": slam.time} if rng.random() < 0.3 else {}))


def odd_move(rng: Generator, slam: Slam) -> Call:
    """Draw a step that is odd."""
    (controls, *_), _ = sound_move(rng, slam)[1:3]
    k, now = len(controls), slam.time
    ends = now + 0.1 * np.arange(1, k + 1)
    number = one_of(rng, NUMBERS_ODD)
    return one_of(
        rng,
        [
            lambda: Call("move", (spoiled(rng, controls), 0.1), {}),
            lambda: Call("move", (spoiled(rng, controls),), {"time": ends}),
            lambda: Call("move", (controls, spoiled(rng, ends - now)), {}),
            lambda: Call("move", (controls,), {"time": spoiled(rng, ends)}),
            lambda: Call("move", (controls[0], number), {}),
            lambda: Call("move", (controls[0],), {"time": now + number}),
            lambda: Call("move", (controls,), {"time": ends - 0.1 * k}),
            lambda: Call("move", (controls[:0], ends[:0]), {}),
            lambda: Call("move", ([], []), {}),
            lambda: Call("move", (controls,), {"time": ends[::-1]}),
            lambda: Call("move", (controls,), {}),
            lambda: Call("move", (controls, ends - now), {"time": ends}),
            lambda: Call("move", (), {}, misnamed=True),
            lambda: Call("move", (controls, 0.1), {"speed": 1.0}, misnamed=True),
        ],
    )()


def odd_hear(rng: Generator, slam: Slam) -> Call:
    """Draw a scan of which a column is odd."""
    columns = sound_hear(rng, slam).named
    arrays = [name for name in columns if name not in ("time", "caller")]
    name = one_of(rng, arrays)
    values = np.asarray(columns[name])
    odd = WHOLES_ODD if values.dtype.kind == "i" else NUMBERS_ODD
    strangers = ["bird", b"bat", 0, 1, np.nan, ["bat"], {"bat": 1}, object(), "bat\0", None]
    return one_of(
        rng,
        [
            lambda: Call("hear", (), columns | {name: spoiled(rng, values)}),
            lambda: Call("hear", (), columns | {name: np.full(values.shape, one_of(rng, odd))}),
            lambda: Call("hear", (), columns | {name: strange(rng, values)}),
            lambda: Call("hear", (), {one: columns[one] for one in columns if one != name}),
            lambda: Call("hear", (), {one: _twice(columns[one]) for one in columns}),
            lambda: Call("hear", (), columns | {"caller": [one_of(rng, strangers)] * len(values)}),
            lambda: Call("hear", (), columns | {"caller": one_of(rng, strangers)}),
            lambda: Call("hear", (), columns | {"time": one_of(rng, [*NUMBERS_ODD, "now", [1.0]])}),
            lambda: Call("hear", (), columns | {one_of(rng, ["bearings", "", "x y"]): values}),
            lambda: Call("hear", (), columns | {"bearing_slope": spoiled(rng, 1.0 * values)}),
            lambda: Call("hear", (), columns | {"level_db": spoiled(rng, 1.0 * values)}),
            lambda: Call("hear", (columns,), {}, misnamed=True),
        ],
    )()


def _twice(values: Any) -> Any:
    """Repeat the rows of a column."""
    return values if np.ndim(values) == 0 else [*values, *values]


def odd_save(rng: Generator, _: Slam) -> Call:
    """Draw a place where nothing can be saved."""
    places = ["folder", "foreign.txt", "pipe", "no/such/place", "", ".", "..", "link", "x" * 5000]
    others = ["a\0b", None, 3, b"bytes", [], Path("folder"), np.nan, "foreign.txt/in", "/proc/x"]
    return Call("save", (one_of(rng, [*places, *others]),), {})


def odd_load(rng: Generator, slam: Slam) -> Call:
    """Draw a file that is no saved drive, or one that has been changed."""
    if rng.random() < 0.3:
        return Call("load", odd_save(rng, slam).given, {})
    whole = slam.save("whole.slam").read_bytes()
    if rng.random() < 0.5:
        _, data = one_of(rng, BYTES)(rng, whole)
    else:  # with the right sum
        _, _, body = whole[len(HEAD) :].partition(b"\n")
        line, _, known = body.partition(b"\n")
        parts = [one_of(rng, BYTES)(rng, line)[1], known]
        if rng.random() < 0.5:
            parts = [line, one_of(rng, BYTES)(rng, known)[1]]
        body = b"\n".join(parts)
        data = HEAD + sha256(body).hexdigest().encode() + b"\n" + body
    Path("spoiled.slam").write_bytes(data)
    named = {"filter": one_of(rng, ["ekf", "no", "a:b", 3, dict])} if rng.random() < 0.2 else {}
    return Call("load", ("spoiled.slam",), named)


def called(slam: Slam, call: Call) -> Any:
    """Make a call."""
    return getattr(slam, call.verb)(*call.given, **call.named)


def begun(rng: Generator, faults: list[str]) -> tuple[Slam | None, bool]:
    """Make a vehicle, or None where it was odd, and refused; tell whether it is sound."""
    callers, options = one_of(rng, PAIRS)
    robot = one_of(rng, MOTIONS) | SENSOR | {"callers": callers}
    options = SWARM | options | {"filter": one_of(rng, [*CATALOGUE])}
    if rng.random() < 0.2:
        robot["sensor_pose"] = [0.4, -0.1, 0.3]
    odd = rng.random() < ODD / 4.0
    if odd:
        where = one_of(rng, [robot, options])
        key = one_of(rng, [*where, "strange", "kept", "time"])
        values = np.asarray(where.get(key, 1.0))
        where[key] = spoiled(rng, values) if values.dtype.kind in "fi" else one_of(rng, STRANGERS)
    print("Slam", robot, options, flush=True)
    try:
        return Slam(robot, **options), not odd
    except InputError as error:
        if not odd:
            faults.append(f"Slam: refuses what is sound: {kind_of(str(error))}")
    return None, False


def obey(rng: Generator) -> list[str]:
    """Make calls of a vehicle, and name the faults."""
    faults: list[str] = []
    Path("folder").mkdir()
    Path("foreign.txt").write_text("mine")
    os.mkfifo("pipe")
    Path("link").symlink_to("foreign.txt")
    slam, sound = begun(rng, faults)
    for _ in range(int(rng.integers(3, 12)) if slam else 0):
        assert slam is not None
        call = one_of(rng, [sound_move, sound_move if slam._heard else sound_hear])(rng, slam)
        if odd := rng.random() < ODD:
            call = one_of(rng, [odd_move, odd_hear, odd_hear, odd_save, odd_load])(rng, slam)
        print(f"{call.verb}({call.given}, {call.named})", flush=True)
        before, twin = numbers_of(slam), slam.copy()
        try:
            found = called(slam, call)
        except (InputError, TypeError) as error:
            if isinstance(error, TypeError) and not call.misnamed:
                raise
            if not odd and sound:
                faults.append(f"{call.verb}: refuses what is sound: {kind_of(str(error))}")
            if numbers_of(slam) != before or not same_after(rng, slam, twin):
                faults.append(f"{call.verb}: a refusal changes the vehicle")
            continue
        sound = sound and not odd
        if numbers_of(twin) != before:
            faults.append(f"{call.verb}: changes a copy")
        if call.verb == "save":
            found = Slam.load(found)
            if numbers_of(found) != before:
                faults.append("save: is not what is loaded")
        faults += [f"{call.verb}: {one}" for one in unsound_numbers(slam)]
        if not unharmed(slam, found):
            faults.append("an answer that is written to changes the vehicle")
    if Path("foreign.txt").read_text() != "mine":
        faults.append("a file of somebody's is changed")
    return faults


def same_after(rng: Generator, slam: Slam, twin: Slam) -> bool:
    """Drive on both a vehicle and its copy; tell whether they find the same."""
    for draw in (sound_move, sound_hear):
        call, ends = draw(rng, twin), []
        for one in (slam, twin):
            try:
                called(one, call)
                ends.append("")
            except InputError as error:
                ends.append(str(error))
        if ends[0] != ends[1] or numbers_of(slam) != numbers_of(twin):
            return False
    return True


def unharmed(slam: Slam, found: Any) -> bool:
    """Write into what a vehicle handed out; tell whether it stays as it is."""
    before = numbers_of(slam)
    for handed in (slam.pose.covariance, found):
        if isinstance(handed, np.ndarray) and handed.flags.writeable:
            handed[...] = 7
    return numbers_of(slam) == before


def watched(rng: Generator) -> list[str]:
    """Make calls of a vehicle, and name the faults and what Python or numpy warns of."""
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        warnings.filterwarnings("ignore", "Warning: converting a masked element")  # numpy's word
        warnings.filterwarnings("ignore", module=r".*fuzz\.(steps|live)")
        faults = obey(rng)
    return faults + [
        f"{one.category.__name__} in {Path(one.filename).name}: {kind_of(str(one.message))}"
        for one in said
    ]


def attempt(rng: Generator, place: Path, _: None) -> Tried:
    """Drive a vehicle now and then by something odd, in a child."""
    ending = end_of(lambda: watched(rng), place, ("live",))
    faults = tuple(ending.found) if ending.how == "returned" else (_fault_of(ending.said),)
    ending = replace(ending, found=len(faults))
    return Tried(told=(), endings=(ending,), faults=faults)


def _fault_of(said: str) -> str:
    """Name what ended a child, by the last line of ours."""
    lines = said.strip().splitlines() or [""]
    ours = [line.split("/pipistrelle/")[-1] for line in lines if "/pipistrelle/" in line]
    return f"{kind_of(lines[-1])} in {kind_of((ours or ['no code of ours'])[-1])}"


def prepare(_: Path) -> None:
    """Compile what sound calls need, which would take longer than a child may."""
    rng = np.random.default_rng(0)
    for name, motion, (callers, options) in product(CATALOGUE, MOTIONS, PAIRS):
        slam = Slam(motion | SENSOR | {"callers": callers}, **SWARM | options, filter=name)
        for draw in (sound_move, sound_hear) * 3:
            called(slam, draw(rng, slam))
