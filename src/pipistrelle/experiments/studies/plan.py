"""A study's plan: the settings that it varies, and the cases that result.

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
from pipistrelle.experiments.hearing.world import ALL_DRAWN, World
from pipistrelle.experiments.hearing.world_folder import laid_over
from pipistrelle.settings import RADIUS_KEY, WORLD_KEY, Given, Key, Layer, from_flags, resolve

RADIUS, WORLD = ".".join(RADIUS_KEY), ".".join(WORLD_KEY)
MOST_CASES = 2**15 - 1
"""Largest number of cases, so that their numbers fit the column of the tables."""
MOST_WORLDS = 1_000_000
"""Largest number of worlds; each is one file for every table."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Plan:
    """What a study varies, and in how many worlds."""

    name: str
    iterations: int
    """Number of worlds."""
    strategies: tuple[Strategy, ...]
    filters: tuple[str, ...]
    """The names of estimators."""
    config: Config
    """Settings of every case, unless the grid says otherwise."""
    grid: Mapping[str, tuple[Any, ...]]
    """Settings by their dotted name, with the values that each takes."""
    own: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    """Settings of one filter alone by its name, each by its dotted name; they change nothing that
    is heard."""
    worlds: Mapping[str, World] = field(default_factory=dict)
    """Worlds that ``scenario.world`` names, by their names."""
    planned: int = 0
    """Number of worlds of a whole study, as the plan's file names it, though fewer were asked for;
    at least ``iterations`` in what is read."""

    def world(self, config: Config) -> World:
        """Return the user's own world that settings name, or the one of which all is drawn."""
        return ALL_DRAWN if config.scenario.world is None else self.worlds[config.scenario.world]


@dataclass(frozen=True, slots=True, kw_only=True)
class PlannedCase(Case):
    """One combination of a plan: a case, in any world, with its settings."""

    number: int
    """Number of the case, from 0, in the order of the plan."""
    values: Mapping[str, Any]
    """Values of the grid's settings; None for the radius of a passive case."""
    config: Config
    """Settings with these values, and with those of the filter alone."""


def cases_of(plan: Plan) -> tuple[PlannedCase, ...]:
    """Lay out the cases of a plan, in the order of their numbers.

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
    """Return settings with those of one filter's own laid over them.

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
    """Return a plan's settings with some values of its grid, without those of one filter alone.

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
    """Yield each combination of a grid, its values by name, and the settings with these values.

    The values of the last name change fastest. The prefix stands before a name in a refusal.

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
