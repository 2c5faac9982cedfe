"""Study plans: the varied settings and the resulting cases, read from and written to TOML.

The cases are the product of the grid, the strategies and the filters. A passive case does not
depend on the vehicle's beam, so all radii share a single passive case.

A grid may vary `beamwidth` [deg] instead of `emitter.radius` [m]. It is converted to the radius of
the piston with that beamwidth, so both forms describe the same study.
"""

import json
import re
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from decimal import ROUND_FLOOR, Context
from functools import partial
from hashlib import sha256
from importlib.resources import files
from itertools import product
from math import isfinite, prod, radians
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any, Literal, cast

from pydantic import AfterValidator, Field, ValidationError

from pipistrelle.acoustics.call import with_calls
from pipistrelle.arrays.layout import with_array
from pipistrelle.config import STRATEGIES, Config, InputError, Section, Strategy
from pipistrelle.estimation.catalogue import CATALOGUE, PAPERS, check_distinct, names_class
from pipistrelle.experiments.hearing.caller_paths import with_routes
from pipistrelle.experiments.hearing.scenario import ALL_DRAWN, World
from pipistrelle.experiments.hearing.world_folder import (
    laid_over,
    named_world,
    read_world,
    with_world,
)
from pipistrelle.experiments.named_settings import (
    PLANS,
    Case,
    check_own,
    laid,
    over_named,
    parted,
    with_settings,
)
from pipistrelle.files import check_ordinary, text_of
from pipistrelle.refusals import refusal, shown, table_refusal
from pipistrelle.settings import (
    ARRAY_KEY,
    CALLERS,
    OWN,
    RADIUS_KEY,
    SETTINGS,
    WORLD_KEY,
    Given,
    Key,
    Layer,
    derived,
    from_flags,
    from_table,
    known_settings,
    leaves,
    read_toml,
    resolve,
    spread,
    with_places,
)

RADIUS, WORLD = ".".join(RADIUS_KEY), ".".join(WORLD_KEY)
MOST_CASES = 2**15 - 1
"""Largest number of cases; case numbers are 16-bit in the tables."""
MOST_WORLDS = 1_000_000
"""Largest number of worlds; each is a file per table."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Plan:
    """A study's settings, varied values, strategies, filters and number of worlds."""

    name: str
    iterations: int
    strategies: tuple[Strategy, ...]
    filters: tuple[str, ...]
    config: Config
    """Settings of every case, unless the grid overrides them."""
    grid: Mapping[str, tuple[Any, ...]]
    """Values of each varied setting, by dotted name."""
    own: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    """Settings for single filters, by filter and dotted name; they do not change the simulated
    measurements."""
    worlds: Mapping[str, World] = field(default_factory=dict)
    """World folders, by their names in ``scenario.world``."""
    planned: int = 0
    """Number of worlds in the plan's file, if fewer are requested; at least ``iterations`` once
    read."""

    def world(self, config: Config) -> World:
        """Return the user's world that the settings name, or an entirely random world."""
        return ALL_DRAWN if config.scenario.world is None else self.worlds[config.scenario.world]


@dataclass(frozen=True, slots=True, kw_only=True)
class PlannedCase(Case):
    """A numbered combination of a plan's varied values, strategy and filter, with its settings."""

    number: int
    """Number of the case, from 0, in the order of the plan."""
    values: Mapping[str, Any]
    """Values of the grid; the radius of a passive case is None."""
    config: Config
    """Settings with these values and the filter's overrides."""


def cases_of(plan: Plan) -> tuple[PlannedCase, ...]:
    """Return the cases of a plan: each combination of varied values, strategy and filter."""
    settled = from_flags(plan.config.model_dump(mode="json"))
    narrowest = max(plan.grid.get(RADIUS, (plan.config.emitter.radius,)))
    cases: list[PlannedCase] = []
    for values, config in combinations(settled, plan.grid, "grid.", plan.worlds):
        for strategy, name in product(plan.strategies, plan.filters):
            passive = strategy == "passive" and RADIUS in values
            if passive and config.emitter.radius != narrowest:
                continue
            case = PlannedCase(
                number=len(cases),
                strategy=strategy,
                filter=name,
                values=values | {RADIUS: None} if passive else values,
                config=with_settings(config, _dotted(plan.own.get(name, {}), f"own.{name}.")),
            )
            cases.append(case)
    return tuple(cases)


def _dotted(values: Mapping[str, Any], prefix: str) -> Layer:
    """Convert a dict of settings by dotted name to a layer; names in messages get `prefix`."""
    return {
        cast(Key, tuple(name.split("."))): Given(value, prefix + name)
        for name, value in values.items()
    }


