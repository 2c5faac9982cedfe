"""Merge settings from five sources: defaults < preset < file < environment < flags.

Each source gives a `Layer`: its settings by their key, each with its place in words. Layers merge
like dictionaries, the right operand wins, and an error of `resolve` names the place where the user
wrote the value:

    config = resolve(from_file(path) | from_environment(os.environ) | from_flags(flags))

The spelling of one setting is ``merge`` under ``[rays]`` in a file, ``PIPISTRELLE_RAYS__MERGE`` in
the environment and ``--rays.merge`` as a flag.
"""

import json
import tomllib
import warnings
from collections.abc import Callable, Container, Iterable, Iterator, Mapping
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo

from pipistrelle.config import (
    MAX_OTHERS,
    SQUARE,
    SWEEP,
    TONE,
    CallerConfig,
    Config,
    InputError,
    Section,
)
from pipistrelle.files import read_text
from pipistrelle.refusals import expectation, meant, refusal, shown, values_expected

PREFIX = "PIPISTRELLE_"
NOT_SETTINGS = frozenset({"PIPISTRELLE_DATA"})
"""Variables of the environment with the prefix that are no settings."""

Key = tuple[str, ...]

_MAX_DEPTH = 8
"""Most levels of tables and lists in a file."""


class Given(NamedTuple):
    """A setting's value, and the place where the user gave it, in words."""

    value: Any
    where: str


Layer = dict[Key, Given]


@cache
def known_settings() -> dict[Key, FieldInfo]:
    """Return the pydantic field of every setting by its key, in the order of `Config`."""
    found = {}
    for name, field in Config.model_fields.items():
        if isinstance(field.default, Section):
            found |= {(name, leaf): info for leaf, info in type(field.default).model_fields.items()}
        else:
            found[name,] = field
    return found


CALLERS: Key = ("callers",)
WORLD_KEY: Key = ("scenario", "world")
RADIUS_KEY: Key = ("emitter", "radius")
ARRAY_KEY: Key = ("receiver", "array")
CALL_KEYS: tuple[Key, ...] = (("emitter", "call"), ("beacon", "call"))
"""Settings with a special treatment: tables of callers, the piston of the beam, and the files of a
world, an array and calls, which are relative to the file of settings."""
SETTINGS: Key = ("settings",)
OWN: Key = ("own",)
"""Keys of the preset (`experiments.named_settings`) and of settings for one estimator:
``[own.iekf] rays.exponent`` in a file is ``("own", "iekf", "rays", "exponent")`` in a layer."""

RENAMED = {
    "emitter.off_axis": "emitter.directivity_law", "emitter.pulse": "emitter.call_duration",
    "association.detection": "association.detection_rate",
    "association.clutter": "association.clutter_rate",
    "association.bearing_std": "association.max_angle_std",
    "association.way_std": "association.max_range_std", "rays.ranged": "rays.range_update",
    "listening.timing": "listening.excess_paths", "rays.spacing": "rays.precise_bearings",
    "rays.ratio": "rays.relative_std", "rays.density": "rays.range_ratio",
    "rays.prune": "rays.prune_threshold", "rays.power": "rays.exponent",
}  # fmt: skip
"""New names of settings, by the names that older files, results and scripts contain."""


def derived(config: Config) -> dict[Key, Any]:
    """Return the values of all settings that are computed from others if omitted."""
    return {
        (name, "speed_of_sound"): getattr(config, name).sound_speed for name in ("air", "water")
    }


def from_file(path: Path) -> Layer:
    """Read a TOML file of settings as a layer: values and their places by key."""
    return with_places(path, from_table(read_toml(path), f"{path}: "))


def with_places(path: Path, layer: Layer) -> Layer:
    """Resolve all file names in a layer of settings relative to the folder of its file."""
    for key, given in layer.items():
        if key == CALLERS:
            layer[key] = given._replace(value=beside(path, given.value))
        named = key == WORLD_KEY or (key == ARRAY_KEY and given.value != SQUARE)
        named |= key in CALL_KEYS and given.value not in (TONE, SWEEP)
        if named and isinstance(given.value, str):
            layer[key] = given._replace(value=str(path.parent / given.value))
    return layer


def beside(path: Path, callers: Any) -> Any:
    """Resolve the route and call files of callers, valid or not, relative to a file's folder."""
    if not isinstance(callers, list):
        return callers

    def placed(caller: Any) -> Any:
        if not isinstance(caller, dict):
            return caller
        return caller | {
            name: (path.parent / caller[name]).as_posix()
            for name in ("route", "call")
            if isinstance(caller.get(name), str) and caller[name] not in (TONE, SWEEP)
        }

    return [*map(placed, callers)]


