"""Cores and memory of this machine, and refusals of missions that need more memory."""

import math
import os
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from pipistrelle.arrays.layout import Layout, Scattered
from pipistrelle.arrays.sampling import Sampling
from pipistrelle.config import Config, InputError, ScenarioConfig
from pipistrelle.estimation.catalogue import COPIES, DOUBLE, entry
from pipistrelle.estimation.rays import ray_members
from pipistrelle.experiments.hearing.scenario import Scenario

STEP_NUMBERS, TRACK_NUMBERS, ROW_NUMBERS = 18, 12, 9
"""Numbers of a step (true and noisy pose, controls, time, bound), of a step of each track (pose and
covariance), and of a row that is heard (`detection.scans.Scan`)."""
LIMIT = Path("/sys/fs/cgroup/memory.max")
"""The file with the memory limit of a container: a number of bytes, or a word."""
MALLOPT = ((-3, 32 << 20), (-1, 256 << 20))
"""Of the GNU C library: arrays up to 32 MB come from the heap; it shrinks when 256 MB are free."""


def cores() -> int:
    """Count the cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def check_memory(
    filters: Sequence[str],
    landmarks: int,
    config: Config,
    *,
    passive: bool,
    workers: int = 1,
) -> None:
    """Refuse landmarks whose estimate may need more memory than this machine has.

    With passive rows a landmark may be a whole ray. So many workers on this machine (0: elsewhere)
    each need as much.

    >>> check_memory(["ekf", "fastslam"], 51, Config(), passive=True)
    """
    each_ray = ray_members(config.rays)[0].size if passive else 1
    for name in filters:
        estimator = entry(name)
        ray = f" of {each_ray:,} members each (rays.density)" if passive else ""
        particles = f" and {config.fastslam.particles} particles (fastslam.particles)"
        held = particles if "fastslam" in estimator.sections else ""
        need = estimator.memory(landmarks, each_ray, config)
        _refuse_beyond(f"{name}: {landmarks} landmarks{ray}{held}", need, workers)


def check_length(
    setup: ScenarioConfig, *, strategies: int = 1, filters: int = 1, workers: int = 1
) -> None:
    """Refuse a drive whose scans and tracks may need more memory than this machine has.

    Those of so many strategies and filters are kept, by each of so many workers on this machine (0:
    elsewhere).

    >>> check_length(ScenarioConfig(), strategies=3, filters=2)
    """
    step = COPIES * STEP_NUMBERS + TRACK_NUMBERS * strategies * filters
    frames = setup.steps // setup.steps_per_frame
    rows = frames * setup.landmarks * (1 + strategies)
    need = DOUBLE * (float(setup.steps) * step + float(rows) * ROW_NUMBERS)
    _refuse_beyond(f"scenario.steps: {setup.steps:,} steps", need, workers)


def check_recording(
    scenario: Scenario,
    config: Config,
    layout: Layout | Scattered,
    settled: Sampling,
    *,
    workers: int = 1,
) -> None:
    """Refuse a world of which one frame's recording may need more memory than this machine has.

    So many workers on this machine (0: elsewhere) each need as much.
    """
    setup, path = config.scenario, _farthest(scenario.path[:, :2])
    driven = "scenario.start" if math.hypot(*setup.start[:2]) > path / 2.0 else "scenario.step"
    reach = {
        driven: path,
        "scenario.radius": _farthest(scenario.landmarks),
        **{
            "scenario.beacon_distance" if caller.key == "beacon" else caller.key or caller.name: (
                _farthest(caller.place)
            )
            for caller in scenario.callers
            if caller.place is not None
        },
    }
    key = max(reach, key=reach.__getitem__)
    # To a landmark and home: at most twice across the circle around the centre that holds all.
    length = {
        key: 4.0 * reach[key] / settled.speed_of_sound,
        "emitter.pulse": settled.pulse * settled.interval,
    }
    numbers = 2 * settled.tones.size  # complex, of each tone's sums
    if settled.dense:  # samples and each tone's filter, in single precision
        length |= {"scenario.step": max(length.get("scenario.step", 0.0), _period(setup))}
        numbers = (1 + settled.tones.size) * settled.block
    key = max(length, key=length.__getitem__)
    numbers *= math.prod(layout.shape)
    need = COPIES * DOUBLE * length[key] / settled.interval * numbers
    _refuse_beyond(f"{key}: a recording of {length[key]:.3g} s", need, workers)


def _farthest(places: Any) -> float:
    """Return the largest distance of places from the centre [m]; 0 where there are none."""
    return float(np.hypot(*np.reshape(places, (-1, 2)).T).max(initial=0.0))


def _period(setup: ScenarioConfig) -> float:
    """Return the time between two calls [s]."""
    return setup.step * setup.steps_per_frame


def _refuse_beyond(what: str, need: float, workers: int) -> None:
    """Refuse what may need more memory [bytes], in each of so many workers, than there is."""
    if need * workers <= (have := installed()):
        return
    each = f" in each of {workers} workers" if workers > 1 else ""
    raise InputError(
        f"{what} may need {need / 1e9:.1f} GB of memory{each}, but this machine has "
        f"{have / 1e9:.1f} GB; ask for less"
    )


def installed() -> float:
    """Return the memory of this machine, or of its share in a container [bytes]; else infinity."""
    have = float("inf")
    with suppress(AttributeError, ValueError, OSError):
        have = float(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))
    with suppress(ValueError, OSError):
        have = min(have, float(LIMIT.read_text()))
    return have


def keep_freed_memory() -> None:
    """Let this process keep freed memory, where the C library allows it.

    A filter makes its arrays anew in every frame. Those above a megabyte, such as the covariance
    of 200 landmarks, would be given back to the system and asked for again each time, and cleared
    page by page: several times the cost of the arithmetic on them.
    """
    from ctypes import CDLL

    with suppress(AttributeError, OSError, TypeError):
        for parameter, value in MALLOPT:
            CDLL(None).mallopt(parameter, value)
