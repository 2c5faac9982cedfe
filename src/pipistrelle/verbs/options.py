"""Options that verbs share: every setting as a flag, and the short names of a mission."""

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType, NoneType
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypedDict, Union, get_args, get_origin

from cyclopts import Group, Parameter

from pipistrelle.config import Config, InputError
from pipistrelle.estimation.catalogue import CATALOGUE, entry
from pipistrelle.experiments.named_settings import NAMES, laid, settings_of
from pipistrelle.scripting.arguments import GROUPS, mission_settings, named_filters
from pipistrelle.settings import (
    ARRAY_KEY,
    CALLERS,
    OWN,
    SETTINGS,
    WORLD_KEY,
    Given,
    Key,
    Layer,
    from_environment,
    from_flags,
    from_text,
    known_settings,
)

Chosen = Literal["active", "fused", "passive", "all"]


def _whole(_: Any, tokens: Sequence[Any]) -> int:
    """Read a whole number; the command line's own reader rounds 2.5 off."""
    try:
        return int(tokens[0].value)
    except ValueError:
        raise ValueError(f"found {tokens[0].value!r}, expected a whole number") from None


Whole = Annotated[int, Parameter(converter=_whole)]


def _as_written(_: Any, tokens: Sequence[Any]) -> Any:
    """Read a value as a file has it, on one line."""
    return from_text(tokens[0].value)


_METAVARS = {CALLERS: "TABLES", OWN: "TABLES", ARRAY_KEY: "FILE"}
"""Settings that are given as a file has them, and what stands for them in the help."""

if TYPE_CHECKING:
    from pipistrelle.experiments.hearing.scenario import World

    ChosenFilter = str
else:  # the help names those that are listed
    ChosenFilter = Annotated[Literal[(*CATALOGUE, *GROUPS)] | str, Parameter(metavar="CHOICE")]
NamedSettings = Annotated[
    list[str] | None,
    Parameter(
        name=("--settings", "--config"),
        metavar="NAME|FILE",
        help=f"Settings to start from: {', '.join(NAMES)}, or a TOML file as `pipistrelle config "
        "show` prints it. A name lies beneath a file; give both by two --settings.",
    ),
]
Particles = Annotated[
    Whole | None,
    Parameter(metavar="N", help="Particles of FastSLAM; sets fastslam.particles. [default: 100]"),
]


def setting_flags(
    shown: Callable[[Key], bool] = lambda _: True, own: Mapping[Key, Any] = MappingProxyType({})
) -> Any:
    """Make the type from which the command line builds a flag for every setting.

    `shown` says whether the help lists a setting; its flag works either way. `own` holds defaults
    that a verb has of its own, for the help.

    >>> sorted(setting_flags().__annotations__)[:3]
    ['air', 'association', 'assumed']
    """
    sections: dict[str, dict[str, Any]] = {}
    top: dict[str, Any] = {}
    for key, field in known_settings().items():
        if key == SETTINGS:
            continue  # an option that takes files, too
        value = own.get(key, field.default)
        default = value if isinstance(value, tuple) else (value,)
        texts = [str(item).lower() if isinstance(item, bool) else str(item) for item in default]
        settled = "" if value is None else f"[default: {' '.join(texts) or 'none'}]"
        words = " ".join(f"{field.description or ''} {settled}".split())
        flag = Parameter(help=words, show=shown(key), negative=(), consume_multiple=True)
        kind: Any = Whole if field.annotation is int else _unbounded(field.annotation)
        if key in _METAVARS:
            metavar = _METAVARS[key]
            kind = Annotated[Any, Parameter(converter=_as_written, n_tokens=1, metavar=metavar)]
        elif field.annotation is bool:
            kind = Annotated[
                Any, Parameter(converter=_as_written, n_tokens=1, metavar="true|false")
            ]
        if len(key) == 1:
            top[key[0]] = Annotated[kind, flag]
        else:
            group = Parameter(group=_section_group(key[0]))
            sections.setdefault(key[0], {})[key[1]] = Annotated[kind, flag, group]
    record: Any = TypedDict
    nested = {name: record(name, table, total=False) for name, table in sections.items()}
    return record("Settings", top | nested, total=False)


def _unbounded(kind: Any) -> Any:
    """Return a type without its bounds and without None: `resolve` refuses, in the same words."""
    parts = [_unbounded(part) for part in get_args(kind) if part is not NoneType]
    either: Any = Union
    if get_origin(kind) is Union and len(parts) > 1:
        return either[tuple(parts)]
    if get_origin(kind) in (Annotated, Union):
        return parts[0]
    record: Any = tuple
    return record[tuple(parts)] if get_origin(kind) is tuple else kind


