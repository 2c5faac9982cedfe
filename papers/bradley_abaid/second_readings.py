"""Which worlds, labels and exclusions the paper means: a second experiment beside `readings`.

    python papers/bradley_abaid/second_readings.py FOLDER [--worlds 60] [--workers 2]

Six more choices, and one of `readings`, in combinations:

    layout      disc: uniform over 25 m, landmarks 3 m apart ("a minimum spacing of at least 3 m");
                annulus: 3 to 25 m "from the center of the map", landmarks 0.5 m apart, uniform in
                distance (`r = 3 + 22 * rand`), or uniform over the area
    labels      known association by gates of 0.1, 0.2, 0.3 or 0.5 rad and a quarter of a call; by
                the arrival that caused the peak; by the nearest true bearing
    cap         active sensing at 180 degrees sees at most 36.5 landmarks (our choice; with gates of
                0.1 and 0.3 rad and the paper's front end), or no limit
    front end   paper: the strongest peak of a run, 10 log p; physics: every maximum, 20 log p
    ranged      a range for a partial landmark places it anew; is not used until bearings have
                placed it; moves the heaviest member
    weighed     FastSLAM's particles are weighed by all landmarks; by those initialised alone, so
                that a ray refines the proposal and does not weigh; so, and rays restart at
                resampling (each with the first two ways of a range)
    exclusions  a world is lost if any of a filter's cases diverges; or if the mean NEES over the
                beamwidths of a strategy does ("ANEES is also used to determine if an iteration of
                a filter has diverged")

Levels and tau are fitted again for each in the first 60 worlds, as in `readings` (the levels of the
gates of 0.2 and 0.5 rad are those of 0.3 rad). The next 60 worlds judge. The *misfit* is the root
of the mean square of four parts, none of which anything is fitted to:

    landmarks    Table II's other means, ours less the paper's in the paper's sigma (RMS)
    spread       sigma over the worlds of the seen landmarks in Table II, log of ours over the
                 paper's (RMS)
    left out     the worlds that a filter loses: log of our share over the paper's (RMS)
    gap          passive minus active seen, in sigma over worlds: above 1 at 65 degrees and wider,
                 or below 1 at narrower beams, by so much (RMS)

The rule, written before the run: of the readings whose misfit is within one standard error (of the
paired difference) of the least, the one with the fewest departures from the plan `paper` as it was
(disc, gate of 0.1 rad, capped, paper, bearing, all, union) is the plan `paper`; of equals, the one
of the least misfit. No sentence's verdict is looked at. *Features* stand beside it, as in
`readings`, with one more: the heading, at how many of the four beamwidths fused sensing with
EKF-SLAM is ahead (Appendix A: at all).

What is heard in a combination of layout, labels, cap and front end is tried no further than the
first 12 of the judging worlds, if the best of its readings has there a misfit of 2.5 standard
errors (of the paired difference) above the least; its rows in the table have ``worlds`` 12, and
cannot be chosen. (This was added when the first 12 were done, to save time. It stops all but two of
the labellings without a gate, the disc with the front end of physics, and one reading more.)

The worlds have seed 1000; the study's have 2022. What is done is kept in FOLDER;
``second_readings.csv`` beside this file is the table. With other than 60 worlds it goes into
FOLDER.
"""

import json
import math
import sys
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from itertools import product
from pathlib import Path
from statistics import fmean
from typing import Any

import numpy as np
import polars as pl
from calibration import MOST_ACTIVE, SEED, Oracle, Run, changed, fit_levels, in_worlds
from oracles import label_by_bearing, label_by_cause
from readings import (
    ALL_DRAWN,
    BEAMS,
    CASES,
    CASES_TRIED,
    Change,
    Levels,
    Reading,
    asked,
    drawn,
    fit_tau,
    keep,
    misfits,
    published,
    read_kept,
    write_table,
)

from pipistrelle.config import STRATEGIES, Config, Strategy
from pipistrelle.detection.front_end import FrameMeasurements
from pipistrelle.estimation.catalogue import entry
from pipistrelle.evaluation.accuracy import rmse
from pipistrelle.evaluation.consistency import diverged, track_nees
from pipistrelle.experiments.hearing.listening import listen
from pipistrelle.experiments.hearing.oracle import label_detections
from pipistrelle.experiments.hearing.scenario import Scenario, world_of
from pipistrelle.experiments.named_settings import Case
from pipistrelle.experiments.runs.heard_world import drive_of, scans_of
from pipistrelle.experiments.runs.trial import run_trial
from pipistrelle.experiments.studies.plan import find_plan, read_plan
from pipistrelle.files import write_whole
from pipistrelle.report.sentences import EXCLUDED, TABLE_II, WORLDS

