"""Readings of the paper one at a time: what each detail of the filters and of the sound changes.

    python papers/bradley_abaid/single_readings.py FOLDER [--worlds 60] [--workers 2]
        [--layout disc] [--labels "0.1 rad"] [--cap capped] [--front-end paper]
        [--fits FILE] [--table]

The base is a combination of the first four factors of `second_readings`, by default the plan
`paper`; of another, levels and tau are fitted first, or taken from FILE, the fits of
`second_readings`. Each row of the table changes one thing:

    EKF          all measurements of a scan in one update; the aggregated likelihoods not
                 normalised, also with tau fitted again; a correspondence in each hypothesis
    FastSLAM     weights, proposal and resampling as in T. Bailey's MATLAB package, with several
                 ways for a ray to enter them; what a range does to a ray; likelihoods and
                 correspondence as above
    estimate     FastSLAM's pose and covariance, read from the same particles in other ways
    map          which particles' landmarks count
    sound        `own_hearing.HEARD`

Filters are the package's where its settings have the reading; `own_ekf` and `own_fastslam` where
they have not. Where a reading changes what is heard, levels and tau are fitted again (`Hearing`
says which), to the counts that the base has in the same worlds; elsewhere they are the base's.

The worlds have seed 1000; the study's have 2022. What is done is kept in FOLDER, a file for each
world and reading, so that a run that is cut off goes on; --table sums up what is done. The table is
``single_readings.csv`` beside this file for 60 worlds of the default base, else in FOLDER. Of its
columns, ``full``, ``total``: means of Table II and their sigma over the worlds; ``gain``, ``turn``:
error of active sensing less that of fused in position [m] and heading [rad]; ``anees``: the largest
over time and beams of the NEES averaged over worlds; ``union``, ``average``: worlds lost, by any
case or by the NEES averaged over the beams of a strategy; ``never``: at how many of the four beams
fused sensing is not ahead in position; ``worst``: in how many of the eight active and fused cases
the error is below that of passive sensing (the paper has 4 and 8 for FastSLAM); ``d_...``: change
against the base in the same worlds. All are of the worlds that the reading's filter does not lose
by the average (all, if it loses all), but changes are of all worlds, those of the NEES as log10.
"""

import argparse
import json
import sys
from collections.abc import Callable, Iterator, Mapping
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import polars as pl
from calibration import Oracle, Run, at_least, changed, fit_levels, in_worlds
from own_ekf import OwnEkf
from own_fastslam import AFTER, BEFORE, HEAVIEST, NONE, SHARED, WHOLE, Details, OwnFastSlam
from own_hearing import HEARD, fit_again, hear, tau_for
from own_tracks import READINGS, follow, track_of, whole
from readings import BEAMS, CASES, Change, fit_tau, keep, read_kept, write_table
from readings import WHOLE as WORLDS
from second_readings import CAP, DEFAULTS, FACTORS, ORACLES, settings
from second_readings import HEARD as FACTORS_HEARD
from single_table import BASE, SAME, table_of

from pipistrelle.arithmetic.random_stream import stream_key
from pipistrelle.config import Config
from pipistrelle.estimation.catalogue import entry
from pipistrelle.evaluation.consistency import diverged, track_nees
from pipistrelle.experiments.drives import Drive
from pipistrelle.experiments.hearing.oracle import label_detections
from pipistrelle.experiments.named_settings import Case
from pipistrelle.experiments.results.scores import score
from pipistrelle.experiments.runs.heard_world import drive_of, scans_of
from pipistrelle.experiments.runs.trial import run_trial
from pipistrelle.experiments.studies.plan import find_plan, read_plan
from pipistrelle.files import write_whole
from pipistrelle.report.sentences import EXCLUDED

