"""Verbs made from Python functions: their parameters as flags, and every setting as a flag."""

import os
from collections.abc import Callable, Mapping, Sequence
from inspect import Parameter as Argument
from inspect import Signature, cleandoc, signature
from pathlib import Path
from types import MappingProxyType, NoneType
from typing import Annotated, Any, Literal, TypedDict, Union, get_args, get_origin, get_type_hints

from cyclopts import Group, Parameter

from pipistrelle.config import Config
from pipistrelle.estimation.catalogue import CATALOGUE
from pipistrelle.experiments.named_settings import NAMES, laid, settings_of
from pipistrelle.scripting.arguments import GROUPS, Door
from pipistrelle.settings import (
    ARRAY_KEY,
    CALLERS,
    OWN,
    RENAMED,
    SETTINGS,
    Key,
    Layer,
    from_environment,
    from_flags,
    from_text,
    known_settings,
)
from pipistrelle.verbs.command_line import EVERYTHING, NAMED
from pipistrelle.verbs.console import announced, command_line
from pipistrelle.verbs.streams import say, warn

OMITTED = ("progress", "settings")
"""Parameters of Python without a flag of their name."""
OTHER_DEFAULTS = ("shard", "workers")
"""Parameters without the default of Python."""
FLAGS = {
    "strategies": ("--strategy",),
    "filters": ("--filter", "--estimator"),
    "output": ("--output", "-o"),
}
"""Flags that are spelt differently from their parameters, or in several ways."""


def _whole(_: Any, tokens: Sequence[Any]) -> int:
    """Parse a whole number on the command line; cyclopts would round 2.5."""
    try:
        return int(tokens[0].value)
    except ValueError:
        raise ValueError(f"found {tokens[0].value!r}, expected a whole number") from None


Whole = Annotated[int, Parameter(converter=_whole)]


def _robot(_: Any, tokens: Sequence[Any]) -> int | str:
    """Parse a robot on the command line: digits as a number, other text as a name."""
    text = tokens[0].value
    return int(text) if text.isdecimal() else text


_METAVARS = {CALLERS: "TABLES", OWN: "TABLES", ARRAY_KEY: "FILE"}
"""Settings that are parsed as TOML, with their placeholder in the help."""


class _Everything:
    """A truth value that can change: whether the help lists all settings."""

    def __bool__(self) -> bool:
        """Return whether the help lists all settings."""
        return EVERYTHING.lstrip("-") in NAMED

    def __xor__(self, other: bool) -> bool:
        """Return whether the value differs from a wanted value, as cyclopts asks."""
        return bool(self) ^ other


SHOWN: Any = _Everything()
"""Read when the help is printed."""


class _Named(dict[str, Any]):
    """Flags and sections of flags; cyclopts parses only the sections that the user names."""

    def items(self) -> Any:
        """Return flags without a section, and named sections or, for help, all (0.1 s)."""
        named = {*self} if {"help", "help-all", "h"} & NAMED else NAMED
        return [one for one in super().items() if one[0] in named or not isinstance(one[1], type)]


_LITERAL: Any = Literal
NamedSettings = Annotated[
    list[str] | None,
    Parameter(
        name=("--settings", "--config"),
        metavar="NAME|FILE",
        help=f"Settings to start from: {', '.join(NAMES)}, or a TOML file as `pipistrelle config "
        "show` prints it. A file overrides a name; give both by two --settings.",
    ),
]
_KINDS: dict[str, Any] = {
    "config": NamedSettings,
    "strategies": Literal["active", "fused", "passive", "all"] | str,
    "filters": _LITERAL[(*CATALOGUE, *GROUPS)] | str | None,
    "robot": Annotated[int | str | None, Parameter(converter=_robot, n_tokens=1)],
    "shard": str | None,
    "workers": Whole | None,
    "plan": str,
}
"""Types of parameters on the command line, where they differ from Python's."""


def verb_of(
    function: Callable[..., Any],
    act: Callable[[dict[str, Any]], Any],
    *,
    settings: Any,
    options: Mapping[str, tuple[str, ...]],
    extra: Sequence[Argument] = (),
    only: Sequence[str] = (),
) -> Callable[..., Any]:
    """Return a command-line verb with the parameters and the help of a Python function.

    `act` receives the arguments by name. `options` gives the placeholder of parameters in the help,
    the text of their default, and perhaps other help than Python's; `only` selects parameters.
    """
    hints, arguments = get_type_hints(function), []
    for name, argument in signature(function).parameters.items():
        if name in OMITTED or (only and name not in only):
            continue
        metavar, default, *words = options.get(name, ("", ""))
        more: dict[str, Any] = {"help": words[0]} if words else {}
        if default:
            more["show_default"] = default
        positional = argument.kind is Argument.POSITIONAL_ONLY and name != "config"
        kind, kinds = _KINDS.get(name, hints[name]), get_args(hints[name])
        if name not in _KINDS and Path in kinds:
            kind = Path | None if NoneType in kinds else Path
        elif set(kinds) == {int, NoneType}:
            kind = Whole | None
        if name != "config":
            names = None if positional else FLAGS.get(name)
            kind = Annotated[kind, Parameter(name=names, metavar=metavar or None, **more)]
        value = None if name in OTHER_DEFAULTS else argument.default
        where = Argument.POSITIONAL_ONLY if positional else Argument.KEYWORD_ONLY
        arguments.append(Argument(name, where, default=value, annotation=kind))
    flags = Annotated[settings | None, Parameter(name="*")]
    arguments += [
        *extra,
        Argument("settings", Argument.KEYWORD_ONLY, default=None, annotation=flags),
    ]
    arguments.sort(key=lambda one: one.kind)
    bound = Signature(arguments)

    def verb(*words: Any, **given: Any) -> Any:
        values = bound.bind(*words, **given)
        values.apply_defaults()
        return act(values.arguments)

    verb.__doc__ = _rejoined(cleandoc(function.__doc__ or ""))
    verb.__annotations__ = {one.name: one.annotation for one in arguments}
    verb.__dict__["__signature__"] = bound
    return verb


