"""Arguments of Python and the command line: settings, strategies, estimators, settings of logs."""

import sys
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from itertools import chain
from math import isfinite, radians
from numbers import Real
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

from pydantic import create_model

from pipistrelle.config import STRATEGIES, BagConfig, Config, InputError, Section, Strategy
from pipistrelle.estimation.catalogue import (
    CATALOGUE,
    PAPERS,
    SECTIONS,
    check_distinct,
    check_name,
    entry,
)
from pipistrelle.experiments.named_settings import check_own, laid, over_named, settings_of
from pipistrelle.files import Kind, OwnFiles, claim
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
    from pipistrelle.detection.logs.recording import Log
    from pipistrelle.experiments.hearing.scenario import World

Base = Config | Mapping[str, Any] | str | Path | None
"""Settings to start from: resolved, as a table, or the name or path of a file."""
Progress = Callable[[str, int, int], None]
"""Receives the stage, the number of frames done, and their total."""
Filters = str | type | Sequence[str | type]
"""Estimators by name or class."""
GROUPS = {"both": PAPERS, "all": tuple(CATALOGUE)}
"""Names of groups of estimators."""
RUN_NAMES = "best"
"""Default named settings of `run`."""
SLAM_TAKES = "smoother"
"""Default estimator of `slam`, unless named settings give another."""
STEPS: Key = ("scenario", "steps")
GATE_KEY: Key = ("filter", "gate")
OWN: dict[Key, str] = {
    GATE_KEY: "auto",
    ("rays", "precise_bearings"): "auto",
    ("filter", "noise"): "measured",
    ("fastslam", "estimate"): "mixture",
}
"""Defaults for recorded logs, where they differ from simulated missions."""
TIMING: Key = ("listening", "excess_paths")
"""Setting that is on for logs with excess paths or a moving caller."""
SHORT: dict[str, Key] = {
    "world": WORLD_KEY,
    "landmarks": ("scenario", "landmarks"),
    "particles": ("fastslam", "particles"),
    "gate": GATE_KEY,
    "truth": ("bag", "truth"),
}
"""Parameters that set a setting under a short name."""
PACKAGE = "pipistrelle."
LOGGED = frozenset(
    {
        ("filter", "range_std"),
        ("filter", "bearing_std"),
        ("filter", "initial_pose_std"),
        ("rays", "range_bounds"),
    }
)
"""Settings that the log decides."""
OF_WORLDS = frozenset({("filter", "first_pose")})
"""Settings of the filter that apply only to simulated truth."""

_REPLAYED: dict[str, Any] = {
    name: (Config.model_fields[name].annotation, ...)
    for name in ("seed", "settings", "own", *SECTIONS)
}
SlamConfig = create_model("SlamConfig", __base__=Section, **_REPLAYED)
"""The settings that affect the solution of a log; the ``config.toml`` of its results."""
BagSlamConfig = create_model("BagSlamConfig", __base__=SlamConfig, bag=(BagConfig, ...))
"""`SlamConfig` with the settings of the reader of ROS bags."""


def base_layer(base: Base) -> Layer:
    """Convert the argument `config` (a Config, mapping, preset or file) to a layer of settings."""
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
    """Convert an argument that names a folder to a path, or raise."""
    if not isinstance(place, (str, Path)):
        raise refusal(name, shown(place), "the path of a folder", "name one")
    return Path(place)


def short_names(short: Layer, flags: Layer) -> Layer:
    """Select the short options that have a value; raise if `flags` give the same setting."""
    short = {key: given for key, given in short.items() if given.value is not None}
    for key in short.keys() & flags.keys():
        both = f"{short[key].where} and {flags[key].where}"
        raise InputError(f"{both} are one setting; give one of them")
    return short


def keyword(name: str, value: str = "") -> str:
    """Format a parameter, with a value if any, as a Python keyword argument for messages."""
    return f"{name}={value}" if value else name


def warn_caller(*lines: str) -> None:
    """Issue warnings that point to the user's line of code that called the package."""
    frame, level = sys._getframe(1), 2
    while (caller := frame.f_back) and caller.f_globals.get("__name__", "").startswith(PACKAGE):
        frame, level = caller, level + 1
    for line in lines:
        warnings.warn(line, stacklevel=level + 1)


