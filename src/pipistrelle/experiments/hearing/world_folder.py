"""World folders: the known parts of a world as text files, read and written.

``world.toml`` holds settings and callers, ``landmarks.csv`` the landmarks, ``path.csv`` the course
of the vehicle. Each is optional; the content of a missing file is drawn. Errors name the file and
its line or key.
"""

import os
from difflib import get_close_matches
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float
from pydantic import ConfigDict, Field, ValidationError

from pipistrelle.acoustics.call import settings_of
from pipistrelle.acoustics.emitter import SHAPES, Bodies
from pipistrelle.acoustics.paths import VEHICLE, moves
from pipistrelle.config import CallerConfig, Config, InputError, Section, TargetConfig
from pipistrelle.estimation.catalogue import SECTIONS
from pipistrelle.experiments.hearing.caller_paths import routes_read
from pipistrelle.experiments.hearing.scenario import Scenario, World
from pipistrelle.experiments.hearing.trajectories import Commands, Course, Poses, steps_of
from pipistrelle.files import read_file, read_text, shipped_text
from pipistrelle.refusals import refusal, shown, table_refusal
from pipistrelle.settings import (
    CALLERS,
    OWN,
    SETTINGS,
    WORLD_KEY,
    Given,
    Key,
    Layer,
    beside,
    from_table,
    parse_toml,
    resolve,
)
from pipistrelle.text_tables import (
    Schema,
    Table,
    check_unique,
    fields_in,
    place_of,
    points_of,
    read_table,
    table_text,
)

_COUNT: Key = ("scenario", "landmarks")
_STEPS: Key = ("scenario", "steps")
LANDMARKS = Schema(
    file="landmarks.csv",
    row="a row is a landmark; numbered from 1 in any order",
    columns=("landmark", "x", "y"),
    optional=("radius", "shape"),
)
_CONTROLS = {"bicycle": ("speed", "steering"), "unicycle": ("velocity", "angular_rate")}
_POSE = ("time", "x", "y", "heading")
COURSES = {
    ("x", "y"): "way-points",
    _POSE: "poses",
    **{("time", *names): "controls" for names in _CONTROLS.values()},
    **{(*_POSE, *names): "poses and controls" for names in _CONTROLS.values()},
}
"""Kind of a course by the columns of ``path.csv``."""
FILES = ("world.toml", LANDMARKS.file, "path.csv")
"""Files of a world, besides the routes of its callers."""


class _WorldTable(Section):
    model_config = ConfigDict(strict=True)

    format: Literal[1]
    config: dict[str, Any] = Field(default_factory=dict)
    callers: Any = None


def named_world(layer: Layer) -> World | None:
    """Read the folder of the world that the settings name; None if they name none."""
    given = layer.get(WORLD_KEY)
    return None if given is None or given.value is None else read_world(Path(str(given.value)))


def with_world(world: World, layer: Layer) -> Layer:
    """Merge a world's settings under the given settings; add its numbers of landmarks and steps."""
    beneath = world.settings | _decided(world, layer) | layer
    if world.course is not None and _STEPS not in beneath:
        steps = steps_of(world.course, resolve(beneath).scenario)
        beneath[_STEPS] = Given(steps, f"{world.name}: path.csv")
    return beneath


def laid_over(world: World, layer: Layer, values: Layer) -> Layer:
    """Merge settings of a plan, a world in its grid and other grid values, in rising priority.

    `values` are the settings of the rest of the grid. The drive ends with the world's course if
    that is shorter.
    """
    over = layer | world.settings | _decided(world, values) | values
    if world.callers is not None and CALLERS not in values:
        over.pop(CALLERS, None)
    if isinstance(world.course, Commands | Poses):
        setup = resolve(over).scenario
        steps = min(setup.steps, steps_of(world.course, setup))
        over[_STEPS] = Given(steps, f"{world.name}: path.csv")
    return over


def _decided(world: World, layer: Layer) -> Layer:
    """Return the number of landmarks that a world's file fixes; raise if `layer` contradicts it."""
    if world.landmarks is None:
        return {}
    count, given = len(world.landmarks), layer.get(_COUNT)
    if given is not None and given.value != count:
        but = f"but the world's landmarks.csv has {count}; leave it out"
        raise InputError(f"{given.where}: found {shown(given.value)}, {but}")
    return {_COUNT: Given(count, f"{world.name}: landmarks.csv")}


