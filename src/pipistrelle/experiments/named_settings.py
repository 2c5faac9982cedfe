"""Presets (``settings/NAME.toml``) and estimator-specific settings.

A preset lists settings, as a user's file does, and the estimators that it is meant for. All other
sources override it. In any file ``[own.iekf]`` holds settings for that estimator only, which
override the common settings of that file and of lower layers.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path

from pipistrelle.config import Config, InputError, Strategy
from pipistrelle.estimation.catalogue import SECTIONS, check_name
from pipistrelle.refusals import meant, refusal, shown
from pipistrelle.settings import (
    OWN,
    SETTINGS,
    Given,
    Layer,
    from_file,
    from_flags,
    from_table,
    read_toml,
    resolve,
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Case:
    """A sensing strategy and an estimator (`estimation.catalogue.entry`) to run in a world."""

    strategy: Strategy
    filter: str
    iteration: int = 0


def shipped(room: str) -> tuple[str, ...]:
    """List the names of the TOML files in a folder of this package, in alphabetical order."""
    files_there = (files("pipistrelle.experiments") / room).iterdir()
    return tuple(sorted(each.name[:-5] for each in files_there if each.name.endswith(".toml")))


NAMES = shipped("settings")
PLANS = tuple(name for name in shipped("studies") if not name.endswith("_calibration"))
"""Names of the study plans that ship with the package."""


def settings_of(word: str, where: str) -> Layer:
    """Return settings from a preset's name or a TOML file's path; `where` names the option."""
    if word in NAMES:
        return {SETTINGS: Given(word, where)}
    path = Path(word)
    if path.is_dir():
        fix = "a world of your own is named by world"
        raise refusal(where, f"{word!r}, a folder", "a TOML file of settings", fix)
    if not (path.suffix or len(path.parts) > 1 or path.exists()):
        raise _unknown(Given(word, where), " or the path of a TOML file")
    if layer := from_file(path):
        return layer
    raise refusal(path, "no setting", "settings", "add one, or leave the file out")


def _unknown(given: Given, other: str = "") -> InputError:
    """Return the InputError for an unknown preset, with the most similar known name."""
    near = meant(str(given.value), NAMES)
    fix = f"did you mean {near}?" if near else "choose one"
    expected = f"{', '.join(NAMES)}{other}"
    return refusal(given.where, shown(given.value), expected, fix)


def over_named(*layers: Layer, default: str | None = None) -> tuple[Layer, tuple[str, ...]]:
    """Merge layers of settings over the preset that they name, else over the preset `default`.

    Also returns the estimators that the preset is meant for; none without a preset.
    """
    over = laid(*layers)
    given = over.get(SETTINGS, Given(default, "settings"))
    if given.value is None:
        return over, ()
    if given.value not in NAMES:
        raise _unknown(given)
    path = Path(str(files("pipistrelle.experiments") / "settings" / f"{given.value}.toml"))
    table = read_toml(path)
    estimators = tuple(table.pop("filters"))
    beneath, _ = over_named(from_table(table, f"{path}: "))
    return laid(beneath, over, {SETTINGS: given}), estimators


def laid(*layers: Layer) -> Layer:
    """Merge layers of settings; later layers override earlier, also estimator-specific values."""
    found: Layer = {}
    for layer in layers:
        beneath = {key: one for key, one in found.items() if not (_own(key) and key[2:] in layer)}
        found = beneath | layer
    return found


def _own(key: tuple[str, ...]) -> bool:
    """Return whether a key is an estimator-specific setting (``own.NAME.…``)."""
    return key[:1] == OWN and len(key) > 2


def parted(layer: Layer) -> tuple[Layer, dict[str, Layer]]:
    """Split a layer of settings into common and estimator-specific settings, by estimator."""
    own: dict[str, Layer] = {}
    for key, given in layer.items():
        if _own(key):
            own.setdefault(key[1], {})[key[2:]] = given
    return {key: given for key, given in layer.items() if not _own(key)}, own


def check_own(layer: Layer) -> None:
    """Raise if an estimator-specific setting is invalid or changes the simulated measurements."""
    _, own = parted(layer)
    for name, settings in own.items():
        for key, given in settings.items():
            check_name(name, where=given.where)
            if key[0] not in SECTIONS:
                expected = f"one of the sections {', '.join(SECTIONS)}"
                raise InputError(f"{given.where}: changes what is heard; expected {expected}")
        resolve(settings)


def own_config(config: Config, name: str) -> Config:
    """Return the common settings with the overrides for an estimator applied."""
    own = {} if config.own is None else config.own.get(name, {})
    return with_settings(config.model_copy(update={"own": None}), from_flags(own))


def with_settings(config: Config, over: Layer) -> Config:
    """Return settings with a layer of others over them."""
    return resolve(from_flags(config.model_dump(mode="json")) | over) if over else config


def of_estimators(config: Config, names: Sequence[str]) -> Config:
    """Return a mission's settings, with the overrides merged in if all its estimators agree."""
    first, *others = (own_config(config, name) for name in names)
    if all(other == first for other in others):
        return first
    own = {name: config.own[name] for name in names if config.own and name in config.own}
    return config.model_copy(update={"own": own})


def each_its_own(config: Config, names: Sequence[str]) -> Iterator[tuple[Config, tuple[str, ...]]]:
    """Yield groups of estimators with equal settings: the settings and the estimators' names."""
    left = list(names)
    while left:
        own = own_config(config, left[0])
        alike = tuple(name for name in left if own_config(config, name) == own)
        left = [name for name in left if name not in alike]
        yield own, alike