def common(plan: Plan, values: Mapping[str, Any]) -> Config:
    """Return a plan's common settings for given values of its varied settings."""
    settled = from_flags(plan.config.model_dump(mode="json"))
    grid = {name: (one,) for name, one in values.items()}
    ((_, config),) = combinations(settled, grid, "grid.", plan.worlds)
    return config


def combinations(
    layer: Layer,
    grid: Mapping[str, tuple[Any, ...]],
    prefix: str,
    worlds: Mapping[str, World] = MappingProxyType({}),
) -> Iterator[tuple[dict[str, Any], Config]]:
    """Yield each combination of a grid's values by name, and the settings with these values.

    The values of the last name change fastest. `prefix` precedes a name in error messages.

    >>> grid = {"seed": (1, 2), "filter.gate": (0.9,)}
    >>> [(named["seed"], config.filter.gate) for named, config in combinations({}, grid, "grid.")]
    [(1, 0.9), (2, 0.9)]
    """
    for values in product(*grid.values()):
        named = dict(zip(grid, values, strict=True))
        varied = _dotted(named, prefix)
        world = worlds[named[WORLD]] if WORLD in named else None
        over = layer | varied if world is None else laid_over(world, layer, varied)
        yield named, resolve(over)


BEAMWIDTH = "beamwidth"
MAKERS = (
    *("emitter.call", "emitter.band", "emitter.frequency"),
    *("air.speed_of_sound", "air.temperature_c"),
)
"""Settings that change the beamwidth; the last only if no speed of sound is given."""
DIGITS = Context(prec=12, rounding=ROUND_FLOOR)
"""Significant digits of a radius, so that all machines agree; rounded down, so that no beam exceeds
the widest."""


def radii_of(
    where: str, grid: Mapping[str, Any], strategies: Sequence[str], layer: Layer
) -> list[float]:
    """Return the piston radii [m] of the beamwidths [deg] in a plan's grid, in the same order.

    `layer` contains the plan's settings, which give the tone and the speed of sound.
    """
    widths, place = grid[BEAMWIDTH], f"{where}.{BEAMWIDTH}"
    names = {".".join(key) for key, _ in leaves(grid)}
    if RADIUS in names:
        raise InputError(f"{place}: is {RADIUS} in other words; vary one of them")
    makers = MAKERS[: -1 if ("air", "speed_of_sound") in layer else None]
    if varied := [name for name in makers if name in names]:
        why = f"a beamwidth is no one radius where {varied[0]} varies too; vary {RADIUS}"
        raise InputError(f"{place}: {why}")
    if set(strategies) == {"passive"}:
        why = "the beam is that of the vehicle's call, which passive sensing does not hear"
        raise InputError(f"{place}: {why}; add another strategy or take it out")
    if not isinstance(widths, list) or not widths:
        raise refusal(place, shown(widths), "a list of degrees", "write it as [180, 33, 11]")
    config = resolve(layer)
    radii: dict[float, Any] = {}
    for width in widths:
        radius = _radius(place, width, config)
        if radius in radii:
            raise refusal(place, f"{shown(width)} twice", "each value once", "leave one out")
        radii[radius] = width
    widest = max(radii)
    resolve(layer | {("emitter", "radius"): Given(widest, f"{place}: radius of {radii[widest]}")})
    return [*radii]


def _radius(where: str, width: Any, config: Config) -> float:
    """Return the radius [m] of the piston emitter with a beamwidth [deg]; raise if invalid."""
    from pipistrelle.acoustics.emitter import piston_radius

    number = isinstance(width, (int, float)) and not isinstance(width, bool)
    if not number or not isfinite(width) or not 0.0 < width <= 180.0:
        expected = "degrees above 0 and up to 180, the widest beam of a back-baffled piston"
        raise refusal(where, shown(width), expected, "correct the value")
    tone = {"frequency": config.emitter.centre, "speed_of_sound": config.medium.sound_speed}
    return float(DIGITS.create_decimal_from_float(float(piston_radius(radians(width), **tone))))


FORMAT = 1


def _checked_filter(name: str) -> str:
    """Return an estimator's name; raise unless it is in the catalogue or ``module:Class``."""
    if name not in CATALOGUE and not names_class(name):
        raise ValueError(f"{', '.join(map(repr, CATALOGUE))} or module:Class")
    return name