FITTED = "likelihoods not normalised, tau fitted again"
EKF: dict[str, dict[str, Any]] = {
    "one update a scan": {"batch": True},
    "likelihoods not normalised": {"normalised": False},
    FITTED: {"normalised": False},
    "a correspondence in each hypothesis": {"carried": True},
}
"""Details of `own_ekf`."""
SAMPLED = Details(at_sample=True)
FASTSLAM = {
    "weights at the sample": SAMPLED,
    "weights at the sample, hypotheses as landmarks": SAMPLED._replace(weight=SHARED),
    "weights at the sample, hypotheses as landmarks with R": SAMPLED._replace(weight=WHOLE),
    "hypotheses as landmarks": Details(weight=SHARED),
    "hypotheses as landmarks with R": Details(weight=WHOLE),
    "hypotheses as landmarks with R, also in the proposal": Details(WHOLE, WHOLE),
    "hypotheses with R in the proposal": Details(WHOLE),
    "every measurement refines the motion's covariance": Details(printed=True),
    "heaviest hypothesis proposes and weighs": Details(HEAVIEST, HEAVIEST),
    "heaviest hypothesis weighs": Details(weight=HEAVIEST),
    "rays do not weigh": Details(weight=NONE),
    "rays neither propose nor weigh": Details(NONE, NONE),
    "rays do not weigh, and restart at resampling": Details(weight=NONE, restart=True),
    "rays neither propose nor weigh, and restart at resampling": Details(NONE, NONE, restart=True),
    "rays do not weigh, likelihoods not normalised": Details(weight=NONE, normalised=False),
    "weights at the sample, rays do not weigh": SAMPLED._replace(weight=NONE),
    "resampled before the sample, rays do not weigh": Details(weight=NONE, early=True),
    "resampled before the sample": Details(early=True),
    "resampled before the sample, hypotheses as landmarks": Details(weight=SHARED, early=True),
    "a range moves the heaviest, alone, before the proposal": Details(ranged=BEFORE),
    "a range moves the heaviest, alone, after the sample": Details(ranged=AFTER),
    "weights at the sample, a range moves the heaviest before": SAMPLED._replace(ranged=BEFORE),
    "likelihoods not normalised": Details(normalised=False),
    FITTED: Details(normalised=False),
    "a correspondence in each hypothesis": Details(carried=True),
}
"""Details of `own_fastslam`."""
SETTINGS: dict[str, Change] = {
    "a range places the landmark anew": {"rays.range_update": "anew"},
    "a range moves the heaviest, with the others": {"rays.range_update": "moved"},
    "rays restart at resampling": {"fastslam.resampled_rays": "restart"},
}
"""Settings of the package, for both filters."""


class Base(NamedTuple):
    """The settings of a base reading, and how its detections are labelled."""

    config: Config
    oracle: Oracle
    taus: Mapping[str, float]
    """Fitted again, by reading."""
    fits: Mapping[str, Change]
    """Settings fitted again, by change of what is heard."""


def main() -> None:
    """Fit, run what is not done, and write the table."""
    chosen = _asked()
    name = "/".join(getattr(chosen, factor) for factor in FACTORS_HEARD)
    plain = name == "/".join(DEFAULTS[factor] for factor in FACTORS_HEARD)
    folder = chosen.folder / f"{name.replace('/', ', ')}, {chosen.worlds}"
    folder.mkdir(parents=True, exist_ok=True)
    if not chosen.table:
        with in_worlds(chosen.worlds, chosen.workers) as run:
            base = _fitted(folder / "fits.json", chosen, name, run)
            run(partial(world_done, folder, base))
    done = sorted(folder.glob("*.parquet"))
    if not done:
        sys.exit(f"{folder}: nothing is done yet; run without --table")
    trials = pl.concat(read_kept(path) for path in done)
    estimates = [f"estimate: {reading}" for reading in READINGS]
    order = [BASE, SAME, *SETTINGS, *EKF, *FASTSLAM, *estimates, *HEARD]
    table = table_of(trials, order)
    finished = plain and (table["worlds"] == WORLDS).all()
    output = Path(__file__).with_name("single_readings.csv")
    write_table(table, output if finished else folder / output.name)


def _asked() -> argparse.Namespace:
    """Read the command line."""
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("folder", type=Path, help="where what is done is kept; again: go on")
    options.add_argument(
        "--worlds", type=at_least(2), default=WORLDS, help="how many [%(default)s]"
    )
    options.add_argument("--workers", type=at_least(1), default=2, help="processes [%(default)s]")
    for factor in FACTORS_HEARD:
        options.add_argument(
            f"--{factor.replace('_', '-')}", choices=[*FACTORS[factor]], default=DEFAULTS[factor]
        )
    options.add_argument("--table", action="store_true", help="only the table of what is done")
    options.add_argument("--fits", type=Path, help="fits of second_readings, for its levels")
    return options.parse_args()


# Fits


