"""Effects: which cases are compared, in which worlds, as which family."""

import json
import re
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from pipistrelle.evaluation.comparison import Statement, judge
from pipistrelle.report.effects import (
    HEADLINE,
    answer,
    effects_of,
    gains_of,
    measured,
    measures_of,
    pairings_of,
    question,
    record,
)
from pipistrelle.report.study import READ, RULES, read_study, select, selections
from report.invented import changed, invent, narrowed, only, with_third
from report.planted import LEVELS, by_level, write_planted

BOTH = 'strategies = ["fused", "passive"]\nfilters = ["ekf"]\n'
TWO = LEVELS + '\n"rays.exponent" = [1.0, 3.0]'


def study_of(tmp_path, *args, **given):
    write_planted(tmp_path / "s", *args, **given)
    return read_study(tmp_path / "s")


def position(effects, **asked):
    """Effects on the position's error of the contrasts asked for."""
    found = [effect for effect in effects if effect.measure.title == "position RMSE"]
    return [e for e in found if all(getattr(e.pairing, k) == v for k, v in asked.items())]


def test_every_value_of_a_variable_is_compared_with_its_first_in_each_strategy(tmp_path):
    study = study_of(tmp_path, worlds=2, ways='filters = ["ekf", "fastslam"]\n')
    mine = [c for c in pairings_of(study) if c.factor == "beacon.level_db"]
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


def test_false_assumptions_are_compared_with_the_truth_on_either_side(tmp_path):
    study = study_of(tmp_path, SOUNDS, worlds=2)
    mine = [c for c in pairings_of(study) if c.factor == "assumed.speed_of_sound"]
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
def test_the_reference_is_the_truth_in_every_combination_or_else_the_least_value(
    tmp_path, grid, truth
):
    study = study_of(tmp_path, grid, worlds=2)
    last = study.variables[-1]
    assert last.words[last.base] == truth
    mine = [c for c in pairings_of(study) if c.factor == last.name]
    assert {c.before for c in mine} == {truth}
    ends = {c.after for c in mine if c.end}
    assert ends == {last.words[0], last.words[-1]} - {truth}


def test_strategies_and_filters_are_compared_with_the_first_of_them(tmp_path):
    study = study_of(tmp_path, worlds=2, ways='filters = ["fastslam", "ekf"]\n')
    ways = [c for c in pairings_of(study) if c.factor == "strategy"]
    assert [(c.filter, c.before, c.after) for c in ways] == [
        (name, "active", after) for name in ("ekf", "fastslam") for after in ("fused", "passive")
    ]
    filters = [c for c in pairings_of(study) if c.factor == "filter"]
    assert [(c.strategy, c.before, c.after) for c in filters] == [
        (strategy, "EKF", "FastSLAM 2.0") for strategy in ("active", "fused", "passive")
    ]
    assert {len(c.pairs) for c in (*ways, *filters)} == {3}, "one at each level"


def test_the_beam_does_nothing_to_passive_sensing_and_is_not_compared_in_it():
    study = invent(3)
    mine = [
        c
        for c in pairings_of(study)
        if c.factor == "beamwidth" and c.measures == measures_of(study)
    ]
    assert {c.strategy for c in mine} == {"active", "fused"}
    assert len(mine) == 2 * 2 * 11
    (far,) = [c for c in pairings_of(study) if (c.filter, c.after) == ("ekf", "passive")]
    assert len(far.pairs) == 12
    assert far.names[:2] == ("11°", "14°")


def test_other_variables_are_averaged_in_each_world_and_judged_at_each_combination(tmp_path):
    def effect(case):
        more = {1.0: 0.1, 3.0: 0.5}[case.values["rays.exponent"]]
        return {"position_rmse_m": more * (case.values["beacon.level_db"] > 40.0)}

    study = study_of(tmp_path, TWO, effect=effect, spread=0.01)
    (end,) = position(effects_of(select(study, "none")), factor="beacon.level_db", end=True)
    assert end.pairing.names == ("rays.exponent = 1", "rays.exponent = 3")
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
            table = study.trials["ekf", effect.pairing.strategy].scores["position_rmse_m"]
            samples.append(table[:, 2 if end else 1] - table[:, 0])
        expected = judge([Statement(label="", sample=sample) for sample in samples])
        assert [e.finding.p for e in mine] == [f.p for f in expected]
        assert [e.finding.interval for e in mine] == [f.interval for f in expected]
        assert len(mine) == 2


