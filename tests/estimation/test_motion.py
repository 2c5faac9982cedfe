from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipistrelle.config import InputError
from pipistrelle.estimation.motion import (
    Motion,
    motion_jacobians,
    motion_noise,
    motion_numbers,
    motion_step,
    propagate_pose,
)
from pipistrelle.estimation.observations.bearing import measurement_jacobians
from pipistrelle.estimation.observations.range import NEAREST
from pipistrelle.geometry import range_and_bearing, wrap
from reference.ekf_slam import moved, noise_of
from reference.odometry import as_motions, by_poses, wandering

BICYCLE = Motion(model="bicycle", control_std=(0.1, 0.03), wheelbase=0.2)
UNICYCLE = Motion(model="unicycle", control_std=(0.1, 0.15))
CAR = Motion(model="ackermann", control_std=(0.1, 0.03), wheelbase=2.8, speed_offset=0.76)
POSES = Motion(model="poses", control_std=(0.02, 0.01, 0.03))

# Central differences with this step: the rounding error is about 10 m * 2e-16 / 1e-5 = 2e-10,
# the truncation error 1e-10 / 6 times third derivatives of at most about 50.
STEP = 1e-5
TOLERANCE = 1e-8

angles = st.floats(-np.pi, np.pi)
lengths = st.floats(-10, 10)
poses = st.tuples(lengths, lengths, angles).map(np.array)
controls = st.tuples(st.floats(-2, 2), st.floats(-1.1, 1.1)).map(np.array)
ways = st.tuples(st.floats(-2, 2), st.floats(-2, 2), st.floats(-1.2, 1.2)).map(np.array)
wheeled = st.tuples(st.sampled_from([BICYCLE, UNICYCLE, CAR]), controls)
steps = wheeled | st.tuples(st.just(POSES), ways)
durations = st.floats(0.01, 0.5)


def differences(function, at, angle_row):
    """Jacobian by central differences; one row of the value is an angle."""
    columns = []
    for unit in np.eye(len(at)):
        change = function(at + STEP * unit) - function(at - STEP * unit)
        change[angle_row] = wrap(change[angle_row])
        columns.append(change / (2 * STEP))
    return np.array(columns).T


@given(steps, poses, durations)
def test_motion_jacobians_are_the_finite_differences_of_the_step(step, pose, dt):
    motion, control = step
    F, U = motion_jacobians(motion, pose, control, dt)
    by_pose = differences(lambda x: motion_step(motion, x, control, dt), pose, 2)
    by_control = differences(lambda u: motion_step(motion, pose, u, dt), control, 2)
    np.testing.assert_allclose(F, by_pose, atol=TOLERANCE)
    np.testing.assert_allclose(U, by_control, atol=TOLERANCE)


@given(st.floats(0.1, 2), st.floats(-1.1, 1.1))
def test_the_wheels_of_a_car_go_about_one_centre(speed, steering):
    # Rear wheels at h to the left and right, the front in the middle: each goes along a circle
    # about the same point on the rear axle's line, as far as the angle of its turn says.
    offset, base = CAR.speed_offset, CAR.wheelbase
    after = motion_step(CAR, np.zeros(3), np.array([speed, steering]), 0.1)
    heading = after[2]
    wheel = after[:2] + offset * np.array([-np.sin(heading), np.cos(heading)]) - [0.0, offset]
    chord = np.hypot(*wheel) / np.sinc(heading / (2 * np.pi))
    assert chord == pytest.approx(speed * 0.1, rel=1e-9)
    if abs(steering) > 1e-3:
        centre = base / np.tan(steering)
        assert np.hypot(after[0], after[1] - centre) == pytest.approx(abs(centre), rel=1e-9)
        assert np.arctan2(base, centre) % np.pi == pytest.approx(steering % np.pi)


@pytest.mark.parametrize(("offset", "fits"), [(1.4, True), (-1.5, False), (np.nan, False)])
def test_a_speed_is_measured_within_the_car(offset, fits):
    told = {"model": "ackermann", "control_std": (0.1, 0.1), "wheelbase": 2.8}
    if fits:
        assert Motion(**told, speed_offset=offset).speed_offset == offset
    else:
        with pytest.raises(InputError, match=r"speed_offset .*half"):
            Motion(**told, speed_offset=offset)


@given(steps, poses, durations)
def test_step_and_jacobians_match_the_slow_reference(step, pose, dt):
    motion, control = step
    after, F, U = moved(motion, pose, control, dt)
    change = motion_step(motion, pose, control, dt) - after
    change[2] = wrap(change[2])
    fast_F, fast_U = motion_jacobians(motion, pose, control, dt)
    np.testing.assert_allclose(change, 0, atol=1e-14 * 20)
    np.testing.assert_allclose(fast_F, F, atol=1e-14)
    np.testing.assert_allclose(fast_U, U, atol=1e-12)


def test_bicycle_step_follows_equation_5():
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


@given(poses, poses, steps, durations)
def test_motion_looks_the_same_from_every_frame(pose, frame, step, dt):
    motion, control = step

    def seen_from(pose):
        c, s = np.cos(frame[2]), np.sin(frame[2])
        xy = np.array([[c, -s], [s, c]]) @ pose[:2] + frame[:2]
        return np.array([*xy, wrap(pose[2] + frame[2])])

    change = motion_step(motion, seen_from(pose), control, dt) - seen_from(
        motion_step(motion, pose, control, dt)
    )
    np.testing.assert_allclose([*change[:2], wrap(change[2])], 0, atol=1e-14 * 40)


