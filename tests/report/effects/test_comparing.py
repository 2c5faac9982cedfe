"""Effects: which cases are compared, in which worlds, as which family."""

import json
from collections import Counter

import numpy as np
import pytest

from pipistrelle.evaluation.comparison import Statement, judge
from pipistrelle.report.claims.contrasts import select, selections
from pipistrelle.report.effects.comparing import contrasts_of, effects_of, record, resolvable
from pipistrelle.report.effects.measures import gains_of, is_first, measures_of
from pipistrelle.report.reading import read_study
from pipistrelle.report.studied import RULES
from report.invented import changed, invent, only
from report.planted import LEVELS, by_level, write_planted

BOTH = 'strategies = ["fused", "passive"]\nfilters = ["ekf"]\n'
TWO = LEVELS + '\n"rays.power" = [1.0, 3.0]'


def study_of(tmp_path, *args, **given):
    write_planted(tmp_path / "s", *args, **given)
    return read_study(tmp_path / "s")


def position(effects, **asked):
    """Effects on the position's error of the contrasts asked for."""
    found = [effect for effect in effects if is_first(effect.measure)]
    return [e for e in found if all(getattr(e.contrast, k) == v for k, v in asked.items())]


def test_every_value_of_a_variable_is_compared_with_its_first_in_each_strategy(tmp_path):
    study = study_of(tmp_path, worlds=2, ways='filters = ["ekf", "fastslam"]\n')
    mine = [c for c in contrasts_of(study) if c.factor == "beacon.level_db"]
    gains = [c for c in mine if c.measures == gains_of(study)]
    assert Counter((c.filter, c.strategy) for c in gains) == {
        (name, strategy): 2 for name in ("ekf", "fastslam") for strategy in ("fused", "passive")
    }
    mine = [c for c in mine if c.measures == measures_of(study)]
    assert Counter((c.filter, c.strategy, c.before, c.after, c.end) for c in mine) == {
        (name, strategy, "36.8", after, after == "48.8"): 1
        for name in ("ekf", "fastslam")
        for strategy in ("active", "fused", "passive")
        for after in ("42.8", "48.8")
    }
    assert all(len(c.pairs) == 1 for c in mine)


SOUNDS = '"assumed.speed_of_sound" = [349.0, 346.0, 343.0, 340.0, 337.0]'


def test_what_is_assumed_wrongly_is_compared_with_the_truth_on_either_side(tmp_path):
    study = study_of(tmp_path, SOUNDS, worlds=2)
    mine = [c for c in contrasts_of(study) if c.factor == "assumed.speed_of_sound"]
    assert [(c.before, c.after, c.end) for c in mine] == [
        ("343", "337", True), ("343", "340", False), ("343", "346", False), ("343", "349", True),
    ]  # fmt: skip
    assert [c.pairs for c in mine] == [
        ((("ekf", "fused", 2), ("ekf", "fused", other)),) for other in (0, 1, 3, 4)
    ]


@pytest.mark.parametrize(
    ("grid", "truth"),
    [
        ('"assumed.wheelbase" = [0.18, 0.2, 0.22]', "0.2"),
        ('"assumed.steering_std" = [0.015, 0.03]', "0.03"),
        ('"motion.turn_bias" = [-0.003, 0.0, 0.003]', "0"),
        ('"air.temperature_c" = [10.0]\n"assumed.speed_of_sound" = [331.0, 337.1, 343.0]', "337.1"),
        ('"assumed.wheelbase" = [0.18, 0.19, 0.22]', "0.18"),
        ('"air.temperature_c" = [10, 20]\n"assumed.speed_of_sound" = [331.0, 337.1, 343.0]', "331"),
        ('"motion.wheelbase" = [0.18, 0.2, 0.22]', "0.18"),
        ('"filter.bearing_std" = [0.1, 0.15, 0.2]', "0.1"),
    ],
)
def test_the_truth_is_what_holds_in_every_combination_and_where_there_is_none_the_least(
    tmp_path, grid, truth
):
    study = study_of(tmp_path, grid, worlds=2)
    last = study.variables[-1]
    assert last.words[last.base] == truth
    mine = [c for c in contrasts_of(study) if c.factor == last.name]
    assert {c.before for c in mine} == {truth}
    ends = {c.after for c in mine if c.end}
    assert ends == {last.words[0], last.words[-1]} - {truth}