@dataclass(frozen=True, slots=True, kw_only=True)
class Door:
    """A user's call from Python or the command line: arguments, settings, output of messages.

    The defaults are for Python; the command line spells options as flags and prints messages.
    """

    asked: Mapping[str, Any]
    """Arguments by the names of the function's parameters."""
    beneath: Layer
    """Settings to start from."""
    flags: Layer
    """Settings that override them."""
    command: str
    """The call, as the result folder quotes it."""
    default: str = RUN_NAMES
    """Name of the settings where no other is given."""
    option: Callable[..., str] = keyword
    """Formats a parameter, perhaps with a value."""
    warn: Callable[..., object] = warn_caller
    """Receives warnings, as several lines."""
    note: Callable[[str], object] = lambda _: None
    """Receives messages on the work."""
    drawing: Callable[[str], AbstractContextManager[object]] = nullcontext
    """Receives a message on work that may take long, which is the body of the context."""
    makes_folder: bool = False
    """Whether results go to a new folder if none is given."""
    working: Callable[..., AbstractContextManager[Any]] = nullcontext
    """Yields the function that receives progress, given the settings and the estimators."""

    def given(self, name: str) -> Given:
        """Return an argument by its parameter's name, with the option's name for messages."""
        return Given(self.asked.get(name), self.option(name))

    def short(self) -> Layer:
        """Select the settings that short options give; raise if `flags` give the same setting."""
        given = {key: self.given(name) for name, key in SHORT.items()}
        if isinstance(path := given[WORLD_KEY].value, Path):
            given[WORLD_KEY] = Given(str(path), given[WORLD_KEY].where)
        return short_names(given, self.flags)

    def folder(self, name: str) -> Path | None:
        """Return the path of the folder that an argument names; None if it is not given."""
        value = self.asked.get(name)
        return None if value is None else folder_named(value, self.option(name))

    def ways_out(self, name: str) -> tuple[str, str]:
        """Return the options, for messages, that name another folder and allow overwriting."""
        return self.option(name, "DIR"), self.option("overwrite", "True")

    def claimed(self, name: str, kind: Kind) -> OwnFiles | None:
        """Claim the folder that an argument names for writing; None if it is not given."""
        if (folder := self.folder(name)) is None:
            return None
        overwrite = self.asked["overwrite"]
        return claim(folder, kind, overwrite=overwrite, flags=self.ways_out(name))

    def estimators(self, usual: str | Sequence[str]) -> tuple[str, ...]:
        """Return the chosen estimators, else `usual`; raise for `particles` without FastSLAM."""
        chosen, particles = self.asked["filters"], self.asked.get("particles")
        names = named_filters(usual if chosen is None else chosen, self.option("filters"))
        if particles is not None and not any("fastslam" in entry(n).sections for n in names):
            able = [known.name for known in CATALOGUE.values() if "fastslam" in known.sections]
            others = " or ".join(self.option("filters", name) for name in (*able, *GROUPS))
            but = f"but {self.option('filters')} is {','.join(names)}, which has none"
            raise InputError(f"{self.option('particles')}: found {particles}, {but}; add {others}")
        return names


def mission_settings(door: Door) -> tuple[Config, "World | None", tuple[str, ...]]:
    """Return the resolved settings of a simulated mission, its world and its estimators.

    Later layers win: defaults, named settings, the world's settings, `Door.beneath`, and
    `Door.flags` with the short options. The beamwidth is the half-power width of the vehicle's
    call [deg], the duration in seconds.

    >>> minute = Door(asked={"duration": 60.0}, beneath={}, flags={}, command="")
    >>> config, _, estimators = mission_settings(minute)
    >>> config.scenario.steps, config.settings, estimators
    (480, 'best', ('smoother',))
    """
    flags, beamwidth, duration = door.flags, door.given("beamwidth"), door.given("duration")
    layer = laid(door.beneath, flags, door.short())
    check_own(layer)
    world = None
    if CALLERS in layer:
        from pipistrelle.experiments.hearing.caller_paths import with_routes

        layer = with_routes(layer)
    if CALLERS in layer or not layer.keys().isdisjoint(CALL_KEYS):
        from pipistrelle.acoustics.call import with_calls

        layer = with_calls(layer)
    if ARRAY_KEY in layer:
        from pipistrelle.arrays.layout import with_array

        layer = with_array(layer)
    if WORLD_KEY in layer:
        from pipistrelle.experiments.hearing.world_folder import named_world, with_world

        world = named_world(layer)
        layer = layer if world is None else with_world(world, layer)
    layer, estimators = over_named(layer, default=door.default)
    base, more = resolve(layer), {}
    if duration.value is not None:
        step, frame = base.scenario.step, base.scenario.step * base.scenario.steps_per_frame
        if not frame <= number(duration) or not isfinite(duration.value / step):
            found = f"found {duration.value:g}, expected at least one frame ({frame:g} s)"
            raise InputError(f"{duration.where}: {found}, in finite time")
        steps = round(duration.value / step)
        more[STEPS] = Given(steps, f"{duration.where} {duration.value:g}")
    if beamwidth.value is not None:
        from pipistrelle.acoustics.emitter import piston_radius

        width, c = radians(number(beamwidth)), base.medium.sound_speed
        radius = piston_radius(width, frequency=base.emitter.centre, speed_of_sound=c)
        more[RADIUS_KEY] = Given(float(radius), beamwidth.where)
    return resolve(layer | short_names(more, flags)), world, estimators


def number(given: Given) -> float:
    """Convert an argument to a float; raise if it is not a number, even for text such as "60"."""
    if not isinstance(given.value, Real):
        raise InputError(f"{given.where}: found {shown(given.value)}, expected a number")
    return float(given.value)


