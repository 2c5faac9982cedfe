"""The misfit of whole studies: how near a reading is in worlds that did not choose it.

    python papers/bradley_abaid/held_out.py STUDY_FOLDER...

`readings.py` chooses among many misfits in sixty worlds, and the least of many is in part luck.
Here the same measure is taken of studies at full size, in worlds of another seed and with their
frozen settings, from the nine cases that the experiment has. Written as ``held_out.csv`` beside
this file, with standard errors by bootstrap over the worlds; the first study is the one that the
others are compared with.
"""

import argparse
import sys
from pathlib import Path

import numpy as np
import polars as pl
from readings import BEAMS, Reading, drawn, write_table

from pipistrelle.config import InputError
from pipistrelle.experiments.studies.study import load_study

OUTPUT = Path(__file__).with_name("held_out.csv")


def main() -> None:
    """Read the studies, and write the table."""
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("studies", type=Path, nargs="+", help="folders of `pipistrelle study`")
    try:
        readings = {folder.name: reading_of(folder) for folder in options.parse_args().studies}
    except InputError as mistake:
        sys.exit(str(mistake))
    values = drawn(list(readings.values()))
    rows = []
    for i, (name, reading) in enumerate(readings.items()):
        rows.append(
            {
                "study": name,
                **reading.parts(np.arange(reading.worlds)),
                **reading.placed(np.arange(reading.worlds)),
                **reading.features(np.arange(reading.worlds)),
                "misfit": values[0, i],
                "standard_error": values[1:, i].std(),
                "above_first": values[0, i] - values[0, 0],
                "above_first_error": (values[1:, i] - values[1:, 0]).std(),
            }
        )
    write_table(pl.DataFrame(rows), OUTPUT)


def reading_of(folder: Path) -> Reading:
    """Take of a study's trials the cases that the experiment has, under its names."""
    trials = load_study(folder).trials.collect()
    width = pl.col("beamwidth_deg")
    near = [pl.when((width - beam).abs() < 1.0).then(beam) for beam in BEAMS]
    named = trials.select(
        "strategy",
        "filter",
        "diverged",
        pl.col("iteration").alias("world"),
        pl.col("landmarks_full").alias("full"),
        pl.col("landmarks_total").alias("total"),
        pl.col("position_rmse_m").alias("position"),
        pl.col("nees_mean").alias("nees"),
        pl.when(pl.col("strategy") == "passive").then(0).otherwise(pl.coalesce(near)).alias("beam"),
    )
    return Reading(named.drop_nulls("beam"), {})


if __name__ == "__main__":
    main()
