"""Cores and memory of this machine, and checks that a mission fits into its memory."""

import math
import os
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from pipistrelle.acoustics.call import lag_step
from pipistrelle.arrays.layout import Layout, Scattered
from pipistrelle.arrays.sampling import Sampling
from pipistrelle.config import Config, InputError, ScenarioConfig
from pipistrelle.estimation.catalogue import COPIES, DOUBLE, entry
from pipistrelle.estimation.rays import ray_members
from pipistrelle.experiments.hearing.scenario import Scenario

STEP_NUMBERS, TRACK_NUMBERS, ROW_NUMBERS = 18, 12, 9
"""Numbers stored for each control step (true and noisy pose, controls, time, bound), for each
step of each track (pose and covariance), and for each measurement (`detection.scans.Scan`)."""
LIMIT = Path("/sys/fs/cgroup/memory.max")
"""File with the memory limit of a container [bytes]; it may hold a word instead."""


def cores() -> int:
    """Count the processor cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def check_memory(
    filters: Sequence[str], landmarks: int, config: Config, *, passive: bool, workers: int = 1
) -> None:
    """Raise if an estimator's map may need more memory than this machine has.

    With passive bearings each landmark may be a whole ray of hypotheses. `workers` processes on
    this machine each need as much; 0 skips the check.
    """
    each_ray = ray_members(config.rays)[0].size if passive else 1
    for name in filters:
        estimator = entry(name)
        ray = f" of {each_ray:,} members each (rays.range_ratio)" if passive else ""
        particles = f" and {config.fastslam.particles} particles (fastslam.particles)"
        held = particles if "fastslam" in estimator.sections else ""
        need = estimator.memory(landmarks, each_ray, config)
        _refuse_beyond(f"{name}: {landmarks} landmarks{ray}{held}", need, workers)


def check_length(
    setup: ScenarioConfig, *, strategies: int = 1, filters: int = 1, workers: int = 1
) -> None:
    """Raise if the scans and tracks of a drive may need more memory than this machine has."""
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
    """Raise if recording a frame's sound may need more memory than this machine has."""
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
    # Path to a landmark and back: at most 4 radii of the circle around the centre that holds all.
    length = {
        key: 4.0 * reach[key] / settled.speed_of_sound,
        "emitter.call_duration": settled.pulse * settled.interval,
    }
    numbers = 2 * settled.tones.size  # complex sums of each tone
    if settled.banded:  # envelopes, noise and outputs of each call, in single precision
        each = settled.block / lag_step(settled.calls, settled.rate)
        numbers = math.ceil(3.0 * settled.tones.size * each)
    key = max(length, key=length.__getitem__)
    numbers *= math.prod(layout.shape)
    need = COPIES * DOUBLE * length[key] / settled.interval * numbers
    _refuse_beyond(f"{key}: a recording of {length[key]:.3g} s", need, workers)


def _farthest(places: Any) -> float:
    """Return the largest distance of points from the centre [m]; 0 if there are none."""
    return float(np.hypot(*np.reshape(places, (-1, 2)).T).max(initial=0.0))


def _refuse_beyond(what: str, need: float, workers: int) -> None:
    """Raise if workers that need `need` bytes each exceed the memory of this machine."""
    if need * workers <= (have := installed()):
        return
    each = f" in each of {workers} workers" if workers > 1 else ""
    raise InputError(
        f"{what} may need {need / 1e9:.1f} GB of memory{each}, but this machine has "
        f"{have / 1e9:.1f} GB; ask for less"
    )


def installed() -> float:
    """Return the memory of this machine or its container [bytes]; infinity if unknown."""
    have = float("inf")
    with suppress(AttributeError, ValueError, OSError):
        have = float(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))
    with suppress(ValueError, OSError):
        have = min(have, float(LIMIT.read_text()))
    return have


def keep_freed_memory() -> None:
    """Configure the C library, where possible, to keep freed memory for later arrays.

    A filter allocates new arrays in every frame. Without this, arrays above a megabyte (the
    covariance of 200 landmarks) are returned to the system and mapped and cleared again each time,
    which costs several times the arithmetic on them.
    """
    from ctypes import CDLL

    with suppress(AttributeError, OSError, TypeError):
        CDLL(None).mallopt(-3, 32 << 20)  # arrays up to 32 MB come from the heap
        CDLL(None).mallopt(-1, 256 << 20)  # memory is returned when 256 MB are free