def test_equal_cases_are_marked_untouched_and_leave_their_family(tmp_path):
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
def test_worlds_count_by_the_rule_and_if_they_have_a_number(tmp_path, rule, left):
    def diverged(case, world):
        level = case.values["beacon.level_db"]
        return (level == 48.8 and world < 3) or (level == 42.8 and world == 7)

    study = study_of(tmp_path, diverged=diverged)
    (end,) = position(effects_of(select(study, rule)), factor="beacon.level_db", end=True)
    assert end.finding.n == left
    study.trials["ekf", "fused"].scores["position_rmse_m"][11, 2] = np.inf
    (end,) = position(effects_of(select(study, rule)), factor="beacon.level_db", end=True)
    assert end.finding.n == left - 1


def half_width(finding):
    low, high = finding.family
    return (high - low) / 2.0


def test_the_smallest_significant_effect_is_half_the_familys_interval(tmp_path):
    study = study_of(tmp_path, ways=BOTH, spread=0.2)
    first, second = position(effects_of(select(study, "none")), factor="beacon.level_db", end=True)
    tables = [study.trials["ekf", way].scores["position_rmse_m"] for way in ("fused", "passive")]
    one, other = (table[:, 2] - table[:, 0] for table in tables)
    assert first.finding.holds is second.finding.holds is None
    for more, shown in ((1.01, True), (0.99, None)):
        larger = one - one.mean() + more * half_width(first.finding)
        statements = [Statement(label="", sample=sample) for sample in (larger, other)]
        assert judge(statements)[0].holds is shown


def test_a_single_world_decides_nothing_and_none_still_less(tmp_path):
    study = study_of(tmp_path, worlds=1, effect=by_level(1.0))
    for effect in effects_of(select(study, "none")):
        assert effect.finding.holds is None
        assert effect.untouched or half_width(effect.finding) == np.inf
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
        2, ["rays.exponent = 1", "rays.exponent = 3"],
    )  # fmt: skip
    assert found["shown"]
    assert found["alone"][0] < found["mean"] < found["alone"][1]
    assert 40.0 < found["mean"] < 80.0


def test_a_study_without_anything_to_compare_has_no_effects():
    assert effects_of(select(only(invent(3), [("ekf", "passive")]), "none")) == ()


@pytest.mark.slow
def test_over_many_studies_without_an_effect_a_family_is_wrong_in_five_percent():
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


def test_the_effect_on_a_gain_is_that_on_active_less_the_other_in_each_world(tmp_path):
    study = study_of(tmp_path, TWO, ways=THREE, effect=gains_by_level)
    found = {
        effect.pairing.strategy: effect
        for effect in effects_of(select(study, "none"))
        if effect.measure == gains_of(study)[0]
        and (effect.pairing.factor, effect.pairing.end) == ("beacon.level_db", True)
    }
    samples = []
    for way in ("fused", "passive"):
        active, other = (
            study.trials["ekf", one].scores["position_rmse_m"] for one in ("active", way)
        )
        gain = active - other
        samples.append(0.5 * (gain[:, 4] - gain[:, 0] + gain[:, 5] - gain[:, 1]))
    for effect, sample in zip(found.values(), samples, strict=True):
        assert effect.finding.mean == pytest.approx(sample.mean())
    assert [*found] == ["fused", "passive"]
    assert found["fused"].finding.mean == pytest.approx(-0.2, abs=0.03)
    expected = judge([Statement(label="", sample=sample) for sample in samples])
    assert [e.finding.p for e in found.values()] == pytest.approx([f.p for f in expected])
    assert [f.mean for f in found["fused"].apart] == pytest.approx([-0.2, -0.2], abs=0.05)


def test_a_gain_counts_worlds_where_active_sensing_counts(tmp_path):
    def diverged(case, world):
        return case.strategy == "active" and world < 3

    ways = 'filters = ["ekf"]\nstrategies = ["active", "fused"]\n'
    study = study_of(tmp_path, ways=ways, diverged=diverged)
    for rule, left in (("case", 9), ("none", 12)):
        mine = [e for e in effects_of(select(study, rule)) if e.measure == gains_of(study)[0]]
        assert {effect.finding.n for effect in mine} == {left}