def _checked_folder(name: str) -> str:
    """Return a word; raise unless a folder may have it as its name."""
    if not re.fullmatch(r"\w[\w.-]*", name):
        raise ValueError("letters, digits, _ . and -, as of a folder")
    return name


_Filter = Annotated[str, AfterValidator(_checked_filter)]


class _PlanFile(Section):
    """Keys of a plan file, validated by Pydantic; the settings in its tables are checked later."""

    format: Literal[1]
    name: Annotated[str, AfterValidator(_checked_folder)]
    iterations: Annotated[int, Field(ge=1, le=MOST_WORLDS)]
    planned: int = 0
    strategies: Annotated[tuple[Strategy, ...], Field(min_length=1)] = STRATEGIES
    filters: Annotated[tuple[_Filter, ...], Field(min_length=1)] = PAPERS
    settings: Any = None
    config: dict[str, Any] = Field(default_factory=dict)
    grid: dict[str, Any] = Field(default_factory=dict)
    own: dict[str, Any] = Field(default_factory=dict)


def find_plan(word: str) -> Path:
    """Return the path of a plan, from the name of a shipped plan (`PLANS`) or from a path."""
    path = Path(word)
    if word in PLANS:
        return Path(str(files("pipistrelle.experiments.studies") / f"{word}.toml"))
    if not path.exists():
        expected = f"{', '.join(PLANS)} or the path of a plan"
        raise InputError(f"{word}: found no such file; expected {expected}")
    check_ordinary(path)
    return path


def read_plan(path: Path, over: Layer | None = None, iterations: int | None = None) -> Plan:
    """Read a plan's file, let `over` and `iterations` override it, and check every combination.

    >>> from pipistrelle.experiments.studies.plan import cases_of
    >>> plan = read_plan(find_plan("paper"))
    >>> plan.iterations, len(cases_of(plan))
    (115, 50)
    """
    return plan_of(read_toml(path), path, over, iterations)


def kept_plan(folder: Path) -> Plan:
    """Read the plan of a study's folder; old names of settings in it need no change."""
    with warnings.catch_warnings(action="ignore", category=FutureWarning):
        return read_plan(folder / "plan.toml")


def plan_of(
    table: Mapping[str, Any],
    path: Path = Path("plan"),
    over: Layer | None = None,
    iterations: int | None = None,
) -> Plan:
    """Create a plan from the parsed content of its file, and check every combination.

    `path` is the file's name in error messages and the base of relative paths.

    >>> levels = {"beacon.level_db": [36.8, 42.8]}
    >>> plan_of({"format": 1, "iterations": 6, "grid": levels}).grid
    {'beacon.level_db': (36.8, 42.8)}
    """
    over = over or {}
    given = ((name, table.get(name)) for name in ("config", "grid", "own"))
    tables = {name: one if isinstance(one, Mapping) else {} for name, one in given}
    named, usual = _beneath(path, (tables["config"], table), over)
    names = {RADIUS if n == BEAMWIDTH else n: values for n, values in tables["grid"].items()}
    worlds: dict[str, World] = {}
    file, layer, own_layer, varied = _together(
        lambda: _plan_file(path, {"filters": usual, **table} if usual else table, iterations),
        lambda: _laid(path, tables["config"], over, worlds),
        lambda: from_table({"own": tables["own"]}, f"{path}: "),
        lambda: from_table(spread(names, "."), f"{path}: ", "grid.", (BEAMWIDTH,)),
    )
    for key in sorted(over.keys() & varied.keys()):
        warnings.warn(f"{over[key].where} replaces its values in [grid] of {path}", stacklevel=2)
        del varied[key]
    if BEAMWIDTH in tables["grid"] and RADIUS_KEY in varied:
        radii = radii_of(f"{path}: grid", tables["grid"], file.strategies, layer)
        varied[RADIUS_KEY] = Given(radii, f"{path}: grid.{BEAMWIDTH}")
    asked = {key: _read(path, key, given.value, worlds) for key, given in varied.items()}
    named = {k: given for k, given in named.items() if not {k, k[2:]} & varied.keys()}
    if others := [key[1] for key in own_layer if key[1] not in file.filters]:
        expected = f"expected one of {', '.join(file.filters)}"
        raise InputError(f"{path}: own.{others[0]}: no filter of this plan; {expected}")
    check_own(own_layer)
    layer, own = parted(laid(named, layer, own_layer))
    lengths = [len(values) for values in asked.values() if isinstance(values, list)]
    most = prod(lengths) * len(file.strategies) * len(file.filters)
    if most > MOST_CASES:
        raise InputError(f"{path}: grid: found {most} cases, expected at most {MOST_CASES}")
    config, *lists = _together(
        lambda: resolve(layer),
        *(partial(_values, path, key, values, layer) for key, values in asked.items()),
    )
    grid = dict(zip(map(".".join, asked), lists, strict=True))
    _check_unvaried(path, layer, grid, BEAMWIDTH in tables["grid"])
    if twice := [one.where for key, one in own_layer.items() if ".".join(key[2:]) in grid]:
        raise InputError(f"{twice[0]}: the plan varies this setting; take it out")
    own = {name: own[name] for name in file.filters if name in own}
    values: dict[str, dict[str, Any]] = {}
    for name, given in own.items():
        settled: Any = resolve(layer | given).model_dump(mode="json")
        values[name] = {".".join(key): settled[key[0]][key[1]] for key in given}
    plan = Plan(
        name=file.name,
        iterations=file.iterations,
        planned=max(file.iterations, file.planned),
        strategies=file.strategies,
        filters=file.filters,
        config=config,
        grid=grid,
        own=values,
        worlds=worlds,
    )
    for given in ({}, *own.values()):
        for _ in combinations(layer | given, grid, f"{path}: grid.", worlds):
            pass
    return plan