def test_strategies_and_filters_are_compared_with_the_first_of_them(tmp_path):
    study = study_of(tmp_path, worlds=2, ways='filters = ["fastslam", "ekf"]\n')
    ways = [c for c in contrasts_of(study) if c.factor == "strategy"]
    assert [(c.filter, c.before, c.after) for c in ways] == [
        (name, "active", after) for name in ("ekf", "fastslam") for after in ("fused", "passive")
    ]
    filters = [c for c in contrasts_of(study) if c.factor == "filter"]
    assert [(c.strategy, c.before, c.after) for c in filters] == [
        (strategy, "EKF", "FastSLAM 2.0") for strategy in ("active", "fused", "passive")
    ]
    assert {len(c.pairs) for c in (*ways, *filters)} == {3}, "one at each level"


def test_the_beam_does_nothing_to_passive_sensing_and_is_not_compared_in_it():
    study = invent(3)
    mine = [
        c
        for c in contrasts_of(study)
        if c.factor == "beamwidth" and c.measures == measures_of(study)
    ]
    assert {c.strategy for c in mine} == {"active", "fused"}
    assert len(mine) == 2 * 2 * 11
    (far,) = [c for c in contrasts_of(study) if (c.filter, c.after) == ("ekf", "passive")]
    assert len(far.pairs) == 12
    assert far.names[:2] == ("11°", "14°")


def test_what_else_varies_is_averaged_over_world_by_world_and_looked_at_apart(tmp_path):
    def effect(case):
        more = {1.0: 0.1, 3.0: 0.5}[case.values["rays.power"]]
        return {"position_rmse_m": more * (case.values["beacon.level_db"] > 40.0)}

    study = study_of(tmp_path, TWO, effect=effect, spread=0.01)
    (end,) = position(effects_of(select(study, "none")), factor="beacon.level_db", end=True)
    assert end.contrast.names == ("rays.power = 1", "rays.power = 3")
    assert [f.mean for f in end.apart] == pytest.approx([0.1, 0.5], abs=0.01)
    table = study.trials["ekf", "fused"].scores["position_rmse_m"]
    by_hand = 0.5 * (table[:, 4] - table[:, 0] + table[:, 5] - table[:, 1])
    assert end.finding.mean == pytest.approx(by_hand.mean())
    assert end.finding.std == pytest.approx(by_hand.std(ddof=1))
    assert end.finding.n == 12


def test_a_family_is_judged_as_the_projects_comparisons_are(tmp_path):
    study = study_of(tmp_path, ways=BOTH, effect=by_level(0.03), spread=0.05)
    effects = effects_of(select(study, "none"))
    for end in (True, False):
        mine = position(effects, factor="beacon.level_db", end=end)
        samples = []
        for effect in mine:
            table = study.trials["ekf", effect.contrast.strategy].scores["position_rmse_m"]
            samples.append(table[:, 2 if end else 1] - table[:, 0])
        expected = judge([Statement(label="", sample=sample) for sample in samples])
        assert [e.finding.p for e in mine] == [f.p for f in expected]
        assert [e.finding.interval for e in mine] == [f.interval for f in expected]
        assert len(mine) == 2


def test_what_nothing_touches_is_known_as_such_and_makes_nothing_harder_to_show(tmp_path):
    study = study_of(tmp_path, ways=BOTH, effect=by_level(0.03), spread=0.05)
    passive = study.trials["ekf", "passive"].scores["position_rmse_m"]
    passive[:, 1:] = passive[:, :1]
    fused, idle = position(effects_of(select(study, "none")), factor="beacon.level_db", end=True)
    assert (fused.untouched, idle.untouched) == (False, True)
    assert (idle.finding.mean, idle.finding.holds) == (0.0, None)
    table = study.trials["ekf", "fused"].scores["position_rmse_m"]
    (alone,) = judge([Statement(label="", sample=table[:, 2] - table[:, 0])])
    assert fused.finding.p == alone.p


