"""The answer to a study's own question, in words that follow its numbers."""

import re
from dataclasses import replace

import numpy as np
import pytest

from pipistrelle.evaluation.bound import IN_ONE_WORLD
from pipistrelle.report.claims.contrasts import selections
from pipistrelle.report.effects.answer import HEADLINE, answer, question
from pipistrelle.report.effects.comparing import effects_of
from pipistrelle.report.reading import read_study
from report.invented import changed, invent, narrowed, only, with_third
from report.planted import by_level, write_planted

BOTH = 'strategies = ["fused", "passive"]\nfilters = ["ekf"]\n'
TWO = '"beacon.level_db" = [36.8, 48.8]\n"rays.power" = [1.0, 3.0]'
INTERVAL = r"\[−?[\d.]+, −?[\d.]+\]"


def without_variables(study):
    """The same study at one beamwidth."""
    return replace(narrowed(study, [5]), variables=())


def told(study):
    by_rule = selections(study)
    effects = {rule: effects_of(selection) for rule, selection in by_rule.items()}
    return answer(by_rule[HEADLINE], effects)


@pytest.fixture
def planted(tmp_path):
    """The answer of a study whose effect is planted."""

    def planted(*args, **given):
        write_planted(tmp_path / "s", *args, **given)
        return told(read_study(tmp_path / "s"))

    return planted


def test_a_planted_rise_is_found_with_its_size_and_its_interval(planted):
    headline, sentence, *_ = planted(effect=by_level(0.34))
    assert headline == "A higher beacon.level_db raises the position error."
    found = re.match(
        r"beacon\.level_db from 36\.8 to 48\.8 raises fused EKF's position error by "
        r"([\d.]+) m \[([\d.]+), ([\d.]+)\]\.", sentence,
    )  # fmt: skip
    mean, low, high = map(float, found.groups())
    assert low < 0.34 < high
    assert mean == pytest.approx(0.34, abs=0.03)
    assert high - low < 0.1


def test_a_planted_fall_is_worded_as_a_fall_by_a_positive_size(planted):
    headline, sentence, *_ = planted(effect=by_level(-0.34))
    assert headline == "A higher beacon.level_db lowers the position error."
    found = re.search(
        r"lowers fused EKF's position error by ([\d.]+) m \[([\d.]+), ([\d.]+)\]", sentence
    )
    mean, low, high = map(float, found.groups())
    assert 0.0 < low < mean < high


def test_where_nothing_is_planted_nothing_is_found_and_what_would_have_been_is_said(planted):
    headline, sentence, *_ = planted()
    assert headline == "No effect of beacon.level_db is shown."
    found = re.fullmatch(
        r"beacon\.level_db from 36\.8 to 48\.8 shows no effect on fused EKF's position error "
        r"\((−?[\d.]+) m, where ([\d.]+) m would have been shown\)\.", sentence,
    )  # fmt: skip
    mean, least = (float(text.replace("−", "-")) for text in found.groups())
    assert abs(mean) < least
    expected = 0.02 * np.sqrt(2.0 / 12.0) * 2.2
    assert least == pytest.approx(expected, rel=0.5)


def test_each_strategy_has_its_clause_and_one_that_is_not_touched_is_said_to_be(planted):
    def effect(case):
        return by_level({"fused": 0.3, "passive": -0.3, "active": 0.0}[case.strategy])(case)

    ways = 'strategies = ["active", "fused", "passive"]\nfilters = ["ekf"]\n'
    headline, _, sentence, *_ = planted(ways=ways, effect=effect)
    assert headline == (
        "A higher beacon.level_db raises the position error of fused sensing and lowers that of "
        "passive sensing, and changes the position gain over active."
    )
    assert re.search(r" shows no effect on active EKF's position error \(", sentence)
    assert re.search(r"\. It raises fused EKF's by 0\.(29|3)\d* m ", sentence)
    assert re.search(r"\. It lowers passive EKF's by 0\.(29|3)\d* m ", sentence)


def test_what_stays_the_same_to_the_last_digit_is_told_so(tmp_path):
    write_planted(tmp_path / "s", ways=BOTH, effect=by_level(0.3))
    study = read_study(tmp_path / "s")
    for score, table in study.trials["ekf", "passive"].scores.items():
        if score != "common_map_rmse_m":
            table[:] = table[:, :1]
    headline, sentence, *_ = told(study)
    assert headline == "A higher beacon.level_db raises the position error of fused sensing."
    assert "]. It leaves passive EKF's as it is, to the last digit." in sentence


