"""What is looked at, and how two cases are compared in it."""

from dataclasses import replace

import numpy as np
import pytest

from pipistrelle.report.effects.measures import change, gains_of, measures_of
from pipistrelle.report.studied import READ
from report.invented import changed, invent

BEFORE, AFTER = ("ekf", "fused", 0), ("ekf", "fused", 5)


@pytest.fixture
def study():
    return invent(6)


def measured(study, score):
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
        np.testing.assert_array_equal(change(study, measured(study, name), BEFORE, AFTER), expected)


def test_nees_changes_by_a_ratio(study):
    twice = changed(
        study, ("ekf", "fused"), "nees_mean", lambda n: np.where([[1] * 5 + [0] * 7], n, 2 * n)
    )
    nees = study.trials["ekf", "fused"].scores["nees_mean"]
    found = np.exp(change(twice, measured(study, "nees_mean"), BEFORE, AFTER))
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


def test_maps_are_compared_over_the_landmarks_that_both_have_placed(study):
    made = with_maps(study, [[1, 1, 0], [1, 1, 1]], [[3.0, 4.0, 90.0], [3.0, 8.0, 70.0]])
    expected = np.sqrt((9 + 64) / 2) - np.sqrt((9 + 16) / 2)
    assert change(made, measured(study, "map_rmse_m"), BEFORE, AFTER) == pytest.approx(
        np.full(6, expected)
    )


def test_maps_without_a_landmark_in_common_have_no_difference(study):
    made = with_maps(study, [[1, 0], [0, 1]], [[1.0, 1.0], [1.0, 1.0]])
    assert np.isnan(change(made, measured(study, "map_rmse_m"), BEFORE, AFTER)).all()


def test_maps_of_other_landmarks_are_compared_as_they_are(study):
    made = with_maps(study, [[1, 1], [1, 1]], [[1.0, 1.0], [2.0, 2.0]])
    elsewhere = replace(made, drawing=np.arange(12))
    own = made.trials["ekf", "fused"].scores["map_rmse_m"]
    found = change(elsewhere, measured(study, "map_rmse_m"), BEFORE, AFTER)
    np.testing.assert_array_equal(found, own[:, 5] - own[:, 0])
    assert change(made, measured(study, "map_rmse_m"), BEFORE, AFTER) == pytest.approx(np.ones(6))


def test_passive_sensing_is_compared_with_any_beam_by_its_one_case(study):
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
