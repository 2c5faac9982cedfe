"""What was fitted is what is used, and was fitted to what may be fitted, on worlds of its own."""

import importlib.util
import tomllib
from importlib.resources import files
from pathlib import Path
from statistics import fmean

import pytest

from pipistrelle.config import Config
from pipistrelle.experiments.studies.plan import find_plan, read_plan
from pipistrelle.report.sentences import TABLE_II

SCRIPT = Path(__file__).parents[2] / "papers/bradley_abaid/calibration.py"
FITTED = ("paper", "physics")
"""Plans with numbers of their own that were fitted; `beyond` has those of `physics`."""
PAPER = {(row.filter, round(row.beamwidth)): row for row in TABLE_II}


@pytest.fixture(scope="module", params=FITTED)
def plan(request) -> str:
    return request.param


@pytest.fixture(scope="module")
def found(plan) -> dict:
    text = files("pipistrelle.experiments.studies").joinpath(f"{plan}_calibration.toml").read_text()
    return tomllib.loads(text)


def value(config: Config, name: str) -> float:
    section, field = name.split(".")
    return getattr(getattr(config, section), field)


def test_the_fitted_values_equal_the_plans(found, plan):
    assert len(found["fitted"]) == 4
    for name, fitted in found["fitted"].items():
        assert value(read_plan(find_plan(plan)).config, name) == fitted


def test_the_defaults_equal_the_physics_plans():
    assert read_plan(find_plan("physics")).config == Config(seed=2022)


def test_the_fit_and_the_study_use_different_worlds(found, plan):
    assert found["worlds"]["seed"] != read_plan(find_plan(plan)).config.seed


def test_only_three_numbers_of_table_ii_were_fitted_to(found):
    assert {name: fit["paper"] for name, fit in found["fitted_to"].items()} == {
        "fused 180": PAPER["ekf", 180].total[0],
        "passive": PAPER["ekf", 0].total[0],
        "passive, fully initialised": PAPER["ekf", 0].full[0],
    }


def test_the_fit_meets_them_within_two_standard_errors(found):
    for fit in found["fitted_to"].values():
        assert abs(fit["ours"] - fit["paper"]) < 2 * fit["standard_error"]


def test_active_sensing_sees_no_more_than_the_papers_claims_allow(found):
    assert round(found["landmarks_seen_predicted"]["active 180"]["ours"]) <= 36


def test_the_fitted_power_is_the_least_that_reaches_the_papers_count(found):
    grid = found["prunes_tried"]
    assert grid == sorted(grid)
    for row in found["rays_tried"]:
        counts = row["landmarks_full_at_every_prune"]
        nearest = min(counts, key=lambda count: abs(count - PAPER["ekf", 0].full[0]))
        assert row["prune"] == grid[counts.index(nearest)]
    least = min(row["power"] for row in found["rays_tried"] if row["power"] > 1)
    assert found["fitted"]["rays.exponent"] == least


@pytest.mark.slow
def test_some_of_its_worlds_heard_again_see_as_many_landmarks(found, plan):
    spec = importlib.util.spec_from_file_location("calibration", SCRIPT)
    assert spec is not None
    assert spec.loader is not None
    calibration = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(calibration)
    config = read_plan(find_plan(plan)).config
    worlds, config = 12, config.model_copy(update={"seed": found["worlds"]["seed"]})
    seen = [calibration.landmarks_seen(config, ("180", "11"), world) for world in range(worlds)]
    for name in ("fused 180", "passive"):
        fit = found["fitted_to"][name]
        error = fit["standard_error"] * (found["worlds"]["count"] / worlds) ** 0.5
        assert abs(fmean(row[name] for row in seen) - fit["ours"]) < 4 * error