def from_table(
    values: Mapping[str, Any], where: str, above: str = "", others: Iterable[str] = ()
) -> Layer:
    """Convert a nested table of settings to a layer: values and their places by key.

    `where`: name of the file in messages; `above`: prefix of a setting's name in the file;
    `others`: further names in the table, for suggestions.
    """
    given = leaves(values, known_settings())
    return _layer(given, lambda key: above + ".".join(key), where, others)


def from_environment(environment: Mapping[str, str]) -> Layer:
    """Convert environment variables to a layer of settings; text there needs no quotes."""
    given = (
        (tuple(name.removeprefix(PREFIX).lower().split("__")), from_text(environment[name]))
        for name in sorted(environment)
        if name.startswith(PREFIX) and name not in NOT_SETTINGS
    )
    return _layer(given, lambda key: PREFIX + "__".join(key).upper())


def from_flags(values: Mapping[str, Any]) -> Layer:
    """Convert command-line flags, of settings and sections, to a layer of settings."""
    given = leaves(values, known_settings())
    return _layer(given, lambda key: "--" + ".".join(key).replace("_", "-"))


def from_keywords(values: Mapping[str, Any], others: Iterable[str] = ()) -> Layer:
    """Convert the keywords of a call, settings and sections, to a layer of settings.

    `others`: further keywords of the call, for suggestions.

    >>> from_keywords({"rays__merge": 8.0, "air": {"temperature_c": 5.0}})["rays", "merge"]
    Given(value=8.0, where='rays__merge')
    >>> from_keywords({"rays__merg": 8.0})
    Traceback (most recent call last):
    pipistrelle.config.InputError: rays__merg: no such setting; did you mean rays__merge?
    """
    given = leaves(spread(values, "__"), known_settings())
    return _layer(given, "__".join, others=others)


def spread(table: Mapping[str, Any], parts: str) -> dict[str, Any]:
    """Split names such as `rays__merge` at a separator, and nest the values in tables.

    >>> spread({"seed": 3, "rays.merge": 2.0, "rays": {"weights": "aggregated"}}, ".")
    {'seed': 3, 'rays': {'merge': 2.0, 'weights': 'aggregated'}}
    """
    nested: dict[str, Any] = {}
    for name, value in table.items():
        *sections, leaf = str(name).split(parts)
        inner: Any = nested
        for section in (*sections, *([leaf] if isinstance(value, Mapping) else ())):
            inner = inner.setdefault(section, {})
            if not isinstance(inner, dict):
                raise InputError(f"{name}: found {section} as a value too; give a section or one")
        if isinstance(value, Mapping):
            inner |= spread(value, parts)
        else:
            inner[leaf] = value
    return nested


def resolve(layer: Layer) -> Config:
    """Validate a layer of settings; return the `Config`, completed with the defaults.

    >>> resolve(from_flags({"seed": 3})).seed
    3
    >>> resolve(from_flags({"air": {"pressure_kpa": -1.0}}))
    Traceback (most recent call last):
    pipistrelle.config.InputError: --air.pressure-kpa: found -1.0, expected greater than 0
    """
    nested: dict[str, Any] = {}
    for (*sections, leaf), given in layer.items():
        table = nested
        for section in sections:
            table = table.setdefault(section, {})
        table[leaf] = given.value
    try:
        # JSON is strict where TOML is (text is no number) and lenient where TOML must be (a
        # list makes a tuple).
        return Config.model_validate_json(json.dumps(nested, default=_plain), strict=True)
    except ValidationError as refused:
        problems = [_problem(error, layer) for error in refused.errors(include_url=False)]
        raise InputError("\n".join(dict.fromkeys(problems))) from None


def _plain(value: Any) -> Any:
    """Convert settings and NumPy's numbers to JSON values, other values to text."""
    if isinstance(value, BaseModel):
        return value.model_dump(mode="json", exclude_none=True)
    return value.tolist() if hasattr(value, "tolist") else str(value)