ANNULUS: Change = {"scenario.inner_radius": 3.0, "scenario.spacing": 0.5}
LAYOUT: dict[str, Change] = {
    "disc": {},
    "annulus": {**ANNULUS, "scenario.density": "distance"},
    "annulus by area": ANNULUS,
}
LABELS: dict[str, Change] = {
    **{f"{gate} rad": {"matching.bearing_gate": gate} for gate in (0.1, 0.3, 0.2, 0.5)},
    "cause": {},
    "nearest": {},
}
LEVELS = ("emitter.level_db", "beacon.level_db")
LEVELS_OF = {"0.2 rad": "0.3 rad", "0.5 rad": "0.3 rad"}
"""Gates whose levels are those fitted at another gate: where they were fitted, too (the disc, no
limit), they differed by 0.1 dB, which moves the counts by less than half their standard error."""
ORACLES: dict[str, Oracle] = {"cause": label_by_cause, "nearest": label_by_bearing}
CAP = {"capped": MOST_ACTIVE, "uncapped": math.inf}
FRONT_END: dict[str, Change] = {
    "paper": {
        "detection.snapshots": "runs", "detection.peak_db": 0.0, "emitter.directivity_law": "power",
    },
    "physics": {
        "detection.snapshots": "maxima", "detection.peak_db": -8.0,
        "emitter.directivity_law": "pressure",
    },
}  # fmt: skip
RANGED = ("bearing", "anew", "moved")
WEIGHED: dict[str, Change] = {
    "all": {},
    "initialised": {"fastslam.weighed_by": "initialised"},
    "initialised, restart": {
        "fastslam.weighed_by": "initialised", "fastslam.resampled_rays": "restart",
    },
}  # fmt: skip
EXCLUSIONS = ("union", "average")
FACTORS = {
    "layout": LAYOUT, "labels": LABELS, "cap": CAP, "front_end": FRONT_END, "ranged": RANGED,
    "weighed": WEIGHED, "exclusions": EXCLUSIONS,
}  # fmt: skip
WAYS: dict[str, dict[str, Change]] = {
    "layout": LAYOUT, "labels": LABELS, "front_end": FRONT_END,
    "ranged": {name: {"rays.range_update": name} for name in RANGED}, "weighed": WEIGHED,
}  # fmt: skip
"""Settings of the levels of factors that a plan has."""
DEFAULTS = {name: next(iter(levels)) for name, levels in FACTORS.items()}
"""The plan `paper` as it was."""
OUTPUT = Path(__file__).with_name("second_readings.csv")
HEARD = ("layout", "labels", "cap", "front_end")
"""Factors that change what is heard."""
ALL_HEARD = [
    (layout, labels, cap, front_end)
    for cap, layout, front_end, labels in product(reversed(CAP), LAYOUT, FRONT_END, LABELS)
    if cap == "uncapped" or (labels in ("0.1 rad", "0.3 rad") and front_end == "paper")
]
"""Their combinations that are tried."""
MAPPED = [way for way in product(RANGED, WEIGHED) if way[0] != "moved" or way[1] == "all"]
"""Combinations of ranged and weighed that are tried."""
FIRST = 12
"""Worlds in which every combination is tried."""
MOST_ABOVE = 2.5
"""Standard errors above the least misfit in these worlds with which a combination goes on."""
DRAWS_FIRST = 200


def main() -> None:
    """Fit, run what is not done, and write the table."""
    chosen = asked(__doc__)
    with in_worlds(chosen.worlds, chosen.workers) as run:
        fits = fitted(chosen.folder / f"second_fits_{chosen.worlds}.json", run)
        done = partial(world_done, chosen.folder / f"second_worlds_{chosen.worlds}", fits)
        first = [path for path in run(partial(done, ALL_HEARD, (0, FIRST), chosen.worlds)) if path]
        begun = readings_of(pl.concat(read_kept(path) for path in first), ALL_HEARD)
        heard = promising(begun)
        rest = run(partial(done, heard, (FIRST, chosen.worlds), chosen.worlds))
    chosen_trials = [read_kept(path) for path in (*first, *filter(None, rest))]
    readings = readings_of(pl.concat(chosen_trials), heard)
    stopped = {levels: one for levels, one in begun.items() if levels[: len(HEARD)] not in heard}
    values = drawn(list(readings.values()))
    fitted_to = {key: fits["/".join(key[: len(HEARD)])] for key in (*readings, *stopped)}
    table = misfits(readings, values, fitted_to, DEFAULTS).with_columns(worlds=chosen.worlds)
    if stopped:
        few = misfits(stopped, drawn(list(stopped.values())), fitted_to, DEFAULTS)
        unknown = ("above_best", "above_best_error", "tied")
        few = few.with_columns(*(pl.lit(None).alias(name) for name in unknown), worlds=FIRST)
        table = pl.concat([table, few], how="vertical_relaxed")
    write_table(table, published(OUTPUT, chosen), "rays.prune_threshold")
    tied = table.filter("tied").sort("departures", "misfit")
    print("chosen by the rule, of", tied.height, "tied:", tied.select(*FACTORS).row(0))
    with pl.Config(tbl_rows=40, tbl_cols=-1, tbl_width_chars=200, float_precision=2):
        print(table)


