"""Arguments of Python and the command line: settings, strategies and estimators by name.

Words come from a command line or from Python; where each was given is said in its refusal.
"""

import sys
from collections.abc import Iterable, Mapping, Sequence
from math import isfinite, radians
from numbers import Real
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

from pipistrelle.config import STRATEGIES, Config, InputError, Strategy
from pipistrelle.estimation.catalogue import CATALOGUE, PAPERS, check_distinct, check_name, entry
from pipistrelle.experiments.named_settings import check_own, laid, over_named, settings_of
from pipistrelle.refusals import meant, refusal, shown
from pipistrelle.settings import (
    ARRAY_KEY,
    CALL_KEYS,
    CALLERS,
    RADIUS_KEY,
    WORLD_KEY,
    Given,
    Key,
    Layer,
    from_flags,
    from_table,
    resolve,
    spread,
)

if TYPE_CHECKING:
    from pipistrelle.experiments.hearing.scenario import World

Base = Config | Mapping[str, Any] | str | Path | None
"""Settings to start from: as they were resolved, as a table, by name, or the file that holds it."""
Filters = str | type | Sequence[str | type]
"""Estimators: by name, or classes of the user."""
GROUPS = {"both": PAPERS, "all": tuple(CATALOGUE)}
"""Names that stand for several estimators."""
RUN_NAMES = "best"
"""Named settings of `run`, where no others are named."""
SLAM_TAKES = "smoother"
"""Estimator of `slam`, where neither it nor settings are named."""
STEPS: Key = ("scenario", "steps")


def base_layer(base: Base) -> Layer:
    """Return the settings to start from, by their keys.

    >>> base_layer({"rays.power": 3.0})["rays", "power"]
    Given(value=3.0, where='config: rays.power')
    """
    if base is None:
        return {}
    if isinstance(base, Config):
        return from_flags(base.model_dump(mode="json", exclude_defaults=True))
    if isinstance(base, Mapping):
        return from_table(spread(base, "."), "config: ")
    if not isinstance(base, (str, Path)):
        expected = "a Config, a mapping, a name or the path of a TOML file"
        raise refusal("config", shown(base), expected, "give settings by keyword")
    return settings_of(str(base), "config")


def folder_named(place: object, name: str) -> Path:
    """Return the folder that an argument of some name gives; refuse what is no path."""
    if not isinstance(place, (str, Path)):
        raise refusal(name, shown(place), "the path of a folder", "name one")
    return Path(place)


def short_names(short: Layer, flags: Layer) -> Layer:
    """Return the settings that were given by short names (their value is not None).

    A setting that was given by its own name too, in `flags`, is refused.

    >>> short_names({("seed",): Given(3, "-s")}, {("seed",): Given(4, "--seed")})
    Traceback (most recent call last):
    pipistrelle.config.InputError: -s and --seed are one setting; give one of them
    """
    short = {key: given for key, given in short.items() if given.value is not None}
    for key in short.keys() & flags.keys():
        both = f"{short[key].where} and {flags[key].where}"
        raise InputError(f"{both} are one setting; give one of them")
    return short


def mission_settings(
    beneath: Layer,
    flags: Layer,
    short: Layer,
    *,
    beamwidth: Given,
    duration: Given,
    default: str = RUN_NAMES,
) -> tuple[Config, "World | None", tuple[str, ...]]:
    """Resolve the settings of a mission: defaults < named < world < beneath < flags.

    The beamwidth is the half-power width of the vehicle's call [deg], the duration in seconds;
    either may be None. `default` is the name of the settings where no other is given. The world and
    the estimators that the settings name are returned, too.

    >>> nothing = Given(None, "")
    >>> minute = Given(60.0, "duration")
    >>> config, _, estimators = mission_settings({}, {}, {}, beamwidth=nothing, duration=minute)
    >>> config.scenario.steps, config.settings, estimators
    (480, 'best', ('smoother',))
    """
    layer = laid(beneath, flags, short_names(short, flags))
    check_own(layer)
    world = None
    if CALLERS in layer:
        from pipistrelle.experiments.hearing.caller_paths import with_routes

        layer = with_routes(layer)
    if CALLERS in layer or not layer.keys().isdisjoint(CALL_KEYS):
        from pipistrelle.acoustics.call import with_calls

        layer = with_calls(layer)
    if ARRAY_KEY in layer:
        from pipistrelle.arrays.array_file import with_array

        layer = with_array(layer)
    if WORLD_KEY in layer:
        from pipistrelle.experiments.hearing.world_folder import named_world, settled

        world = named_world(layer)
        layer = layer if world is None else settled(world, layer)
    layer, estimators = over_named(layer, default=default)
    base, more = resolve(layer), {}
    if duration.value is not None:
        more[STEPS] = Given(_steps(duration, base), f"{duration.where} {duration.value:g}")
    if beamwidth.value is not None:
        more[RADIUS_KEY] = Given(_radius(number(beamwidth), base), beamwidth.where)
    return resolve(layer | short_names(more, flags)), world, estimators


