"""Are the bearings too good? What the fitting worlds give with worse ones.

    python papers/bradley_abaid/noise.py FOLDER [--worlds 60] [--workers 2]

White noise is added to what is heard, to each tone by itself: 0.05, 0.10 and 0.15 rad to bearings,
0.2 m to ranges, as much as the filters are told at most. Levels are the study's, tau is fitted anew
to the paper's count of landmarks that passive EKF-SLAM places. Written as ``noise.csv`` beside this
file: landmarks placed, position errors and what fused sensing gains on active, with its standard
error over the worlds, everything counted, and the worlds that a filter loses. With other than 60
worlds the table goes into FOLDER.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from statistics import fmean, stdev
from typing import Any

import numpy as np
import polars as pl
from calibration import Run, changed, in_worlds
from readings import (
    BEAMS,
    CASES,
    asked,
    fit_tau,
    keep,
    published,
    read_kept,
    settings,
    write_table,
)

from pipistrelle.arithmetic.random_stream import stream_key
from pipistrelle.config import Config
from pipistrelle.detection.front_end import FrameMeasurements
from pipistrelle.detection.scans import BEARING, RANGE
from pipistrelle.estimation.catalogue import PAPERS
from pipistrelle.experiments.hearing.listening import listen
from pipistrelle.experiments.hearing.scenario import world_of
from pipistrelle.experiments.named_settings import Case
from pipistrelle.experiments.runs.heard_world import drive_of, scans_of
from pipistrelle.experiments.runs.trial import run_trial
from pipistrelle.geometry import wrap

LEVELS = (0.0, 0.05, 0.10, 0.15)
"""Standard deviations of the noise of a bearing [rad]."""
RANGE_STD = 0.2
NEAREST = 0.05
"""No range gets nearer [m]."""
OUTPUT = Path(__file__).with_name("noise.csv")


def main() -> None:
    """Fit, run what is not done, and write the table."""
    chosen, rows = asked(__doc__), []
    with in_worlds(chosen.worlds, chosen.workers) as run:
        for level in LEVELS:
            path = chosen.folder / f"noise_{level}_{chosen.worlds}.parquet"
            if not path.exists():
                keep(tried(level, run), path)
            rows.append(row(level, read_kept(path)))
            print(rows[-1], flush=True)
    write_table(pl.DataFrame(rows), published(OUTPUT, chosen), "tau")


def tried(level: float, run: Run) -> pl.DataFrame:
    """Map all worlds with bearings so noisy."""
    config = settings()
    tau = fit_tau(config, run, partial(noisy, level=level))
    fitted = changed(config, {"rays.prune_threshold": tau})
    found = run(partial(trials_in, fitted, level))
    return pl.DataFrame([trial | {"tau": tau} for trials in found for trial in trials])


def noisy(
    heard: Sequence[FrameMeasurements], world: int, *, level: float
) -> tuple[FrameMeasurements, ...]:
    """Add white noise to every row, keyed by the world and the frame alone."""
    if level == 0.0:
        return tuple(heard)
    worse = []
    for number, frame in enumerate(heard):
        rng = np.random.default_rng(stream_key(Config().seed, world, "worse bearings", number))
        numbers = frame.rows.numbers.copy()
        off = rng.standard_normal((2, numbers.shape[1]))
        numbers[BEARING] = wrap(numbers[BEARING] + level * off[0])
        numbers[RANGE] = np.maximum(numbers[RANGE] + RANGE_STD * off[1], NEAREST)
        worse.append(replace(frame, rows=replace(frame.rows, numbers=numbers)))
    return tuple(worse)


def trials_in(config: Config, level: float, world: int) -> list[dict[str, Any]]:
    """Map a world in every case, with each of the paper's filters."""
    scenario = world_of(config, world)
    beams = listen(scenario, config, list(BEAMS.values()), iteration=world)
    worse = dict(zip(BEAMS, (noisy(heard, world, level=level) for heard in beams), strict=True))

    def rows() -> Iterator[dict[str, Any]]:
        for strategy, beam in CASES:
            scans = scans_of(worse[beam or 11], strategy, config)
            for name in PAPERS:
                case = Case(strategy=strategy, filter=name, iteration=world)
                scores = run_trial(case, drive_of(scenario, config), scans, config).scores
                yield {
                    "world": world, "strategy": strategy, "beam": beam, "filter": name,
                    "full": scores.landmarks_full, "diverged": scores.diverged,
                    "position_m": scores.position_rmse_m,
                }  # fmt: skip

    return list(rows())


def row(level: float, trials: pl.DataFrame) -> dict[str, Any]:
    """Sum a level up."""
    found: dict[str, Any] = {
        "bearing_std": level, "tau": trials["tau"][0], "worlds": trials["world"].n_unique(),
    }  # fmt: skip
    for name in PAPERS:
        mine = trials.filter(pl.col("filter") == name)
        lost = mine.group_by("world").agg(pl.col("diverged").any())["diverged"]
        found[f"left_out_{name}"] = int(lost.sum())

        def of(strategy: str, beam: int, score: str, mine: pl.DataFrame = mine) -> np.ndarray:
            case = (pl.col("strategy") == strategy) & (pl.col("beam") == beam)
            return mine.filter(case).sort("world")[score].to_numpy()

        for beam in (180, 33, 11):
            found[f"full_{beam}_{name}"] = fmean(of("fused", beam, "full"))
        found[f"full_passive_{name}"] = fmean(of("passive", 0, "full"))
        found[f"position_passive_{name}"] = fmean(of("passive", 0, "position_m"))
        for beam in BEAMS:
            active, fused = of("active", beam, "position_m"), of("fused", beam, "position_m")
            gain = (active - fused).tolist()
            found[f"position_active_{beam}_{name}"] = fmean(active)
            found[f"gain_{beam}_{name}"] = fmean(gain)
            found[f"gain_{beam}_{name}_se"] = stdev(gain) / len(gain) ** 0.5
    return found


if __name__ == "__main__":
    main()