def test_a_value_between_that_does_more_than_the_ends_is_named(planted):
    def effect(case):
        return {"position_rmse_m": -0.4 * (case.values["beacon.level_db"] == 42.8)}

    headline, sentence, *_ = planted(effect=effect)
    assert headline == (
        "beacon.level_db changes the position error, but no effect from end to end is shown."
    )
    assert re.search(
        rf"\. At 42\.8 fused EKF's is 0\.\d+ m {INTERVAL} less than at 36\.8\.", sentence
    )


def test_a_mean_that_hides_the_opposite_says_where(planted):
    def effect(case):
        sign = {1.0: 1.0, 3.0: -0.3}[case.values["rays.power"]]
        return {"position_rmse_m": sign * 0.5 * (case.values["beacon.level_db"] > 40.0)}

    _, sentence, *_ = planted(TWO, effect=effect)
    assert sentence.startswith(
        "beacon.level_db from 36.8 to 48.8, on average over rays.power, raises fused EKF's"
    )
    assert re.search(
        rf"\. At rays\.power = 3 it lowers fused EKF's by 0\.1\d* m {INTERVAL}", sentence
    )


def test_effects_that_cancel_are_not_told_as_none(planted):
    def effect(case):
        sign = {1.0: 1.0, 3.0: -1.0}[case.values["rays.power"]]
        return {"position_rmse_m": sign * 0.5 * (case.values["beacon.level_db"] > 40.0)}

    _, sentence, *_ = planted(TWO, effect=effect)
    assert "shows no effect on fused EKF's position error" in sentence
    assert re.search(r"\. At rays\.power = [13] and at 1 more it (raises|lowers) fused", sentence)


def test_words_are_compared_with_the_one_listed_first(planted):
    def effect(case):
        return {"position_rmse_m": 0.4 * (case.values["rays.weights"] == "aggregated")}

    grid = '"rays.weights" = ["instantaneous", "aggregated"]'
    headline, sentence, *_ = planted(grid, effect=effect)
    assert headline == (
        "rays.weights = aggregated instead of instantaneous raises the position error."
    )
    assert sentence.startswith(
        "rays.weights = aggregated instead of instantaneous raises fused EKF's position error by"
    )


def test_of_several_lists_each_is_told_and_the_headline_says_which_do_what(planted):
    def effect(case):
        near = case.values["rays.range_bounds"][0]
        return {"position_rmse_m": {0.5: 0.0, 1.0: 0.4, 2.0: -0.4, 3.0: 0.4}[near]}

    grid = '"rays.range_bounds" = [[0.5, 20.0], [1.0, 20.0], [2.0, 20.0], [3.0, 20.0]]'
    headline, sentence, *_ = planted(grid, effect=effect)
    assert headline == (
        "rays.range_bounds: against [0.5, 20], [1, 20] and [3, 20] raise the position error and "
        "[2, 20] lowers the position error."
    )
    assert sentence.count("instead of [0.5, 20]") == 3


def test_of_very_many_words_the_strongest_are_told(planted):
    def effect(case):
        return {"position_rmse_m": 0.4 * (case.values["rays.range_bounds"][0] == 4.0)}

    grid = f'"rays.range_bounds" = {[[float(k), 20.0] for k in range(1, 10)]}'
    _, sentence, *_ = planted(grid, effect=effect)
    assert sentence.count(" instead of ") == 4
    assert "[4, 20] instead of [1, 20] raises" in sentence
    assert " 4 more values are in the table." in sentence


def test_other_measures_that_change_are_named_with_their_strategies(planted):
    def effect(case):
        higher = case.values["beacon.level_db"] > 40.0
        fused = case.strategy == "fused"
        return {"heading_rmse_rad": 0.1 * higher, "nees_mean": -0.8 * higher * fused}

    headline, sentence, *_ = planted(ways=BOTH, effect=effect)
    assert headline == (
        "No effect of beacon.level_db on the position error is shown, but one on the heading error "
        "and NEES."
    )
    assert sentence.endswith(" Besides, it raises the heading error and lowers the NEES (fused).")


