"""Drives whose steps are split where something is heard between their ends."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipistrelle.detection.scans import make_scan
from pipistrelle.estimation.beliefs import Gaussian
from pipistrelle.estimation.catalogue import entry
from pipistrelle.estimation.motion import Motion, motion_step
from pipistrelle.experiments.cases import Case
from pipistrelle.experiments.drives import Drive, Truth, split_at
from pipistrelle.experiments.runs.trial import run_trial
from pipistrelle.settings import from_flags, resolve

MOTIONS = [
    Motion(model="bicycle", control_std=(0.1, 0.03), wheelbase=0.2),
    Motion(model="unicycle", control_std=(0.1, 0.2)),
    Motion(model="poses", control_std=(0.02, 0.01, 0.03)),
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
def test_the_parts_of_steps_lead_where_the_steps_do_along_the_true_path(motion, times):
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


def test_a_drive_is_as_it_was_where_all_is_heard_at_the_end_of_a_step():
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