def number(given: Given) -> float:
    """Return a value that is a number; refuse anything else, even text that spells one.

    >>> number(Given("60", "duration"))
    Traceback (most recent call last):
    pipistrelle.config.InputError: duration: found '60', expected a number
    """
    if not isinstance(given.value, Real):
        raise InputError(f"{given.where}: found {shown(given.value)}, expected a number")
    return float(given.value)


def frames_named(text: str | None, count: int, where: str) -> range:
    """Return the frames that a slice names, A:B, of so many; all of None.

    >>> frames_named("2:4", 10, "--frames"), frames_named(":3", 10, "--frames")
    (range(2, 4), range(0, 3))
    """
    if text is None:
        return range(count)
    parts = text.split(":")
    if len(parts) == 2 and all(p.isascii() and (p.isdigit() or not p) for p in parts):
        begin, end = (int(p[:18]) if p else None for p in parts)
        if frames := range(count)[begin:end]:
            return frames
    raise InputError(
        f"{where}: found {shown(text)}, expected A:B, from A to before B of {count} frames that "
        "are counted from 0"
    )


def named_strategies(chosen: str | Sequence[str]) -> tuple[Strategy, ...]:
    """Return the strategies of a choice, in their usual order.

    >>> named_strategies("all"), named_strategies(["fused"])
    (('active', 'fused', 'passive'), ('fused',))
    """
    if isinstance(chosen, str):
        chosen = STRATEGIES if chosen == "all" else (chosen,)
    chosen = tuple(chosen) if isinstance(chosen, Iterable) else (chosen,)
    for strategy in chosen or (chosen,):
        if strategy not in get_args(Strategy):
            near = meant(str(strategy), STRATEGIES)
            fix = f"did you mean {near!r}?" if near else "choose"
            expected = "'active', 'fused', 'passive' or 'all'"
            raise InputError(f"strategies: found {shown(strategy)}, expected {expected}; {fix}")
    return tuple(strategy for strategy in STRATEGIES if strategy in chosen)


_EXPECTED = "expected an estimator's name or its class"


def named_filters(chosen: Filters, where: str = "filters") -> tuple[str, ...]:
    """Return the names of the estimators of a choice; of a class, ``module:Class``.

    Text may hold several names, separated by commas. The groups are "both", the paper's two, and
    "all".

    >>> named_filters("both"), named_filters("ekf,iekf"), named_filters(["ekf", "iekf"])
    (('ekf', 'fastslam'), ('ekf', 'iekf'), ('ekf', 'iekf'))
    >>> from pipistrelle.estimation.ekf.filter import EkfSlam
    >>> named_filters(EkfSlam)
    ('pipistrelle.estimation.ekf.filter:EkfSlam',)
    """
    if isinstance(chosen, str):
        chosen = GROUPS.get(chosen) or (chosen,)
    elif isinstance(chosen, type) or not isinstance(chosen, Iterable):
        chosen = (chosen,)
    elif getattr(chosen, "ndim", 1) == 0:  # an array that Python takes for iterable
        raise InputError(f"{where}: found {shown(chosen)}, {_EXPECTED}")
    parted = (each for choice in chosen for each in _parted(choice))
    names = tuple(dict.fromkeys(_name_of(choice, where) for choice in parted))
    if not names:
        raise InputError(f"{where}: found none, {_EXPECTED}")
    for name in names:
        if name in GROUPS:
            means = ", ".join(GROUPS[name])
            raise InputError(f"{where}: found {name!r} in a list; it stands alone, for {means}")
        entry(check_name(name, *GROUPS, where=where))
    check_distinct(names, where)
    return names


def _parted(chosen: str | type) -> Sequence[str | type]:
    """Split names at commas; a class is one."""
    return [name.strip() for name in chosen.split(",")] if isinstance(chosen, str) else (chosen,)


def _name_of(kind: str | type, where: str) -> str:
    """Return the name by which workers and folders find an estimator: of a class, module:Class."""
    if isinstance(kind, str):
        return kind
    if not isinstance(kind, type):
        raise InputError(f"{where}: found {shown(kind)}, {_EXPECTED}")
    module, name = kind.__module__, kind.__qualname__
    if getattr(sys.modules.get(module), name, None) is not kind:
        raise InputError(
            f"{where}: found the class {name}, which its module, {module}, does not have by this "
            "name; expected one that others find, as module:Class: define it outside of functions"
        )
    return f"{module}:{name}"


def _steps(duration: Given, config: Config) -> int:
    """Count the control steps of a drive; at least one frame."""
    scenario = config.scenario
    frame = scenario.step * scenario.steps_per_frame
    if not frame <= number(duration) or not isfinite(duration.value / scenario.step):
        raise InputError(
            f"{duration.where}: found {duration.value:g}, expected at least one frame "
            f"({frame:g} s), in finite time"
        )
    return round(duration.value / scenario.step)


def _radius(beamwidth: float, config: Config) -> float:
    """Find the piston that makes a beamwidth [deg]."""
    from pipistrelle.acoustics.emitter import piston_radius

    return float(
        piston_radius(
            radians(beamwidth),
            frequency=config.emitter.centre,
            speed_of_sound=config.medium.sound_speed,
        )
    )