def test_what_changes_alike_in_every_world_has_no_interval_and_is_told_so(tmp_path):
    write_planted(tmp_path / "s")
    study = read_study(tmp_path / "s")
    hard = 0.5 * np.arange(12)[:, None]
    study.trials["ekf", "fused"].scores["position_rmse_m"][:] = hard + np.array([0.0, 0.125, 0.25])
    _, sentence, *_ = told(study)
    assert sentence == (
        "beacon.level_db from 36.8 to 48.8 changes fused EKF's position error by 0.25 m in every "
        "world alike."
    )


def test_an_answer_that_hangs_on_what_diverged_is_told_both_ways(planted):
    """In three of sixteen worlds the highest level makes the filter diverge, far off."""

    def diverged(case, world):
        return case.values["beacon.level_db"] == 48.8 and world < 3

    def effect(case):
        return {"position_rmse_m": -0.05 * (case.values["beacon.level_db"] == 48.8)}

    _, sentence, *_ = planted(worlds=16, effect=effect, diverged=diverged)
    assert "ithout diverged cases" not in sentence, "the same either way"
    _, sentence, *_, lost = planted(worlds=16, effect=effect, diverged=diverged, far=3.0)
    assert re.search(
        r"shows no effect on fused EKF's position error \([\d.]+ m, where [\d.]+ m would have been "
        r"shown\)\. Without diverged cases the change is −0\.0\d+ m \[−[\d.]+, −[\d.]+\]\.",
        sentence,
    )
    assert lost == "The filter diverged, of the trials, with EKF fused in 6.2 %."


SOUNDS = '"assumed.speed_of_sound" = [337.0, 340.0, 343.0, 346.0, 349.0]'


def off_by(metres, fused=1.0):
    """Plant a rise with the distance from the true speed of sound."""

    def effect(case):
        far = abs(case.values["assumed.speed_of_sound"] - 343.0) / 6.0
        return {"position_rmse_m": metres * far * (fused if case.strategy == "fused" else 1.0)}

    return effect


def test_what_is_assumed_wrongly_is_answered_for_on_both_sides_of_the_truth(planted):
    headline, sentence, *_ = planted(SOUNDS, effect=off_by(0.3))
    assert headline == (
        "assumed.speed_of_sound: against 343, 337 and 349 raise the position error."
    )
    assert re.fullmatch(
        rf"assumed\.speed_of_sound from 343 to 337 raises fused EKF's position error by "
        rf"0\.[23]\d* m {INTERVAL}\. assumed\.speed_of_sound from 343 to 349 raises fused EKF's "
        rf"position error by 0\.[23]\d* m {INTERVAL}\.", sentence,
    )  # fmt: skip


def test_of_what_only_some_cases_show_it_is_said_how_many(planted):
    headline, *_ = planted(SOUNDS, ways=BOTH, effect=off_by(0.3, fused=0.0))
    assert headline == (
        "assumed.speed_of_sound: against 343, 337 and 349 raise the position error in 2 of 4 cases."
    )


def test_a_value_between_the_truth_and_an_end_is_told_of_its_own_side(planted):
    def effect(case):
        return {"position_rmse_m": 0.3 * (case.values["assumed.speed_of_sound"] == 340.0)}

    headline, sentence, *_ = planted(SOUNDS, effect=effect)
    assert headline == (
        "assumed.speed_of_sound changes the position error, but no effect from end to end is shown."
    )
    assert re.search(
        rf"\. At 340 fused EKF's is 0\.[23]\d* m {INTERVAL} more than at 343", sentence
    )
    assert "t 346" not in sentence


def test_what_rises_on_one_side_of_the_truth_alone_is_not_told_again_of_its_inner_value(planted):
    def effect(case):
        return {"position_rmse_m": 0.05 * max(343.0 - case.values["assumed.speed_of_sound"], 0.0)}

    headline, sentence, *_ = planted(SOUNDS, effect=effect)
    assert headline == "assumed.speed_of_sound: against 343, 337 raises the position error."
    assert "from 343 to 349 shows no effect on" in sentence
    assert " more than at " not in sentence


def test_where_the_truth_is_the_greatest_value_a_lower_one_is_what_errs(planted):
    headline, sentence, *_ = planted(
        '"assumed.speed_of_sound" = [337.0, 343.0]', effect=off_by(0.3)
    )
    assert headline == "A lower assumed.speed_of_sound raises the position error."
    assert sentence.startswith("assumed.speed_of_sound from 343 to 337 raises fused EKF's")


