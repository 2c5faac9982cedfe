"""The answer to a study's own question, in words that follow its numbers."""

import re
from dataclasses import replace

import numpy as np
import pytest

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
    return answer(by_rule[HEADLINE], effects[HEADLINE])


@pytest.fixture
def planted(tmp_path):
    """The answer of a study whose effect is planted."""

    def planted(*args, **given):
        write_planted(tmp_path / "s", *args, **given)
        return told(read_study(tmp_path / "s"))

    return planted


def test_a_planted_rise_is_found_with_its_size_and_its_interval(planted):
    headline, sentence, *_ = planted(effect=by_level(0.34))
    assert headline == "A higher beacon.level_db raises the position RMSE."
    found = re.match(
        r"beacon\.level_db from 36\.8 to 48\.8 raises fused EKF's position RMSE by "
        r"([\d.]+) m \[([\d.]+), ([\d.]+)\]\.", sentence,
    )  # fmt: skip
    mean, low, high = map(float, found.groups())
    assert low < 0.34 < high
    assert mean == pytest.approx(0.34, abs=0.03)
    assert high - low < 0.1


def test_a_planted_fall_is_worded_as_a_fall_by_a_positive_size(planted):
    headline, sentence, *_ = planted(effect=by_level(-0.34))
    assert headline == "A higher beacon.level_db lowers the position RMSE."
    found = re.search(
        r"lowers fused EKF's position RMSE by ([\d.]+) m \[([\d.]+), ([\d.]+)\]", sentence
    )
    mean, low, high = map(float, found.groups())
    assert 0.0 < low < mean < high


def test_where_nothing_is_planted_nothing_is_found_and_how_small_it_is_is_said(planted):
    headline, sentence = planted()
    assert headline == "No effect of beacon.level_db is shown."
    found = re.fullmatch(
        r"beacon\.level_db from 36\.8 to 48\.8 shows no effect on fused EKF's position RMSE; "
        r"the change is (−?[\d.]+) m \[(−?[\d.]+), (−?[\d.]+)\]\.", sentence,
    )  # fmt: skip
    mean, low, high = (float(text.replace("−", "-")) for text in found.groups())
    assert low < 0.0 < high
    assert low < mean < high
    assert (high - low) / 2.0 == pytest.approx(0.02 * np.sqrt(2.0 / 12.0) * 2.2, rel=0.5)


def test_the_headline_tells_strategies_apart_and_the_sentence_has_the_largest_effect(planted):
    def effect(case):
        return by_level({"fused": 0.3, "passive": -0.4, "active": 0.0}[case.strategy])(case)

    ways = 'strategies = ["active", "fused", "passive"]\nfilters = ["ekf"]\n'
    headline, sentence = planted(ways=ways, effect=effect)
    assert headline == (
        "A higher beacon.level_db raises the position RMSE of fused sensing and lowers that of "
        "passive sensing, and changes the gain in position RMSE over active."
    )
    assert re.search(r" lowers passive EKF's position RMSE by 0\.(39|4)\d* m ", sentence)


def test_what_stays_the_same_to_the_last_digit_is_told_so(tmp_path):
    write_planted(tmp_path / "s", ways=BOTH, effect=by_level(0.3))
    study = read_study(tmp_path / "s")
    for trials in study.trials.values():
        trials.scores["position_rmse_m"][:] = trials.scores["position_rmse_m"][:, :1]
    _, sentence = told(study)
    assert sentence.endswith(" position RMSE as it is, to the last digit.")


def test_where_only_a_value_between_does_anything_the_sentence_is_of_that(planted):
    def effect(case):
        return {"position_rmse_m": -0.4 * (case.values["beacon.level_db"] == 42.8)}

    headline, sentence = planted(effect=effect)
    assert headline == (
        "beacon.level_db changes the position RMSE, but no effect from end to end is shown."
    )
    assert re.search(rf"36\.8 to 42\.8 lowers fused EKF's .* by 0\.\d+ m {INTERVAL}\.", sentence)


def test_words_are_compared_with_the_one_listed_first(planted):
    def effect(case):
        return {"position_rmse_m": 0.4 * (case.values["rays.weights"] == "aggregated")}

    grid = '"rays.weights" = ["instantaneous", "aggregated"]'
    headline, sentence, *_ = planted(grid, effect=effect)
    assert headline == (
        "rays.weights = aggregated instead of instantaneous raises the position RMSE."
    )
    assert sentence.startswith(
        "rays.weights = aggregated instead of instantaneous raises fused EKF's position RMSE by"
    )


