"""Callers that move: against slow references, by how sure the filters are, and where they are."""

import numpy as np
import pytest

from pipistrelle.config import CallerConfig, Config, FilterConfig, ListeningConfig, ScenarioConfig
from pipistrelle.estimation.beliefs import Gaussian
from pipistrelle.estimation.ekf.filter import (
    EkfSlam,
    InvariantEkfSlam,
    is_velocity,
    propagate_callers,
    velocity_of,
)
from pipistrelle.estimation.motion import Motion
from pipistrelle.experiments.runs.trial import run_mission
from reference.missions import (
    BICYCLE,
    CIRCLE,
    START,
    STEADY,
    SURE,
    beside,
    draw_mission,
    followed,
    paper_filter,
    paper_mission,
    ray_config,
    scattered,
    steady,
)
from reference.roaming import (
    BOAT,
    SlowRoamingEkfSlam,
    SlowRoamingInvariantEkfSlam,
    drift,
    wandering,
    with_boat,
)

KINDS = [EkfSlam, InvariantEkfSlam]
PAIRS = [(EkfSlam, SlowRoamingEkfSlam), (InvariantEkfSlam, SlowRoamingInvariantEkfSlam)]


# Against what is slow


def test_propagation_of_two_callers_and_a_ray_matches_the_exact_solution():
    rng = np.random.default_rng(4)
    landmark = np.array([7, 3, 3, 3, 5, velocity_of(3), 8, velocity_of(7)])
    size = 3 + 2 * landmark.size
    root = rng.normal(size=(size, size))
    mean, P = rng.normal(size=size), root @ root.T
    F, Q = drift(8, {0: 7, 1: 5, 2: 5, 3: 5}, 1.7, 0.3)
    whole, noise = np.eye(size), np.zeros((size, size))
    whole[3:, 3:], noise[3:, 3:] = F, Q
    expected = whole @ P @ whole.T + noise
    went, spread = mean.copy(), P.copy()
    propagate_callers(went, spread, landmark, np.array([0.4, 1.3]), 0.3)
    np.testing.assert_allclose(went, whole @ mean, rtol=0, atol=1e-12)
    np.testing.assert_allclose(spread, expected, rtol=0, atol=1e-11)


def boat_mission(strategy, frames=60):
    rng = np.random.default_rng(8)
    mission = paper_mission(strategy, frames=frames, range_std=0.1, bearing_std=0.05)
    return with_boat(mission, wandering(rng, frames, [6.0, 2.0], 0.5, 0.2), rng, direct=0.8)