def test_beside_the_position_a_strategy_that_every_value_moves_is_named_once(planted):
    def effect(case):
        far = abs(case.values["assumed.speed_of_sound"] - 343.0) / 6.0
        return {
            "heading_rmse_rad": 0.3 * far * (case.strategy == "fused"),
            "map_rmse_m": 0.3 * (case.values["assumed.speed_of_sound"] == 349.0),
        }

    _, sentence, *_ = planted(SOUNDS, ways=BOTH, effect=effect)
    assert sentence.endswith(
        " Besides, it raises the heading error (fused) and the map error (fused 349, passive 349)."
    )


def test_what_is_so_without_diverged_cases_stands_behind_a_size(planted):
    def effect(case):
        return {"position_rmse_m": 0.01 * (case.values["beacon.level_db"] == 48.8)}

    def diverged(case, world):
        return case.values["beacon.level_db"] == 48.8 and world < 8

    _, sentence, *_ = planted(worlds=16, effect=effect, diverged=diverged, far=1.0, spread=0.1)
    assert re.search(
        rf"raises fused EKF's position error by 0\.[3-7]\d* m {INTERVAL}"
        rf"\. Without diverged cases the change is −?0\.\d+ m {INTERVAL}, which is not shown",
        sentence,
    )


def test_the_beamwidth_is_called_so_and_passive_sensing_has_no_part_in_it():
    study = narrowed(only(invent(20), [("ekf", "fused"), ("ekf", "passive")]), [0, 5, 11])
    assert question(study) == "What does the beamwidth change?"
    headline, sentence, *_ = told(study)
    assert headline == "A wider beam lowers the position error."
    assert sentence.startswith("The beamwidth from 11° to 180° lowers fused EKF's position error")
    assert "passive" not in sentence


def test_a_study_that_only_listens_is_told_that_its_beam_is_nothing_to_it():
    study = narrowed(only(invent(5), [("ekf", "passive")]), [0, 11])
    headline, bound = told(study)
    assert headline == "Nothing that was heard depends on the beamwidth."
    assert bound.startswith("In multiples of the bound, the least position error")
    assert bound.endswith(IN_ONE_WORLD), "the same remark about luck as in the terminal"
    assert "EKF passive" in bound


def test_what_listening_adds_is_told_of_each_case_where_they_are_few_and_else_of_the_ends():
    whole = only(invent(20), [("ekf", "active"), ("ekf", "fused")])
    lead = (
        rf"Fused instead of active sensing (?:(?:raises|lowers) EKF's position error by [\d.]+ m "
        rf"{INTERVAL}|shows no effect on EKF's position error \(−?[\d.]+ m, where [\d.]+ m would "
        r"have been shown\))"
    )
    (few,) = [said for said in told(narrowed(whole, [0, 11])) if said.startswith("Fused instead")]
    (many,) = [said for said in told(whole) if said.startswith("Fused instead")]
    size = rf"(−?[\d.]+) m {INTERVAL}"
    each = re.fullmatch(
        rf"{lead}\. At (\d+)° it changes by {size}\. At (\d+)° it changes by {size}\.", few
    )
    ends = re.fullmatch(
        rf"{lead}\. The least is {size} at \d+°\. The most is {size} at \d+°\.", many
    )
    for least, most in (each.group(2, 4), ends.group(1, 2)):
        assert float(least.replace("−", "-")) < float(most.replace("−", "-"))
    assert {each[1], each[3]} == {"11", "180"}
    alone = told(only(invent(20), [("ekf", "fused"), ("ekf", "passive")]))
    assert not any("instead of active" in said for said in alone)


def test_questions_are_what_a_study_asks():
    study = invent(2)
    cases = {
        "How do active, fused and passive sensing compare?": list(study.trials),
        "How do EKF and FastSLAM 2.0 compare?": [("ekf", "fused"), ("fastslam", "fused")],
        "How well does EKF locate the vehicle by fused sensing?": [("ekf", "fused")],
    }
    for words, ways in cases.items():
        assert question(without_variables(only(study, ways))) == words


def test_without_a_grid_strategies_are_compared_and_levels_told():
    ways = [("ekf", way) for way in ("active", "fused", "passive")]
    study = changed(invent(20), ("ekf", "fused"), "position_rmse_m", lambda e: e - 0.4)
    headline, levels, sentence, *rest = told(without_variables(only(study, ways)))
    assert headline == (
        "Fused instead of active sensing lowers the position error; passive instead of active "
        "sensing raises the position error."
    )
    assert re.match(
        rf"EKF's position error is 0\.\d+ m {INTERVAL} by active sensing \(the bound: 0\.23 m\), "
        rf"0\.\d+ m {INTERVAL} by fused sensing \(the bound: 0\.23 m\) and ", levels,
    )  # fmt: skip
    assert sentence.startswith("Fused instead of active sensing lowers EKF's position error by 0.4")
    assert rest == []


