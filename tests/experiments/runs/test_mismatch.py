"""What filters assume may differ from the truth: it changes what they are told, and no more."""

import numpy as np
import pytest

from pipistrelle.arithmetic.random_stream import stream_key
from pipistrelle.config import AssumedConfig, Config, FilterConfig, MotionConfig, ScenarioConfig
from pipistrelle.evaluation.bound import bound_of_drawn_start, pose_bound
from pipistrelle.experiments.hearing.scenario import assumed_motion, standing_landmarks, world_of
from pipistrelle.experiments.hearing.trajectories import true_motion
from pipistrelle.experiments.runs.heard_world import drive_of, scans_of
from pipistrelle.experiments.runs.trial import run_mission
from pipistrelle.experiments.studies.plan import Plan
from pipistrelle.experiments.studies.world import heard_together, run_world

SHORT = ScenarioConfig(steps=80, landmarks=12)


def with_(**sections):
    return Config(scenario=SHORT, **sections)


def test_assumptions_default_to_the_truth():
    config = with_(motion=MotionConfig(wheelbase=0.4, speed_std=0.2))
    assert assumed_motion(config) == true_motion(config.motion)
    assert config.assumed_sound_speed == config.air.sound_speed


@pytest.mark.parametrize(
    ("assumed", "found"),
    [
        ({"wheelbase": 0.3}, ("wheelbase", 0.3)),
        ({"speed_std": 0.5}, ("control_std", (0.5, 0.03))),
        ({"steering_std": 0.2}, ("control_std", (0.1, 0.2))),
    ],
)
def test_filters_assume_another_motion_in_the_same_world(assumed, found):
    config, other = with_(), with_(assumed=AssumedConfig(**assumed))
    world = world_of(config)
    assert world_of(other).path.tobytes() == world.path.tobytes()
    assert getattr(drive_of(world, other).motion, found[0]) == found[1]
    right, wrong = (run_mission(one, ["fused"]) for one in (config, other))
    assert right.heard[3].rows.bearing.tobytes() == wrong.heard[3].rows.bearing.tobytes()
    assert right.trials[0].scores.position_bound_m == wrong.trials[0].scores.position_bound_m
    assert not np.array_equal(right.trials[0].track.pose.mean, wrong.trials[0].track.pose.mean)


def test_a_unicycles_angular_rate_may_be_thought_noisier():
    config = with_(
        motion=MotionConfig(model="unicycle"), assumed=AssumedConfig(angular_rate_std=0.7)
    )
    assert assumed_motion(config).control_std == (0.1, 0.7)


def test_ranges_are_counted_by_the_speed_of_sound_that_is_assumed():
    true, fast = with_(), with_(assumed=AssumedConfig(speed_of_sound=1.02 * 343.0))
    right, wrong = (run_mission(config, ["active"]).heard for config in (true, fast))
    compared = 0
    for one, other in zip(right, wrong, strict=True):
        same = np.intersect1d(one.rows.landmark, other.rows.landmark)
        pick = [np.searchsorted(rows.landmark, same) for rows in (one.rows, other.rows)]
        ratio = other.rows.range[pick[1]] / one.rows.range[pick[0]]
        ratio = ratio[~np.isnan(ratio)]
        compared += len(ratio)
        np.testing.assert_allclose(ratio, 1.02, rtol=2e-3)
    assert compared > 8


@pytest.mark.parametrize("model", ["bicycle", "unicycle"])
def test_a_bias_moves_the_vehicle_and_not_its_controls(model):
    still = {"model": model, "speed_std": 0.0, "steering_std": 0.0, "angular_rate_std": 0.0}
    plain, biased = (
        world_of(with_(motion=MotionConfig(**still, **bias)))
        for bias in ({}, {"speed_bias": 0.15, "turn_bias": 0.01})
    )
    assert biased.controls.tobytes() == plain.controls.tobytes()
    lengths = [np.hypot(*np.diff(one.path[:, :2], axis=0).T).sum() for one in (plain, biased)]
    assert lengths[1] / lengths[0] == pytest.approx(0.9 / 0.75, rel=1e-3)
    turned = [np.unwrap(one.path[:, 2])[-1] for one in (plain, biased)]
    gained = 10.0 * 0.01 if model == "unicycle" else turned[0] * (1.2 * 37.0 / 27.0 - 1.0)
    assert turned[1] - turned[0] == pytest.approx(gained, rel=1e-3)


def test_drawn_starts_have_the_filters_initial_deviation():
    config = with_(filter=FilterConfig(first_pose="drawn"))
    world, std = world_of(config), np.array(config.filter.initial_pose_std)
    off = np.array([drive_of(world, config, i).start.mean for i in range(2000)]) - world.path[0]
    drawn = off / std
    # 2000 numbers: mean within 4 sigma of 0, variance of 1.
    assert np.abs(drawn.mean(axis=0)).max() < 4.0 / np.sqrt(2000)
    assert np.abs(drawn.var(axis=0) - 1.0).max() < 4.0 * np.sqrt(2.0 / 2000)
    assert stream_key(7, 0, "start") != stream_key(7, 1, "start")
    again = drive_of(world, config, 5).start.mean
    assert again.tobytes() == drive_of(world, config, 5).start.mean.tobytes()


def test_the_bound_of_a_drawn_start_includes_its_uncertainty():
    exact, drawn = (with_(filter=FilterConfig(first_pose=start)) for start in ("exact", "drawn"))
    missions = [run_mission(config, ["fused"]) for config in (exact, drawn)]
    bounds = [mission.trials[0].scores.position_bound_m for mission in missions]
    world = missions[1].scenario
    measured = drawn.model_copy(
        update={"filter": drawn.filter.model_copy(update={"noise": "measured"})}
    )
    scans = scans_of(missions[1].heard, "fused", measured)
    B = pose_bound(
        true_motion(drawn.motion), world.controls, world.time, world.path,
        standing_landmarks(world), scans,
    )  # fmt: skip
    P = bound_of_drawn_start(B, world.path, np.diag(np.square(drawn.filter.initial_pose_std)))
    assert bounds[1] == pytest.approx(np.sqrt(np.mean(P[1:, 0, 0] + P[1:, 1, 1])), rel=1e-12)
    assert bounds[1] > bounds[0]


def test_a_study_hears_a_world_once_for_all_that_filters_assume():
    ways = {"strategies": ("fused",), "filters": ("ekf",)}
    grid = {
        "assumed.wheelbase": (0.15, 0.2),
        "filter.first_pose": ("exact", "drawn"),
        "assumed.speed_of_sound": (335.0, 343.0),
    }
    plan = Plan(name="wrong", iterations=1, config=with_(), grid=grid, **ways)
    assert [len(cases) for cases in heard_together(plan)] == [4, 4]
    records = run_world(plan, 0)
    assert not any("error" in record.row for record in records)
    assert len({record.row["position_rmse_m"] for record in records}) == 8
    expected = {record.case.values["filter.first_pose"]: record.steps[:, 3:] for record in records}
    assert np.unique(expected["drawn"], axis=0).tolist() == [[3.0, 6.0]]
    assert expected["exact"][:, 0].max() < 3.0