def _together(*checks: Callable[[], Any]) -> list[Any]:
    """Return the results of checks; raise a single error with the errors of all of them."""
    results, problems = [], []
    for check in checks:
        try:
            results.append(check())
        except InputError as refused:
            problems += str(refused).splitlines()
    if problems:
        raise InputError("\n".join(dict.fromkeys(problems)))
    return results


def _check_unvaried(path: Path, layer: Layer, grid: Mapping[str, Any], in_degrees: bool) -> None:
    """Raise if a setting that the plan's grid varies is also given a single value."""
    for key in (key for key in layer if ".".join(key) in grid):
        # The plan in a study's folder lists every setting, so a default value is no conflict.
        if resolve({key: layer[key]}) != Config():
            name = f" as {BEAMWIDTH}" * (in_degrees and ".".join(key) == RADIUS)
            why = f"the plan varies this setting{name}; take it out of [grid] in {path}"
            raise InputError(f"{layer[key].where}: {why}, or in a copy (cp {path} my.toml)")


def _beneath(
    path: Path, places: Iterable[Mapping[str, Any]], over: Layer
) -> tuple[Layer, tuple[str, ...]]:
    """Return settings and estimators of the preset that `over`, or else the plan's file, names."""
    words = [Given(one["settings"], f"{path}: settings") for one in places if "settings" in one]
    given = [*words, *(one for key, one in over.items() if key == SETTINGS)]
    return over_named(*({SETTINGS: one} for one in given))


def _laid(path: Path, table: Mapping[str, Any], over: Layer, worlds: dict[str, World]) -> Layer:
    """Merge the settings of a world, a plan and the caller (`over`), in rising priority."""
    layer = from_table(spread(table, "."), f"{path}: ", "config.")
    layer = with_array(with_calls(with_routes(with_places(path, layer) | over)))
    world = named_world(layer)
    if world is None:
        return layer
    worlds[world.name] = world
    return with_world(world, layer) | {WORLD_KEY: Given(world.name, layer[WORLD_KEY].where)}


def _read(path: Path, key: Key, values: Any, worlds: dict[str, World]) -> Any:
    """Read the files in a grid's values (worlds, arrays, routes); return the new values."""
    if key == WORLD_KEY:
        return _worlds(path, values, worlds)
    if key not in (CALLERS, ARRAY_KEY) or not isinstance(values, list):
        return values
    given = (Given(value, f"{path}: grid.{'.'.join(key)}") for value in values)
    layers = (with_array(with_routes(with_places(path, {key: one}))) for one in given)
    return [layer[key].value for layer in layers]


def _worlds(path: Path, folders: Any, worlds: dict[str, World]) -> Any:
    """Read a grid's world folders into `worlds`, and return the names of the worlds."""
    if not isinstance(folders, list) or not all(isinstance(one, str) for one in folders):
        return folders  # rejected later with all values
    names = []
    for folder in folders:
        world = read_world(path.parent / folder)
        if world.files != worlds.setdefault(world.name, world).files:
            fix = "rename a folder"
            raise InputError(f"{path}: grid.{WORLD}: found two worlds called {world.name}; {fix}")
        names.append(world.name)
    return names