def test_without_a_grid_and_with_one_strategy_filters_are_compared():
    study = without_variables(only(invent(20), [("ekf", "fused"), ("fastslam", "fused")]))
    headline, *levels, sentence = told(study)
    assert headline == "FastSLAM 2.0 instead of EKF raises the position error."
    assert [line.split("'s")[0] for line in levels] == ["EKF", "FastSLAM 2.0"]
    assert sentence.startswith(
        "FastSLAM 2.0 instead of EKF raises the position error of fused sensing by 0."
    )


def test_of_one_strategy_and_one_filter_the_answer_is_how_far_off_it_is():
    study = without_variables(only(invent(20), [("ekf", "fused")]))
    (headline,) = told(study)
    assert re.fullmatch(
        rf"EKF's position error is 0\.\d+ m {INTERVAL} by fused sensing \(the bound: 0\.23 m\)\.",
        headline,
    )
    (lonely,) = told(without_variables(only(invent(1), [("ekf", "fused")])))
    assert re.fullmatch(r"EKF's position error is 0\.\d+ m in the one world by fused .*", lonely)


@pytest.mark.parametrize("worlds", [1, 3])
def test_nothing_is_answered_before_there_are_worlds(tmp_path, worlds):
    write_planted(tmp_path / "s", worlds=worlds, effect=by_level(0.3))
    study = read_study(tmp_path / "s")
    if worlds == 3:
        study.trials["ekf", "fused"].failed[:] = True
    headline, sentence, *_ = told(study)
    left = "a single world is left" if worlds == 1 else "no world is left"
    assert headline == f"Not decided: {left}."
    assert "has too few worlds to tell of fused EKF's position error" in sentence


def test_a_filter_from_outside_is_named_by_its_class_and_many_cases_are_counted():
    study = with_third(narrowed(invent(20), [0, 11]), "toy_slam.filters:Smoother")
    better = changed(study, ("ekf", "fused"), "position_rmse_m", lambda e: e[:, ::-1])
    headline, *sentences = told(better)
    assert headline == (
        "A wider beam raises the position error of fused EKF and lowers that of 5 of 6 cases, and "
        "lowers the position gain over active."
    )
    errors = [line for line in sentences if "position error" in line.split(" by ")[0]]
    assert [line.split(" by ")[0].rpartition("lowers ")[2] for line in errors[1:3]] == [
        "active FastSLAM 2.0's position error", "active Smoother's position error",
    ]  # fmt: skip


def test_what_a_variable_does_to_the_gain_of_listening_is_the_first_sentence(planted):
    def effect(case):
        return by_level({"active": -0.5, "fused": -0.1}[case.strategy])(case)

    ways = 'strategies = ["active", "fused"]\nfilters = ["ekf"]\n'
    headline, sentence, *_ = planted(TWO, ways=ways, effect=effect)
    assert (
        headline
        == "A higher beacon.level_db lowers the position error, and lowers the position gain over "
        "active; no effect of rays.power is shown."
    )
    found = re.match(
        r"beacon\.level_db from 36\.8 to 48\.8, on average over rays\.power, lowers fused EKF's "
        r"position gain over active by ([\d.]+) m \[([\d.]+), ([\d.]+)\]\.", sentence,
    )  # fmt: skip
    mean, low, high = map(float, found.groups())
    assert low < mean < high
    assert mean == pytest.approx(0.4, abs=0.03)


def test_without_active_sensing_no_gain_is_told_of(planted):
    assert "gain" not in " ".join(planted(ways=BOTH, effect=by_level(0.3)))


def test_each_sentence_on_an_effect_has_one_size_with_its_interval(planted):
    def effect(case):
        return by_level({"active": -0.5, "fused": -0.1, "passive": 0.3}[case.strategy])(case)

    answered = planted(TWO, ways='filters = ["ekf"]\n', effect=effect)
    for sentence in re.split(r"\. (?=[A-Zb])", " ".join(answered[:5])):
        assert len(re.findall(INTERVAL, sentence)) <= 1, sentence
