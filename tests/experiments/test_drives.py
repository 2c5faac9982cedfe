"""Drives whose steps are split where something is heard between their ends."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipistrelle.detection.scans import make_scan
from pipistrelle.estimation.beliefs import Gaussian
from pipistrelle.estimation.catalogue import entry
from pipistrelle.estimation.motion import Motion, motion_step
from pipistrelle.experiments.drives import Drive, Truth, at_sensor, at_vehicle, carried, split_at
from pipistrelle.experiments.named_settings import Case
from pipistrelle.experiments.runs.trial import run_trial
from pipistrelle.settings import from_flags, resolve
from reference.missions import scan_with

MOTIONS = [
    Motion(model="bicycle", control_std=(0.1, 0.03), wheelbase=0.2),
    Motion(model="unicycle", control_std=(0.1, 0.2)),
    Motion(model="poses", control_std=(0.02, 0.01, 0.03)),
    Motion(model="ackermann", control_std=(0.1, 0.03), wheelbase=1.0, speed_offset=0.3),
]


def driven(motion, steps=12, seed=7):
    """Return a drive with its true path, which no noise disturbs."""
    rng = np.random.default_rng(seed)
    controls = rng.uniform(0.2, 1.0, (steps, len(motion.control_std)))
    time = np.append(0.0, rng.uniform(0.05, 0.3, steps).cumsum())
    path = np.zeros((steps + 1, 3))
    for k in range(steps):
        path[k + 1] = motion_step(motion, path[k], controls[k], time[k + 1] - time[k])
    start = Gaussian(mean=np.zeros(3), covariance=np.diag([0.01, 0.01, 0.001]))
    truth = Truth(time=time, path=path)
    return Drive(motion=motion, start=start, time=time, controls=controls, truth=truth)


@pytest.mark.parametrize("motion", MOTIONS, ids=lambda motion: motion.model)
@given(times=st.lists(st.floats(0.001, 1.5), min_size=1, max_size=6))
def test_split_steps_follow_the_true_path(motion, times):
    drive = driven(motion)
    fine, steps = split_at(drive, times)
    assert np.array_equal(fine.time[steps], drive.time)
    pose, poses = np.zeros(3), [np.zeros(3)]
    for control, dt in zip(fine.controls, np.diff(fine.time), strict=True):
        pose = motion_step(fine.motion, pose, control, dt)
        poses.append(pose)
    np.testing.assert_allclose(np.array(poses)[steps], drive.truth.path, atol=1e-12)
    np.testing.assert_allclose(poses, fine.truth.path, atol=1e-12)


@pytest.mark.parametrize("motion", MOTIONS, ids=lambda motion: motion.model)
def test_the_parts_of_a_step_are_together_about_as_uncertain_as_the_step(motion):
    drive = driven(motion)
    fine, steps = split_at(drive, 0.5 * (drive.time[1:] + drive.time[:-1]))
    estimator, rng = entry("ekf"), np.random.default_rng(7)
    config = resolve({})
    whole, parted = (
        estimator.build(config, one.motion).predict(
            estimator.build(config, one.motion).init(drive.start),
            one.controls,
            np.diff(one.time),
            rng,
        )[1]
        for one in (drive, fine)
    )
    np.testing.assert_allclose(parted.mean[steps[1:] - 1], whole.mean, atol=1e-12)
    deviation = np.sqrt(
        np.array([whole.covariance[-1].diagonal(), parted.covariance[-1].diagonal()])
    )
    np.testing.assert_allclose(deviation[0], deviation[1], rtol=0.02)


def test_a_drive_with_scans_at_step_ends_is_unchanged():
    drive = driven(MOTIONS[0])
    same, steps = split_at(drive, drive.time[[2, 5]])
    assert same is drive
    assert steps.tolist() == list(range(13))


@pytest.mark.parametrize("name", ["ekf", "iekf", "fastslam", "smoother"])
def test_every_estimator_hears_between_the_steps_and_tracks_at_their_ends(name):
    drive = driven(MOTIONS[0], steps=40)
    scans, config = [], resolve(from_flags({"fastslam": {"particles": 50}}))
    for k in range(1, 39):
        time = 0.3 * drive.time[k] + 0.7 * drive.time[k + 1]
        fine, _ = split_at(drive, [time])
        x, y, heading = fine.truth.path[np.searchsorted(fine.time, time)]
        away = np.array([[3.0, 1.0], [-2.0, 4.0]]) - [x, y]
        scans.append(
            make_scan(
                time,
                np.array([4, 9]),
                np.arctan2(away[:, 1], away[:, 0]) - heading,
                range=np.hypot(*away.T),
                bearing_std=0.01,
                range_std=0.02,
            )
        )
    trial = run_trial(Case(strategy="active", filter=name), drive, scans, config)
    assert np.array_equal(trial.track.time, drive.time)
    off = trial.track.pose.mean - drive.truth.path
    assert np.hypot(*off[:, :2].T).max() < 0.2
    assert trial.track.landmarks.landmark.tolist() == [4, 9]


SENSOR = (0.7, -0.3, 0.4)


def composed(pose, place):
    """Return where a place in the axes of a pose is, by complex numbers."""
    turn = np.exp(1j * pose[2])
    z = complex(*pose[:2]) + turn * complex(*place[:2])
    return np.array([z.real, z.imag, np.angle(turn * np.exp(1j * place[2]))])


@pytest.mark.parametrize("motion", MOTIONS, ids=lambda motion: motion.model)
def test_a_sensor_goes_where_the_vehicle_carries_it(motion):
    drive = replace(driven(motion), sensor=SENSOR)
    there = at_sensor(drive)
    pose = there.start.mean
    for k, (control, dt) in enumerate(zip(there.controls, np.diff(drive.time), strict=True)):
        np.testing.assert_allclose(pose, composed(drive.truth.path[k], SENSOR), atol=1e-12)
        pose = motion_step(there.motion, pose, control, dt)
    np.testing.assert_allclose(pose, composed(drive.truth.path[-1], SENSOR), atol=1e-12)


@pytest.mark.parametrize("motion", MOTIONS, ids=lambda motion: motion.model)
def test_a_sensor_is_as_uncertain_as_the_vehicle_makes_it(motion):
    # The vehicle's covariance, carried to the sensor, is that of the sensor's own drive: to first
    # order both are the same linear map of the same noise.
    drive = replace(driven(motion), sensor=SENSOR)
    config, estimator = resolve({}), entry("ekf")

    def ends(one):
        built = estimator.build(config, one.motion)
        begun = built.init(one.start)
        return built.predict(begun, one.controls, np.diff(one.time), np.random.default_rng(1))[1]

    whole, there = carried(ends(drive), SENSOR), ends(at_sensor(drive))
    np.testing.assert_allclose(there.mean, whole.mean, atol=1e-12)
    np.testing.assert_allclose(there.covariance, whole.covariance, atol=1e-12)


def test_covariances_are_carried_by_the_slopes_of_the_pose():
    rng = np.random.default_rng(3)
    pose, root = np.array([1.0, -2.0, 2.5]), rng.normal(size=(3, 3))
    slopes = np.column_stack(
        [(composed(pose + h, SENSOR) - composed(pose - h, SENSOR)) / 2e-6 for h in 1e-6 * np.eye(3)]
    )
    found = carried(Gaussian(mean=pose, covariance=root @ root.T), SENSOR)
    np.testing.assert_allclose(found.covariance, slopes @ root @ root.T @ slopes.T, rtol=1e-8)


FOUR = ("ekf", "iekf", "fastslam", "smoother")
POSTS = np.array([[2.0, 3.0], [6.0, -2.0], [9.0, 4.0], [5.0, 7.0], [-2.0, 2.0], [1.0, -3.0]])


def seen_from(sensor, seed=5):
    """Return a drive of a car with a sensor, exact but for a little noise, and its scans."""
    rng = np.random.default_rng(seed)
    motion = Motion(model="ackermann", control_std=(0.1, 0.02), wheelbase=1.0, speed_offset=0.3)
    time, path = 0.25 * np.arange(161.0), [np.zeros(3)]
    told = np.column_stack((np.full(160, 0.8), 0.22 + 0.1 * np.sin(time[1:])))
    done = told + rng.normal(size=told.shape) * motion.control_std
    scans = []
    for control in done:
        path.append(motion_step(motion, path[-1], control, 0.25))
        eye = composed(path[-1], sensor)
        way = (POSTS - eye[:2]) @ [1, 1j] * np.exp(-1j * eye[2])
        near = np.abs(np.angle(way)) < 1.4
        stds = {"range_std": 0.03, "bearing_std": 0.01}
        scans.append(
            scan_with(
                np.flatnonzero(near),
                np.angle(way[near]) + rng.normal(0, 0.01, near.sum()),
                np.abs(way[near]) + rng.normal(0, 0.03, near.sum()),
                time=time[len(scans) + 1],
                **stds,
            )
        )
    start = Gaussian(mean=np.zeros(3), covariance=1e-6 * np.eye(3))
    truth = Truth(time=time, path=np.array(path), landmarks=(np.arange(len(POSTS)), POSTS))
    return Drive(
        motion=motion, start=start, time=time, controls=told, truth=truth, sensor=sensor
    ), scans


@pytest.mark.parametrize("name", FOUR)
def test_a_sensor_aside_of_a_car_finds_track_and_map(name):
    drive, scans = seen_from((1.2, 0.4, 0.3))
    config = resolve(from_flags({"fastslam": {"particles": 60}}))
    case = Case(strategy="fused", filter=name)
    right = run_trial(case, drive, scans, config)
    assert right.scores.position_rmse_aligned_m < 0.1
    assert right.scores.map_rmse_aligned_m < 0.1
    wrong = run_trial(case, replace(drive, sensor=(0.0, 0.0, 0.0)), scans, config)
    assert wrong.scores.position_rmse_aligned_m > 3.0 * right.scores.position_rmse_aligned_m


def test_a_track_is_the_vehicles_again_and_a_sensor_at_home_changes_no_bit():
    drive, scans = seen_from((1.2, 0.4, 0.3))
    track = run_trial(Case(strategy="fused", filter="smoother"), drive, scans, resolve({})).track
    there = replace(track, pose=carried(track.pose, drive.sensor), online=None)
    back = at_vehicle(there, drive.sensor)
    np.testing.assert_allclose(back.pose.mean, track.pose.mean, atol=1e-12)
    np.testing.assert_allclose(back.pose.covariance, track.pose.covariance, atol=1e-12)
    assert at_vehicle(track, (0.0, 0.0, 0.0)) is track
    home = replace(drive, sensor=(0.0, 0.0, 0.0))
    assert at_sensor(home) is home