# Fits


def settings(layout: str, labels: str, front_end: str) -> Config:
    """Return the settings of the plan `paper` with the levels of three factors."""
    config = read_plan(find_plan("paper")).config.model_copy(update={"seed": SEED})
    return changed(config, LAYOUT[layout] | LABELS[labels] | FRONT_END[front_end])


def fitted(path: Path, run: Run) -> dict[str, Change]:
    """Fit levels and tau of every combination of layout, labels, cap and front end."""
    try:
        fits: dict[str, Change] = json.loads(path.read_text()) if path.exists() else {}
    except ValueError:
        sys.exit(f"{path}: no fits that can be read; remove it, and they are made anew")
    for layout, labels, cap, front_end in ALL_HEARD:
        name = "/".join((layout, labels, cap, front_end))
        if name in fits:
            continue
        config, oracle = settings(layout, labels, front_end), ORACLES.get(labels, label_detections)
        near = [fit for other, fit in fits.items() if other.split("/")[::3] == [layout, front_end]]
        gate = fits.get("/".join((layout, LEVELS_OF.get(labels, ""), cap, front_end)))
        if gate is not None:
            config = changed(config, {key: gate[key] for key in LEVELS})
        else:
            config = fit_levels(
                changed(config, near[-1] if near else {}), run,
                oracle=oracle, most_active=CAP[cap], step=2 if near else 8,
            )  # fmt: skip
        fits[name] = {
            "emitter.level_db": config.emitter.level_db, "beacon.level_db": config.beacon.level_db,
            "rays.prune_threshold": fit_tau(config, run, oracle=oracle),
        }  # fmt: skip
        print(name, fits[name], flush=True)
        write_whole(path, json.dumps(fits, indent=1).encode())
    return fits


# Trials


def world_done(
    folder: Path,
    fits: Mapping[str, Change],
    heard: Sequence[Levels],
    bounds: tuple[int, int],
    before: int,
    number: int,
) -> Path | None:
    """Run combinations in the world behind some others, unless its file exists; return the file.

    `bounds`: None is returned for a world that is not between them.
    """
    if not bounds[0] <= number < bounds[1]:
        return None
    path = folder / f"world_{before + number}.parquet"
    folder.mkdir(exist_ok=True)
    if not path.exists():
        keep(pl.DataFrame(trials_in(fits, heard, before + number)), path)
    return path


def trials_in(
    fits: Mapping[str, Change], combinations: Sequence[Levels], world: int
) -> list[dict[str, Any]]:
    """Map a world under each combination that changes what is heard, in every case."""
    rows = []
    for levels in combinations:
        layout, labels, cap, front_end = levels
        fit = fits["/".join(levels)]
        if cap == "capped" and fit == fits["/".join((layout, labels, "uncapped", front_end))]:
            continue
        config = changed(settings(layout, labels, front_end), fit)
        scenario = world_of(config, world)
        oracle = ORACLES.get(labels, label_detections)
        frames = listen(scenario, config, list(BEAMS.values()), iteration=world, oracle=oracle)
        heard = dict(zip(BEAMS, frames, strict=True))
        for name, strategy in product(EXCLUDED, STRATEGIES):
            for ranged, weighed in ways_of(name, strategy):
                change = WAYS["ranged"].get(ranged, {}) | WEIGHED.get(weighed, {})
                ways = changed(config, change)
                case = Case(strategy=strategy, filter=name, iteration=world)
                mapped = list(mapped_at_each_beam(scenario, heard, case, ways))
                average = np.mean([row.pop("track_nees") for row in mapped], axis=0)
                about = {
                    **dict(zip(HEARD, levels, strict=True)), "filter": name, "ranged": ranged,
                    "weighed": weighed,
                    "average_diverged": diverged(average, entry(name).nees_limit),
                }  # fmt: skip
                rows += [about | row for row in mapped]
    return rows


def ways_of(name: str, strategy: Strategy) -> Iterator[tuple[str, str]]:
    """List levels of ranged and weighed, where these make a difference to a filter's map."""
    for ranged, weighed in MAPPED:
        by_range, swarm = strategy == "fused", name == "fastslam" and strategy != "active"
        if (by_range or ranged == RANGED[0]) and (swarm or weighed == "all"):
            yield ranged if by_range else ALL_DRAWN, weighed if swarm else ALL_DRAWN


