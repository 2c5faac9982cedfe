"""Legs: poses between two that are known better."""

import numpy as np
import pytest

from pipistrelle.estimation.beliefs import Gaussian
from pipistrelle.estimation.motion import SMALLEST_STD, Motion
from pipistrelle.estimation.smoother.preintegration import (
    extended,
    no_odometry,
    placed,
    poses_between,
)
from pipistrelle.geometry import wrap
from reference.ekf_slam import moved
from reference.factor_graph import turned
from reference.missions import BICYCLE, CIRCLE, STEP
from reference.odometry import as_motions, by_poses


def leg_of(motion, controls, dt, before=None):
    """The odometry of control steps."""
    none = np.empty(0, np.int64)
    return extended(before or no_odometry(), motion, np.array(controls, float), dt, none)


def between(ends, joint, leg):
    """The poses after each step of a leg, when those at both ends are known."""
    noise = np.stack([np.zeros((3, 3)), leg.covariance[-1] + SMALLEST_STD**2 * np.eye(3)])
    rows = np.zeros((2, 2), np.int64)
    legs = np.stack([np.zeros(3), leg.mean[-1]]), noise, np.zeros(2), rows
    legs = *legs, np.zeros((2, 3, 0)), 0
    count = np.array([[0, 0], [0, len(leg.mean)]])
    nodes = ends.copy(), np.stack([joint[:3, :3], joint[3:, 3:]])
    cross = np.stack([np.zeros((3, 3)), joint[3:, :3]])
    mean, covariance = poses_between(legs, count, (leg.mean, leg.covariance), nodes, cross)
    return Gaussian(mean=mean[1:], covariance=covariance[1:])


STEPS = 6
LEG = leg_of(BICYCLE, np.tile([CIRCLE[0], 0.2], (STEPS, 1)), np.full(STEPS, STEP))
A = Gaussian(mean=np.array([2.0, -1.0, 2.5]), covariance=np.diag([0.04, 0.02, 0.01]))


def predicted_joint(start, leg):
    """Return the poses at both ends and their covariance as the controls alone have them."""
    steps = placed(start, leg)
    dx, dy = steps.mean[-1, :2] - start.mean[:2]
    F = np.array([[1.0, 0.0, -dy], [0.0, 1.0, dx], [0.0, 0.0, 1.0]])
    M = turned(start.mean[2])
    P = start.covariance
    own = M @ (leg.covariance[-1] + SMALLEST_STD**2 * np.eye(3)) @ M.T
    ends = np.array([start.mean, steps.mean[-1]])
    return ends, np.block([[P, P @ F.T], [F @ P, F @ P @ F.T + own]])


def test_a_leg_step_by_step_is_the_slow_references_prediction():
    pose, P = np.zeros(3), np.zeros((3, 3))
    for k in range(STEPS):
        pose, F, U = moved(BICYCLE, pose, (CIRCLE[0], 0.2), STEP)
        P = F @ P @ F.T + U @ np.diag(np.square(BICYCLE.control_std)) @ U.T
        np.testing.assert_allclose(LEG.mean[k], pose, rtol=0, atol=1e-12)
        np.testing.assert_allclose(LEG.covariance[k], P, rtol=0, atol=1e-14)


def test_a_leg_made_longer_is_the_leg_made_at_once():
    one = leg_of(BICYCLE, np.tile([CIRCLE[0], 0.2], (2, 1)), np.full(2, STEP))
    rest = np.tile([CIRCLE[0], 0.2], (STEPS - 2, 1))
    both = leg_of(BICYCLE, rest, np.full(STEPS - 2, STEP), one)
    np.testing.assert_array_equal(both.mean, LEG.mean)
    np.testing.assert_array_equal(both.covariance, LEG.covariance)


def test_a_leg_by_poses_is_the_leg_of_the_controls_that_led_there():
    controls, dt = np.tile([CIRCLE[0], 0.2], (STEPS, 1)), np.full(STEPS, STEP)
    told = leg_of(by_poses(BICYCLE), as_motions(BICYCLE, controls, dt), dt)
    np.testing.assert_allclose(told.mean, LEG.mean, rtol=0, atol=1e-14)
    np.testing.assert_allclose(told.covariance, LEG.covariance, rtol=0, atol=1e-16)


def test_ends_as_the_controls_have_them_leave_the_prediction():
    ends, joint = predicted_joint(A, LEG)
    told, steps = between(ends, joint, LEG), placed(A, LEG)
    np.testing.assert_allclose(told.mean, steps.mean, rtol=0, atol=1e-12)
    np.testing.assert_allclose(told.covariance, steps.covariance, rtol=0, atol=2e-12)


def test_a_known_end_is_met_and_earlier_steps_move_less():
    ends, _ = predicted_joint(A, LEG)
    off = np.array([0.01, -0.02, 0.03])
    told = between(np.array([ends[0], ends[1] + off]), np.zeros((6, 6)), LEG)
    np.testing.assert_array_equal(told.mean[-1], ends[1] + off)
    np.testing.assert_array_equal(told.covariance[-1], np.zeros((3, 3)))
    drift = np.hypot(*(told.mean - placed(A, LEG).mean)[:, :2].T)
    assert (np.diff(drift) > 0.0).all()
    spread = np.linalg.eigvalsh(told.covariance)[:, -1]
    assert (spread[:-1] > 0.0).all()


def test_the_end_of_a_leg_is_met_across_the_turn_of_half_a_circle():
    ends, _ = predicted_joint(A, LEG)
    for turns in (-1, 1):
        other = ends + np.array([[0.0] * 3, [0.0, 0.0, 2.0 * np.pi * turns]])
        told = between(other, np.zeros((6, 6)), LEG)
        np.testing.assert_allclose(told.mean[:-1], between(ends, np.zeros((6, 6)), LEG).mean[:-1])
        assert wrap(told.mean[-1, 2] - ends[1, 2]) == pytest.approx(0.0, abs=1e-12)


def test_covariances_are_symmetric_and_never_more_than_the_predictions():
    ends, joint = predicted_joint(A, LEG)
    rng, steps = np.random.default_rng(3), placed(A, LEG)
    for _ in range(20):
        H = rng.normal(size=(rng.integers(1, 5), 6))
        S = H @ joint @ H.T + rng.uniform(1e-6, 1.0) * np.eye(len(H))
        less = joint - joint @ H.T @ np.linalg.solve(S, H @ joint)
        told = between(ends, (less + less.T) / 2, LEG)
        np.testing.assert_array_equal(told.covariance, np.swapaxes(told.covariance, 1, 2))
        assert np.linalg.eigvalsh(told.covariance).min() > -1e-12
        assert np.linalg.eigvalsh(steps.covariance - told.covariance).min() > -3e-12


def test_a_leg_without_noise_is_itself_between_any_ends():
    exact = Motion(model="bicycle", control_std=(0.0, 0.0), wheelbase=0.2)
    leg = leg_of(exact, np.tile([CIRCLE[0], 0.2], (STEPS, 1)), np.full(STEPS, STEP))
    ends, joint = predicted_joint(A, leg)
    told, steps = between(ends, joint, leg), placed(A, leg)
    np.testing.assert_allclose(told.mean, steps.mean, rtol=0, atol=1e-12)
    np.testing.assert_allclose(told.covariance, steps.covariance, rtol=0, atol=2e-12)