def _section_group(section: str) -> Group:
    """Return the heading of a section of settings in the help, in the order of `Config`."""
    order = list(Config.model_fields).index(section)
    meaning = type(getattr(Config(), section)).__doc__ or ""
    return Group(f"Settings: {section}", help=" ".join(meaning.split()), sort_key=order)


if TYPE_CHECKING:
    SettingFlags = dict[str, Any]
else:
    SettingFlags = setting_flags()


@dataclass(frozen=True, slots=True, kw_only=True)
class OutputOptions:
    """Options for the output of a mission."""

    output: Annotated[
        Path | None,
        Parameter(
            name=("--output", "-o"),
            metavar="DIR",
            help="The result folder itself. [default: runs/TIME-NAME]",
        ),
    ] = None
    overwrite: Annotated[bool, Parameter(negative=(), help="Replace earlier results in DIR.")] = (
        False
    )
    animate: Annotated[
        Literal["gif", "mp4"] | None,
        Parameter(help="Film the mission; --animate without a value makes a gif. [default: no]"),
    ] = None
    save_bag: Annotated[
        bool, Parameter(negative=(), help="Write tracks and maps as a ROS bag, too: mission.mcap.")
    ] = False
    quiet: Annotated[bool, Parameter(negative=(), help="Print the result folder alone.")] = False


@dataclass(frozen=True, slots=True, kw_only=True)
class MissionOptions:
    """Options for the world of a simulated mission."""

    named: NamedSettings = None
    beamwidth: Annotated[
        float | None,
        Parameter(
            metavar="DEG",
            help="Half-power beamwidth of the vehicle's call [deg], up to 180; sets "
            "emitter.radius. [default: 33.3]",
        ),
    ] = None
    landmarks: Annotated[
        Whole | None,
        Parameter(metavar="N", help="Number of landmarks; sets scenario.landmarks. [default: 50]"),
    ] = None
    duration: Annotated[
        float | None,
        Parameter(
            metavar="SECONDS",
            help="Length of the drive [s]; sets scenario.steps. [default: 187.5]",
        ),
    ] = None
    engine: Annotated[
        Literal["auto", "block", "dense"] | None,
        Parameter(
            help="How samples are computed: block (exact sums over blocks, fast), dense (every "
            "sample, slow) or auto (block where it applies); sets receiver.engine. [default: auto]"
        ),
    ] = None
    particles: Particles = None
    world: Annotated[
        Path | None,
        Parameter(
            metavar="DIR",
            help="A world of your own: landmarks.csv, path.csv, world.toml; sets scenario.world. "
            "[default: one is drawn]",
        ),
    ] = None
    settings: Annotated[SettingFlags | None, Parameter(name="*")] = None


def mission_config(options: MissionOptions) -> tuple[Config, "World | None", tuple[str, ...]]:
    """Resolve the settings of a mission: defaults < world < named < file < environment < flags.

    The estimators that the named settings are meant for are returned, too.

    >>> config, _, estimators = mission_config(MissionOptions(duration=60.0))
    >>> config.scenario.steps, config.settings, estimators
    (480, 'best', ('smoother',))
    """
    short: Layer = {
        WORLD_KEY: Given(options.world and str(options.world), "--world"),
        ("scenario", "landmarks"): Given(options.landmarks, "--landmarks"),
        ("receiver", "engine"): Given(options.engine, "--engine"),
        ("fastslam", "particles"): Given(options.particles, "--particles"),
    }
    return mission_settings(
        layers(options.named, None),
        from_flags(options.settings or {}),
        short,
        beamwidth=Given(options.beamwidth, "--beamwidth"),
        duration=Given(options.duration, "--duration"),
    )


def layers(named: Sequence[str] | None, settings: SettingFlags | None) -> Layer:
    """Lay named settings, files, environment and flags over each other.

    >>> layers(None, {"seed": 3})["seed",].value
    3
    """
    given = [(word, settings_of(word, "--settings")) for word in named or ()]
    named_here = (layer for word, layer in given if word in NAMES)
    start, environment = (layer for _, layer in given), from_environment(os.environ)
    return laid(*start, environment, from_flags(settings or {}), *named_here)


def filters(chosen: str | Sequence[str], particles: int | None) -> tuple[str, ...]:
    """Return the names of the estimators of a choice; refuse particles for filters without them.

    >>> filters("both", 300), filters("ekf", None)
    (('ekf', 'fastslam'), ('ekf',))
    """
    names = named_filters(chosen, "--filter")
    if particles is not None and not any("fastslam" in entry(n).sections for n in names):
        able = [known.name for known in CATALOGUE.values() if "fastslam" in known.sections]
        others = " or ".join(f"--filter {name}" for name in (*able, *GROUPS))
        raise InputError(
            f"--particles: found {particles}, but --filter is {','.join(names)}, which has none; "
            f"add {others}"
        )
    return names