@pytest.mark.parametrize(("rule", "left"), [("world", 8), ("case", 9), ("none", 12)])
def test_the_worlds_are_those_that_the_rule_counts_and_have_a_number(tmp_path, rule, left):
    def diverged(case, world):
        level = case.values["beacon.level_db"]
        return (level == 48.8 and world < 3) or (level == 42.8 and world == 7)

    study = study_of(tmp_path, diverged=diverged)
    (end,) = position(effects_of(select(study, rule)), factor="beacon.level_db", end=True)
    assert end.finding.n == left
    study.trials["ekf", "fused"].scores["position_rmse_m"][11, 2] = np.inf
    (end,) = position(effects_of(select(study, rule)), factor="beacon.level_db", end=True)
    assert end.finding.n == left - 1


def test_what_would_have_been_significant_is_half_the_familys_interval(tmp_path):
    study = study_of(tmp_path, ways=BOTH, spread=0.2)
    first, second = position(effects_of(select(study, "none")), factor="beacon.level_db", end=True)
    tables = [study.trials["ekf", way].scores["position_rmse_m"] for way in ("fused", "passive")]
    one, other = (table[:, 2] - table[:, 0] for table in tables)
    assert first.finding.holds is second.finding.holds is None
    for more, shown in ((1.01, True), (0.99, None)):
        larger = one - one.mean() + more * resolvable(first.finding)
        statements = [Statement(label="", sample=sample) for sample in (larger, other)]
        assert judge(statements)[0].holds is shown


def test_a_single_world_decides_nothing_and_none_still_less(tmp_path):
    study = study_of(tmp_path, worlds=1, effect=by_level(1.0))
    for effect in effects_of(select(study, "none")):
        assert effect.finding.holds is None
        assert effect.untouched or resolvable(effect.finding) == np.inf
    study.trials["ekf", "fused"].failed[:] = True
    assert {effect.finding.n for effect in effects_of(select(study, "none"))} == {0}


def test_the_record_is_plain_json_with_ratios_as_ratios(tmp_path):
    study = study_of(tmp_path, TWO, ways=BOTH, effect=lambda case: (
        {"nees_mean": 100.0} if case.values["beacon.level_db"] > 48.0 else {}
    ))  # fmt: skip
    by_rule = {rule: effects_of(one) for rule, one in selections(study).items()}
    rows = record(by_rule, "none")
    json.dumps(rows, allow_nan=False)
    assert len(rows) == len(by_rule["none"])
    (nees,) = [
        row for row in rows
        if (row["measure"], row["to"], row["strategy"]) == ("nees_mean", "48.8", "fused")
    ]  # fmt: skip
    found = nees["by_exclusion"]["none"]
    assert set(nees["by_exclusion"]) == set(RULES)
    assert (nees["unit"], nees["variable"], nees["from"]) == ("ratio", "beacon.level_db", "36.8")
    assert (nees["averaged_over"], [one["at"] for one in nees["apart"]]) == (
        2, ["rays.power = 1", "rays.power = 3"],
    )  # fmt: skip
    assert found["shown"]
    assert found["alone"][0] < found["mean"] < found["alone"][1]
    assert 40.0 < found["mean"] < 80.0


def test_a_study_without_anything_to_compare_has_no_effects():
    assert effects_of(select(only(invent(3), [("ekf", "passive")]), "none")) == ()


@pytest.mark.slow
def test_over_many_studies_without_an_effect_a_family_is_wrong_as_seldom_as_it_says():
    """Five in a hundred at most, whatever the number of strategies, within three errors."""
    wrong, runs = 0, 150
    study = only(invent(12), [("ekf", "active"), ("ekf", "fused")])
    for seed in range(runs):
        rng = np.random.default_rng(seed)
        for way in study.trials:
            drawn = rng.normal(1.0, 0.2, study.trials[way].scores["position_rmse_m"].shape)
            study = changed(study, way, "position_rmse_m", lambda _, now=drawn: now)
        effects = effects_of(select(study, "none"))
        mine = position(effects, factor="beamwidth", end=False)
        wrong += any(effect.finding.holds is not None for effect in mine)
    assert wrong / runs <= 0.05 + 3.0 * np.sqrt(0.05 * 0.95 / runs)
    assert len(mine) == 20


def gains_by_level(case):
    """Active's error falls by 0.3 m over the levels and fused's by 0.1 m: the gain by 0.2 m."""
    falls = {"active": -0.3, "fused": -0.1, "passive": 0.0}[case.strategy]
    return by_level(falls)(case)


THREE = 'filters = ["ekf"]\n'


