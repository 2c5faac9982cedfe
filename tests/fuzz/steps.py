"""Odd calls of the four estimators, step by step: a first pose, control steps, scans."""

from collections.abc import Callable
from dataclasses import fields, replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from numpy.random import Generator

from fuzz.judging import Tried, kind_of
from fuzz.mutations import one_of
from fuzz.running import end_of
from pipistrelle.config import Config, InputError
from pipistrelle.detection.scans import NO_CALLERS, NUMBERS, Scan, make_scan
from pipistrelle.estimation.beliefs import Gaussian
from pipistrelle.estimation.catalogue import CATALOGUE, entry
from pipistrelle.estimation.motion import Motion

SPOILED = 0.3
"""Share of the calls that are handed something odd."""
NUMBERS_ODD = (
    *(np.nan, np.inf, -np.inf, 0.0, -0.0, -1.0, 1e300, -1e300, 1e-300, 5e-324, 1e9, -1e9, 1e10),
    *(1e-9, 7.0, -7.0, 1e6, 1e-6, 0.5),
)
WHOLES_ODD = (-1, -2, -7, 0, 2**31, 2**53, -(2**63), 2**63 - 1, 3, 8, 99)
STDS = {"bicycle": (0.1, 0.03), "unicycle": (0.1, 0.15), "poses": (0.05, 0.03, 0.02)}
SWARM = {"fastslam": {"particles": 20}}
CONFIGS: tuple[dict[str, Any], ...] = (
    {},
    {"filter": {"gate": 0.99}},
    {"filter": {"robust": "huber"}},
    {"rays": {"precise_bearings": "paper"}},
    {"fastslam": {"particles": 20, "mixture": "exact"}},
)


def strange(rng: Generator, values: Any) -> Any:
    """Return an array in another shape or of another type, or something in its place."""
    array = np.asarray(values)
    flat = array.ravel()
    return one_of(
        rng,
        [
            lambda: array.tolist(),
            lambda: array.astype(
                one_of(rng, ["f4", "f2", "i4", "u8", "?", "c16", "O", "U8", ">f8"])
            ),
            lambda: np.asfortranarray(array),
            lambda: np.repeat(array, 2, axis=-1)[..., ::2] if array.ndim else array,
            lambda: flat,
            lambda: array[np.newaxis],
            lambda: array[..., np.newaxis],
            lambda: array[..., :-1] if array.ndim else None,
            lambda: array[1:] if array.ndim else None,
            lambda: np.concatenate([array, array], axis=0) if array.ndim else array,
            lambda: np.concatenate([array, array], axis=-1) if array.ndim else array,
            lambda: np.resize(array, one_of(rng, [(30, 3), (1000,), (3, 30), (0, 2), (0,), ()])),
            lambda: _frozen(array),
            lambda: np.ma.masked_array(array, mask=rng.random(array.shape) < 0.5),
            lambda: [[0.1, 0.2], [0.3]],
            lambda: one_of(rng, [None, "", "abc", 3, 0.5, {}, [], (), {1: 2}, object(), np.nan]),
        ],
    )()


def _frozen(array: np.ndarray) -> np.ndarray:
    """Return an array that cannot be written to."""
    copy = array.copy()
    copy.setflags(write=False)
    return copy


def spoiled(rng: Generator, values: np.ndarray) -> Any:
    """Spoil an array: one of its numbers, mostly, or all of it."""
    if rng.random() < 0.5 or not values.size:
        return strange(rng, values)
    spoiled = values.copy()
    odd = WHOLES_ODD if values.dtype.kind == "i" else NUMBERS_ODD
    for _ in range(int(rng.integers(1, 3))):
        spoiled[tuple(rng.integers(0, n) for n in spoiled.shape)] = one_of(rng, odd)
    return spoiled


def pose(rng: Generator) -> Gaussian:
    """Draw a first pose."""
    root = rng.normal(size=(3, 3)) * 0.05 * rng.integers(0, 2)
    return Gaussian(mean=rng.normal(size=3), covariance=root @ root.T)


def steps(rng: Generator, model: str) -> list[np.ndarray]:
    """Draw control steps and their times."""
    k = int(rng.integers(0, 5))
    controls = rng.normal(0.2, 0.2, (k, len(STDS[model])))
    if model == "poses" and rng.random() < 0.5:
        said = np.array([1e-4, 0.0, 0.0, 1e-4, 0.0, 1e-4]) * rng.random((k, 1))
        controls = np.hstack([controls, said])
    return [controls, rng.uniform(0.05, 0.5, k)]


def scan(rng: Generator) -> Scan:
    """Draw a scan, of echoes of one's own call and of others', perhaps timed."""
    m = int(rng.integers(0, 8))
    caller = rng.integers(0, 3, m)
    excess_path = np.where((caller > 0) & (rng.random(m) < 0.7), rng.uniform(0.5, 9.0, m), np.nan)
    drawn = make_scan(
        float(rng.random()),
        rng.permutation(12)[:m],
        rng.uniform(-np.pi, np.pi, m),
        caller=caller,
        range=np.where((caller == 0) & (rng.random(m) < 0.7), rng.uniform(1, 9, m), np.nan),
        bearing_std=10.0 ** rng.uniform(-3, 0),
        range_std=10.0 ** rng.uniform(-3, 0),
        excess_path=excess_path,
        excess_path_std=10.0 ** rng.uniform(-3, 0),
    )
    labels = one_of(rng, [NO_CALLERS, np.array([-1, 3, 4]), np.array([-1, 3, 4])])
    moving = one_of(rng, [NO_CALLERS, NO_CALLERS, np.array([4])])
    return replace(drawn, callers=labels, moving=moving)


