"""The filters and changes of `single_readings` are the package's with nothing changed."""

from types import SimpleNamespace

import numpy as np
import pytest

from pipistrelle.arithmetic.random_stream import stream_key
from pipistrelle.config import Config, FastSlamConfig, RayConfig, ScenarioConfig
from pipistrelle.experiments.hearing.listening import frames_of, listen
from pipistrelle.experiments.hearing.scenario import world_of
from pipistrelle.experiments.named_settings import Case
from pipistrelle.experiments.runs.heard_world import drive_of, scans_of
from pipistrelle.experiments.runs.trial import run_trial
from reference.papers import papers_module

RADIUS = 0.0088
SETTINGS = Config(
    scenario=ScenarioConfig(steps=120),
    fastslam=FastSlamConfig(particles=25),
    rays=RayConfig(range_update="bearing", prune_threshold=1e-3),
)
WORLD = world_of(SETTINGS)
DRIVE = drive_of(WORLD, SETTINGS)


@pytest.fixture(scope="module")
def own():
    names = ("own_ekf", "own_fastslam", "own_hearing", "own_tracks", "single_readings")
    return SimpleNamespace(**{name: papers_module(name) for name in names})


@pytest.fixture(scope="module")
def heard():
    return listen(WORLD, SETTINGS, (RADIUS,))[0]


def followed(own, slam, scans, name):
    rng = np.random.default_rng(stream_key(SETTINGS.seed, 0, name))
    done = own.own_tracks.follow(slam, DRIVE, scans, rng)
    return own.own_tracks.track_of(
        done.path or own.own_tracks.whole(done.before), DRIVE, slam.landmarks()
    )


def assert_is_the_packages(own, slam, heard, strategy, name):
    scans = scans_of(heard, strategy, SETTINGS)
    mine = followed(own, slam, scans, name)
    track = run_trial(Case(strategy=strategy, filter=name), DRIVE, scans, slam.config).track
    np.testing.assert_allclose(mine.pose.mean, track.pose.mean, atol=1e-6)
    np.testing.assert_allclose(mine.pose.covariance, track.pose.covariance, atol=1e-6)
    np.testing.assert_array_equal(*(np.sort(t.landmarks.landmark) for t in (mine, track)))


@pytest.mark.parametrize("strategy", ["fused", "passive"])
def test_the_ekf_with_nothing_changed_is_the_packages(own, heard, strategy):
    assert_is_the_packages(own, own.own_ekf.OwnEkf(SETTINGS, DRIVE.motion), heard, strategy, "ekf")


def test_one_update_of_a_single_measurement_is_the_usual_one(own, heard):
    alone = [scan for scan in scans_of(heard, "active", SETTINGS) if scan.landmark.size == 1]
    tracks = [
        followed(own, own.own_ekf.OwnEkf(SETTINGS, DRIVE.motion, batch=batch), alone, "ekf")
        for batch in (False, True)
    ]
    assert len(alone) > 3
    np.testing.assert_allclose(*(track.pose.mean for track in tracks), atol=1e-9)


RESTART = {"resampled_rays": "restart"}
CHANGES = ({}, {"weights": "sampled"}, RESTART, {**RESTART, "weighed_by": "initialised"})


@pytest.mark.slow  # compiles
@pytest.mark.parametrize("change", CHANGES)
@pytest.mark.parametrize("strategy", ["active", "fused", "passive"])
def test_fastslam_with_nothing_changed_is_the_packages(own, heard, strategy, change):
    config = SETTINGS.model_copy(update={"fastslam": SETTINGS.fastslam.model_copy(update=change)})
    details = own.own_fastslam.Details(
        weight=own.own_fastslam.NONE if "weighed_by" in change else own.own_fastslam.MIXTURE,
        at_sample="weights" in change,
        restart="resampled_rays" in change,
    )
    slam = own.own_fastslam.OwnFastSlam(config, DRIVE.motion, details)
    assert_is_the_packages(own, slam, heard, strategy, "fastslam")
    assert slam.resampled > 0


@pytest.mark.slow
def test_details_of_rays_change_nothing_where_there_are_none(own, heard):
    scans = scans_of(heard, "active", SETTINGS)
    base = None
    for name, details in {"base": own.own_fastslam.PLAIN, **own.single_readings.FASTSLAM}.items():
        slam = own.own_fastslam.OwnFastSlam(SETTINGS, DRIVE.motion, details)
        mine = followed(own, slam, scans, "fastslam").pose.mean
        base = mine if base is None else base
        concerned = name != "base" and own.single_readings._concerns_active("fastslam", name)
        assert np.array_equal(mine, base) != concerned, name


def test_a_plain_mean_of_headings_splits_at_the_wrap(own):
    pose, P = np.zeros((1, 2, 3)), np.zeros((1, 2, 3, 3))
    pose[0, :, 2] = 3.0, -3.0
    swarm = own.own_tracks.Swarm(pose, P, P, np.full((1, 2), 0.5))
    assert abs(own.own_tracks.whole(swarm)[0][0, 2]) == pytest.approx(np.pi)
    mean, covariance = own.own_tracks.plainly(swarm)
    assert (mean[0, 2], covariance[0, 2, 2]) == pytest.approx((0.0, 9.0))


def test_echoes_travel_to_where_the_vehicle_has_got_to(own):
    beams = (RADIUS,), SETTINGS, lambda arrivals, **_: arrivals
    still = next(frames_of(WORLD, *beams)).aimed[0]
    with own.own_hearing.met_moving(WORLD):
        moving = next(frames_of(WORLD, *beams)).aimed[0]
    k, mine = SETTINGS.scenario.steps_per_frame, moving.caller == 0
    target = np.vstack([WORLD.landmarks, WORLD.callers[1].place])[moving.landmark - 1]
    ends = WORLD.path[k], own.own_hearing._pose_at(WORLD, WORLD.time[k] + moving.delay)
    way = sum(np.hypot(*(target - end[..., :2]).T) for end in ends)
    np.testing.assert_allclose(343.0 * moving.delay[mine], way[mine], atol=1e-6)
    assert 1e-5 < np.abs(moving.delay - still.delay).max() < 1e-3