def read_world(folder: Path) -> World:
    r"""Read a world from the files in a folder (landmarks, path, callers, settings).

    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as place:
    ...     _ = (Path(place) / "landmarks.csv").write_text("landmark,x,y\n1,2.5,0\n2,-1,4\n")
    ...     _ = (Path(place) / "path.csv").write_text("x,y\n-5,0\n5,0\n5,5\n")
    ...     world = read_world(Path(place))
    >>> world.landmarks[1], world.course.shape, world.callers
    (array([-1.,  4.]), (3, 2), None)
    """
    if not folder.is_dir():
        found = "a file" if folder.exists() else "no such folder"
        expected, fix = f"a folder with {', '.join(FILES)}", "name a world's (scenario.world)"
        raise refusal(folder, found, expected, fix)
    there = [name for name in FILES if os.path.lexists(folder / name)]
    raw = {"format": 1}
    if "world.toml" in there:
        raw = parse_toml(read_text(folder / "world.toml"), folder / "world.toml")
    try:
        table = _WorldTable.model_validate(raw)
    except ValidationError as error:
        raise table_refusal(folder / "world.toml", error, _WorldTable, "format") from None
    callers, routes = _callers(folder / "world.toml", table.callers)
    missing = [name for name in FILES if name not in (*there, *routes)]
    for path in sorted(folder.iterdir()):
        near = get_close_matches(path.name.lower(), missing, n=1, cutoff=0.85)
        if near and path.name not in (*FILES, *there, *routes):
            raise refusal(folder, f"{path.name!r}", repr(near[0]), "rename it")
    if not there:
        expected = f"one of {', '.join(FILES)}, or several"
        raise refusal(folder, "none of its files", expected, "see `pipistrelle run --save-world`")
    settings = from_table(table.config, f"{folder / 'world.toml'}: ", "config.")
    if WORLD_KEY in settings:
        raise InputError(f"{settings[WORLD_KEY].where}: a world has no other world; take it out")
    if CALLERS in settings:
        fix = "take out config."
        raise InputError(f"{settings[CALLERS].where}: a world's callers are [[callers]]; {fix}")
    landmarks = bodies = course = None
    config = resolve(settings)
    if "landmarks.csv" in there:
        landmarks, bodies = _read_landmarks(folder / "landmarks.csv", config.target)
    if "path.csv" in there:
        course = _read_course(folder / "path.csv", config)
    return World(
        name=folder.resolve().name,
        landmarks=landmarks,
        bodies=bodies,
        course=course,
        callers=callers,
        settings=settings,
        files={name: read_file(folder / name) for name in dict.fromkeys([*there, *routes])},
    )


def kept_world(config: Config, world: World) -> tuple[Config, dict[str, bytes]]:
    """Return settings that name a result folder's copy of a world, and the files of the copy."""
    place = f"worlds/{world.name}"
    scenario = config.scenario.model_copy(update={"world": place})
    files = {f"{place}/{name}": content for name, content in world.files.items()}
    return config.model_copy(update={"scenario": scenario}), files


def world_files(scenario: Scenario, config: Config) -> dict[str, str]:
    """Return the text files of a random world, by name, to edit or to simulate again."""
    import tomli_w

    names = _CONTROLS[config.motion.model]
    controls = np.vstack((scenario.controls, np.zeros(2)))
    columns = (scenario.time, *scenario.path.T, *controls.T)
    path = Schema(file="path.csv", row="the vehicle's path", columns=(*_POSE, *names))
    numbers = np.arange(1, len(scenario.landmarks) + 1)
    landmarks = {"landmark": numbers} | dict(zip("xy", scenario.landmarks.T, strict=True))
    if (bodies := scenario.bodies) is not None:
        landmarks |= {"radius": bodies.radius, "shape": bodies.shape}
    files = {
        "README.md": shipped_text("experiments/hearing/world_readme.md")
        + "\n".join((LANDMARKS.readme([*landmarks]), path.readme())),
        LANDMARKS.file: table_text(landmarks),
        path.file: table_text(dict(zip(path.columns, columns, strict=True))),
    }
    callers = []
    for caller in scenario.callers[VEHICLE + 1 :]:
        row = {"name": caller.name, "frequency": caller.frequency, "level_db": caller.level_db}
        row |= settings_of(caller.sound)
        if moves(caller):
            row["route"] = f"caller_{caller.name}.csv"
            heading = () if caller.heading is None else (caller.heading,)
            route = (scenario.time, *np.asarray(caller.place).T, *heading)
            files[row["route"]] = table_text(dict(zip(_POSE, route, strict=False)))
        else:
            row["place"] = np.asarray(caller.place).tolist()
        if caller.calls is not None:
            row["times"] = caller.calls.tolist()
        callers.append(row)
    vehicle = scenario.callers[VEHICLE]
    call = {"frequency": vehicle.frequency, "level_db": vehicle.level_db}
    call |= settings_of(vehicle.sound)
    emitter = config.emitter.model_copy(update=call)
    own = _own_settings(config.model_copy(update={"emitter": emitter}))
    head = {"format": 1, "config": own, "callers": callers}
    return files | {"world.toml": tomli_w.dumps(head)}


