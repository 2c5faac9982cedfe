"""Landmarks that are known beforehand: they are in the map, and what is heard of them places us."""

from contextlib import suppress

import numpy as np
import pytest

from pipistrelle.estimation.beliefs import Gaussian, Informed
from pipistrelle.estimation.ekf.filter import EkfSlam
from pipistrelle.estimation.ekf.invariant import InvariantEkfSlam
from pipistrelle.estimation.measurement import measurement_jacobians
from pipistrelle.geometry import range_and_bearing
from reference.missions import BICYCLE, map_with, ray_config, scan_with

KINDS = [EkfSlam, InvariantEkfSlam]
with suppress(ImportError):  # an extra
    from pipistrelle.estimation.smoother.filter import Smoother

    KINDS.append(Smoother)
START = Gaussian(mean=np.array([4.0, -7.0, 0.3]), covariance=np.diag([0.2, 0.3, 0.25]) ** 2)
POSTS = map_with([7, 9], [[1.0, 3.0], [-6.0, 2.0]], [0.04 * np.eye(2), np.diag([0.01, 0.09])])


def informed(kind, posts=POSTS):
    slam = kind(motion=BICYCLE, rays=ray_config())
    assert isinstance(slam, Informed)
    return slam, slam.knowing(slam.init(START), posts)


@pytest.mark.parametrize("kind", KINDS)
def test_what_is_known_is_in_the_map_as_surely_and_the_pose_is_as_it_was(kind):
    _, belief = informed(kind)
    rows, pose = belief.landmarks(), belief.pose()
    assert rows.landmark.tolist() == [7, 9]
    np.testing.assert_allclose(rows.mean, POSTS.mean, rtol=0, atol=1e-9)
    np.testing.assert_allclose(rows.covariance, POSTS.covariance, rtol=0, atol=1e-9)
    np.testing.assert_allclose(pose.mean, START.mean, rtol=0, atol=1e-9)
    np.testing.assert_allclose(pose.covariance, START.covariance, rtol=0, atol=1e-9)


@pytest.mark.parametrize("kind", KINDS)
def test_what_is_heard_of_it_tells_the_pose_even_which_way_is_north(kind):
    slam, belief = informed(kind)
    distance, bearing = range_and_bearing(START.mean, POSTS.mean)
    heard = scan_with([7, 9], bearing, distance, range_std=0.1, bearing_std=0.05)
    after = slam.update(belief, heard)
    C, rows, R = np.zeros((7, 7)), [], np.diag([0.1, 0.05, 0.1, 0.05]) ** 2
    C[:3, :3], C[3:5, 3:5], C[5:, 5:] = START.covariance, *POSTS.covariance
    for n, post in enumerate(POSTS.mean):
        H = np.zeros((2, 7))
        H[:, :3], H[:, 3 + 2 * n : 5 + 2 * n] = measurement_jacobians(START.mean, post)
        rows.append(H)
    H = np.vstack(rows)
    expected = C - C @ H.T @ np.linalg.solve(H @ C @ H.T + R, H @ C)
    np.testing.assert_allclose(after.pose().covariance, expected[:3, :3], rtol=0, atol=1e-6)
    assert after.pose().covariance[2, 2] < 0.3 * START.covariance[2, 2]
    np.testing.assert_allclose(after.pose().mean, START.mean, rtol=0, atol=1e-6)