def to_toml(config: BaseModel) -> str:
    """Return all settings, or some sections, as the text of a TOML file, each with its meaning.

    The text reads back as the same settings; settings without a value are comments.
    """
    lines: list[str] = []
    for key in known_settings():
        *sections, leaf = key
        if key[0] not in type(config).model_fields:
            continue
        table: Any = config
        for section in sections:
            table = getattr(table, section)
            if leaf == next(iter(type(table).model_fields)):
                lines += ["", f"# {' '.join((type(table).__doc__ or '').split())}", f"[{section}]"]
        value = getattr(table, leaf)
        if key in (CALLERS, OWN) and value:
            continue  # a table each, at the end
        assignment = f"# {leaf} =" if value is None else f"{leaf} = {json.dumps(value)}"
        lines.append(_remarked(assignment, known_settings()[key]))
    for caller in getattr(config, "callers", None) or ():
        lines += ["", f"# {type(caller).__doc__}", "[[callers]]"]
        fields = type(caller).model_fields
        lines += [
            _remarked(f"{leaf} = {json.dumps(value, ensure_ascii=False)}", fields[leaf])
            for leaf, value in caller.model_dump(mode="json", exclude_none=True).items()
        ]
    for name, sections in (getattr(config, "own", None) or {}).items():
        table = name if name.isidentifier() else json.dumps(name)
        lines += ["", f"# Settings for {name} only.", f"[own.{table}]"]
        lines += [
            _remarked(f"{'.'.join(key)} = {json.dumps(value)}", known_settings()[key])
            for key, value in leaves(sections)
        ]
    return "\n".join(lines) + "\n"


def _remarked(assignment: str, field: FieldInfo) -> str:
    """Append the meaning of a setting to its TOML line, as a comment."""
    meaning = " ".join((field.description or "").split())
    return f"{assignment:<39} # {meaning}" if meaning else assignment


def read_toml(path: Path) -> dict[str, Any]:
    """Read a TOML file."""
    return parse_toml(read_text(path), path)


def parse_toml(text: str, where: object) -> dict[str, Any]:
    """Parse TOML; raise if an integer exceeds 64 bits or tables exceed `_MAX_DEPTH` levels."""
    found, expected = f"more than {_MAX_DEPTH} levels", "tables of settings, or lists of them"
    deep = found, expected, "mend the file"
    try:
        table = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise refusal(where, str(error), "TOML", "correct the line") from None
    except RecursionError:
        raise refusal(where, *deep) from None
    except ValueError:  # Python reads no integers of thousands of digits
        raise refusal(where, "an integer of many digits", "at most 64 bits", "correct it") from None
    waiting: list[tuple[Key, Any]] = [((), table)]
    while waiting:
        key, value = waiting.pop()
        if len(key) > _MAX_DEPTH:
            raise refusal(f"{where}: {'.'.join(key[:3])}", *deep)
        if isinstance(value, dict):
            waiting += [((*key, name), inner) for name, inner in value.items()]
        elif isinstance(value, list):
            waiting += [((*key, str(i)), inner) for i, inner in enumerate(value)]
        elif isinstance(value, int) and not -(2**63) <= value < 2**64:
            bits = f"an integer of {value.bit_length()} bits"
            raise refusal(f"{where}: {'.'.join(key)}", bits, "at most 64", "correct it")
    return table


def leaves(
    values: Mapping[str, Any], whole: Container[Key] = (), above: Key = ()
) -> Iterator[tuple[Key, Any]]:
    """Yield key and value of each leaf of nested tables; empty and `whole` tables are leaves."""
    for name, value in values.items():
        key = (*above, name)
        if isinstance(value, Mapping) and value and key not in whole:
            yield from leaves(value, whole, key)
        else:
            yield key, value


def _layer(
    given: Iterable[tuple[Key, Any]],
    spell: Callable[[Key], str],
    prefix: str = "",
    others: Iterable[str] = (),
) -> Layer:
    """Build a layer of settings with each value's place; raise for unknown names."""
    layer, problems = dict[Key, Given](), list[str]()
    for old, value in given:
        where = prefix + spell(old)
        key = tuple(RENAMED[name].split(".")) if (name := ".".join(old)) in RENAMED else old
        if key != old:
            text = f"{where} is now called {spell(key)}; the old name is still read"
            warnings.warn(text, FutureWarning, stacklevel=2)
        if key in layer:
            raise InputError(f"{layer[key].where} and {where} are one setting; give one of them")
        if key == OWN and value is not None:
            layer |= _own_layer(value, where)
        elif key in known_settings():
            layer[key] = Given(value, where)
        elif any(key == known[: len(key)] for known in known_settings()):
            if value != {}:
                near = f"; did you mean {where}s?" if f"{where}s" in others else ""
                expected = f"expected a section of settings{near}"
                problems.append(f"{where}: found {shown(value)}, {expected}")
        else:
            names = {".".join(known): spell(known) for known in known_settings()}
            names |= {name: spell(tuple(new.split("."))) for name, new in RENAMED.items()}
            same = [word for name, word in names.items() if name.split(".")[1:] == [*key]]
            names |= {name: name for name in others}
            near = meant(".".join(key), names)
            fit = " or ".join(same) or (names[near] if near else "")
            fix = f"did you mean {fit}?" if fit else "see `pipistrelle config show`"
            problems.append(f"{where}: no such setting; {fix}")
    if problems:
        raise InputError("\n".join(problems))
    return layer