def test_of_several_lists_each_is_told_and_the_headline_says_which_do_what(planted):
    def effect(case):
        near = case.values["rays.range_bounds"][0]
        return {"position_rmse_m": {0.5: 0.0, 1.0: 0.4, 2.0: -0.4, 3.0: 0.4}[near]}

    grid = '"rays.range_bounds" = [[0.5, 20.0], [1.0, 20.0], [2.0, 20.0], [3.0, 20.0]]'
    headline, sentence, *_ = planted(grid, effect=effect)
    assert headline == (
        "rays.range_bounds: against [0.5, 20], [1, 20] and [3, 20] raise the position RMSE and "
        "[2, 20] lowers the position RMSE."
    )
    assert re.search(r"= \[\d, 20\] instead of \[0\.5, 20\] (raises|lowers) fused EKF's", sentence)


def test_other_measures_that_change_are_named(planted):
    def effect(case):
        higher = case.values["beacon.level_db"] > 40.0
        fused = case.strategy == "fused"
        return {"heading_rmse_rad": 0.1 * higher, "nees_mean": -0.8 * higher * fused}

    headline, *_ = planted(ways=BOTH, effect=effect)
    assert headline == (
        "No effect of beacon.level_db on the position RMSE is shown, but one on the heading RMSE "
        "and NEES, mean."
    )


def test_what_changes_alike_in_every_world_has_no_interval_and_is_told_so(tmp_path):
    write_planted(tmp_path / "s")
    study = read_study(tmp_path / "s")
    hard = 0.5 * np.arange(12)[:, None]
    study.trials["ekf", "fused"].scores["position_rmse_m"][:] = hard + np.array([0.0, 0.125, 0.25])
    _, sentence, *_ = told(study)
    assert sentence == (
        "beacon.level_db from 36.8 to 48.8 changes fused EKF's position RMSE by 0.25 m in every "
        "world alike."
    )


SOUNDS = '"assumed.speed_of_sound" = [337.0, 340.0, 343.0, 346.0, 349.0]'


def off_by(metres, fused=1.0):
    """Plant a rise with the distance from the true speed of sound."""

    def effect(case):
        far = abs(case.values["assumed.speed_of_sound"] - 343.0) / 6.0
        return {"position_rmse_m": metres * far * (fused if case.strategy == "fused" else 1.0)}

    return effect


def test_what_is_assumed_wrongly_is_answered_for_on_both_sides_of_the_truth(planted):
    headline, sentence, *_ = planted(SOUNDS, effect=off_by(0.3))
    assert headline == ("assumed.speed_of_sound: against 343, 337 and 349 raise the position RMSE.")
    assert re.fullmatch(
        rf"assumed\.speed_of_sound from 343 to 3(37|49) raises fused EKF's position RMSE by "
        rf"0\.[23]\d* m {INTERVAL}\.", sentence,
    )  # fmt: skip


def test_of_what_only_some_cases_show_it_is_said_how_many(planted):
    headline, *_ = planted(SOUNDS, ways=BOTH, effect=off_by(0.3, fused=0.0))
    assert headline == (
        "assumed.speed_of_sound: against 343, 337 and 349 raise the position RMSE in 2 of 4 cases."
    )


def test_where_the_truth_is_the_greatest_value_a_lower_one_is_what_errs(planted):
    headline, sentence, *_ = planted(
        '"assumed.speed_of_sound" = [337.0, 343.0]', effect=off_by(0.3)
    )
    assert headline == "A lower assumed.speed_of_sound raises the position RMSE."
    assert sentence.startswith("assumed.speed_of_sound from 343 to 337 raises fused EKF's")


def test_the_beamwidth_is_called_so_and_passive_sensing_has_no_part_in_it():
    study = narrowed(only(invent(20), [("ekf", "fused"), ("ekf", "passive")]), [0, 5, 11])
    assert question(study) == "What does the beamwidth change?"
    headline, sentence, *_ = told(study)
    assert headline == "A wider beam lowers the position RMSE."
    assert sentence.startswith("The beamwidth from 11° to 180° lowers fused EKF's position RMSE")
    assert "passive" not in sentence


def test_a_study_that_only_listens_is_told_that_its_beam_is_nothing_to_it():
    study = narrowed(only(invent(5), [("ekf", "passive")]), [0, 11])
    assert told(study) == ["Nothing that was heard depends on the beamwidth."]