def _rejoined(text: str) -> str:
    """Join the lines of each indented paragraph in a help text, which is wrapped again later."""
    lines: list[str] = []
    for line in text.splitlines():
        indented = line.startswith("    ")
        if indented and lines and lines[-1].startswith("    "):
            lines[-1] += f" {line.strip()}"
        else:
            lines.append(line)
    return "\n".join(lines)


def switch(name: str, words: str) -> Argument:
    """Return a boolean option that only the command line has, with its help text."""
    kind = Annotated[bool, Parameter(help=words)]
    return Argument(name, Argument.KEYWORD_ONLY, default=False, annotation=kind)


def spell(name: str, value: str = "") -> str:
    """Format a parameter, with a value if any, as a command-line flag.

    >>> spell("save_log", "DIR"), spell("overwrite", "True")
    ('--save-log DIR', '--overwrite')
    """
    flag, *short = FLAGS.get(name, (f"--{name.replace('_', '-')}",))
    if value in ("", "True"):
        return flag
    return f"{short[0] if name == 'output' else flag} {value}"


def door_of(asked: Mapping[str, Any], **more: Any) -> Door:
    """Convert command-line arguments to a `Door`, which prints messages unless `quiet` is set."""
    if asked.get("quiet"):
        more.setdefault("note", lambda _: None)
    else:
        more |= {"note": say, "drawing": announced}
    return Door(
        asked=asked,
        beneath=layers(asked["config"], None) if "config" in asked else {},
        flags=from_flags(asked["settings"] or {}),
        command=command_line(),
        option=spell,
        warn=warn,
        makes_folder=True,
        **more,
    )


def setting_flags(
    shown: Callable[[Key], bool] = lambda _: True, own: Mapping[Key, Any] = MappingProxyType({})
) -> Any:
    """Return a TypedDict with a flag for each setting, for parsing by cyclopts.

    ``--help-all`` lists the settings that are `shown`, ``--help`` only the seed; all flags work.
    `own` holds defaults of the verb that differ, for the help.
    """
    sections: dict[str, dict[str, Any]] = {}
    for key, field in known_settings().items():
        if key == SETTINGS:
            continue  # --settings takes files also
        value = own.get(key, field.default)
        default = value if isinstance(value, tuple) else (value,)
        texts = [str(item).lower() if isinstance(item, bool) else str(item) for item in default]
        settled = "" if value in (None, ()) else f"[default: {' '.join(texts)}]"
        words = " ".join(f"{field.description or ''} {settled}".split())
        show = shown(key) and (key == ("seed",) or SHOWN)
        kind: Any = Whole if field.annotation is int else _unbounded(field.annotation)
        if metavar := "true|false" if field.annotation is bool else _METAVARS.get(key):
            as_written = Parameter(
                converter=lambda _, tokens: from_text(tokens[0].value), n_tokens=1, metavar=metavar
            )
            kind = Annotated[Any, as_written]
        flag = Annotated[kind, Parameter(help=words, show=show, consume_multiple=True)]
        sections.setdefault("".join(key[:-1]), {})[key[-1]] = flag
        for old in (old for old, new in RENAMED.items() if new == ".".join(key)):
            sections[key[0]][old.split(".")[1]] = Annotated[
                kind, Parameter(show=False, consume_multiple=True)
            ]
    record: Any = TypedDict
    flags = sections.pop("")
    for place, (name, table) in enumerate(sections.items()):
        meaning = " ".join((type(getattr(Config(), name)).__doc__ or "").split())
        panel = Parameter(group=Group(f"Settings: {name}", help=meaning, sort_key=place))
        table = {leaf: Annotated[flag, panel] for leaf, flag in table.items()}
        flags[name] = record(name, table, total=False)
    whole: Any = record("Settings", flags, total=False)
    whole.__annotations__ = _Named(whole.__annotations__)
    return whole


def _unbounded(kind: Any) -> Any:
    """Remove bounds and None from a type annotation; `resolve` checks the values later."""
    parts = [_unbounded(part) for part in get_args(kind) if part is not NoneType]
    either: Any = Union
    if get_origin(kind) is Union and len(parts) > 1:
        return either[tuple(parts)]
    if get_origin(kind) in (Annotated, Union):
        return parts[0]
    record: Any = tuple
    return record[tuple(parts)] if get_origin(kind) is tuple else kind


def layers(named: Sequence[str] | None, settings: Mapping[str, Any] | None) -> Layer:
    """Merge presets, files, environment variables and flags into a layer of settings."""
    given = [(word, settings_of(word, "--settings")) for word in named or ()]
    named_here = (layer for word, layer in given if word in NAMES)
    start, environment = (layer for _, layer in given), from_environment(os.environ)
    return laid(*start, environment, from_flags(settings or {}), *named_here)