def _own_layer(tables: Any, where: str) -> Layer:
    """Build the layer of settings that apply to single estimators, a table for each."""
    if not isinstance(tables, Mapping):
        expected = "a table for each estimator, as {iekf = {rays.exponent = 8.0}}"
        raise InputError(f"{where}: found {shown(tables)}, expected {expected}")
    layer: Layer = {}
    for name, table in tables.items():
        if not isinstance(table, Mapping):
            found = f"found {shown(table)}, expected a table of settings"
            raise InputError(f"{where}.{name}: {found}")
        given = from_table(spread(table, "."), f"{where}.{name}.")
        layer |= {(*OWN, name, *key): one for key, one in given.items()}
    return layer


def from_text(text: str) -> Any:
    """Convert text to a TOML value or a Python number; return other text unchanged."""
    with suppress(InputError):
        read = parse_toml(f"value = {text}", "")
        if read.keys() == {"value"}:
            return read["value"]
    try:
        return float(text)
    except ValueError:
        return text


def _problem(error: Any, layer: Layer) -> str:
    """Return the message for a rejected value: its place, the value and the expected value."""
    if error["type"] == "json_invalid":
        for value, where in layer.values():
            try:
                json.dumps(value, default=_plain, ensure_ascii=False).encode()
            except UnicodeEncodeError:
                fix = "rename the file or folder, or name a link to it"
                return f"{where}: found {shown(value)}, expected UTF-8 text; {fix}"
    if error["loc"][:1] == CALLERS and CALLERS in layer:
        return _caller_problem(error, layer[CALLERS])
    key = tuple(part for part in error["loc"] if isinstance(part, str))
    expected = expectation(error)
    if key not in layer:  # a rule between settings: its message holds what was found
        within = {known: given.where for known, given in layer.items() if known[: len(key)] == key}
        named = [where for known, where in within.items() if known[-1] in expected]
        return f"{', '.join(named or within.values())}: {expected}"
    value, where = layer[key]
    if (count := values_expected(error, known_settings()[key])) is not None:
        expected = f"{count} values"
    elif key != error["loc"]:
        expected += f" as value {error['loc'][-1] + 1}"
    return f"{where}: found {shown(value)}, expected {expected}"


_OF_CALLERS = {
    "route": "a CSV file of time,x,y, or two such rows",
    "name": "up to 40 letters, digits, _ and -",
    "waypoints": "a list of points [x, y], two at least",
    "place": "x and y",
    "centre": "x and y",
}
"""Expected values of keys of a caller."""


def _caller_problem(error: Any, given: Given) -> str:
    """Return the message for a rejected value in the list of callers, counted from 1."""
    _, *inner = error["loc"]
    expected, where = expectation(error), given.where
    if not inner:
        if error["type"] == "value_error":
            return f"{where}: {expected}"
        if error["type"] == "too_long":
            found = f"{len(error['input'])} callers"
            return f"{where}: found {found}, expected at most {MAX_OTHERS} besides the vehicle"
        tables = "a list of tables, one for each caller, as [{frequency = 30e3}]"
        return f"{where}: found {shown(error['input'])}, expected {tables}"
    where, caller = f"{where}.{inner[0] + 1}", given.value[inner[0]]
    if len(inner) == 1:
        if error["type"] == "value_error":
            return f"{where}: {expected}"
        return f"{where}: found {shown(caller)}, expected a table that says who calls"
    name = inner[1]
    if error["type"] == "extra_forbidden":
        near = meant(name, CallerConfig.model_fields)
        fix = f"did you mean {near}?" if near else f"it has {', '.join(CallerConfig.model_fields)}"
        return f"{where}.{name}: no such key of a caller; {fix}"
    if name != "name" or error["type"].startswith("string"):
        expected = _OF_CALLERS.get(name, expected)
    found = caller.get(name) if isinstance(caller, dict) else getattr(caller, name)
    return f"{where}.{name}: found {shown(found)}, expected {expected}"
