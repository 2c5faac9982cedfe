"""Fit the four numbers that the paper does not report and that nothing else settles.

    python papers/bradley_abaid/calibration.py PLAN [--worlds 100] [--workers 2] [--output FILE]

PLAN is paper or physics: the readings of a plan that ships with the package. Fitted, each to one
mean of Table II, in this order:

    beacon.level_db     landmarks seen, passive                   39.5
    emitter.level_db    landmarks seen, fused at 180 degrees      43.7
    rays.prune_threshold (tau)    fully initialised, EKF-SLAM, passive      26.6

the vehicle's level no higher than leaves active sensing at 180 degrees with 36.5 landmarks (our
choice: the paper sees more of them passively at every beamwidth); and
``rays.exponent`` (n) by a rule that looks at no result: one count cannot settle two numbers; the
paper's n says by how much likelier members count for more, so n > 1; of the whole numbers above 1
the least is taken for which some tau reaches the count. The other n are listed with the tau that
each would need.
The worlds have seed 1000, the study's 2022. Every other number, here and in the study, is a
prediction.
"""

import argparse
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from functools import cache, partial
from multiprocessing import get_context
from pathlib import Path
from statistics import fmean, stdev
from typing import Any

import numpy as np
import tomli_w

from pipistrelle.config import Config
from pipistrelle.detection.scans import scan_of
from pipistrelle.experiments.hearing.listening import listen
from pipistrelle.experiments.hearing.oracle import label_detections
from pipistrelle.experiments.hearing.scenario import world_of
from pipistrelle.experiments.named_settings import Case
from pipistrelle.experiments.runs.heard_world import drive_of, scans_of
from pipistrelle.experiments.runs.trial import run_trial
from pipistrelle.experiments.studies.plan import PLANS, find_plan, read_plan

SEED = 1000
BEAMS = {"180": 0.0025, "33": 0.0088, "11": 0.025}
"""Half-power beamwidth [deg] and radius of the piston [m]."""
PAPER = {"fused 180": 43.7, "fused 33": 40.8, "fused 11": 40.1, "passive": 39.5}
"""Landmarks seen: Table II."""
MOST_ACTIVE = 36.5
"""Landmarks that active sensing may see at 180 degrees: clearly fewer than passive sensing."""
PAPER_FULL = 26.6
"""Fully initialised by passive EKF-SLAM: Table II."""
POWERS = (1.0, 2.0, 3.0, 4.0)
PRUNES = tuple(float(f"{digit}e-{decade}") for decade in range(12, 1, -1) for digit in (1, 2, 5))
STUDIES = Path(__file__).parents[2] / "src/pipistrelle/experiments/studies"
Run = Callable[[Callable[[int], Any]], list[Any]]
"""Calls a function with the number of each world; lists what it returns."""
Oracle = Callable[..., Any]
"""Labels detections, as `label_detections` does."""


def main() -> None:
    """Fit, write and print."""
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("plan", choices=PLANS)
    options.add_argument("--worlds", type=at_least(2), default=100, help="how many [%(default)s]")
    options.add_argument("--workers", type=at_least(1), default=2, help="processes [%(default)s]")
    options.add_argument("--output", type=Path, help="file [beside the plan]")
    chosen = options.parse_args()
    output = chosen.output or STUDIES / f"{chosen.plan}_calibration.toml"
    if output.is_dir() or not output.parent.is_dir():
        options.error(f"--output: {output} cannot be a file; name one in a folder that there is")
    readings = read_plan(find_plan(chosen.plan)).config.model_copy(update={"seed": SEED})
    with in_worlds(chosen.worlds, chosen.workers) as run:
        config = fit_levels(readings, run)
        rows = run(partial(landmarks_seen, config, [*BEAMS]))
        seen = {name: [row[name] for row in rows] for name in rows[0]}
        rays = fit_rays(config, run)
    text = tomli_w.dumps(summary(config, seen, rays))
    output.write_text(f"# Written by papers/bradley_abaid/calibration.py {chosen.plan}\n\n{text}")
    print(text)


def at_least(least: int) -> Callable[[str], int]:
    """Return what reads a whole number that is not less."""

    def number(text: str) -> int:
        if (found := int(text)) < least:
            raise argparse.ArgumentTypeError(f"found {found}, expected at least {least}")
        return found

    return number


@contextmanager
def in_worlds(worlds: int, workers: int) -> Iterator[Run]:
    """Give a function that calls another for each world, in as many processes."""
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        yield lambda function: list(pool.map(function, range(worlds), chunksize=2))


def changed(config: Config, change: Mapping[str, Any]) -> Config:
    """Return settings with some changed, each by its dotted name."""
    for key, value in change.items():
        section, field = key.split(".")
        part = getattr(config, section).model_copy(update={field: value})
        config = config.model_copy(update={section: part})
    return config


def landmarks_seen(
    config: Config, beams: Sequence[str], world: int, *, oracle: Oracle = label_detections
) -> dict[str, int]:
    """Count the landmarks that each strategy sees; passive is heard beside the last beam."""
    radii = [BEAMS[b] for b in beams]
    heard = listen(world_of(config, world), config, radii, iteration=world, oracle=oracle)
    cases = {"passive": ("passive", heard[-1])}
    for beam, frames in zip(beams, heard, strict=True):
        cases |= {f"{strategy} {beam}": (strategy, frames) for strategy in ("fused", "active")}
    return {
        name: len(
            {label for frame in frames for label in scan_of(frame.rows, way).landmark.tolist()}
        )
        for name, (way, frames) in cases.items()
    }