def _own_settings(config: Config) -> dict[str, Any]:
    """Return the non-default settings that describe a world, as nested tables."""
    decides = {"world", "landmarks", "steps", "vehicle"}
    others = {"seed", "bag", *SETTINGS, *OWN, *CALLERS, *SECTIONS}
    said = config.model_dump(mode="json", exclude_defaults=True, exclude=others)
    return {
        section: kept
        for section, values in said.items()
        if (kept := {k: v for k, v in values.items() if section != "scenario" or k not in decides})
    }


def _read_landmarks(
    path: Path, usual: TargetConfig
) -> tuple[Float[np.ndarray, "n 2"], Bodies | None]:
    """Read landmark positions, and bodies (radius, shape) if the file has them."""
    header, *rows = fields_in(path) or [(0, [])]
    if not rows and {*LANDMARKS.columns} <= {*header[1]} <= {
        *LANDMARKS.columns,
        *LANDMARKS.optional,
    }:
        return np.empty((0, 2)), None  # the header alone: a world without landmarks
    table = LANDMARKS.read(path, words={"shape": tuple(SHAPES)})
    check_unique(table, "landmark")
    check_unique(table, "x", "y")
    label, count = table.column["landmark"], len(table.line)
    wrong = (label < 1) | (label > count)
    if wrong.any():
        row = int(np.argmax(wrong))
        expected, fix = f"the numbers 1 to {count}", "number the landmarks from 1 on"
        raise refusal(place_of(table, row), f"landmark {label[row]}", expected, fix)
    order = np.argsort(label)
    radius, shape = (table.column[name][order] for name in LANDMARKS.optional)
    stated = not np.isnan(radius).all() or (shape != "").any()
    bodies = Bodies(radius=radius, shape=np.where(shape == "", usual.shape, shape))
    return points_of(table)[order], bodies if stated else None


def _read_course(path: Path, config: Config) -> Course:
    """Read the vehicle's course from a table; the columns decide its kind (`COURSES`)."""
    model, controls = config.motion.model, _CONTROLS[config.motion.model]
    others = {name for names in _CONTROLS.values() for name in names} - {*controls}
    line, fields = next(iter(fields_in(path)), (1, [""]))
    columns, header = tuple(fields), ",".join(fields)
    known = {names: kind for names, kind in COURSES.items() if others.isdisjoint(names)}
    if columns not in known:
        fix = f"or set motion.model: it is {model!r}" if columns in COURSES else "name them so"
        expected = " or ".join(f"{','.join(names)!r} ({kind})" for names, kind in known.items())
        raise refusal(f"{path}, line {line}", f"{header[:80]!r}", expected, fix)
    table = read_table(path, columns)
    column = table.column
    if "time" not in columns:
        return _waypoints(table)
    if len(table.line) < 2:
        raise refusal(path, "one row", "at least two: the last ends the drive", "add rows")
    check_unique(table, "time")
    time = column["time"] - column["time"][0]
    commands = None
    if {*controls} <= {*columns}:
        commands = Commands(time=time, rows=np.column_stack([column[name] for name in controls]))
    if "heading" not in columns:
        assert commands is not None
        return commands
    poses = np.column_stack([column[name] for name in _POSE[1:]])
    return Poses(time=time, path=poses, commands=commands)


def _waypoints(table: Table) -> Float[np.ndarray, "n 2"]:
    """Return the way-points of a table; raise for fewer than two or equal successive points."""
    points = points_of(table)
    if len(points) < 2:
        raise refusal(table.path, "one way-point", "at least two", "add rows")
    same = ~np.diff(points, axis=0).any(axis=1)
    if same.any():
        where, found = place_of(table, int(np.argmax(same)) + 1), "the way-point before it again"
        raise refusal(where, found, "another", "remove the row")
    return points


def _callers(path: Path, tables: Any) -> tuple[tuple[CallerConfig, ...] | None, list[str]]:
    """Validate the callers of a world's file; return them and the names of their route files."""
    if tables is None:
        return None, []
    files = []
    for number, one in enumerate(tables if isinstance(tables, list) else (), start=1):
        route = one.get("route") if isinstance(one, dict) else None
        if isinstance(route, str):
            if Path(route).name != route:
                expected = "the name of a file in the world's folder"
                where = f"{path}: callers.{number}.route"
                raise refusal(where, shown(route), expected, "put it there")
            files.append(route)
    where = f"{path}: callers"
    given = Given(routes_read(beside(path, tables), where), where)
    return resolve({CALLERS: given}).callers, files
