"""The plan of the paper is the reading that the experiments chose, by their own rule."""

from itertools import product
from pathlib import Path

import polars as pl
import pytest

from pipistrelle.config import STRATEGIES, Config
from pipistrelle.experiments.studies.plan import find_plan, read_plan
from reference.papers import papers_module

PAPER = Path(__file__).parents[2] / "papers/bradley_abaid"
changed = papers_module("calibration").changed
first, second = papers_module("readings"), papers_module("second_readings")
FACTORS = {"readings": first.FACTORS | {"ranged": first.ALL_RANGED}, "second_readings": second.WAYS}
PLAN = read_plan(find_plan("paper")).config


def table(name):
    return pl.read_csv(PAPER / f"{name}.csv")


def departures(config, row, factors):
    """Settings of the levels of a row that a config has otherwise, of all that the levels name."""
    wanted = Config()
    for factor, levels in factors.items():
        wanted = changed(wanted, levels[row[factor]])
    keys = {key for levels in factors.values() for way in levels.values() for key in way}
    return {key for key in keys for a, b in [key.split(".")]
            if getattr(getattr(config, a), b) != getattr(getattr(wanted, a), b)}  # fmt: skip


def test_every_combination_of_the_first_experiment_was_tried():
    rows = table("readings")
    assert rows.select(*first.FACTORS).is_unique().sum() == rows.height == 162
    assert rows.filter(pl.col("ranged").is_in(["anew", "bearing"])).height == 4 * 2**5
    assert rows["misfit"].is_sorted()


def test_every_combination_of_the_second_experiment_was_tried():
    rows = table("second_readings")
    every = product(second.ALL_HEARD, second.MAPPED, second.EXCLUSIONS)
    assert set(rows.select(*second.FACTORS).rows()) == {(*a, *b, c) for a, b, c in every}
    assert set(rows["worlds"]) == {second.FIRST, first.WHOLE}
    assert rows.filter(worlds=second.FIRST)["above_best"].is_null().all()


@pytest.mark.parametrize("name", FACTORS)
def test_the_plan_departs_least_among_the_tied_readings(name):
    rows = table(name)
    tied = rows.filter(pl.col("above_best") <= pl.col("above_best_error").fill_nan(0.0))
    assert tied.height == rows["tied"].sum()
    chosen = tied.sort("departures", "misfit").row(0, named=True)
    assert not departures(PLAN, chosen, FACTORS[name])


def test_the_defaults_are_one_of_the_readings_and_far_from_the_least():
    config, near = read_plan(find_plan("physics")).config, table("readings")
    near = near.filter(pl.col("ranged").is_in([*first.ALL_RANGED]))
    mine = [r for r in near.rows(named=True) if not departures(config, r, FACTORS["readings"])]
    assert len(mine) == 1
    assert mine[0]["above_best"] > 2.0 * mine[0]["above_best_error"]


def test_a_filter_runs_once_for_each_choice_that_changes_its_map():
    counts = [len([*second.ways_of(*case)]) for case in product(("ekf", "fastslam"), STRATEGIES)]
    assert counts == [1, 3, 1, 1, 7, 3]