def _fitted(path: Path, chosen: argparse.Namespace, name: str, run: Run) -> Base:
    """Return the base with its levels, and what is fitted again."""
    fits: dict[str, Change] = json.loads(path.read_text()) if path.exists() else {}

    def once(key: str, fit: Callable[[], Change]) -> Change:
        if key not in fits:
            fits[key] = fit()
            print(key, fits[key], flush=True)
            write_whole(path, json.dumps(fits, indent=1).encode())
        return fits[key]

    config = settings(chosen.layout, chosen.labels, chosen.front_end)
    oracle = ORACLES.get(chosen.labels, label_detections)

    def of_base() -> Change:
        if chosen.fits:
            return json.loads(chosen.fits.read_text())[name]
        if name == "/".join(DEFAULTS[factor] for factor in FACTORS_HEARD):
            plan = read_plan(find_plan("paper")).config
            levels = plan.emitter.level_db, plan.beacon.level_db, plan.rays.prune_threshold
        else:
            found = fit_levels(config, run, oracle=oracle, most_active=CAP[chosen.cap])
            tau = fit_tau(found, run, oracle=oracle)
            levels = found.emitter.level_db, found.beacon.level_db, tau
        return dict(
            zip(
                ("emitter.level_db", "beacon.level_db", "rays.prune_threshold"), levels, strict=True
            )
        )

    config = changed(config, once(BASE, of_base))

    def placed(name: str, settings: Config, **details: Any) -> Callable[[int], int]:
        return partial(_placed_passively, name, settings, oracle, details)

    again = {
        name: once(name, partial(fit_again, name, config, run, oracle, placed))
        for name, how in HEARD.items()
        if how.fitted
    }

    def tau() -> Change:
        aim = float(np.mean(run(placed("", config))))
        return {
            "rays.prune_threshold": tau_for(
                aim,
                lambda tau: run(
                    placed("", changed(config, {"rays.prune_threshold": tau}), **EKF[FITTED])
                ),
            )
        }

    again |= {name: dict(how.change) for name, how in HEARD.items() if not how.fitted}
    return Base(config, oracle, {FITTED: once(FITTED, tau)["rays.prune_threshold"]}, again)


def _placed_passively(
    name: str, config: Config, oracle: Oracle, details: Mapping[str, Any], world: int
) -> int:
    """Count the landmarks that passive EKF-SLAM fully initialises."""
    key = (name, config.model_copy(update={"rays": Config().rays}).model_dump_json(), world)
    if key not in _HEARD:
        scenario, (heard,) = hear(name, config, [BEAMS[11]], world, oracle)
        _HEARD[key] = drive_of(scenario, config), scans_of(heard, "passive", config)
    drive, scans = _HEARD[key]
    if not details:
        case = Case(strategy="passive", filter="ekf", iteration=world)
        return run_trial(case, drive, scans, config).scores.landmarks_full
    slam = OwnEkf(config, drive.motion, **details)
    follow(slam, drive, scans, np.random.default_rng(0))
    return int(np.sum(np.unique(slam.label, return_counts=True)[1] == 1))


_HEARD: dict[Any, Any] = {}
"""Worlds heard for a fit, in each process."""


# Trials


def world_done(folder: Path, base: Base, world: int) -> list[Path]:
    """Run every group of readings in a world, unless its file exists; return the files."""
    groups: dict[str, Callable[[], Iterator[dict[str, Any]]]] = {
        **{name: partial(_package, name, base, world) for name in (BASE, *SETTINGS)},
        **{f"own ekf, {name}": partial(_own, "ekf", name, base, world) for name in EKF},
        **{
            f"own fastslam, {name}": partial(_own, "fastslam", name, base, world)
            for name in (BASE, *FASTSLAM)
        },
        **{name: partial(_package, name, base, world) for name in HEARD},
    }
    paths = []
    for name, trials in groups.items():
        paths.append(folder / f"{world} {name}.parquet")
        if not paths[-1].exists():
            keep(pl.DataFrame(list(trials()), infer_schema_length=None), paths[-1])
    return paths


@lru_cache(maxsize=1)
def _heard(name: str, settings: str, oracle: Oracle, world: int) -> tuple[Drive, Any]:
    """Listen in a world; the settings come as text, to be a key."""
    config = Config.model_validate_json(settings)
    scenario, heard = hear(name, config, [*BEAMS.values()], world, oracle)
    return drive_of(scenario, config), heard


