"""The plan of the paper is the reading that the experiment chose, by its own rule."""

from pathlib import Path

import polars as pl

from pipistrelle.config import Config
from pipistrelle.experiments.studies.plan import find_plan, read_plan
from reference.papers import papers_module

TABLE = Path(__file__).parents[2] / "papers/bradley_abaid/readings.csv"
changed = papers_module("calibration").changed
first = papers_module("readings")
FACTORS = first.FACTORS | {"ranged": first.ALL_RANGED}
PLAN = read_plan(find_plan("paper")).config


def departures(config, row, factors):
    """Settings of the levels of a row that a config has otherwise, of all that the levels name."""
    wanted = Config()
    for factor, levels in factors.items():
        wanted = changed(wanted, levels[row[factor]])
    keys = {key for levels in factors.values() for way in levels.values() for key in way}
    return {key for key in keys for a, b in [key.split(".")]
            if getattr(getattr(config, a), b) != getattr(getattr(wanted, a), b)}  # fmt: skip


def test_every_combination_of_the_first_experiment_was_tried():
    rows = pl.read_csv(TABLE)
    assert rows.select(*first.FACTORS).is_unique().sum() == rows.height == 162
    assert rows.filter(pl.col("ranged").is_in(["anew", "bearing"])).height == 4 * 2**5
    assert rows["misfit"].is_sorted()


def test_the_plan_departs_least_among_the_tied_readings():
    rows = pl.read_csv(TABLE)
    tied = rows.filter(pl.col("above_best") <= pl.col("above_best_error"))
    assert tied.height == rows["tied"].sum()
    chosen = tied.sort("departures", "misfit").row(0, named=True)
    assert not departures(PLAN, chosen, FACTORS)


def test_the_defaults_are_one_of_the_readings_and_far_from_the_least():
    config, near = read_plan(find_plan("physics")).config, pl.read_csv(TABLE)
    near = near.filter(pl.col("ranged").is_in([*first.ALL_RANGED]))
    mine = [r for r in near.rows(named=True) if not departures(config, r, FACTORS)]
    assert len(mine) == 1
    assert mine[0]["above_best"] > 2.0 * mine[0]["above_best_error"]
