"""Compilation of the kernels before a mission or a study, optionally in a second process."""

import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from itertools import product

import numpy as np

from pipistrelle.config import (
    STRATEGIES,
    Config,
    ListeningConfig,
    ScenarioConfig,
)
from pipistrelle.detection.scans import OWN, UNLABELLED, Scan, make_scan
from pipistrelle.estimation.beliefs import KNOWN
from pipistrelle.estimation.catalogue import CATALOGUE
from pipistrelle.estimation.data_association.sequential import METHODS
from pipistrelle.experiments.drives import Drive
from pipistrelle.experiments.machine import cores
from pipistrelle.experiments.named_settings import Case, each_its_own
from pipistrelle.experiments.runs.heard_world import drive_of
from pipistrelle.experiments.runs.trial import run_mission, try_trial
from pipistrelle.experiments.runs.validate import checked_scenario
from pipistrelle.geometry import wrap
from pipistrelle.jit import announce

_SECOND = """
import sys
from pipistrelle.config import Config
from pipistrelle.experiments.runs.compiling import compile_filters
compile_filters(Config.model_validate_json(sys.stdin.read()), sys.argv[1:])
"""
_FRAMES, _HEARD = 200, 10
"""Frames of the synthetic drive, and frames with its first landmark; later this landmark leaves the
smoother's window, which compiles the kernels for that case."""


def compile_kernels(
    filters: Iterable[str] = CATALOGUE,
    timings: Iterable[bool] = (False, True),
    associations: Iterable[str] = (KNOWN,),
) -> None:
    """Compile the kernels of estimators, or load them from the cache, by running tiny missions.

    `timings` are values of ``listening.excess_paths``, `associations` of ``association.method``.
    Estimators outside the catalogue are skipped.
    """
    there = [name for name in filters if name in CATALOGUE]
    tiny = ScenarioConfig(steps=8, landmarks=4, radius=10.0)
    for timing, method in product(timings, associations):
        about = {"listening": {"excess_paths": timing}, "association": {"method": method}}
        config = Config.model_validate({"scenario": tiny, **about})
        run_mission(config, STRATEGIES, there)


def compile_all() -> None:
    """Compile or load the kernels of all estimators, with and without known labels."""
    compile_kernels(associations=(KNOWN, *METHODS))
    for timing in (False, True):
        compile_filters(Config(listening=ListeningConfig(excess_paths=timing)), CATALOGUE)


@contextmanager
def in_two_processes(
    tell: Callable[[str], object] | None, config: Config, filters: Sequence[str]
) -> Iterator[None]:
    """Let a second process help to compile kernels while the body of the context runs.

    It starts with the first compilation in this process, which is announced. The processes do not
    repeat each other's work (`pipistrelle.kernel_folder`).
    """
    second = None

    def begin(line: str) -> None:
        nonlocal second
        if tell is not None:
            tell(line)
        second = _second_process(config, filters)

    announce(begin)
    try:
        yield
    finally:
        announce(tell)
        if second is not None:
            second.kill()
            second.wait()


def _second_process(config: Config, filters: Sequence[str]) -> subprocess.Popen[str] | None:
    """Start a process that compiles the kernels of estimators; None on a single core."""
    if cores() < 2:
        return None
    nowhere = subprocess.DEVNULL
    try:
        second = subprocess.Popen(
            [sys.executable or "", "-P", "-c", _SECOND, *filters],
            stdin=subprocess.PIPE, stdout=nowhere, stderr=nowhere, text=True,
        )  # fmt: skip
        assert second.stdin is not None
        with second.stdin as asked:
            asked.write(config.model_dump_json())
    except OSError:
        return None
    return second


def compile_filters(config: Config, filters: Iterable[str]) -> None:
    """Compile the kernels of estimators by running them on a short drive without sound."""
    each = config.scenario.steps_per_frame
    tiny = {"steps": each * _FRAMES, "landmarks": 4, "radius": 10.0, "steps_per_frame": each}
    config = config.model_copy(update={"scenario": ScenarioConfig(**tiny)})
    for own, names in each_its_own(config, [name for name in filters if name in CATALOGUE]):
        drive = drive_of(checked_scenario(own), own)
        scans = [
            _true_scan(drive, each * k, int(k > _HEARD), timing=own.listening.excess_paths)
            for k in range(1, _FRAMES + 1)
        ]
        for name in names:
            try_trial(Case(strategy="fused", filter=name), drive, scans, own)


def _true_scan(drive: Drive, step: int, first: int, *, timing: bool) -> Scan:
    """Return a scan of noise-free measurements at a step; its last landmark is a caller.

    All have a bearing, odd labels a range, even labels with `timing` an excess path.
    """
    path, landmarks = drive.truth.path, drive.truth.landmarks
    assert path is not None
    assert landmarks is not None
    labels, places = landmarks[0][first:], landmarks[1][first:]
    x, y = (places - path[step, :2]).T
    way, caller = np.hypot(x, y), labels[-1]
    own = (labels % 2 == 1) & (labels != caller)
    excess = way + np.hypot(*(places - places[-1]).T) - way[-1]
    detour = np.where(own | (labels == caller) | (not timing), np.nan, excess)
    scan = make_scan(
        drive.time[step],
        labels,
        wrap(np.arctan2(y, x) - path[step, 2]),
        range=np.where(own, way, np.nan),
        excess_path=detour,
        caller=np.where(own, OWN, 1),
        bearing_std=0.05,
        range_std=np.where(own, 0.1, np.nan),
        excess_path_std=np.where(np.isnan(detour), np.nan, 0.1),
    )
    return replace(scan, callers=np.array([UNLABELLED, caller]))
