"""How far the results lean on what the paper does not report: one setting changed at a time.

    python papers/bradley_abaid/sensitivity.py [--worlds 40] [--workers 2]

EKF-SLAM in worlds of seed 1000, which the study does not use, at beams of 180, 33 and 11 degrees.
A change of the air is tried with the fitted source levels and again with levels fitted anew, for
a drier air and a quieter call are hard to tell apart. Written as ``sensitivity.csv`` beside this
file, and printed as a table: landmarks seen and placed, RMS errors of position, what fused sensing
gains on active (mean over worlds, plus or minus its standard error; a world counts where neither
diverged), NEES, and the worlds in which a case diverged.
"""

import argparse
import math
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from statistics import fmean, stdev
from typing import Any, cast

import polars as pl
from calibration import BEAMS, SEED, Run, changed, fit_levels, in_worlds

from pipistrelle.config import STRATEGIES, Config
from pipistrelle.experiments.hearing.listening import listen
from pipistrelle.experiments.hearing.scenario import world_of
from pipistrelle.experiments.named_settings import Case
from pipistrelle.experiments.results.scores import Scores
from pipistrelle.experiments.runs.heard_world import drive_of, scans_of
from pipistrelle.experiments.runs.trial import run_trial

AIR: dict[str, dict[str, Any]] = {
    "humidity 20 %": {"air.relative_humidity": 0.2},
    "humidity 80 %": {"air.relative_humidity": 0.8},
    "bistatic spreading": {"air.spreading": "bistatic"},
}
EARS: dict[str, dict[str, Any]] = {
    "target a sphere": {"target.shape": "sphere"},
    "false alarms 1e-4": {"detection.false_alarm": 1e-4},
    "false alarms 1e-8": {"detection.false_alarm": 1e-8},
    "faces weighted": {"detection.averaging": "weighted"},
    "bearing gate 0.05 rad": {"association.bearing_gate": 0.05},
    "bearing gate 0.2 rad": {"association.bearing_gate": 0.2},
    "delay gate an eighth": {"association.delay_gate": 0.125},
}
FILTER: dict[str, dict[str, Any]] = {
    "as frozen": {},
    "tau / 100": {"rays.prune_threshold": 1e-7},
    "tau x 100": {"rays.prune_threshold": 1e-3},
    "n = 1": {"rays.exponent": 1.0},
    "n = 3": {"rays.exponent": 3.0},
    "n = 8": {"rays.exponent": 8.0},
    "aggregated weights": {"rays.weights": "aggregated"},
    "R: 0.05 rad": {"filter.bearing_std": 0.05},
    "R: 0.3 rad": {"filter.bearing_std": 0.3},
    "R: 0.1 m": {"filter.range_std": 0.1},
    "gate of 99.9 %": {"filter.gate": 0.999},
}
OUTPUT = Path(__file__).with_name("sensitivity.csv")
COLUMNS = {
    "change": "changed",
    "vehicle_db": "vehicle dB",
    "beacon_db": "beacon dB",
    "seen_active_180": "seen, active 180°",
    "seen_fused_180": "seen, fused 180°",
    "seen_passive": "seen, passive",
    "full_fused_180": "full, fused 180°",
    "full_passive": "full, passive",
    "gain_position_33": "gain at 33° [m]",
    "gain_position_11": "gain at 11° [m]",
    "nees_fused_33": "NEES, fused 33°",
    "nees_passive": "NEES, passive",
    "worlds_diverged": "diverged",
}
"""What is printed, of all that is written."""
Trials = dict[tuple[str, str], Scores]
"""Scores by strategy and beam."""


def main() -> None:
    """Try every change; write and print."""
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("--worlds", type=int, default=40)
    options.add_argument("--workers", type=int, default=2)
    chosen = options.parse_args()
    base, rows = Config(seed=SEED), []

    def keep(*more: dict[str, Any]) -> None:
        rows.extend(more)
        pl.DataFrame(rows).write_csv(OUTPUT, float_precision=3)

    with in_worlds(chosen.worlds, chosen.workers) as run:
        settings = [changed(base, change) for change in FILTER.values()]
        tried = run(partial(trials_in, settings))
        keep(*(row(name, base, [w[i] for w in tried]) for i, name in enumerate(FILTER)))
        for name, change in (EARS | AIR).items():
            keep(heard_anew(name, changed(base, change), run))
        for name, change in AIR.items():
            config = fit_levels(changed(base, change), run)
            keep(heard_anew(f"{name}, refitted", config, run))
    print(markdown(rows))


