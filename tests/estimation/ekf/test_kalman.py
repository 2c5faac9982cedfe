"""The filter against Kalman filters where it is linear, exactly or in the limit."""

import numpy as np
import pytest

from pipistrelle.estimation.beliefs import Gaussian
from pipistrelle.estimation.motion import Motion, motion_step
from pipistrelle.geometry import range_and_bearing
from reference.missions import KINDS, START, STEP, STEPS_PER_FRAME, paper_filter, scan_of, steady


@pytest.mark.parametrize("kind", KINDS)
def test_drive_along_an_axis_with_known_heading_equals_a_plain_kalman_filter(kind):
    """Range is linear for landmarks ahead and behind; y and heading are known and stay apart."""
    rng = np.random.default_rng(1)
    motion = Motion(model="bicycle", control_std=(0.1, 0.0), wheelbase=0.2)
    slam = paper_filter(kind, motion=motion)
    start = Gaussian(mean=np.zeros(3), covariance=np.diag([0.3**2, 0, 0]))
    ahead = np.array([1.0, 1.0, -1.0])
    truth = np.array([rng.normal(0, 0.3), 30.0, 50.0, -8.0])
    x, P = np.zeros(1), np.array([[0.3**2]])
    belief = slam.init(start)
    for frame in range(40):
        controls, dt = steady((0.8, 0.0), 1)[0], np.full(STEPS_PER_FRAME, STEP)
        truth[0] += np.sum((0.8 + rng.normal(0, 0.1, STEPS_PER_FRAME)) * STEP)
        x[0] += 0.8 * STEPS_PER_FRAME * STEP
        P[0, 0] += STEPS_PER_FRAME * (0.1 * STEP) ** 2
        z = np.abs(truth[1:] - truth[0]) + rng.normal(0, 0.2, 3)
        if frame == 0:
            x = np.concatenate([x, x[0] + ahead * z])
            P = np.full((4, 4), P[0, 0]) + np.diag([0, *[0.2**2] * 3])
        else:
            H = np.column_stack([-ahead, np.diag(ahead)])
            K = P @ H.T @ np.linalg.inv(H @ P @ H.T + 0.2**2 * np.eye(3))
            x, P = x + K @ (z - H @ x), P - K @ H @ P
        belief, _ = slam.predict(belief, controls, dt)
        bearings = np.where(ahead > 0, 0, -np.pi)
        belief = slam.update(belief, scan_of(*zip((1, 2, 3), z, bearings, strict=True)))
        along = [0, 3, 5, 7]
        np.testing.assert_allclose(belief.mean[along], x, rtol=0, atol=1e-11)
        np.testing.assert_allclose(belief.covariance[np.ix_(along, along)], P, rtol=0, atol=1e-13)


def linearised_kalman_error(scale):
    """Largest departure of the filter from a Kalman filter about the truth, in noise units."""
    rng = np.random.default_rng(5)
    motion = Motion(model="bicycle", control_std=(0.1 * scale, 0.03 * scale), wheelbase=0.2)
    std = scale * np.array([0.2, 0.15])
    P = scale**2 * START.covariance
    slam = paper_filter(motion=motion, range_std=std[0], bearing_std=std[1])
    belief = slam.init(Gaussian(mean=START.mean, covariance=P))
    points = np.array([[4.0, -4.0], [-3.0, -9.0], [6.0, -12.0]])
    nominal, dx = np.array(START.mean), np.zeros(3)
    true = nominal + scale * rng.normal(size=3) * [0.05, 0.05, 0.0436]
    worst = 0.0
    for frame in range(12):
        control = np.array([0.75, 0.2])
        by_pose = jacobian(lambda x: motion_step(motion, x, control, STEP), nominal)  # noqa: B023
        by_control = jacobian(lambda u: motion_step(motion, nominal, u, STEP), control)  # noqa: B023
        F, U = np.eye(dx.size), np.zeros((dx.size, 2))
        F[:3, :3], U[:3] = by_pose, by_control
        dx, P = F @ dx, F @ P @ F.T + U @ np.diag(np.square(motion.control_std)) @ U.T
        noisy = control + rng.normal(size=2) * motion.control_std
        true = motion_step(motion, true, noisy, STEP)
        nominal = motion_step(motion, nominal, control, STEP)
        z = np.column_stack(range_and_bearing(true, points)) + std * rng.normal(size=(3, 2))
        expected = np.column_stack(range_and_bearing(nominal, points))
        seen = scan_of(*((i + 1, z[i, 0] if frame % 2 == 0 else np.nan, z[i, 1]) for i in range(3)))
        belief, _ = slam.predict(belief, control[None], np.array([STEP]))
        belief = slam.update(belief, seen)
        dx, P = kalman_frame(dx, P, nominal, points, z - expected, std, active=frame % 2 == 0)
        ekf = belief.mean - np.concatenate([nominal, points.ravel()])
        worst = max(worst, np.abs(ekf - dx).max() / scale)
        worst = max(worst, np.abs(belief.covariance - P).max() / scale**2)
    return worst


def jacobian(function, at, step=1e-5):
    """Central differences."""
    units = step * np.eye(at.size)
    return np.array([(function(at + u) - function(at - u)) / (2 * step) for u in units]).T


def kalman_frame(dx, P, nominal, points, dz, std, *, active):
    """One frame of a Kalman filter on departures from the truth; the first adds the landmarks."""

    def measured(state):
        return np.concatenate(
            [
                np.column_stack(range_and_bearing(state[:3], p[None]))[0]
                for p in state[3:].reshape(-1, 2)
            ]
        )

    state = np.concatenate([nominal, points.ravel()])
    H = jacobian(measured, state)
    R = np.diag(np.tile(std**2, len(points)))
    if dx.size == 3:
        backward = np.linalg.inv(H[:, 3:])
        grow = np.vstack([np.eye(3), -backward @ H[:, :3]])
        dx = grow @ dx
        dx[3:] += backward @ dz.ravel()
        P = grow @ P @ grow.T
        P[3:, 3:] += backward @ R @ backward.T
        return dx, P
    rows = np.arange(dz.size) if active else np.arange(1, dz.size, 2)
    H, R, dz = H[rows], R[np.ix_(rows, rows)], dz.ravel()[rows]
    K = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
    return dx + K @ (dz - H @ dx), P - K @ H @ P


def test_filter_tends_to_a_linear_kalman_filter_as_the_noise_vanishes():
    coarse, fine = linearised_kalman_error(1e-2), linearised_kalman_error(1e-3)
    assert fine < 1e-2
    assert coarse / fine == pytest.approx(10, rel=0.3)
