import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipistrelle.estimation.measurement import NEAREST, measurement_jacobians
from pipistrelle.estimation.motion import Motion, motion_jacobians, motion_step
from pipistrelle.geometry import range_and_bearing, wrap
from reference.ekf_slam import moved

BICYCLE = Motion(model="bicycle", control_std=(0.1, 0.03), wheelbase=0.2)
UNICYCLE = Motion(model="unicycle", control_std=(0.1, 0.15))

# Central differences with this step: the rounding error is about 10 m * 2e-16 / 1e-5 = 2e-10,
# the truncation error 1e-10 / 6 times third derivatives of at most about 50.
STEP = 1e-5
TOLERANCE = 1e-8

models = st.sampled_from([BICYCLE, UNICYCLE])
angles = st.floats(-np.pi, np.pi)
lengths = st.floats(-10, 10)
poses = st.tuples(lengths, lengths, angles).map(np.array)
controls = st.tuples(st.floats(-2, 2), st.floats(-1.2, 1.2)).map(np.array)
durations = st.floats(0.01, 0.5)


def differences(function, at, angle_row):
    """Jacobian by central differences; one row of the value is an angle."""
    columns = []
    for unit in np.eye(len(at)):
        change = function(at + STEP * unit) - function(at - STEP * unit)
        change[angle_row] = wrap(change[angle_row])
        columns.append(change / (2 * STEP))
    return np.array(columns).T


@given(models, poses, controls, durations)
def test_motion_jacobians_are_the_finite_differences_of_the_step(motion, pose, control, dt):
    F, U = motion_jacobians(motion, pose, control, dt)
    by_pose = differences(lambda x: motion_step(motion, x, control, dt), pose, 2)
    by_control = differences(lambda u: motion_step(motion, pose, u, dt), control, 2)
    np.testing.assert_allclose(F, by_pose, atol=TOLERANCE)
    np.testing.assert_allclose(U, by_control, atol=TOLERANCE)


@given(models, poses, controls, durations)
def test_step_and_jacobians_equal_those_of_the_slow_reference(motion, pose, control, dt):
    after, F, U = moved(motion, pose, control, dt)
    change = motion_step(motion, pose, control, dt) - after
    change[2] = wrap(change[2])
    fast_F, fast_U = motion_jacobians(motion, pose, control, dt)
    np.testing.assert_allclose(change, 0, atol=1e-14 * 20)
    np.testing.assert_allclose(fast_F, F, atol=1e-14)
    np.testing.assert_allclose(fast_U, U, atol=1e-12)


def test_bicycle_step_is_that_of_equation_5():
    pose, (V, gamma), dt = np.array([1.0, 2.0, 0.5]), (0.75, 0.027), 0.125
    x = 1.0 + V * dt * np.cos(0.527)
    y = 2.0 + V * dt * np.sin(0.527)
    heading = 0.5 + V * dt / 0.2 * np.sin(gamma)
    after = motion_step(BICYCLE, pose, np.array([V, gamma]), dt)
    np.testing.assert_allclose(after, [x, y, heading], rtol=1e-15)


@given(poses, controls, durations)
def test_two_halves_of_a_unicycle_step_make_the_whole_step(pose, control, dt):
    half = motion_step(UNICYCLE, motion_step(UNICYCLE, pose, control, dt / 2), control, dt / 2)
    change = half - motion_step(UNICYCLE, pose, control, dt)
    np.testing.assert_allclose([*change[:2], wrap(change[2])], 0, atol=1e-14 * 20)


@pytest.mark.parametrize("side", [-1, 1])
def test_unicycle_is_smooth_where_its_series_takes_over(side):
    pose, dt = np.array([0.0, 0.0, 0.3]), 0.5
    seam = 2 * 1e-4 / dt * side
    below, above = (
        np.hstack(motion_jacobians(UNICYCLE, pose, np.array([2.0, seam * factor]), dt))
        for factor in (1 - 1e-9, 1 + 1e-9)
    )
    # The derivative of U times the move, 2e-9 * 4e-4, and eps / 1e-4 in the difference quotient.
    np.testing.assert_allclose(above, below, rtol=0, atol=1e-11)


@given(poses, poses, controls, durations, models)
def test_motion_looks_the_same_from_every_frame(pose, frame, control, dt, motion):
    def seen_from(pose):
        c, s = np.cos(frame[2]), np.sin(frame[2])
        xy = np.array([[c, -s], [s, c]]) @ pose[:2] + frame[:2]
        return np.array([*xy, wrap(pose[2] + frame[2])])

    change = motion_step(motion, seen_from(pose), control, dt) - seen_from(
        motion_step(motion, pose, control, dt)
    )
    np.testing.assert_allclose([*change[:2], wrap(change[2])], 0, atol=1e-14 * 40)


@given(models, poses, controls, durations)
def test_heading_after_a_step_is_wrapped(motion, pose, control, dt):
    assert -np.pi <= motion_step(motion, pose, 10 * control, dt)[2] < np.pi


@given(poses, st.floats(0.5, 30), angles)
def test_measurement_jacobians_are_the_finite_differences_of_the_measurement(
    pose, distance, direction
):
    point = pose[:2] + distance * np.array([np.cos(direction), np.sin(direction)])

    def measured(pose, point):
        return np.concatenate(range_and_bearing(pose, point[None]))

    H_x, H_m = measurement_jacobians(pose, point)
    by_pose = differences(lambda x: measured(x, point), pose, 1)
    by_point = differences(lambda m: measured(pose, m), point, 1)
    np.testing.assert_allclose(H_x, by_pose, atol=TOLERANCE)
    np.testing.assert_allclose(H_m, by_point, atol=TOLERANCE)


def test_measurement_jacobians_are_finite_at_a_landmark_that_the_vehicle_stands_on():
    for offset in (0.0, NEAREST / 10):
        H_x, H_m = measurement_jacobians(np.zeros(3), np.array([offset, 0.0]))
        assert np.isfinite(H_x).all()
        assert np.isfinite(H_m).all()