def _cases_of(
    name: str, base: Base, world: int, config: Config, *, active: bool
) -> Iterator[tuple[Drive, str, int, Any]]:
    """Yield drive, strategy, beam and scans of every case, heard with a change."""
    changes = changed(base.config, base.fits.get(name, {}))
    heard_as = name if name in HEARD else ""
    drive, heard = _heard(heard_as, changes.model_dump_json(), base.oracle, world)
    for way, beam in CASES:
        if active or way != "active":
            yield drive, way, beam, scans_of(heard[[*BEAMS].index(beam or 11)], way, config)


def _package(name: str, base: Base, world: int) -> Iterator[dict[str, Any]]:
    """Map a world by the package's filters, with a change of settings or of what is heard."""
    config = changed(base.config, base.fits.get(name, SETTINGS.get(name, {})))
    for slam in EXCLUDED:
        rows = []
        active = name not in SETTINGS
        for drive, way, beam, scans in _cases_of(name, base, world, config, active=active):
            case = Case(strategy=way, filter=slam, iteration=world)
            trial = run_trial(case, drive, scans, config)
            nees = track_nees(trial.track.pose, drive.truth.path)[1:]
            rows.append(({"strategy": way, "beam": beam} | _numbers(trial.scores), nees))
        yield from _labelled(name, slam, world, rows)


def _own(slam: str, name: str, base: Base, world: int) -> Iterator[dict[str, Any]]:
    """Map a world by a filter of these scripts, with a detail changed."""
    config, rows = base.config, dict[str, list[Any]]()
    if name in base.taus:
        config = changed(config, {"rays.prune_threshold": base.taus[name]})
    active = _concerns_active(slam, name)
    for drive, way, beam, scans in _cases_of("", base, world, config, active=active):
        rng = np.random.default_rng(stream_key(config.seed, world, slam))
        made = (
            OwnEkf(config, drive.motion, **EKF[name])
            if slam == "ekf"
            else OwnFastSlam(config, drive.motion, FASTSLAM.get(name, Details()))
        )
        for reading, numbers, nees in _read(name, slam, made, drive, scans, rng):
            row = {"strategy": way, "beam": beam} | numbers
            rows.setdefault(reading, []).append((row, nees))
    for reading, of_reading in rows.items():
        yield from _labelled(reading, slam, world, of_reading)


def _concerns_active(slam: str, name: str) -> bool:
    """Return whether a detail changes what happens without a ray."""
    details = FASTSLAM.get(name, Details())
    if slam == "ekf":
        return name == "one update a scan"
    return name == BASE or details.at_sample or details.early or details.printed


def _read(
    name: str, slam: str, made: Any, drive: Drive, scans: Any, rng: np.random.Generator
) -> Iterator[tuple[str, dict[str, Any], np.ndarray]]:
    """Yield the scores of a filter, and for the base those of every reading of its particles."""
    done, limit = follow(made, drive, scans, rng), entry(slam).nees_limit

    def scored(path: Any) -> tuple[dict[str, Any], np.ndarray]:
        track = track_of(path, drive, made.landmarks())
        scores = score(track, drive.truth, scans, limit)
        return _numbers(scores), track_nees(track.pose, drive.truth.path)[1:]

    numbers, nees = scored(done.path or whole(done.before))
    if name != BASE:
        yield name, numbers, nees
        return
    yield SAME, numbers, nees
    for reading, (estimate, when) in READINGS.items():
        yield f"estimate: {reading}", *scored(estimate(getattr(done, when)))
    for reading, full in made.placed().items():
        yield f"map: {reading}", numbers | {"full": float(full)}, nees


def _numbers(scores: Any) -> dict[str, Any]:
    """Return the scores that are kept."""
    return {
        "full": float(scores.landmarks_full), "total": float(scores.landmarks_total),
        "position": scores.position_rmse_m, "heading": scores.heading_rmse_rad,
        "nees": scores.nees_mean, "diverged": scores.diverged,
    }  # fmt: skip


def _labelled(name: str, slam: str, world: int, rows: list[Any]) -> Iterator[dict[str, Any]]:
    """Yield the rows of a reading, with the divergence of the NEES averaged over beams."""
    for row, nees in rows:
        same = [other for of, other in rows if of["strategy"] == row["strategy"]]
        average = diverged(np.mean(same, axis=0), entry(slam).nees_limit)
        kept = nees[3::4].astype(np.float32).tolist()
        yield {
            "reading": name, "filter": slam, "world": world, **row, "average": average,
            "frames": kept,
        }  # fmt: skip


if __name__ == "__main__":
    main()