def test_the_effect_of_the_beam_on_the_gain_of_passive_is_that_on_active():
    study = only(invent(6), [("ekf", "active"), ("ekf", "passive")])
    effects = effects_of(select(study, "none"))
    mine = [e for e in effects if e.pairing.factor == "beamwidth" and e.pairing.end]
    (error,) = (e for e in mine if e.measure.title == "position RMSE")
    (gain,) = (e for e in mine if e.measure == gains_of(study)[0])
    assert (error.pairing.strategy, gain.pairing.strategy) == ("active", "passive")
    assert gain.finding.mean == pytest.approx(error.finding.mean)


def test_a_gain_at_one_level_is_over_active_at_every_beam(tmp_path):
    """Passive sensing has one case for all beams; what it gains over active has one for each."""
    grid = '"emitter.radius" = [0.0025, 0.0088]\n"beacon.level_db" = [36.8, 48.8]'
    study = study_of(tmp_path, grid, worlds=2, ways=THREE)
    mine = [c for c in pairings_of(study) if (c.factor, c.strategy) == (
        "beacon.level_db", "passive",
    )]  # fmt: skip
    assert {c.measures: len(c.pairs) for c in mine} == {measures_of(study): 1, gains_of(study): 2}


def test_a_world_counts_only_where_every_averaged_pair_has_a_number(tmp_path):
    study = study_of(tmp_path, TWO)
    study.trials["ekf", "fused"].scores["position_rmse_m"][3, 5] = np.nan
    (end,) = position(effects_of(select(study, "none")), factor="beacon.level_db", end=True)
    assert len(end.pairing.pairs) == 2
    assert end.finding.n == 11
    assert [finding.n for finding in end.apart] == [12, 11]


def test_the_record_holds_errors_and_gains_under_different_names(tmp_path):
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


BEFORE, AFTER = ("ekf", "fused", 0), ("ekf", "fused", 5)


@pytest.fixture
def study():
    return invent(6)


def change(study, measure, before, after):
    first, second = measured(select(study, "none"), measure, before, after)
    return second - first


def measure_of(study, score):
    (found,) = [measure for measure in measures_of(study) if measure.score == score]
    return found


def test_every_measure_is_a_score_that_is_read_and_has_numbers(study):
    study = changed(study, ("ekf", "active"), "caller_rmse_m", lambda e: 0.0 * np.nan_to_num(e))
    found = [measure.score for measure in measures_of(study)]
    assert set(found) <= set(READ)
    assert found[0] == "position_rmse_m"
    silent = replace(study, trials={("ekf", "fused"): study.trials["ekf", "fused"]})
    assert set(found) - {m.score for m in measures_of(silent)} == {"caller_rmse_m"}


def test_a_change_is_after_minus_before_in_the_same_world(study):
    for name in ("position_rmse_m", "position_rmse_aligned_m", "heading_rmse_rad"):
        score = study.trials["ekf", "fused"].scores[name]
        expected = score[:, 5] - score[:, 0]
        np.testing.assert_array_equal(
            change(study, measure_of(study, name), BEFORE, AFTER), expected
        )


def test_nees_changes_by_a_ratio(study):
    twice = changed(
        study, ("ekf", "fused"), "nees_mean", lambda n: np.where([[1] * 5 + [0] * 7], n, 2 * n)
    )
    nees = study.trials["ekf", "fused"].scores["nees_mean"]
    found = np.exp(change(twice, measure_of(study, "nees_mean"), BEFORE, AFTER))
    assert found == pytest.approx(2.0 * nees[:, 5] / nees[:, 0])


def with_maps(study, placed, off):
    """The same study with the maps of fused EKF, landmarks in the last dimension."""
    trials = study.trials["ekf", "fused"]
    shape = (6, 12, len(placed[0]))
    full, error = np.zeros(shape, bool), np.zeros(shape)
    full[:, [0, 5]], error[:, [0, 5]] = placed, off
    return replace(
        study, trials=study.trials | {("ekf", "fused"): replace(trials, placed=full, off=error)}
    )


