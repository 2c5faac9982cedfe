"""The whole studies of the page, small enough to keep: judge them again without running them.

    python papers/bradley_abaid/kept_studies.py unpack paper FOLDER
    python papers/bradley_abaid/kept_studies.py keep STUDY

``keep`` writes of a study's folder ``studies/NAME`` beside this file, NAME being the plan's name:

    plan.toml              what was run
    trials.parquet         a row per world and case: the scores
    landmarks.parquet      a row per landmark of a final map: placed or not, its error [mm]
    nees.parquet           a row per world and case: the NEES over the frames
    consistent.parquet     a row per case: a consistent filter's NEES over the frames, mean and
                           variance, averaged over the worlds

The NEES is kept to a sixteenth of an octave, each frame as the difference to the one before. That
rounds a value by up to 2.2 % and a mean over a hundred worlds by some 0.1 %. Errors of the pose at
each frame are not kept. ``unpack`` makes of it a study's folder, which `pipistrelle report` reads.
"""

import argparse
import sys
from io import BytesIO
from pathlib import Path

import numpy as np
import polars as pl

from pipistrelle.config import InputError
from pipistrelle.experiments.studies.plan import cases_of, read_plan
from pipistrelle.experiments.studies.study import load_study, open_store
from pipistrelle.experiments.studies.world import STEPS, TrialRecord, write_world
from pipistrelle.files import write_whole

STUDIES = Path(__file__).with_name("studies")
PER_OCTAVE = 16
LEAST = 2.0**-20
"""A NEES below this is kept as this."""
KEY = ("iteration", "case")


def main() -> None:
    """Keep or unpack, as the command line says."""
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    ways = options.add_subparsers(required=True)
    keeping = ways.add_parser("keep", help="make small files of a study's folder")
    keeping.add_argument("folder", type=Path)
    keeping.set_defaults(do=lambda chosen: print(keep_study(chosen.folder)))
    kept = sorted(path.name for path in STUDIES.glob("*"))
    unpacking = ways.add_parser("unpack", help="make a study's folder of what is kept")
    unpacking.add_argument("name", choices=kept)
    unpacking.add_argument("folder", type=Path, help="a new folder")
    unpacking.set_defaults(do=lambda chosen: unpack_study(STUDIES / chosen.name, chosen.folder))
    chosen = options.parse_args()
    try:
        chosen.do(chosen)
    except (InputError, OSError) as mistake:
        sys.exit(str(mistake))


def keep_study(folder: Path, into: Path = STUDIES) -> Path:
    """Write a study's small files; return their folder."""
    study = load_study(folder)
    trials, landmarks, steps = (
        table.collect().sort(*KEY) for table in (study.trials, study.landmarks, study.steps)
    )
    nees = pl.max_horizontal("nees", pl.lit(LEAST, pl.Float32)).log(2.0) * PER_OCTAVE
    level = nees.round().cast(pl.Int32)
    tables = {
        "trials": trials,
        "landmarks": landmarks.with_columns(error_mm=_millimetres()).drop("error_m"),
        "nees": steps.sort(*KEY, "frame")
        .with_columns(level=level)
        .group_by(KEY, maintain_order=True)
        .agg(sixteenths=pl.col("level").diff().fill_null(pl.col("level").first())),
        "consistent": steps.group_by("case", "frame")
        .agg(mean=pl.col("nees_expected").mean(), variance=pl.col("nees_variance").mean())
        .sort("case", "frame")
        .group_by("case", maintain_order=True)
        .agg("mean", "variance"),
    }
    place = into / study.plan.name
    place.mkdir(parents=True, exist_ok=True)
    for name, table in tables.items():
        buffer = BytesIO()
        table.write_parquet(buffer, compression="zstd", compression_level=22)
        write_whole(place / f"{name}.parquet", buffer.getvalue())
    write_whole(place / "plan.toml", (folder / "plan.toml").read_bytes())
    return place


def _millimetres() -> pl.Expr:
    """Round an error in metres to a millimetre."""
    return (pl.col("error_m") * 1000.0).round().cast(pl.Int32)


def unpack_study(place: Path, folder: Path) -> None:
    """Write the folder of a study that is kept."""
    plan = read_plan(place / "plan.toml")
    trials, landmarks, nees, consistent = (
        pl.read_parquet(place / f"{name}.parquet", glob=False)
        for name in ("trials", "landmarks", "nees", "consistent")
    )
    rows = {(row["iteration"], row["case"]): row for row in trials.iter_rows(named=True)}
    maps = dict(landmarks.group_by(KEY))
    ideal = {row[0]: np.array(row[1:], dtype=float).T for row in consistent.iter_rows()}
    paths = {
        (row["iteration"], row["case"]): np.cumsum(row["sixteenths"])
        for row in nees.iter_rows(named=True)
    }
    open_store(folder, plan)
    for world in sorted({iteration for iteration, _ in rows}):
        records = []
        for case in cases_of(plan):
            key = world, case.number
            level = paths.get(key, np.empty(0))
            steps = np.full((len(level), len(STEPS)), np.nan)
            steps[:, STEPS.index("nees")] = 2.0 ** (level / PER_OCTAVE)
            steps[:, -2:] = ideal[case.number][: len(level)] if len(level) else 0.0
            final = maps.get(key, landmarks.clear())
            records.append(
                TrialRecord(
                    case=case,
                    row=rows[key],
                    steps=steps,
                    landmark=final["landmark"].to_numpy(),
                    full=final["full"].to_numpy(),
                    landmark_error=final["error_mm"].to_numpy() / 1000.0,
                )
            )
        write_world(folder, plan, world, records)


if __name__ == "__main__":
    main()