@pytest.mark.parametrize(("kind", "reference"), PAIRS)
@pytest.mark.parametrize(
    ("strategy", "frames"),
    [
        ("fused", 30),
        *(pytest.param(*run, marks=pytest.mark.slow) for run in (("fused", 60), ("passive", 120))),
    ],
)
def test_a_run_with_a_caller_that_moves_equals_the_slow_reference(
    kind, reference, strategy, frames
):
    mission = boat_mission(strategy, frames)
    slam = paper_filter(kind, range_std=0.2, bearing_std=0.15)
    slow = reference(BICYCLE, 0.2, 0.15, slam.rays, 1.0)
    slow.excess_path_variance = 0.05**2
    placed = 0
    for belief, *_ in beside(slam, slow, mission):
        np.testing.assert_array_equal(belief.landmark, slow.landmark)
        np.testing.assert_allclose(belief.weight, slow.weight, rtol=0, atol=1e-5)
        points, expected = ~is_velocity(belief.landmark), slow.mean[3:].reshape(-1, 2)
        np.testing.assert_allclose(belief.rows(points).mean, expected[points], rtol=0, atol=1e-4)
        velocity = belief.mean[3:].reshape(-1, 2)[~points]
        np.testing.assert_allclose(velocity, expected[~points], rtol=0, atol=1e-4)
        linear = slow.linear() if hasattr(slow, "linear") else slow.covariance
        np.testing.assert_allclose(belief.pose().covariance, linear[:3, :3], rtol=0, atol=1e-5)
        placed += len(belief.moving().landmark) == 1
    assert placed > min(frames // 2, 30)


# What is told of it


@pytest.mark.parametrize("kind", KINDS)
def test_a_caller_that_moves_is_no_landmark_of_the_map_and_neither_is_its_velocity(kind):
    mission = boat_mission("fused", frames=40)
    slam = paper_filter(kind)
    *_, (belief, _) = followed(slam, mission)
    assert velocity_of(BOAT) in belief.landmark
    assert BOAT not in belief.landmarks().landmark
    assert (belief.landmarks().landmark > 0).all()
    assert belief.moving().landmark.tolist() == [BOAT]


@pytest.mark.parametrize("kind", KINDS)
def test_bearings_of_a_caller_that_moves_are_never_crossed(kind):
    """From a drive along a line, a boat beside it, at the same speed, is always abeam."""
    rng, frames = np.random.default_rng(2), 30
    start = Gaussian(mean=np.zeros(3), covariance=np.eye(3) * 1e-8)
    still = Motion(model="bicycle", control_std=(1e-3, 1e-4), wheelbase=0.2)
    field = {"landmarks": np.array([[500.0, 500.0]]), "beamwidth": 0.0}
    mission = draw_mission(rng, still, start, controls=steady((1.0, 0.0), frames), **field)
    beside = mission.path[1:, :2] + [0.0, 9.0]
    mission = with_boat(mission, beside, rng, bearing_std=1e-3)
    rays = ray_config(precise_bearings="auto")
    slam = paper_filter(kind, motion=still, rays=rays, bearing_std=1e-3)
    beliefs = [belief for belief, _ in followed(slam, mission, start)]
    assert all(len(belief.moving().landmark) > 1 for belief in beliefs), "a ray, and no more"
    assert all((belief.weight >= 0.0).all() for belief in beliefs), "nothing waits to be crossed"


def test_the_invariant_filter_commutes_with_turning_and_shifting_the_mission():
    """Turned by a radian and shifted, the same mission is believed, turned and shifted."""
    mission = boat_mission("fused", frames=40)
    turn, shift = np.array([[np.cos(1), -np.sin(1)], [np.sin(1), np.cos(1)]]), np.array([7.0, -4.0])
    slam = paper_filter(InvariantEkfSlam)
    x, y, heading = START.mean
    M = np.eye(3)
    M[:2, :2] = turn
    start = Gaussian(
        mean=np.array([*(turn @ [x, y] + shift), heading + 1.0]),
        covariance=M @ START.covariance @ M.T,
    )
    *_, (plain, _) = followed(slam, mission)
    *_, (turned, _) = followed(slam, mission, start)
    expected = plain.moving().mean @ turn.T + shift
    np.testing.assert_allclose(turned.moving().mean, expected, rtol=0, atol=1e-8)


# How sure it is


NOISE, WALK_STD = {"range_std": 0.05, "bearing_std": 0.02}, 0.3


@pytest.fixture(scope="module")
def boats():
    """Forty missions of twenty seconds beside a boat, and its last position."""
    drawn = []
    for seed in range(40):
        rng, heard = np.random.default_rng([5, seed]), {"beamwidth": np.pi, "hearing": 30.0}
        field, drive = scattered(rng, 12, radius=12.0), steady(CIRCLE, 40)
        mission = draw_mission(rng, STEADY, SURE, field, drive, **heard, **NOISE)
        path = wandering(rng, 40, [5.0, 3.0], 0.5, WALK_STD)
        timing = {"bearing_std": 0.02, "excess_path_std": 0.1, "direct": 0.5}
        drawn.append((with_boat(mission, path, rng, **timing), path[-1]))
    return drawn


def caller_nees(kind, boats, told):
    """Mean NEES of a boat's last position, its walk told as a factor of itself."""
    nees, rays = [], ray_config(exponent=8.0, prune_threshold=1e-9)
    walk = {"speed_std": 0.5, "walk_std": told * WALK_STD}
    slam = paper_filter(kind, motion=STEADY, rays=rays, **walk, **NOISE)
    for mission, place in boats:
        *_, (belief, _) = followed(slam, mission, SURE)
        boat = belief.moving()
        off = boat.mean[0] - place
        nees.append(off @ np.linalg.solve(boat.covariance[0], off))
    return np.mean(nees)


@pytest.mark.parametrize("kind", KINDS)
def test_a_tracked_caller_is_consistent_unless_its_walk_is_understated(kind, boats):
    assert 1.2 < caller_nees(kind, boats, 1.0) < 3.0, "2, with the chance of 40 draws"
    assert caller_nees(kind, boats, 1 / 30) > 5.0


# In sound

SAILING = Config(
    callers=(CallerConfig(course="circle", radius=10.0, speed=0.75),),
    scenario=ScenarioConfig(steps=600),
    listening=ListeningConfig(excess_paths=True),
)


def test_a_caller_that_circles_is_followed_by_its_sound():
    done = run_mission(SAILING, ["fused", "passive"], ["iekf", "fastslam"])
    for trial in done.trials:
        if trial.filter == "fastslam":
            assert not trial.track.callers, "it knows of what stands alone"
            continue
        (label,) = trial.track.callers
        true, found = done.drive.truth.callers[label], trial.track.callers[label]
        known = np.isfinite(found.mean[:, 0])
        assert known.sum() > 0.8 * len(trial.scans)
        error = np.hypot(*(found.mean - true)[known].T)
        assert np.sqrt(np.mean(error**2)) == pytest.approx(trial.scores.caller_rmse_m)
        assert trial.scores.caller_rmse_aligned_m < trial.scores.caller_rmse_m < 1.0
        assert label not in trial.track.landmarks.landmark


def test_a_moving_caller_is_ignored_without_timing():
    deaf = SAILING.model_copy(update={"listening": ListeningConfig(excess_paths=False)})
    strays = deaf.model_copy(update={"filter": FilterConfig(caller_walk_std=9.0)})
    one, other = (run_mission(config, ["fused"], ["iekf"]).trials[0] for config in (deaf, strays))
    assert not one.track.callers
    assert one.scores.caller_rmse_m is None
    assert one.scores == other.scores
    assert one.track.pose.mean.tobytes() == other.track.pose.mean.tobytes()