def fit_levels(
    config: Config,
    run: Run,
    *,
    oracle: Oracle = label_detections,
    most_active: float = MOST_ACTIVE,
    step: int = 8,
) -> Config:
    """Fit both source levels to a tenth of a decibel; return the settings with them.

    `step` [0.1 dB] is the first step of the search from the levels of `config`.

    Each is found with the other held, in turn, until neither moves: the vehicle's level hardly
    changes what passive sensing sees, but the beacon's does change what fused sensing sees.
    """

    def at(vehicle: int, beacon: int) -> Config:
        return changed(config, {"emitter.level_db": vehicle / 10, "beacon.level_db": beacon / 10})

    @cache
    def seen(vehicle: int, beacon: int, *beams: str) -> dict[str, list[int]]:
        settings = at(vehicle, beacon)
        rows = run(partial(landmarks_seen, settings, beams, oracle=oracle))
        counts = {name: [row[name] for row in rows] for name in rows[0]}
        means = (f"{name} {fmean(count):.2f}" for name, count in counts.items())
        print(f"{vehicle / 10} and {beacon / 10} dB:", ", ".join(means), flush=True)
        return counts

    def passive(beacon: int) -> float:
        return fmean(seen(vehicle, beacon, "11")["passive"])

    def fused(vehicle: int) -> float:
        return fmean(seen(vehicle, beacon, "180")["fused 180"])

    def active(vehicle: int) -> float:
        return fmean(seen(vehicle, beacon, "180")["active 180"])

    vehicle, beacon = round(10 * config.emitter.level_db), round(10 * config.beacon.level_db)
    before = None
    while before != (vehicle, beacon):
        before = (vehicle, beacon)
        beacon = nearest(passive, PAPER["passive"], beacon, step)
        vehicle = nearest(fused, PAPER["fused 180"], vehicle, step)
        if active(vehicle) > most_active:
            vehicle = nearest(active, most_active, vehicle, step)
        while active(vehicle) > most_active:
            vehicle -= 1
    return at(vehicle, beacon)


def nearest(function: Callable[[int], float], target: float, start: int, step: int = 8) -> int:
    """Return the whole number at which a rising function comes nearest to a target."""
    low = high = start
    while function(low) > target:
        low, high, step = low - step, low, 2 * step
    while function(high) <= target:
        low, high, step = high, high + step, 2 * step
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if function(middle) <= target else (low, middle)
    return min((low, high), key=lambda number: abs(function(number) - target))


def rays_tried(config: Config, world: int) -> list[tuple[int, float, bool]]:
    """Map a world by passive EKF-SLAM with each n and tau: full landmarks, mean NEES, diverged."""
    scenario = world_of(config, world)
    (heard,) = listen(scenario, config, (BEAMS["11"],), iteration=world)
    scans = scans_of(heard, "passive", config)
    case, drive, rows = Case(strategy="passive", filter="ekf"), drive_of(scenario, config), []
    for power in POWERS:
        for prune in PRUNES:
            settings = changed(config, {"rays.exponent": power, "rays.prune_threshold": prune})
            scores = run_trial(case, drive, scans, settings).scores
            rows.append((scores.landmarks_full, scores.nees_mean, scores.diverged))
    return rows


def fit_rays(config: Config, run: Run) -> list[dict[str, float]]:
    """Find for each n the tau, of the series 1, 2, 5, that comes nearest to the paper's count."""
    tried = np.array(run(partial(rays_tried, config)), dtype=float)
    tried = tried.reshape(-1, len(POWERS), len(PRUNES), 3)
    found = []
    for power, column in zip(POWERS, np.swapaxes(tried, 0, 1), strict=True):
        full = column[:, :, 0].mean(axis=0)
        best = int(np.argmin(np.abs(full - PAPER_FULL)))
        count, nees, diverged = column[:, best].T
        found.append(
            {
                "power": power,
                "prune": PRUNES[best],
                "landmarks_full": round(float(count.mean()), 2),
                "standard_error": round(float(count.std(ddof=1)) / len(count) ** 0.5, 2),
                "nees_mean": round(float(nees.mean()), 1),
                "worlds_diverged": int(diverged.sum()),
                "landmarks_full_at_every_prune": full.round(2).tolist(),
            }
        )
    return found


def summary(
    config: Config, seen: Mapping[str, Sequence[int]], rays: Sequence[Mapping[str, Any]]
) -> dict[str, Any]:
    """Lay out what was varied, to what it was fitted, and what is therefore a prediction."""
    worlds = len(seen["passive"])
    means = {
        name: {
            "ours": round(fmean(counts), 2),
            "standard_error": round(stdev(counts) / worlds**0.5, 2),
        }
        | ({"paper": PAPER[name]} if name in PAPER else {})
        for name, counts in seen.items()
    }
    reached = [r for r in rays if r["power"] > 1 and abs(r["landmarks_full"] - PAPER_FULL) < 1]
    chosen = reached[0]
    return {
        "worlds": {"seed": SEED, "count": worlds},
        "fitted": {
            "emitter.level_db": config.emitter.level_db,
            "beacon.level_db": config.beacon.level_db,
            "rays.exponent": chosen["power"],
            "rays.prune_threshold": chosen["prune"],
        },
        "fitted_to": {name: means.pop(name) for name in ("fused 180", "passive")}
        | {
            "passive, fully initialised": {
                "ours": chosen["landmarks_full"],
                "standard_error": chosen["standard_error"],
                "paper": PAPER_FULL,
            }
        },
        "landmarks_seen_predicted": means,
        "prunes_tried": list(PRUNES),
        "rays_tried": [dict(row) for row in rays],
    }


if __name__ == "__main__":
    main()
