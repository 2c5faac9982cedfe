"""A session ends where a filter of the whole drive ends, and holds what it began with."""

import numpy as np
import pytest

from pipistrelle.arithmetic.random_stream import stream_key
from pipistrelle.config import Config, FilterConfig, InputError, ScenarioConfig
from pipistrelle.detection.scans import make_scan
from pipistrelle.estimation.beliefs import Gaussian
from pipistrelle.estimation.catalogue import CATALOGUE, entry
from pipistrelle.estimation.motion import Motion
from pipistrelle.estimation.session import Session
from pipistrelle.experiments.runs.trial import run_mission
from reference.missions import map_with

START = Gaussian(mean=np.array([1.0, 2.0, 0.5]), covariance=1e-4 * np.eye(3))
MOTION = Motion(model="unicycle", control_std=(0.1, 0.05))


@pytest.mark.parametrize("name", CATALOGUE)
def test_a_session_that_is_fed_as_a_robot_is_ends_where_the_mission_does(name):
    config = Config(scenario=ScenarioConfig(steps=80), filter=FilterConfig(noise="measured"))
    mission = run_mission(config, ["fused"], [name])
    (trial,), drive = mission.trials, mission.drive
    rng = np.random.default_rng(stream_key(config.seed, 0, name))
    session = Session(entry(name).build(config, drive.motion), drive.start, rng)
    poses, done = [drive.start.mean], 0
    for scan in trial.scans:
        step = int(np.searchsorted(drive.time, scan.time))
        moved = session.move(drive.controls[done:step], np.diff(drive.time[done : step + 1]))
        poses += [*moved.mean]
        assert session.hear(scan) is scan, "used as it is"
        poses[-1] = session.belief.pose().mean
        done = step
    online = trial.track.online or trial.track.pose
    np.testing.assert_array_equal(poses, online.mean[: len(poses)])


def test_a_session_begins_with_the_map_that_is_known():
    post = map_with([7], [[3.0, 4.0]], 0.01 * np.eye(2)[np.newaxis])
    ekf = entry("ekf").build(Config(), MOTION)
    session = Session(ekf, START, np.random.default_rng(7), known=post)
    assert session.belief.landmarks().mean.tolist() == [[3.0, 4.0]]


def test_unusable_inputs_leave_the_session_unchanged():
    session = Session(entry("iekf").build(Config(), MOTION), START, np.random.default_rng(7))
    before = session.belief
    bad = make_scan(0.5, np.array([4]), np.array([np.inf]), bearing_std=0.1)
    with pytest.raises(InputError, match=r"scan at 0\.5 s: found numbers that no filter can use"):
        session.hear(bad)
    assert session.belief is before
    with pytest.raises(InputError, match="predict: found the controls"):
        session.move(np.array([[np.nan, 0.0]]), np.array([0.5]))
    assert session.belief is before