def trials_in(settings: Sequence[Config], world: int) -> list[Trials]:
    """Listen once in a world, and map it by each strategy and beam under each setting."""
    scenario = world_of(settings[0], world)
    beams = listen(scenario, settings[0], list(BEAMS.values()), iteration=world)
    heard = dict(zip(BEAMS, beams, strict=True))
    cases = [(s, beam) for s in STRATEGIES for beam in BEAMS if s != "passive" or beam == "11"]
    return [
        {
            (s, b): run_trial(
                Case(strategy=s, filter="ekf", iteration=world),
                drive_of(scenario, config),
                scans_of(heard[b], s, config),
                config,
            ).scores
            for s, b in cases
        }
        for config in settings
    ]


def heard_anew(name: str, config: Config, run: Run) -> dict[str, Any]:
    """Try a change of what is heard."""
    return row(name, config, [trials for (trials,) in run(partial(trials_in, [config]))])


def row(name: str, config: Config, worlds: Sequence[Trials]) -> dict[str, Any]:
    """Sum up one setting over the worlds."""

    def mean(strategy: str, beam: str, score: str) -> float:
        return fmean(float(getattr(world[strategy, beam], score)) for world in worlds)

    return {
        "change": name,
        "vehicle_db": config.emitter.level_db,
        "beacon_db": config.beacon.level_db,
        "seen_active_180": mean("active", "180", "landmarks_total"),
        "seen_fused_180": mean("fused", "180", "landmarks_total"),
        "seen_fused_33": mean("fused", "33", "landmarks_total"),
        "seen_passive": mean("passive", "11", "landmarks_total"),
        "full_fused_180": mean("fused", "180", "landmarks_full"),
        "full_fused_33": mean("fused", "33", "landmarks_full"),
        "full_passive": mean("passive", "11", "landmarks_full"),
        "error_active_33_m": settled_error(worlds, "active", "33"),
        "error_fused_33_m": settled_error(worlds, "fused", "33"),
        "error_passive_m": settled_error(worlds, "passive", "11"),
        **gain(worlds, "33", "position_rmse_m"),
        **gain(worlds, "11", "position_rmse_m"),
        **gain(worlds, "33", "heading_rmse_rad"),
        "nees_fused_33": mean("fused", "33", "nees_mean"),
        "nees_passive": mean("passive", "11", "nees_mean"),
        "worlds_diverged": sum(any(s.diverged for s in world.values()) for world in worlds),
        "worlds": len(worlds),
    }


def settled_error(worlds: Sequence[Trials], strategy: str, beam: str) -> float:
    """Mean RMS error of position [m] over the worlds in which the case did not diverge."""
    scores = [world[strategy, beam] for world in worlds]
    return fmean([cast(float, s.position_rmse_m) for s in scores if not s.diverged] or [math.nan])


def gain(worlds: Sequence[Trials], beam: str, score: str) -> dict[str, float]:
    """Active error less fused error, paired: its mean and standard error."""
    pairs = [(world["active", beam], world["fused", beam]) for world in worlds]
    differences = [
        getattr(active, score) - getattr(fused, score)
        for active, fused in pairs
        if not (active.diverged or fused.diverged)
    ]
    name = f"gain_{score.split('_')[0]}_{beam}"
    if len(differences) < 2:
        return {name: math.nan, f"{name}_se": math.nan}
    error = stdev(differences) / len(differences) ** 0.5
    return {name: fmean(differences), f"{name}_se": error}


def markdown(rows: Sequence[Mapping[str, Any]]) -> str:
    """Lay the main columns out as a table, each gain with its standard error."""

    def cell(row: Mapping[str, Any], name: str) -> str:
        if name.startswith("gain"):
            return f"{row[name]:+.2f} ± {row[f'{name}_se']:.2f}"
        return f"{row[name]:.1f}" if isinstance(row[name], float) else str(row[name])

    lines = [list(COLUMNS.values()), ["---"] * len(COLUMNS)]
    lines += [[cell(row, name) for name in COLUMNS] for row in rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


if __name__ == "__main__":
    main()