def odd_scan(rng: Generator, sound: Scan) -> Any:
    """Spoil a scan: a column of it, mostly."""
    if rng.random() < 0.05:
        return one_of(rng, [None, [], (), {}, "scan", 3, sound.numbers])
    name = one_of(rng, ["numbers", "numbers", "numbers", *(one.name for one in fields(Scan))])
    if name == "time":
        return replace(sound, time=one_of(rng, [np.nan, None, "now", -1.0, 10**400]))
    if name == "numbers" and sound.landmark.size and rng.random() < 0.6:
        return replace(sound, numbers=_one_odd_column(rng, sound.numbers))
    return replace(sound, **{name: spoiled(rng, getattr(sound, name))})


def _one_odd_column(rng: Generator, numbers: np.ndarray) -> np.ndarray:
    """Put an odd number into one or all rows of a column."""
    odd, row = numbers.copy(), int(rng.integers(0, NUMBERS))
    which = slice(None) if rng.random() < 0.5 else int(rng.integers(0, numbers.shape[1]))
    odd[row, which] = one_of(rng, NUMBERS_ODD)
    return odd


def answers(belief: Any) -> list[np.ndarray]:
    """Return all numbers that a belief answers, copied."""
    at, rows = belief.pose(), belief.landmarks()
    parts = [at.mean, at.covariance, rows.mean, rows.covariance, rows.weight, rows.landmark]
    if hasattr(belief, "moving"):
        parts += [belief.moving().mean, belief.moving().covariance]
    return [np.array(part) for part in parts]


def drawn_calls(rng: Generator) -> list[tuple[str, str, tuple[Any, ...]]]:
    """Draw an estimator's name and model, and what it is to be handed, call by call."""
    name, model = one_of(rng, [*CATALOGUE]), one_of(rng, [*STDS])
    odd = rng.random() < SPOILED / 3.0
    start = pose(rng)
    if odd:
        part = one_of(rng, ["mean", "covariance"])
        start = replace(start, **{part: spoiled(rng, getattr(start, part))})
    calls: list[tuple[str, str, tuple[Any, ...]]] = [(name, model, (start,))]
    for _ in range(int(rng.integers(2, 10))):
        odd = rng.random() < SPOILED
        if rng.random() < 0.4:
            given = steps(rng, model)
            if odd:
                which = int(rng.integers(0, 2))
                given[which] = spoiled(rng, given[which])
            calls.append(("predict", "odd" * odd, tuple(given)))
        else:
            sound = scan(rng)
            calls.append(("update", "odd" * odd, (odd_scan(rng, sound) if odd else sound,)))
    return calls


def obey(calls: list[tuple[str, str, tuple[Any, ...]]], config: Config) -> list[str]:
    """Make the calls, and name the faults."""
    (name, model, (start,)), *rest = calls
    motion = Motion(model=model, control_std=STDS[model], wheelbase=0.2)  # pyrefly: ignore
    slam, rng = entry(name).build(config, motion), np.random.default_rng(7)
    try:
        belief = slam.init(start)
    except InputError:
        return []
    known, faults = answers(belief), []
    for verb, odd, given in rest:
        action: Callable[..., Any] = getattr(slam, verb)
        try:
            found = action(belief, *given, rng)
        except InputError:
            if not odd:
                faults.append(f"{name} {verb}: refuses what is sound")
            if not all(map(np.array_equal, answers(belief), known)):
                faults.append(f"{name} {verb}: a refusal changes the belief")
            continue
        belief, poses = found if verb == "predict" else (found, belief.pose())
        known = answers(belief)
        if not all(np.isfinite(part).all() for part in (*known, poses.mean, poses.covariance)):
            return [*faults, f"{name} {verb}: a belief that is not finite"]
    return faults


def attempt(rng: Generator, place: Path, _: None) -> Tried:
    """Call an estimator now and then with something odd, in a child."""
    calls = drawn_calls(rng)
    config = Config(**(SWARM | one_of(rng, CONFIGS)))
    ending = end_of(lambda: obey(calls, config), place, ("steps", *calls[0][:2]))
    if ending.how == "returned":
        faults = tuple(ending.found)
    else:
        last = (ending.said.strip().splitlines() or [""])[-1]
        faults = (f"{calls[0][0]} {ending.how}: {kind_of(last)}",)
    ending = replace(ending, found=len(faults) if ending.how == "returned" else ending.found)
    return Tried(told=tuple(map(str, calls)), endings=(ending,), faults=faults)


def prepare(_: Path) -> None:
    """Compile what sound calls need, which would take longer than a child may."""
    rng = np.random.default_rng(0)
    for name, settings in product(CATALOGUE, CONFIGS):
        config = Config(**(SWARM | settings))
        for model in STDS:
            sound = [("predict", "", tuple(steps(rng, model))), ("update", "", (scan(rng),))]
            obey([(name, model, (pose(rng),)), *sound * 4], config)
        for callers, moving in product(
            (NO_CALLERS, np.array([-1, 3, 4])), (NO_CALLERS, np.array([4]))
        ):
            heard = [replace(scan(rng), callers=callers, moving=moving) for _ in range(4)]
            obey([(name, model, (pose(rng),)), *(("update", "", (one,)) for one in heard)], config)
