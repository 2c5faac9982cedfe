"""Compile the kernels before processes start that would each compile them."""

from collections.abc import Iterable

from pipistrelle.config import STRATEGIES, Config, ListeningConfig, ScenarioConfig
from pipistrelle.estimation.catalogue import CATALOGUE
from pipistrelle.experiments.runs.trial import run_mission


def compile_kernels(
    filters: Iterable[str] = CATALOGUE, timings: Iterable[bool] = (False, True)
) -> None:
    """Compile kernels, or load them from the cache, by missions of two frames.

    The timings are the values of ``listening.timing``. Filters that are not of the catalogue
    are left out: their kernels are compiled when they are needed.
    """
    there = [name for name in filters if name in CATALOGUE]
    tiny = ScenarioConfig(steps=8, landmarks=4, radius=10.0)
    for timing in timings:
        run_mission(
            Config(scenario=tiny, listening=ListeningConfig(timing=timing)), STRATEGIES, there
        )
