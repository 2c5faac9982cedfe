"""Compile the kernels before the work begins: they are kept, so this takes long only once."""

import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from numba.core.event import Event, Listener, install_listener

from pipistrelle.config import Config, ScenarioConfig
from pipistrelle.detection.scans import make_scan
from pipistrelle.estimation.beliefs import Estimator, Gaussian
from pipistrelle.estimation.catalogue import CATALOGUE, is_there
from pipistrelle.experiments.hearing.courses import motion_of
from pipistrelle.experiments.machine import cores
from pipistrelle.experiments.runs.trial import run_mission

_SECOND = "from pipistrelle.experiments.runs.compiling import compile_others; compile_others()"


def compile_kernels(tell: Callable[[], object] | None = None) -> None:
    """Compile every kernel, or load it from the cache, by a mission of two frames.

    Where the cache is empty a second process compiles those of all filters that share none with
    the first meanwhile. Nothing depends on it: what it leaves undone is done here.

    Parameters
    ----------
    tell : function of nothing, optional
        Called once, when the first kernel is about to be compiled, and not merely loaded.
    """
    with install_listener("numba:compile", _Once(tell)):
        _compile_or_load()


class _Once(Listener):
    """Tell of the first kernel that is compiled."""

    def __init__(self, tell: Callable[[], object] | None) -> None:
        self.tell = tell

    def on_start(self, event: Event) -> None:
        """Tell, and forget whom."""
        tell, self.tell = self.tell, None
        if tell is not None:
            tell()

    def on_end(self, event: Event) -> None:
        """Say nothing."""


def _compile_or_load() -> None:
    """Run what needs every kernel."""
    tiny = Config(scenario=ScenarioConfig(steps=8, landmarks=4, radius=10.0))
    cached = any(Path(os.environ["NUMBA_CACHE_DIR"]).rglob("*.nbc"))
    if not cached and cores() > 1:
        with _second_process(_SECOND):
            run_mission(tiny, ("fused",), _families()[0])
    run_mission(tiny, ("active", "fused", "passive"), tuple(filter(is_there, CATALOGUE)))


def compile_others() -> None:
    """Compile the kernels of the other families, by one frame, made up: it needs no other."""
    for name in _families()[1]:
        slam, rng = _built(name), np.random.default_rng(0)
        belief = slam.init(Gaussian(mean=np.zeros(3), covariance=np.eye(3)))
        belief, _ = slam.predict(belief, np.ones((1, 2)), np.ones(1), rng)
        heard = {"range": np.array([1.0, np.nan]), "range_std": 0.1, "bearing_std": 0.1}
        slam.update(belief, make_scan(1.0, np.arange(2), np.zeros(2), **heard), rng)


def _families() -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Names of the filters of the first one's package, whose kernels they share, and the others."""
    there = tuple(filter(is_there, CATALOGUE))
    package = {name: type(_built(name)).__module__.rpartition(".")[0] for name in there}
    own = package[next(iter(CATALOGUE))]
    related = tuple(name for name in there if package[name] == own)
    return related, tuple(name for name in there if name not in related)


def _built(name: str) -> Estimator:
    """Build a filter by the defaults."""
    return CATALOGUE[name].build(Config(), motion_of(Config().motion))


@contextmanager
def _second_process(statement: str) -> Iterator[None]:
    """Run a statement in a process of its own, if one can be had, and wait for its end."""
    command, nowhere = [sys.executable or "", "-P", "-c", statement], subprocess.DEVNULL
    try:
        second = subprocess.Popen(command, stdin=nowhere, stdout=nowhere, stderr=nowhere)
    except OSError:
        yield
        return
    try:
        yield
        second.wait()
    finally:
        second.kill()
        second.wait()