@given(steps, poses, durations)
def test_heading_after_a_step_is_wrapped(step, pose, dt):
    motion, control = step
    assert -np.pi <= motion_step(motion, pose, 10 * control, dt)[2] < np.pi


def test_the_motion_since_a_pose_is_forward_then_to_the_left_and_its_length_of_time_is_nothing():
    north = np.array([2.0, 1.0, np.pi / 2])
    for dt in (0.1, 10.0):
        after = motion_step(POSES, north, np.array([3.0, 0.5, 0.25]), dt)
        np.testing.assert_allclose(after, [1.5, 4.0, np.pi / 2 + 0.25], rtol=1e-15)


@given(poses, controls, durations, st.sampled_from([BICYCLE, UNICYCLE, CAR]))
def test_controls_as_relative_motions_lead_to_the_same_pose(pose, control, dt, motion):
    (way,) = as_motions(motion, [control], [dt])
    change = motion_step(by_poses(motion), pose, way, dt) - motion_step(motion, pose, control, dt)
    np.testing.assert_allclose([*change[:2], wrap(change[2])], 0, atol=1e-14 * 20)


@pytest.mark.parametrize("motion", [BICYCLE, UNICYCLE, POSES])
@pytest.mark.parametrize("noise_at_rest", [True, False])
def test_noise_is_the_models_and_zero_at_rest_if_exact(motion, noise_at_rest):
    motion = replace(motion, noise_at_rest=noise_at_rest)
    still = np.zeros(len(motion.control_std))
    moving = [still + unit for unit in np.eye(still.size)]
    for control in (still, *moving):
        exact = not noise_at_rest and control is still
        expected = np.diag(np.square(motion.control_std)) * (not exact)
        np.testing.assert_array_equal(motion_noise(motion, control), expected)
        np.testing.assert_array_equal(noise_of(motion, control), expected)


def test_a_stated_covariance_replaces_the_models():
    told = np.array([0.1, 0.0, 0.2, 4.0, 0.5, -0.3, 2.0, 0.1, 1.0])
    expected = [[4.0, 0.5, -0.3], [0.5, 2.0, 0.1], [-0.3, 0.1, 1.0]]
    np.testing.assert_array_equal(motion_noise(POSES, told), expected)
    told[3:] = np.nan
    np.testing.assert_array_equal(motion_noise(POSES, told), motion_noise(POSES, told[:3]))


def test_a_stated_covariance_counts_at_rest_unless_rest_is_exact():
    still = np.array([0.0, 0.0, 0.0, 4.0, 0.5, -0.3, 2.0, 0.1, 1.0])
    assert motion_noise(POSES, still)[0, 0] == 4.0
    assert not motion_noise(replace(POSES, noise_at_rest=False), still).any()


@pytest.mark.parametrize("stated", [True, False])
@pytest.mark.parametrize("motion", [BICYCLE, UNICYCLE, POSES])
def test_a_pose_and_covariance_are_propagated_by_the_jacobians(motion, stated):
    rng = np.random.default_rng(2)
    drive = wandering(rng, 50, stated=stated)
    drive = drive if motion is POSES else drive[:, :2]
    pose, P, slow = np.array([1.0, -2.0, 3.0]), np.diag([0.04, 0.02, 0.01]), None
    for control in drive:
        F, U = motion_jacobians(motion, pose, control, 0.3)
        slow = F @ P @ F.T + U @ motion_noise(motion, control) @ U.T
        after = motion_step(motion, pose, control, 0.3)
        shift = propagate_pose(pose, P, control, 0.3, motion_numbers(motion))
        np.testing.assert_array_equal(pose, after)
        np.testing.assert_allclose(P, slow, rtol=0, atol=1e-12)
        np.testing.assert_array_equal(P, P.T)
        np.testing.assert_allclose(shift, (F[1, 2], -F[0, 2]), atol=1e-15)
        assert np.linalg.eigvalsh(P)[0] > 0.0


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


def test_measurement_jacobians_are_finite_at_zero_distance():
    for offset in (0.0, NEAREST / 10):
        H_x, H_m = measurement_jacobians(np.zeros(3), np.array([offset, 0.0]))
        assert np.isfinite(H_x).all()
        assert np.isfinite(H_m).all()


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"model": "tracked"}, "found the model 'tracked', expected one of bicycle, unicycle, pos"),
        ({"control_std": (1.0, 1.0, 1.0)}, r"expected 2 numbers from 0 to 1e\+09 for a bicycle"),
        ({"model": "poses"}, "expected 3 numbers"),
        ({"control_std": (1.0, np.nan)}, "found control_std"),
        ({"control_std": (1.0, -1.0)}, "found control_std"),
        ({"control_std": ("a", "b")}, "found control_std"),
        ({"wheelbase": 0.0}, "found wheelbase 0.0"),
    ],
)
def test_a_motion_model_that_is_none_is_refused(given, said):
    with pytest.raises(InputError, match=said):
        Motion(**({"model": "bicycle", "control_std": (0.1, 0.1)} | given))


def test_noise_of_controls_may_be_any_row_of_numbers():
    assert Motion(model="bicycle", control_std=np.array([0.5, 0.25])).control_std == (0.5, 0.25)