@pytest.mark.parametrize(
    ("placed", "off", "expected"),
    [
        (
            [[1, 1, 0], [1, 1, 1]], [[3.0, 4.0, 90.0], [3.0, 8.0, 70.0]],
            np.sqrt((9 + 64) / 2) - np.sqrt((9 + 16) / 2),
        ),
        ([[1, 1], [1, 1]], [[1.0, 1.0], [2.0, 2.0]], 1.0),
        ([[1, 0], [0, 1]], [[1.0, 1.0], [1.0, 1.0]], np.nan),
    ],
)  # fmt: skip
def test_maps_are_compared_over_the_landmarks_that_both_have_placed(study, placed, off, expected):
    made, measure = with_maps(study, placed, off), measure_of(study, "map_rmse_m")
    found = change(made, measure, BEFORE, AFTER)
    assert found == pytest.approx(np.full(6, expected), nan_ok=True)
    own = made.trials["ekf", "fused"].scores["map_rmse_m"]
    elsewhere = change(replace(made, drawing=np.arange(12)), measure, BEFORE, AFTER)
    np.testing.assert_array_equal(elsewhere, own[:, 5] - own[:, 0])


def test_passive_sensing_is_compared_with_any_beam_by_its_single_case(study):
    passive = study.trials["ekf", "passive"].scores["position_rmse_m"][:, 0]
    fused = study.trials["ekf", "fused"].scores["position_rmse_m"][:, 7]
    found = change(study, measures_of(study)[0], ("ekf", "fused", 7), ("ekf", "passive", 7))
    np.testing.assert_array_equal(found, passive - fused)


def test_a_gain_in_the_map_is_over_the_landmarks_that_all_four_cases_have_placed(study):
    four = with_maps(study, [[1, 1, 1, 0], [1, 1, 0, 1]], [[3.0, 4.0, 9.0, 9.0], [3.0, 8.0, 9, 9]])
    alone = four.trials["ekf", "active"]
    shape = (6, 12, 4)
    placed, off = np.ones(shape, bool), np.full(shape, 5.0)
    placed[:, 5, 0] = False  # leaves the second landmark alone to all four
    four = replace(
        four, trials=four.trials | {("ekf", "active"): replace(alone, placed=placed, off=off)}
    )
    (gain,) = (one for one in gains_of(study) if one.score == "map_rmse_m")
    found = change(four, gain, BEFORE, AFTER)
    assert found == pytest.approx(np.full(6, (5.0 - 8.0) - (5.0 - 4.0)))


INTERVAL = r"\[−?[\d.]+, −?[\d.]+\]"


def without_variables(study):
    """The same study at one beamwidth."""
    return replace(narrowed(study, [5]), variables=())


def answer_of(study):
    selection = select(study, HEADLINE)
    return [s for s in answer(selection, effects_of(selection)) if "aligned" not in s]


@pytest.fixture
def planted(tmp_path):
    """The answer of a study whose effect is planted."""

    def planted(*args, **given):
        write_planted(tmp_path / "s", *args, **given)
        return answer_of(read_study(tmp_path / "s"))

    return planted


@pytest.mark.parametrize(("metres", "verb"), [(0.34, "raises"), (-0.34, "lowers")])
def test_a_planted_effect_is_answered_with_its_size_and_interval(planted, metres, verb):
    (sentence,) = planted(effect=by_level(metres))
    match = re.fullmatch(
        rf"The beacon level from 36\.8 to 48\.8 {verb} the position RMSE by "
        r"([\d.]+) m \[([\d.]+), ([\d.]+)\]\.", sentence,
    )  # fmt: skip
    mean, low, high = map(float, match.groups())
    assert 0.0 < low < 0.34 < high
    assert mean == pytest.approx(0.34, abs=0.03)
    assert high - low < 0.1