def test_questions_are_what_a_study_asks():
    study = invent(2)
    cases = {
        "How do active, fused and passive sensing compare?": list(study.trials),
        "How do EKF and FastSLAM 2.0 compare?": [("ekf", "fused"), ("fastslam", "fused")],
        "How well does EKF locate the vehicle by fused sensing?": [("ekf", "fused")],
    }
    for words, ways in cases.items():
        assert question(without_variables(only(study, ways))) == words


def test_without_a_grid_strategies_are_compared():
    ways = [("ekf", way) for way in ("active", "fused", "passive")]
    study = changed(invent(20), ("ekf", "passive"), "position_rmse_m", lambda e: e + 0.4)
    study = changed(study, ("ekf", "fused"), "position_rmse_m", lambda e: e - 0.4)
    headline, sentence = told(without_variables(only(study, ways)))
    assert headline == (
        "Fused instead of active sensing lowers the position RMSE; passive instead of active "
        "sensing raises the position RMSE."
    )
    assert re.match(r"\w+ instead of active sensing \w+ EKF's position RMSE by 0\.\d", sentence)


def test_without_a_grid_and_with_one_strategy_filters_are_compared():
    study = without_variables(only(invent(20), [("ekf", "fused"), ("fastslam", "fused")]))
    headline, sentence = told(study)
    assert headline == "FastSLAM 2.0 instead of EKF raises the position RMSE."
    assert sentence.startswith(
        "FastSLAM 2.0 instead of EKF raises the position RMSE of fused sensing by 0."
    )


def test_of_one_strategy_and_one_filter_the_answer_is_how_far_off_it_is():
    study = without_variables(only(invent(20), [("ekf", "fused")]))
    (headline,) = told(study)
    assert re.fullmatch(
        rf"EKF's position RMSE is 0\.\d+ m {INTERVAL} by fused sensing\.",
        headline,
    )
    (lonely,) = told(without_variables(only(invent(1), [("ekf", "fused")])))
    assert re.fullmatch(r"EKF's position RMSE is 0\.\d+ m in the one world by fused .*", lonely)


@pytest.mark.parametrize("worlds", [1, 3])
def test_nothing_is_answered_before_there_are_worlds(tmp_path, worlds):
    write_planted(tmp_path / "s", worlds=worlds, effect=by_level(0.3))
    study = read_study(tmp_path / "s")
    if worlds == 3:
        study.trials["ekf", "fused"].failed[:] = True
    (headline,) = told(study)
    left = "a single world is left" if worlds == 1 else "no world is left"
    assert headline == f"Not decided: {left}."


def test_a_filter_from_outside_is_named_by_its_class_and_many_cases_are_counted():
    study = with_third(narrowed(invent(20), [0, 11]), "toy_slam.filters:Smoother")
    better = changed(study, ("ekf", "fused"), "position_rmse_m", lambda e: e[:, ::-1])
    headline, *_ = told(better)
    assert headline == (
        "A wider beam raises the position RMSE of fused EKF and lowers that of 5 of 6 cases, and "
        "lowers the gain in position RMSE over active."
    )


def test_what_a_variable_does_to_the_gain_of_listening_is_in_the_headline(planted):
    def effect(case):
        return by_level({"active": -0.5, "fused": -0.1}[case.strategy])(case)

    ways = 'strategies = ["active", "fused"]\nfilters = ["ekf"]\n'
    headline, sentence, *_ = planted(TWO, ways=ways, effect=effect)
    assert (
        headline
        == "A higher beacon.level_db lowers the position RMSE, and lowers the gain in position "
        "RMSE over active; no effect of rays.power is shown."
    )
    assert "on average over rays.power, lowers active EKF's position RMSE by" in sentence


def test_without_active_sensing_no_gain_is_told_of(planted):
    assert "gain" not in " ".join(planted(ways=BOTH, effect=by_level(0.3)))


def test_each_sentence_on_an_effect_has_one_size_with_its_interval(planted):
    def effect(case):
        return by_level({"active": -0.5, "fused": -0.1, "passive": 0.3}[case.strategy])(case)

    answered = planted(TWO, ways='filters = ["ekf"]\n', effect=effect)
    for sentence in re.split(r"\. (?=[A-Zbr])", " ".join(answered[:5])):
        assert len(re.findall(INTERVAL, sentence)) <= 1, sentence
