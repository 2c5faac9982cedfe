"""Which worlds count, under each rule."""

import numpy as np
import pytest

from pipistrelle.report.claims.contrasts import select
from pipistrelle.report.studied import (
    COMMON,
    filter_titles,
    kept,
    lost_worlds,
    mean_std,
    samples,
    values,
)
from report.invented import invent, with_third


@pytest.fixture
def study():
    study = invent(6)
    study.trials["ekf", "fused"].diverged[0, 3] = True
    study.trials["ekf", "passive"].diverged[1, 0] = True
    study.trials["fastslam", "active"].failed[2, 5] = True
    return study


def test_the_paper_drops_a_world_where_any_case_of_the_filter_diverged_or_failed(study):
    assert lost_worlds(study, "ekf").tolist() == [True, True, False, False, False, False]
    assert lost_worlds(study, "fastslam").tolist() == [False, False, True, False, False, False]
    assert np.flatnonzero(~kept(select(study, "world"), [("ekf", "active", 8)])).tolist() == [0, 1]
    pair = [("ekf", "active", 8), ("fastslam", "active", 8)]
    assert np.flatnonzero(~kept(select(study, "world"), pair)).tolist() == [0, 1, 2]


def test_by_case_only_the_cases_at_hand_count(study):
    assert kept(select(study, "case"), [("ekf", "fused", 2)]).all()
    assert np.flatnonzero(~kept(select(study, "case"), [("ekf", "fused", 3)])).tolist() == [0]
    pair = [("ekf", "fused", 3), ("ekf", "passive", 3)]
    assert np.flatnonzero(~kept(select(study, "case"), pair)).tolist() == [0, 1]


def test_without_a_rule_only_failed_trials_are_left_out(study):
    assert kept(select(study, "none"), [("ekf", "fused", 3)]).all()
    assert np.flatnonzero(~kept(select(study, "none"), [("fastslam", "active", 5)])).tolist() == [2]


def test_samples_are_of_the_same_worlds_and_finite(study):
    study.trials["ekf", "active"].scores["position_rmse_m"][4, 3] = np.inf
    study.trials["ekf", "fused"].scores["position_rmse_m"][5, 3] = np.nan
    cells = [("ekf", "active", 3), ("ekf", "fused", 3)]
    first, second = samples(select(study, "none"), "position_rmse_m", cells)
    assert first.tolist() == values(study, "position_rmse_m", cells[0])[:4].tolist()
    assert second.tolist() == values(study, "position_rmse_m", cells[1])[:4].tolist()


def test_passive_has_one_column_but_for_the_landmarks_in_common(study):
    there = study.trials["ekf", "passive"].scores
    assert values(study, "position_rmse_m", ("ekf", "passive", 7)) is not None
    np.testing.assert_array_equal(
        values(study, "position_rmse_m", ("ekf", "passive", 7)), there["position_rmse_m"][:, 0]
    )
    np.testing.assert_array_equal(values(study, COMMON, ("ekf", "passive", 7)), there[COMMON][:, 7])


def test_filters_stand_in_the_catalogues_order_and_others_after_it_by_name(study):
    assert filter_titles(study) == {"ekf": "EKF", "fastslam": "FastSLAM 2.0"}
    for name in ("zoo.slam:Graph", "a.slam:Graph", "a.slam:Rays", "a:EKF"):
        study = with_third(study, name)
    assert list(filter_titles(study).items()) == [
        ("ekf", "EKF"),
        ("fastslam", "FastSLAM 2.0"),
        ("a.slam:Graph", "a.slam:Graph"),
        ("a.slam:Rays", "Rays"),
        ("a:EKF", "a:EKF"),
        ("zoo.slam:Graph", "zoo.slam:Graph"),
    ]


def test_of_no_world_there_is_no_mean():
    assert np.isnan(mean_std(np.empty(0))).all()
