"""Courses: drivers keep their line, poses are followed to the bit, controls are what led there."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipistrelle.config import InputError, ScenarioConfig
from pipistrelle.estimation.motion import Motion, controls_between, motion_step
from pipistrelle.experiments.hearing.trajectories import (
    LOOK_AHEAD,
    MAX_STEERING,
    Commands,
    Poses,
    course_of,
    driven,
    steps_of,
)
from pipistrelle.geometry import wrap

BICYCLE = Motion(model="bicycle", control_std=(0.1, 0.03), wheelbase=0.2)
UNICYCLE = Motion(model="unicycle", control_std=(0.1, 0.1), wheelbase=0.2)
MODELS = [BICYCLE, UNICYCLE]
SHAPES = ["eight", "corridor", "lawn-mower"]


def drive(way, motion, seed=7, **settings):
    setup = ScenarioConfig(**settings)
    if way is None:
        way = course_of(setup, motion)
    return driven(way, setup, motion, np.random.default_rng(seed))


def off_line(path, points):
    """Distance of each place from the closed line through points."""
    ends = np.roll(points, -1, axis=0)
    along = ends - points
    share = ((path[:, None] - points) * along).sum(-1) / (along**2).sum(-1)
    feet = points + np.clip(share, 0.0, 1.0)[..., None] * along
    return np.hypot(*(path[:, None] - feet).transpose(2, 0, 1)).min(axis=1)


@pytest.mark.parametrize("motion", MODELS, ids=lambda m: m.model)
@pytest.mark.parametrize("shape", SHAPES)
def test_a_driver_keeps_near_the_line_whatever_the_noise(shape, motion):
    points = course_of(ScenarioConfig(course=shape), motion)
    for seed in range(3):
        path, controls = drive(None, motion, seed, course=shape, steps=1500)
        assert off_line(path[:, :2], points).max() < LOOK_AHEAD
        assert np.hypot(*np.diff(path[:, :2], axis=0).T).sum() == pytest.approx(140.6, rel=0.03)
        assert np.all(controls[:, 0] == 0.75)
    # A vehicle that drives blindly is soon elsewhere.
    blind = Commands(
        time=np.append(np.arange(1500) * 0.125, 187.5), rows=np.vstack((controls, [0, 0]))
    )
    lost, _ = drive(blind, motion, 9, start=tuple(path[0]))
    assert off_line(lost[:, :2], points).max() > 3.0 * LOOK_AHEAD


def test_a_front_wheel_turns_no_further_than_its_lock():
    to_and_fro = np.array([[0.0, 0.0], [5.0, 0.0]])
    path, controls = drive(to_and_fro, BICYCLE, steps=200)
    assert np.abs(controls[:, 1]).max() == MAX_STEERING
    assert off_line(path[:, :2], to_and_fro).max() < LOOK_AHEAD


@pytest.mark.parametrize("motion", MODELS, ids=lambda m: m.model)
def test_controls_without_noise_lead_along_the_path(motion):
    still = Motion(model=motion.model, control_std=(0.0, 0.0), wheelbase=0.2)
    path, controls = drive(None, still, course="eight", steps=300)
    for k, control in enumerate(controls):
        np.testing.assert_array_equal(motion_step(still, path[k], control, 0.125), path[k + 1])


def test_a_unicycles_circle_is_the_bicycles():
    still = [Motion(model=m.model, control_std=(0.0, 0.0), wheelbase=0.2) for m in MODELS]
    turned = [np.diff(np.unwrap(drive(None, motion)[0][:, 2])) for motion in still]
    np.testing.assert_allclose(turned[0], turned[1], rtol=1e-9)


@pytest.mark.parametrize("motion", MODELS, ids=lambda m: m.model)
@given(
    speed=st.floats(0.05, 3.0),
    turn=st.floats(-0.7, 0.7),
    heading=st.floats(-math.pi, math.pi),
    backwards=st.booleans(),
)
def test_controls_between_two_poses_invert_the_motion_step(motion, speed, turn, heading, backwards):
    control = np.array([-speed if backwards else speed, turn])
    start = np.array([1.0, -2.0, heading])
    path = np.array([start, motion_step(motion, start, control, 0.125)])
    np.testing.assert_allclose(controls_between(path, 0.125, motion)[0], control, atol=1e-9)


def test_given_poses_are_followed_to_the_bit_with_noisy_controls():
    path, controls = drive(None, BICYCLE, steps=200)
    time = np.arange(201) * 0.125
    again, told = drive(Poses(time=time, path=path), BICYCLE, 3, steps=200)
    assert again.tobytes() == path.tobytes()
    off = controls_between(path, 0.125, BICYCLE) - told
    assert off.std(axis=0) == pytest.approx([0.1, 0.03], rel=0.15)
    commands = Commands(time=time, rows=np.vstack((controls, np.zeros(2))))
    again, told = drive(Poses(time=time, path=path, commands=commands), BICYCLE, 3, steps=200)
    assert again.tobytes() == path.tobytes()
    assert told.tobytes() == controls.tobytes()


def test_poses_at_other_times_are_interpolated_the_short_way_round():
    course = Poses(time=np.array([0.0, 1.0]), path=np.array([[0.0, 0, 3.0], [1.0, 0, -3.0]]))
    path, _ = drive(course, UNICYCLE, steps=8)
    half = wrap(3.0 + 0.5 * wrap(np.array([-6.0]))[0])
    np.testing.assert_allclose(path[4], [0.5, 0.0, half], atol=1e-12)


def test_commands_hold_until_the_next_and_the_last_only_ends():
    still = Motion(model="unicycle", control_std=(0.0, 0.0))
    rows = np.array([[1.0, 0.0], [2.0, 0.0], [9.0, 9.0]])
    course = Commands(time=np.array([0.0, 0.25, 0.5]), rows=rows)
    assert steps_of(course, ScenarioConfig()) == 4
    path, controls = drive(course, still, steps=4, start=(0.0, 0.0, 0.0))
    assert controls[:, 0].tolist() == [1.0, 1.0, 2.0, 2.0]
    np.testing.assert_allclose(path[-1], [0.75, 0.0, 0.0])


def test_a_time_that_is_a_steps_but_for_rounding_is_the_steps():
    still = Motion(model="unicycle", control_std=(0.0, 0.0))
    rows = np.array([[1.0, 0.0], [2.0, 0.0], [9.0, 9.0]])
    course = Commands(time=np.array([0.0, 0.1 + 1e-9, 0.3]), rows=rows)
    assert steps_of(course, ScenarioConfig(step=0.1)) == 3
    _, controls = drive(course, still, steps=3, step=0.1)
    assert controls[:, 0].tolist() == [1.0, 2.0, 2.0]
    line = np.array([[0.0, 0.0], [0.1 + 0.2, 0.0]])
    assert 0.3 / 0.1 < 3.0 < (0.1 + 0.2) / 0.1
    assert steps_of(line, ScenarioConfig(step=0.1, speed=1.0)) == 3


@pytest.mark.parametrize("more", [1, 100])
def test_a_drive_longer_than_its_course_is_refused(more):
    course = Commands(time=np.array([0.0, 0.5]), rows=np.zeros((2, 2)))
    with pytest.raises(InputError, match=f"found {4 + more}, but the path of .* ends after 4 "):
        drive(course, BICYCLE, steps=4 + more)


@pytest.mark.parametrize("speed", [0.0, -0.75])
def test_way_points_need_a_speed(speed):
    points = np.array([[0.0, 0.0], [1.0, 0.0]])
    with pytest.raises(InputError, match=r"scenario\.speed: found"):
        drive(points, BICYCLE, speed=speed)
    with pytest.raises(InputError, match=r"scenario\.speed: found"):
        steps_of(points, ScenarioConfig(speed=speed))


def test_way_points_all_within_the_drivers_reach_are_circled_for_ever():
    points = np.array([[0.0, 0.0], [0.3, 0.0], [0.0, 0.3]])
    path, _ = drive(points, BICYCLE, steps=400)
    assert np.isfinite(path).all()
    assert np.hypot(*path[:, :2].T).max() < 3.0 * LOOK_AHEAD