def mapped_at_each_beam(
    scenario: Scenario,
    heard: Mapping[int, Sequence[FrameMeasurements]],
    case: Case,
    config: Config,
) -> Iterator[dict[str, Any]]:
    """Map a world in a case at each beamwidth; give its scores and its NEES over time."""
    for beam in (beam for strategy, beam in CASES if strategy == case.strategy):
        scans = scans_of(heard[beam or 11], case.strategy, config)
        trial = run_trial(case, drive_of(scenario, config), scans, config)
        yield {
            "strategy": case.strategy, "beam": beam, "world": case.iteration,
            "full": trial.scores.landmarks_full, "total": trial.scores.landmarks_total,
            "diverged": trial.scores.diverged, "nees": trial.scores.nees_mean,
            "position": trial.scores.position_rmse_m, "heading": trial.scores.heading_rmse_rad,
            "track_nees": track_nees(trial.track.pose, scenario.path)[1:],
        }  # fmt: skip


# The misfit


def readings_of(trials: pl.DataFrame, heard: Sequence[Levels]) -> dict[Levels, "SecondReading"]:
    """Lay out every reading of some combinations of what is heard."""
    readings = {}
    for combination, mapped, exclusions in product(heard, MAPPED, EXCLUSIONS):
        levels = (*combination, *mapped, exclusions)
        readings[levels] = SecondReading(trials, dict(zip(FACTORS, levels, strict=True)))
    return readings


def promising(readings: Mapping[Levels, Reading]) -> list[Levels]:
    """List the combinations of what is heard whose best reading is not far above the least."""
    values = drawn(list(readings.values()), DRAWS_FIRST)
    best, least = int(values[0].argmin()), dict[Levels, int]()
    for i, levels in enumerate(readings):
        combination = levels[: len(HEARD)]
        if combination not in least or values[0, i] < values[0, least[combination]]:
            least[combination] = i
    found = []
    for combination, i in least.items():
        above = values[:, i] - values[:, best]
        error = np.std(above[1:][np.isfinite(above[1:])])
        if above[0] <= MOST_ABOVE * error:
            found.append(combination)
    return found


class SecondReading(Reading):
    """The numbers of a combination: a row per world, for each filter and case."""

    factors = FACTORS

    def __init__(self, trials: pl.DataFrame, levels: Mapping[str, str]) -> None:
        lost = "diverged" if levels["exclusions"] == "union" else "average_diverged"
        heard = {name: levels[name] for name in (*HEARD, "ranged", "weighed")}
        if levels["cap"] == "capped":
            keys = [pl.col(name) == levels[name] for name in HEARD]
            if trials.filter(*keys).is_empty():  # the limit does not bind
                heard["cap"] = "uncapped"
        renamed = trials.with_columns(diverged=pl.col(lost))
        super().__init__(renamed, heard, scores=("heading",))
        tried = CASES_TRIED if levels["exclusions"] == "union" else dict.fromkeys(EXCLUDED, 1.0)
        self.expected = {name: tried[name] * n / WORLDS for name, n in EXCLUDED.items()}

    def parts(self, rows: np.ndarray) -> dict[str, float]:
        """Return the distances to the paper, with that of the spread of the seen landmarks."""
        ratios = []
        for printed in TABLE_II:
            beam = round(printed.beamwidth)
            case = ("fused" if beam else "passive", beam)
            seen = self.columns[printed.filter, "total"][case][self.kept(printed.filter, rows)]
            spread = max(float(seen.std(ddof=1)), 0.1) if len(seen) > 1 else math.inf
            ratios.append(math.log(spread / printed.total[1]))
        return {**super().parts(rows), "spread": rmse(np.array(ratios))}

    def features(self, rows: np.ndarray) -> dict[str, int]:
        """Count the statements about the paper's curves that the means have."""
        heading = self.means("ekf", "heading", rows)
        ahead = sum(heading["fused", beam] < heading["active", beam] for beam in BEAMS)
        return {**super().features(rows), "heading": ahead}

    def placed(self, rows: np.ndarray) -> dict[str, float]:
        """Return landmarks placed and seen, errors in position, and gains with their errors."""
        found = super().placed(rows)
        for name in EXCLUDED:
            kept = self.kept(name, rows)
            for beam in BEAMS:
                active, fused = (
                    self.columns[name, "position"][way, beam][kept] for way in ("active", "fused")
                )
                gain = active - fused
                found[f"gain_{beam}_{name}"] = float(gain.mean())
                found[f"gain_{beam}_{name}_se"] = float(gain.std(ddof=1)) / len(gain) ** 0.5
            found[f"position_passive_{name}"] = fmean(
                self.columns[name, "position"]["passive", 0][kept].tolist()
            )
        return found


if __name__ == "__main__":
    main()
