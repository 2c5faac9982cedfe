"""A study's plan: what to vary, as a file, and the cases that it stands for.

The cases are the product of the grid, the strategies and the filters. A passive case does not
depend on the vehicle's beam: there is one for all radii, heard beside the narrowest beam.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from itertools import product
from types import MappingProxyType
from typing import Any, cast

from pipistrelle.config import Config, Strategy
from pipistrelle.experiments.cases import Case
from pipistrelle.experiments.hearing.world import ANY, World
from pipistrelle.experiments.hearing.world_folder import laid_over
from pipistrelle.settings import Given, Key, Layer, from_flags, resolve

RADIUS = "emitter.radius"
WORLD = "scenario.world"
MOST_CASES = 2**15 - 1
"""What their numbers have room for in the tables."""
MOST_WORLDS = 1_000_000
"""Each is a file in every folder of tables."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Plan:
    """What a study tries, in how many worlds.

    Attributes
    ----------
    name : str
    iterations : int
        Number of worlds.
    strategies : tuple of "active", "fused", "passive"
    filters : tuple of str
        The names of estimators.
    config : Config
        What holds where the grid says nothing else.
    grid : dict
        Settings by their dotted name, with the values that each takes.
    own : dict
        Settings of one filter alone by its name, each by its dotted name; they change nothing that
        is heard.
    worlds : dict
        Worlds that ``scenario.world`` names, by their names.
    planned : int
        Number of worlds of a whole study, as the plan's file names it, though fewer were asked for;
        at least ``iterations`` in what is read.
    """

    name: str
    iterations: int
    strategies: tuple[Strategy, ...]
    filters: tuple[str, ...]
    config: Config
    grid: Mapping[str, tuple[Any, ...]]
    own: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    worlds: Mapping[str, World] = field(default_factory=dict)
    planned: int = 0

    def world(self, config: Config) -> World:
        """Return what is known beforehand of the worlds of some settings."""
        return ANY if config.scenario.world is None else self.worlds[config.scenario.world]


@dataclass(frozen=True, slots=True, kw_only=True)
class PlannedCase(Case):
    """One combination of a plan: a case, whatever the world, with its settings.

    Attributes
    ----------
    number : int
        From 0, in the order of the plan.
    values : dict
        Of the grid's settings; None for the radius of a passive case.
    config : Config
        With these values, and what is the filter's own.
    """

    number: int
    values: Mapping[str, Any]
    config: Config


def cases_of(plan: Plan) -> tuple[PlannedCase, ...]:
    """Lay out the cases of a plan, in the order of their numbers.

    Parameters
    ----------
    plan : Plan

    Returns
    -------
    tuple of PlannedCase

    Examples
    --------
    >>> grid = {"emitter.radius": (0.0025, 0.025)}
    >>> ways = {"strategies": ("active", "passive"), "filters": ("ekf",)}
    >>> plan = Plan(name="two", iterations=1, config=Config(), grid=grid, **ways)
    >>> [(case.strategy, case.values["emitter.radius"]) for case in cases_of(plan)]
    [('active', 0.0025), ('active', 0.025), ('passive', None)]
    """
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
                config=own_config(plan, name, config),
            )
            cases.append(case)
    return tuple(cases)


def own_config(plan: Plan, name: str, config: Config) -> Config:
    """Return settings with those that are one filter's own.

    Parameters
    ----------
    plan : Plan
    name : str
        Of the filter.
    config : Config

    Returns
    -------
    Config

    Raises
    ------
    InputError
        For a value that its setting does not take.

    Examples
    --------
    >>> own = {"iekf": {"filter.noise": "measured"}}
    >>> ways = {"strategies": ("fused",), "filters": ("ekf", "iekf")}
    >>> plan = Plan(name="two", iterations=1, config=Config(), grid={}, own=own, **ways)
    >>> [case.config.filter.noise for case in cases_of(plan)]
    ['constant', 'measured']
    """
    if name not in plan.own:
        return config
    own = {
        cast(Key, tuple(key.split("."))): Given(value, f"own.{name}.{key}")
        for key, value in plan.own[name].items()
    }
    return resolve(from_flags(config.model_dump(mode="json")) | own)


def common(plan: Plan, values: Mapping[str, Any]) -> Config:
    """Return a plan's settings with some values of its grid, and no filter's own.

    Parameters
    ----------
    plan : Plan
    values : dict
        By their dotted names.

    Returns
    -------
    Config

    Examples
    --------
    >>> ways = {"strategies": ("fused",), "filters": ("ekf",), "config": Config()}
    >>> plan = Plan(name="one", iterations=1, grid={"filter.gate": (0.9,)}, **ways)
    >>> common(plan, {"filter.gate": 0.9}).filter.gate
    0.9
    """
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
    """Walk through the product of a grid.

    Parameters
    ----------
    layer : Layer
        Settings that hold where the grid says nothing else.
    grid : dict of tuple
        Settings by their dotted name, with the values that each takes.
    prefix : str
        Before such a name, where a refusal says which value is wrong.
    worlds : dict
        Those that the grid names.

    Yields
    ------
    dict
        The values of one combination, by their names; those of the last name change fastest.
    Config
        With these values.

    Raises
    ------
    InputError
        For a value that its setting does not take.

    Examples
    --------
    >>> grid = {"seed": (1, 2), "filter.gate": (0.9,)}
    >>> [(named["seed"], config.filter.gate) for named, config in combinations({}, grid, "grid.")]
    [(1, 0.9), (2, 0.9)]
    """
    for values in product(*grid.values()):
        named = dict(zip(grid, values, strict=True))
        varied = {
            cast(Key, tuple(name.split("."))): Given(value, prefix + name)
            for name, value in named.items()
        }
        world = worlds[named[WORLD]] if WORLD in named else None
        over = layer | varied if world is None else laid_over(world, layer, varied)
        yield named, resolve(over)
