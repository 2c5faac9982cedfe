"""One number per world: laps, swings, departures and slopes against closed forms."""

from dataclasses import replace

import numpy as np
import pytest

from pipistrelle.estimation.motion import motion_step
from pipistrelle.experiments.hearing.trajectories import motion_of
from pipistrelle.report.claims.contrasts import (
    approach,
    curves,
    departure,
    differences,
    frame_time,
    lap_fit,
    lap_time,
    select,
)
from report.invented import BEAMWIDTH, changed, invent

FRAMES = 375


@pytest.fixture(scope="module")
def study():
    return invent(8)


def turning(study, **scenario):
    setup = study.config.scenario.model_copy(update=scenario)
    config = study.config.model_copy(update={"scenario": setup})
    return replace(study, config=config, configs=(config,) * len(study.configs))


def test_a_lap_takes_what_the_motion_model_takes_to_turn_once(study):
    config = study.config
    controls = np.array([config.scenario.speed, config.scenario.steering])
    pose = motion_step(motion_of(config.motion), np.zeros(3), controls, config.scenario.step)
    assert lap_time(study) == pytest.approx(2 * np.pi / pose[2] * config.scenario.step, rel=1e-9)
    assert lap_time(study) == pytest.approx(62.1, abs=0.05), "as the paper's drive: three laps"


def test_a_straight_drive_has_no_laps(study):
    straight = turning(study, steering=0.0)
    assert lap_time(straight) == np.inf
    assert lap_fit(straight) is None


def test_less_than_two_laps_tell_nothing_of_laps(study):
    assert lap_fit(turning(study, step=0.125 * 2 * 62.06 / 187.6)) is None
    assert lap_fit(turning(study, step=0.125 * 2 * 62.06 / 187.4)) is not None


def test_rise_and_swing_are_read_off_a_curve_that_has_them(study):
    rise, swing = lap_fit(study)
    tau = frame_time(study, FRAMES) / lap_time(study)
    curve = (
        3.0 + 0.7 * tau + 2.5 * (1 - np.cos(2 * np.pi * tau)) / 2 - 0.4 * np.sin(2 * np.pi * tau)
    )
    assert curve @ rise == pytest.approx(0.7, rel=1e-9)
    assert curve @ swing == pytest.approx(2.5, rel=1e-9)


def test_a_curve_that_only_rises_does_not_swing(study):
    rise, swing = lap_fit(study)
    tau = frame_time(study, FRAMES) / lap_time(study)
    assert (3.0 + 5.0 * tau) @ swing == pytest.approx(0.0, abs=1e-9)
    assert np.ones(FRAMES) @ rise == pytest.approx(0.0, abs=1e-9)


def test_noise_swings_as_often_down_as_up(study):
    """White noise of unit variance: the swing's variance is the weights' sum of squares."""
    _, swing = lap_fit(study)
    found = np.random.default_rng(6).normal(size=(4000, FRAMES)) @ swing
    error = np.sqrt(swing @ swing)
    assert abs(found.mean()) < 4.0 * error / np.sqrt(4000)
    assert found.std() == pytest.approx(error, rel=4.0 / np.sqrt(2 * 4000))


@pytest.mark.parametrize(("level", "expected"), [(3.0, 0.0), (3.0 * np.e, 1.0), (3.0 / np.e, 1.0)])
def test_the_departure_counts_over_and_under_confidence_alike(level, expected):
    for ideal in (3.0, 2.2):
        nees, consistent = np.full((5, 2, 10), level * ideal / 3.0), np.full((2, 10), ideal)
        assert departure(nees, consistent) == pytest.approx(np.full(5, expected), abs=1e-12)
        assert departure(nees[:1], consistent) == pytest.approx([expected], abs=1e-12)


def test_the_departure_is_that_of_the_mean_over_worlds():
    """Half the worlds at 1 and half at 5 make an ANEES of 3: no departure, to order 1/n."""
    nees = np.repeat([1.0, 5.0], 200)[:, None, None] * np.ones((400, 1, 6))
    values = departure(nees, np.full((1, 6), 3.0))
    assert abs(values.mean()) < 1 / 400
    single = np.square(np.log(nees / 3.0)).mean()
    assert single > 0.5, "the control: averaging over worlds last would see one"


def test_curves_leave_out_worlds_without_a_number(study):
    nees = study.trials["ekf", "active"].nees.copy()
    nees[2, 4, 100] = np.inf
    spoilt = replace(
        study,
        trials=study.trials
        | {("ekf", "active"): replace(study.trials["ekf", "active"], nees=nees)},
    )
    (found,) = curves(select(spoilt, "none"), [("ekf", "active")])
    np.testing.assert_array_equal(found, np.delete(nees, 2, axis=0))
    assert curves(select(study, "none"), [("ekf", "unheard")]) is None


def test_curves_are_of_the_worlds_that_the_rule_counts(study):
    trials = study.trials["ekf", "fused"]
    diverged = trials.diverged.copy()
    diverged[3, 5] = True
    spoilt = {**study.trials, ("ekf", "fused"): replace(trials, diverged=diverged)}
    made = replace(study, trials=spoilt)
    for rule, fused, active in (("world", 7, 7), ("case", 7, 8), ("none", 8, 8)):
        for strategy, left in (("fused", fused), ("active", active)):
            nees = study.trials["ekf", strategy].nees
            (found,) = curves(select(made, rule), [("ekf", strategy)])
            expected = nees if left == 8 else np.delete(nees, 3, axis=0)
            np.testing.assert_array_equal(found, expected)


def test_fused_leaves_passive_by_the_slope_over_octaves(study):
    passive = study.trials["ekf", "passive"].scores["position_rmse_m"]
    gap = 0.25 * np.log2(BEAMWIDTH / 5.0)
    for sign in (1.0, -1.0):
        fused = passive + sign * gap
        made = changed(study, ("ekf", "fused"), "position_rmse_m", lambda _, now=fused: now)
        slope = approach(select(made, "none"), "position_rmse_m", "ekf")
        assert slope == pytest.approx(np.full(8, 0.25), rel=1e-9)


def test_differences_are_paired_and_named(study):
    pair = ("ekf", "active"), ("ekf", "fused")
    found = differences(select(study, "none"), "position_rmse_m", *pair, name="EKF", below=41.0)
    assert [s.label for s in found] == [f"EKF, {b}°" for b in (11, 14, 18, 22, 27, 33)]
    scores = [study.trials[way].scores["position_rmse_m"] for way in pair]
    np.testing.assert_array_equal(found[2].sample, scores[0][:, 2] - scores[1][:, 2])
    blind = ("fastslam", "passive"), ("ekf", "passive")
    assert [s.label for s in differences(select(study, "none"), "nees_mean", *blind, name="p")] == [
        "p"
    ]
    assert differences(select(study, "none"), "nees_mean", ("ekf", "deaf"), pair[0], name="x") == []
