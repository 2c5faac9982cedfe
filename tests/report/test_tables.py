"""Rows of effects: what the answer's one sentence for each variable leaves to the table."""

from dataclasses import replace

import numpy as np
import pytest

from pipistrelle.evaluation.consistency import anees_bounds
from pipistrelle.experiments.studies.plan import find_plan, read_plan
from pipistrelle.report.effects import HEADLINE, OTHERWISE, effects_of
from pipistrelle.report.study import read_study, select, selections
from pipistrelle.report.tables import (
    by_strategy,
    case_rows,
    consistency_rows,
    effect_tables,
    exclusion_rows,
    not_the_papers,
    not_the_papers_line,
    table_ii_rows,
)
from pipistrelle.settings import from_flags
from report.invented import RADII, diverging, invent, only, with_third
from report.planted import by_level, write_planted

TWO = '"beacon.level_db" = [36.8, 48.8]\n"rays.exponent" = [1.0, 3.0]'


@pytest.fixture
def rows(tmp_path):
    """The rows on beacon.level_db of a study whose effect is planted."""

    def rows(*args, **given):
        write_planted(tmp_path / "s", *args, **given)
        by_rule = selections(read_study(tmp_path / "s"))
        effects = [effects_of(by_rule[rule]) for rule in (HEADLINE, OTHERWISE)]
        return effect_tables(by_rule[HEADLINE], *effects)[0]["rows"]

    return rows


@pytest.mark.parametrize("second", [1.0, -1.0])
def test_each_of_few_combinations_has_a_row_and_one_with_the_opposite_is_marked(rows, second):
    def effect(case):
        sign = {1.0: 1.0, 3.0: second}[case.values["rays.exponent"]]
        return {"position_rmse_m": sign * 0.5 * (case.values["beacon.level_db"] > 40.0)}

    mean, *apart = rows(TWO, effect=effect)
    assert [row["label"] for row in apart] == ["at rays.exponent = 1", "at rays.exponent = 3"]
    assert [row["cells"][0]["text"][:4] for row in apart] == [
        "+0.5" if second > 0 else row["cells"][0]["text"][:4] for row in apart
    ]
    assert all(row["below"] and row["cells"][0]["shown"] for row in apart)
    assert mean["cells"][0]["shown"] is (second > 0)
    assert [row["contrary"] for row in apart] == [second < 0] * 2


def test_an_effect_that_depends_on_diverged_cases_has_a_second_row(rows):
    """In three of sixteen worlds the highest level makes the filter diverge, far off."""

    def diverged(case, world):
        return case.values["beacon.level_db"] == 48.8 and world < 3

    def effect(case):
        return {"position_rmse_m": -0.05 * (case.values["beacon.level_db"] == 48.8)}

    given = {"worlds": 16, "effect": effect, "diverged": diverged}
    labels = [row["label"] for row in rows(**given)]
    assert "without diverged cases" not in labels, "the same either way"
    found = rows(**given, far=3.0)
    assert not found[1]["cells"][0]["shown"]
    (without,) = (row for row in found if row["below"])
    assert (without["label"], without["contrary"]) == ("without diverged cases", True)
    assert without["cells"][0]["shown"]
    assert without["cells"][0]["text"].startswith("−0.0")


def test_cases_have_floor_bound_and_the_multiple_of_the_bound(tmp_path):
    write_planted(tmp_path / "s", effect=by_level(0.3))
    row = case_rows(selections(read_study(tmp_path / "s"))[HEADLINE])[0]
    assert row["position_floor_m"] is None, "the planted study has none"
    assert row["position_bound_m"] == pytest.approx(0.25, abs=0.02)
    assert row["times_the_bound"] == pytest.approx(0.8 / 0.25, rel=0.1)


def as_the_paper(study, **flags):
    """The same study under the settings of the plan `paper`, but for those given."""
    plan = read_plan(find_plan("paper"), from_flags(flags), iterations=2)
    return replace(study, config=plan.config, grid=plan.grid)