def frames_named(given: Given, count: int) -> range:
    """Parse a range A:B out of `count` frames; None selects all of them.

    >>> frames_named(Given("2:4", "--frames"), 10), frames_named(Given(None, "--frames"), 10)
    (range(2, 4), range(0, 10))
    """
    if given.value is None:
        return range(count)
    parts = given.value.split(":")
    if len(parts) == 2 and all(p.isascii() and (p.isdigit() or not p) for p in parts):
        begin, end = (int(p[:18]) if p else None for p in parts)
        if frames := range(count)[begin:end]:
            return frames
    expected = f"A:B, from A to before B of {count} frames that are counted from 0"
    raise InputError(f"{given.where}: found {shown(given.value)}, expected {expected}")


def named_strategies(chosen: str | Sequence[str], where: str) -> tuple[Strategy, ...]:
    """Return the sensing strategies that an argument chooses, in the order of `STRATEGIES`."""
    if isinstance(chosen, str):
        chosen = STRATEGIES if chosen == "all" else chosen.split(",")
    chosen = tuple(chosen) if isinstance(chosen, Iterable) else (chosen,)
    for strategy in chosen or (chosen,):
        if strategy not in get_args(Strategy):
            near = meant(str(strategy), STRATEGIES)
            fix = f"did you mean {near!r}?" if near else "take one of them"
            expected = "'active', 'fused', 'passive', several with commas, or 'all'"
            raise InputError(f"{where}: found {shown(strategy)}, expected {expected}; {fix}")
    return tuple(strategy for strategy in STRATEGIES if strategy in chosen)


_EXPECTED = "expected an estimator's name or its class"


def named_filters(chosen: Filters, where: str = "filters") -> tuple[str, ...]:
    """Return the names of the estimators that an argument chooses; ``module:Class`` for a class.

    Text may list several names, separated by commas. The groups are "both", the paper's two, and
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
    listed = (each.split(",") if isinstance(each, str) else (each,) for each in chosen)
    names = tuple(dict.fromkeys(_name_of(each, where) for each in chain.from_iterable(listed)))
    if not names:
        raise InputError(f"{where}: found none, {_EXPECTED}")
    for name in names:
        if name in GROUPS:
            means = ", ".join(GROUPS[name])
            raise InputError(f"{where}: found {name!r} in a list; it stands alone, for {means}")
        entry(check_name(name, *GROUPS, where=where))
    check_distinct(names, where)
    return names


def _name_of(kind: str | type, where: str) -> str:
    """Return an estimator's name, or ``module:Class`` for a class, for import by workers."""
    if isinstance(kind, str):
        return kind.strip()
    if not isinstance(kind, type):
        raise InputError(f"{where}: found {shown(kind)}, {_EXPECTED}")
    module, name = kind.__module__, kind.__qualname__
    if getattr(sys.modules.get(module), name, None) is not kind:
        found = f"the class {name}, which its module, {module}, does not have by this name"
        expected = "one that others find, as module:Class: define it outside of functions"
        raise InputError(f"{where}: found {found}; expected {expected}")
    return f"{module}:{name}"


def replayed(config: Config) -> Section:
    """Select the settings that affect the solution of a recorded log."""
    kind = SlamConfig if config.bag == BagConfig() else BagSlamConfig
    return kind(**{name: getattr(config, name) for name in kind.model_fields})


def is_open(key: Key) -> bool:
    """Return whether a setting may be given with a log: it is used, and not fixed by the log."""
    return key[0] in BagSlamConfig.model_fields and key not in LOGGED | OF_WORLDS


def check_open(flags: Layer) -> None:
    """Raise if a given setting is fixed by the log or has no effect on a log."""
    for key, given in flags.items():
        if not is_open(key):
            why = "the log decides this" if key in LOGGED else "means nothing to a recorded log"
            raise InputError(f"{given.where}: {why}; leave it out")


def has_excess_paths(recorded: "Log") -> bool:
    """Return whether any measurement of a log has an excess path."""
    return any((scan.excess_path == scan.excess_path).any() for scan in recorded.scans)


def with_log(layer: Layer, recorded: "Log", log: Path) -> tuple[Config, list[str]]:
    """Resolve settings with the values that a log fixes; return notes on overruled settings."""
    decided: Layer = {key: Given(getattr(recorded, key[1]), f"{log}: {key[1]}") for key in LOGGED}
    own = {key: Given(value, "slam") for key, value in OWN.items()}
    for name, value in recorded.association.items():
        own["association", name] = Given(value, f"{log}: association.{name}")
    if recorded.gate is not None:
        own[GATE_KEY] = Given(recorded.gate, str(log))
    moves = any(caller.moves for caller in recorded.callers)
    own[TIMING] = Given(moves or has_excess_paths(recorded), str(log))
    if recorded.excess_path_std is not None:
        where = f"{log}: excess_path_std"
        own["filter", "excess_path_std"] = Given(recorded.excess_path_std, where)
    if ("rays", "likelihood") in layer:  # it is a reading of the paper's rays
        del own["rays", "precise_bearings"]
    wished, settled, notes = resolve(layer), resolve(laid(own, layer, decided)), []
    for section, name in sorted(LOGGED & layer.keys()):
        value = getattr(getattr(settled, section), name)
        if getattr(getattr(wished, section), name) != value:
            where = layer[section, name].where
            notes.append(f"{where}: the log decides this, and says {value}")
    return settled, notes