def plan_text(plan: Plan) -> str:
    """Format a plan as TOML that lists every setting and is read back as the same plan."""
    import tomli_w

    return tomli_w.dumps(_as_table(plan))


def changed_settings(there: Plan, asked: Plan) -> list[str]:
    """Describe each difference between two plans in a line, except the number of worlds."""
    old, new = plan_settings(there), plan_settings(asked)

    def worded(table: Mapping[str, Any], name: str) -> str:
        return json.dumps(table[name]) if name in table else "nothing"

    return [
        f"{name}: {worded(old, name)} there, {worded(new, name)} asked for"
        for name in dict.fromkeys((*old, *new))
        if name != "iterations" and (name not in old or name not in new or old[name] != new[name])
    ]


def plan_settings(plan: Plan) -> dict[str, Any]:
    """Return a plan's settings by dotted name, with derived values and digests of its worlds."""
    table = {".".join(key): value for key, value in leaves(_as_table(plan)) if key != ("planned",)}
    worlds = {}
    for name, world in plan.worlds.items():
        digest = sha256()
        for file, content in sorted(world.files.items()):
            digest.update(f"{file}\n{len(content)}\n".encode() + content)
        worlds[f"worlds/{name}"] = digest.hexdigest()[:16]
    values = {f"config.{'.'.join(key)}": value for key, value in derived(plan.config).items()}
    return table | worlds | values


def _as_table(plan: Plan) -> dict[str, Any]:
    """Return a plan as nested tables for TOML; varied settings keep their defaults."""
    layer = from_flags(plan.config.model_dump(mode="json"))
    kept = {key: layer[key] for key in layer if ".".join(key) not in plan.grid}
    own = {name: dict(settings) for name, settings in plan.own.items()}
    if plan.config.scenario.world is not None:
        kept[WORLD_KEY] = Given(f"worlds/{plan.config.scenario.world}", "")
    grid = {name: list(values) for name, values in plan.grid.items()}
    if WORLD in grid:
        grid[WORLD] = [f"worlds/{name}" for name in grid[WORLD]]
    config = resolve(kept).model_dump(mode="json", exclude_none=True)
    settings = config.pop("settings", None)
    return {
        "format": FORMAT,
        "name": plan.name,
        "iterations": plan.iterations,
        **({"planned": plan.planned} if plan.planned > plan.iterations else {}),
        "strategies": list(plan.strategies),
        "filters": list(plan.filters),
        **({"settings": settings} if settings else {}),
        "config": config,
        "grid": grid,
        **({"own": own} if own else {}),
    }


def _plan_file(path: Path, table: Mapping[str, Any], iterations: int | None) -> _PlanFile:
    """Validate the top-level keys of a plan file; raise an error that lists its faults."""
    given = {"name": text_of(path.stem), **table}
    if iterations is not None:
        if isinstance(given.get("iterations"), int):
            given.setdefault("planned", given["iterations"])
        given["iterations"] = iterations
    try:
        file = _PlanFile.model_validate_json(json.dumps(given, default=str), strict=True)
    except ValidationError as refused:
        raise table_refusal(path, refused, _PlanFile, "format", every=True) from None
    for name in ("strategies", "filters"):
        _check_distinct(f"{path}: {name}", getattr(file, name))
    check_distinct(file.filters, f"{path}: filters")
    return file


def _values(path: Path, key: Key, values: Any, layer: Layer) -> tuple[Any, ...]:
    """Validate and return the values that a plan's grid lists for a setting."""
    where = f"{path}: grid.{'.'.join(key)}"
    if key == ("seed",):
        raise InputError(f"{where}: every iteration is another world already; raise iterations")
    if key in (SETTINGS, OWN):
        raise InputError(f"{where}: holds for a whole plan; vary settings themselves")
    if not isinstance(values, list) or not values:
        raise InputError(f"{where}: found {shown(values)}, expected a list of values")
    checked = []
    for value in values:
        table = resolve(layer | {key: Given(value, where)}).model_dump(mode="json")
        settled = dict(leaves(table, known_settings()))[key]
        if key == CALLERS:
            settled = [{k: v for k, v in each.items() if v is not None} for each in settled]
        checked.append(settled)
    _check_distinct(where, checked)
    return tuple(checked)


def _check_distinct(where: str, values: Sequence[Any]) -> None:
    """Raise if a list contains the same value twice."""
    seen = [json.dumps(value) if isinstance(value, list) else value for value in values]
    for i, value in enumerate(values):
        if seen[i] in seen[:i]:
            raise InputError(f"{where}: found {shown(value)} twice, expected each value once")