def test_what_a_variable_does_to_the_gain_of_listening_is_active_less_the_other_in_each_world(
    tmp_path,
):
    study = study_of(tmp_path, TWO, ways=THREE, effect=gains_by_level)
    found = {
        effect.contrast.strategy: effect
        for effect in effects_of(select(study, "none"))
        if effect.measure == gains_of(study)[0]
        and (effect.contrast.factor, effect.contrast.end) == ("beacon.level_db", True)
    }
    table = {way: study.trials["ekf", way].scores["position_rmse_m"] for way in (
        "active", "fused", "passive",
    )}  # fmt: skip
    samples = []
    for way in ("fused", "passive"):
        gain = table["active"] - table[way]
        samples.append(0.5 * (gain[:, 4] - gain[:, 0] + gain[:, 5] - gain[:, 1]))
    for effect, sample in zip(found.values(), samples, strict=True):
        assert effect.finding.mean == pytest.approx(sample.mean())
    assert [*found] == ["fused", "passive"]
    assert found["fused"].finding.mean == pytest.approx(-0.2, abs=0.03)
    expected = judge([Statement(label="", sample=sample) for sample in samples])
    assert [e.finding.p for e in found.values()] == pytest.approx([f.p for f in expected])
    assert [f.mean for f in found["fused"].apart] == pytest.approx([-0.2, -0.2], abs=0.05)


def test_a_gain_is_of_the_worlds_in_which_what_it_is_over_counts(tmp_path):
    def diverged(case, world):
        return case.strategy == "active" and world < 3

    ways = 'filters = ["ekf"]\nstrategies = ["active", "fused"]\n'
    study = study_of(tmp_path, ways=ways, diverged=diverged)
    for rule, left in (("case", 9), ("none", 12)):
        mine = [e for e in effects_of(select(study, rule)) if e.measure == gains_of(study)[0]]
        assert {effect.finding.n for effect in mine} == {left}


def test_what_the_beam_does_to_the_gain_of_passive_sensing_is_what_it_does_to_active():
    study = only(invent(6), [("ekf", "active"), ("ekf", "passive")])
    effects = effects_of(select(study, "none"))
    mine = [e for e in effects if e.contrast.factor == "beamwidth" and e.contrast.end]
    (error,) = (e for e in mine if is_first(e.measure))
    (gain,) = (e for e in mine if e.measure == gains_of(study)[0])
    assert (error.contrast.strategy, gain.contrast.strategy) == ("active", "passive")
    assert gain.finding.mean == pytest.approx(error.finding.mean)


def test_a_gain_at_one_level_is_over_active_at_every_beam(tmp_path):
    """Passive sensing has one case for all beams; what it gains over active has one for each."""
    grid = '"emitter.radius" = [0.0025, 0.0088]\n"beacon.level_db" = [36.8, 48.8]'
    study = study_of(tmp_path, grid, worlds=2, ways=THREE)
    mine = [c for c in contrasts_of(study) if (c.factor, c.strategy) == (
        "beacon.level_db", "passive",
    )]  # fmt: skip
    assert {c.measures: len(c.pairs) for c in mine} == {measures_of(study): 1, gains_of(study): 2}


def test_a_world_counts_only_where_every_averaged_pair_has_a_number(tmp_path):
    study = study_of(tmp_path, TWO)
    study.trials["ekf", "fused"].scores["position_rmse_m"][3, 5] = np.nan
    (end,) = position(effects_of(select(study, "none")), factor="beacon.level_db", end=True)
    assert len(end.contrast.pairs) == 2
    assert end.finding.n == 11
    assert [finding.n for finding in end.apart] == [12, 11]


def test_gains_stand_in_the_record_beside_errors_under_names_of_their_own(tmp_path):
    study = study_of(tmp_path, worlds=3, ways=THREE)
    by_rule = {rule: effects_of(one) for rule, one in selections(study).items()}
    rows = [row for row in record(by_rule, "none") if row["variable"] == "beacon.level_db"]
    gains = [row for row in rows if row["measure"].startswith("gain_")]
    assert {row["measure"] for row in gains} == {
        "gain_position_rmse_m", "gain_position_rmse_aligned_m", "gain_heading_rmse_rad",
        "gain_map_rmse_m",
    }  # fmt: skip
    assert {row["strategy"] for row in gains} == {"fused", "passive"}
    assert len(rows) - len(gains) == 3 * 2 * len(measures_of(study))