def test_settings_and_cases_that_are_not_the_papers_are_named_with_both_values():
    same = as_the_paper(invent(2, planned=7), seed=5)
    assert same.grid["emitter.radius"] == RADII
    assert not_the_papers(same) == []
    assert not_the_papers_line([]) == ""
    study = as_the_paper(invent(2), scenario={"steps": 200}, beacon={"level_db": 45.0})
    assert not_the_papers_line(not_the_papers(study)) == (
        "Not the paper's study: scenario.steps 200 (paper 1500), beacon.level_db 45 (paper 43.2)"
    )
    study = replace(as_the_paper(invent(2)), grid={"emitter.radius": (0.025, 0.0025)})
    line = not_the_papers_line(not_the_papers(only(study, [("ekf", "active"), ("ekf", "fused")])))
    assert line == (
        "Not the paper's study: "
        "emitter.radius 0.0025 and 0.025 (paper 12 values from 0.0025 to 0.025), "
        "strategies active and fused (paper active, fused and passive), "
        "filters ekf (paper ekf and fastslam)"
    )


def test_exclusions_count_worlds_and_trials_and_have_the_papers():
    study = invent(6)
    for way, columns in (("fused", slice(2, 5)), ("active", slice(1))):
        study.trials["ekf", way] = diverging(study.trials["ekf", way], 0, columns)
    study.trials["fastslam", "passive"].failed[3, 0] = True
    ekf, fastslam = exclusion_rows(study)
    assert (ekf["excluded"], ekf["worlds"], ekf["paper"], ekf["limit"]) == (1, 6, 8, 50.0)
    assert ekf["diverged"] == {"active": 1, "fused": 3, "passive": 0}
    assert ekf["trials"] == {"active": 72, "fused": 72, "passive": 6}
    assert (fastslam["excluded"], fastslam["failed"], fastslam["paper"]) == (1, 1, 15)
    *papers, third = exclusion_rows(with_third(study, "toy_slam:Slam"))
    assert papers == [ekf, fastslam]
    assert (third["filter"], third["excluded"], third["worlds"]) == ("toy_slam:Slam", 2, 6)
    assert (third["limit"], third["paper"]) == (None, None), "outside the catalogue"
    assert third["diverged"] == {"active": 24, "fused": 24, "passive": 1}


def test_table_ii_has_the_means_of_the_worlds_that_count():
    study = invent(6)
    study.trials["ekf", "passive"] = diverging(study.trials["ekf", "passive"], 2)
    rows = table_ii_rows(select(study, "world"))
    count = np.delete(study.trials["ekf", "fused"].scores["landmarks_full"][:, 11], 2)
    assert rows[0]["full"] == pytest.approx([count.mean(), count.std(ddof=1)])
    assert [row["n"] for row in rows] == [5] * 4 + [6] * 4
    assert rows[4]["full_mean"][0] == pytest.approx(rows[4]["full"][0] + 0.1)
    fused = only(study, [("ekf", "fused")])
    assert table_ii_rows(select(fused, "world"))[7]["full"] is None


def consistency_of(study):
    """The row of passive sensing with the EKF."""
    rows = consistency_rows(select(study, "world"))
    (row,) = [row for row in rows if (row["filter"], row["strategy"]) == ("ekf", "passive")]
    return row


def test_consistency_is_given_in_shares_of_time():
    study = invent(20)
    low, high = anees_bounds(20)
    nees = study.trials["ekf", "passive"].nees
    nees[:, :, :75] = 3.0
    nees[:, :, 75:300] = high + 1.0
    nees[:, :, 300:] = low - 1.0
    row = consistency_of(study)
    assert (row["inside"], row["above"]) == pytest.approx((75 / 375, 225 / 375))
    assert row["bounds"] == pytest.approx([low, high])
    assert row["expected"] == 3.0
    squares = [0.0, np.log((high + 1) / 3) ** 2, np.log((low - 1) / 3) ** 2]
    assert row["departure"] == pytest.approx(np.dot(squares, [75, 225, 75]) / 375)
    assert row["beamwidth"] is None


def test_consistency_is_relative_to_a_consistent_filter():
    study = invent(20)
    passive = study.trials["ekf", "passive"]
    passive.consistent[:] = np.array([2.0, 3.0])[:, None, None]
    passive.nees[:] = 2.0
    row = consistency_of(study)
    assert (row["inside"], row["departure"], row["expected"]) == (1.0, 0.0, 2.0)
    assert row["bounds"][0] < 2.0 < row["bounds"][1] < anees_bounds(20)[1]


def test_strategies_are_averages_over_beamwidths():
    rows = consistency_rows(select(invent(5), "world"))
    assert len(rows) == 50
    mine = [r["anees"] for r in rows if (r["filter"], r["strategy"]) == ("fastslam", "active")]
    found = {(r["filter"], r["strategy"]): r for r in by_strategy(rows)}
    assert found["fastslam", "active"]["anees"] == pytest.approx(np.mean(mine))
    assert len(found) == 6