def test_no_effect_is_answered_with_the_change_and_its_interval(planted):
    (sentence,) = planted()
    match = re.fullmatch(
        r"The beacon level from 36\.8 to 48\.8: no effect on the position RMSE was shown; "
        r"the change is (−?[\d.]+) m \[(−?[\d.]+), (−?[\d.]+)\]\.", sentence,
    )  # fmt: skip
    mean, low, high = (float(text.replace("−", "-")) for text in match.groups())
    assert low < 0.0 < high
    assert low < mean < high
    assert (high - low) / 2.0 == pytest.approx(0.02 * np.sqrt(2.0 / 12.0) * 2.2, rel=0.5)


def test_the_answer_averages_over_strategies_and_names_them_if_they_disagree(tmp_path):
    def effect(case):
        return by_level({"fused": 0.3, "passive": -0.4, "active": 0.0}[case.strategy])(case)

    ways = 'strategies = ["active", "fused", "passive"]\nfilters = ["ekf"]\n'
    study = study_of(tmp_path, ways=ways, effect=effect)
    (sentence,) = answer_of(study)
    assert sentence.endswith(
        ", averaged over 3 cases. It is shown to rise with fused EKF and fall with passive EKF."
    )
    tables = [trials.scores["position_rmse_m"] for trials in study.trials.values()]
    sample = np.mean([table[:, 2] - table[:, 0] for table in tables], axis=0)
    (finding,) = judge([Statement(label="", sample=sample)])
    assert f"{-finding.mean:.3f}".rstrip("0") in sentence


def test_a_change_that_is_equal_in_every_world_has_no_interval(tmp_path):
    study = study_of(tmp_path)
    position = study.trials["ekf", "fused"].scores["position_rmse_m"]
    for rises, words in (
        ([0.0, 0.125, 0.25], "changes the position RMSE by 0.25 m in every world."),
        ([0.0, 0.0, 0.0], "leaves the position RMSE the same to the last digit."),
    ):
        position[:] = 0.5 * np.arange(12)[:, None] + np.array(rises)
        assert answer_of(study) == [f"The beacon level from 36.8 to 48.8 {words}"]


def off_by(metres):
    """Plant a rise with the distance from the true speed of sound."""

    def effect(case):
        far = abs(case.values["assumed.speed_of_sound"] - 343.0) / 6.0
        return {"position_rmse_m": metres * far}

    return effect


def by_value(setting, **errors):
    """Plant an error for each value of a setting, by its text."""
    return lambda case: {"position_rmse_m": errors[str(case.values[setting])]}


NEAR = {"[0.5, 20.0]": 0.0, "[1.0, 20.0]": 0.4, "[2.0, 20.0]": -0.6, "[3.0, 20.0]": 0.4}


@pytest.mark.parametrize(
    ("grid", "effect", "pattern"),
    [
        (
            LEVELS, by_value("beacon.level_db", **{"36.8": 0.0, "42.8": -0.4, "48.8": 0.0}),
            rf"The beacon level from 36\.8 to 42\.8 lowers the .* by 0\.\d+ m {INTERVAL}\.",
        ),
        (
            '"rays.weights" = ["instantaneous", "aggregated"]',
            by_value("rays.weights", instantaneous=0.0, aggregated=0.4),
            r"Aggregated instead of instantaneous as the rays weights raises the position .*",
        ),
        (
            f'"rays.range_bounds" = [{", ".join(NEAR)}]', by_value("rays.range_bounds", **NEAR),
            r"\[2, 20\] instead of \[0\.5, 20\] as the rays range bounds lowers .*",
        ),
        (
            SOUNDS, off_by(0.3),
            r"The assumed speed of sound from 343 to 3(37|49) raises the position RMSE by "
            rf"0\.[23]\d* m {INTERVAL}\.",
        ),
        (
            '"assumed.speed_of_sound" = [337.0, 343.0]', off_by(0.3),
            r"The assumed speed of sound from 343 to 337 raises .*",
        ),
    ],
    ids=["between the ends", "words", "the largest of several", "either side", "one side"],
)  # fmt: skip
def test_the_answer_is_the_largest_change_shown_from_the_reference(planted, grid, effect, pattern):
    (sentence,) = planted(grid, effect=effect)
    assert re.fullmatch(pattern, sentence)


