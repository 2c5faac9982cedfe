"""Worlds of the benchmarks: the paper's world and short versions of it."""

from functools import lru_cache

import numpy as np

from pipistrelle.config import Config
from pipistrelle.detection.scans import Scan
from pipistrelle.experiments.hearing.listening import listen
from pipistrelle.experiments.hearing.scenario import Scenario, world_of
from pipistrelle.experiments.runs import heard_world
from pipistrelle.experiments.studies.plan import find_plan, read_plan

RADII = tuple(read_plan(find_plan("paper")).grid["emitter.radius"])
"""The paper's twelve piston radii [m]."""


def some_frames(world: Scenario, every: int) -> Scenario:
    """Keep each n-th frame of a world, with the four steps that lead to it."""
    frames = np.arange(every, len(world.controls) // 4 + 1, every)
    steps = (4 * frames[:, None] + np.arange(-3, 1)).ravel()
    kept = np.concatenate(([0], steps))
    return Scenario(
        time=world.time[kept],
        path=world.path[kept],
        controls=world.controls[steps - 1],
        landmarks=world.landmarks,
        callers=world.callers,
    )


@lru_cache
def scans_of(config: Config, strategy: str) -> tuple[Scan, ...]:
    """Simulate the scans of a strategy in a whole world."""
    (heard,) = listen(world_of(config), config, (config.emitter.radius,))
    return heard_world.scans_of(heard, strategy, config)