def test_values_of_a_variable_are_one_family_in_the_answer(tmp_path):
    study = study_of(tmp_path, SOUNDS, effect=off_by(0.3))
    table = study.trials["ekf", "fused"].scores["position_rmse_m"]
    samples = [table[:, i] - table[:, 2] for i in (0, 4)]
    findings = judge([Statement(label="", sample=sample) for sample in samples])
    (sentence,) = answer_of(study)
    largest = max(findings, key=lambda finding: finding.mean)
    assert f"{largest.mean:.3f}".rstrip("0") in sentence
    assert f"[{largest.family[0]:.3f}"[:6] in sentence


def test_the_beamwidth_has_an_article_and_passive_sensing_does_not_count():
    study = narrowed(only(invent(20), [("ekf", "fused"), ("ekf", "passive")]), [0, 5, 11])
    assert question(study) == "What does the beamwidth change?"
    (sentence,) = answer_of(study)
    assert re.match(
        rf"The beamwidth from 11° to 180° lowers the position RMSE by 0\.\d+ m {INTERVAL}\.",
        sentence,
    )


def test_a_study_of_passive_sensing_is_answered_that_the_beam_has_no_effect():
    study = narrowed(only(invent(5), [("ekf", "passive")]), [0, 11])
    assert answer_of(study) == ["No measurement depends on the beamwidth."]


def test_the_question_names_the_variables_or_strategies_or_filters():
    study = invent(2)
    cases = {
        "How do active, fused and passive sensing compare?": list(study.trials),
        "How do EKF and FastSLAM 2.0 compare?": [("ekf", "fused"), ("fastslam", "fused")],
        "How well does EKF locate the vehicle by fused sensing?": [("ekf", "fused")],
    }
    for words, ways in cases.items():
        assert question(without_variables(only(study, ways))) == words


def test_without_a_grid_strategies_or_else_filters_are_compared():
    ways = [("ekf", way) for way in ("active", "fused", "passive")]
    study = changed(invent(20), ("ekf", "passive"), "position_rmse_m", lambda e: e + 0.4)
    study = changed(study, ("ekf", "fused"), "position_rmse_m", lambda e: e - 0.4)
    fused, passive = answer_of(without_variables(only(study, ways)))
    assert fused.startswith("Fused instead of active sensing lowers the position RMSE by 0.")
    assert passive.startswith("Passive instead of active sensing raises the position RMSE by 0.")
    study = without_variables(only(invent(20), [("ekf", "fused"), ("fastslam", "fused")]))
    (sentence,) = answer_of(study)
    assert sentence.startswith("FastSLAM 2.0 instead of EKF raises the position RMSE by 0.")


def test_of_one_strategy_and_one_filter_the_answer_is_the_error():
    for worlds, end in ((20, rf"{INTERVAL} by fused sensing\."), (1, "in the one world by .*")):
        (sentence,) = answer_of(without_variables(only(invent(worlds), [("ekf", "fused")])))
        assert re.fullmatch(rf"EKF's position RMSE is 0\.\d+ m {end}", sentence)


@pytest.mark.parametrize("worlds", [1, 3])
def test_an_answer_is_undecided_without_worlds(tmp_path, worlds):
    write_planted(tmp_path / "s", worlds=worlds, effect=by_level(0.3))
    study = read_study(tmp_path / "s")
    if worlds == 3:
        study.trials["ekf", "fused"].failed[:] = True
    left = "a single world is left" if worlds == 1 else "no world is left"
    assert answer_of(study) == [f"The beacon level from 36.8 to 48.8: not decided, {left}."]


def test_each_variable_has_a_sentence_averaged_over_all_cases(planted):
    def effect(case):
        return by_level({"active": -0.5, "fused": -0.1}[case.strategy])(case)

    ways = 'strategies = ["active", "fused"]\nfilters = ["ekf"]\n'
    level, power = planted(LEVELS + '\n"rays.exponent" = [1.0, 3.0]', ways=ways, effect=effect)
    assert re.match(r"The beacon level from 36\.8 to 48\.8 lowers the .* averaged over 4", level)
    assert re.match(r"The rays exponent from 1 to 3: no effect .* shown; .* averaged over 6", power)


def test_a_filter_from_outside_counts_in_the_average():
    study = with_third(narrowed(invent(20), [0, 11]), "toy_slam.filters:Smoother")
    (sentence,) = answer_of(study)
    assert "averaged over 6 cases." in sentence
