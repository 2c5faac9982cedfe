"""Landmarks that are known beforehand: they are in the map, and what is heard of them places us."""

from dataclasses import replace

import numpy as np
import pytest

from pipistrelle.config import FastSlamConfig, InputError
from pipistrelle.detection.scans import make_scan
from pipistrelle.estimation.beliefs import AcceptsMap, Gaussian
from pipistrelle.estimation.ekf.filter import EkfSlam, InvariantEkfSlam
from pipistrelle.estimation.fastslam.filter import FastSlam
from pipistrelle.estimation.observations.bearing import measurement_jacobians
from pipistrelle.estimation.observations.excess_path import excess_path_of
from pipistrelle.estimation.smoother.filter import Smoother
from pipistrelle.experiments.drives import Drive
from pipistrelle.experiments.runs.trial import run_filter
from pipistrelle.geometry import range_and_bearing
from reference.missions import BICYCLE, map_with, ray_config, scan_with

KINDS = [EkfSlam, InvariantEkfSlam, Smoother]
START = Gaussian(mean=np.array([4.0, -7.0, 0.3]), covariance=np.diag([0.2, 0.3, 0.25]) ** 2)
POSTS = map_with([7, 9], [[1.0, 3.0], [-6.0, 2.0]], [0.04 * np.eye(2), np.diag([0.01, 0.09])])


def informed(kind, posts=POSTS):
    slam = kind(motion=BICYCLE, rays=ray_config())
    assert isinstance(slam, AcceptsMap)
    return slam, slam.knowing(slam.init(START), posts)


@pytest.mark.parametrize("kind", KINDS)
def test_a_known_map_enters_the_map_and_leaves_the_pose(kind):
    _, belief = informed(kind)
    rows, pose = belief.landmarks(), belief.pose()
    assert rows.landmark.tolist() == [7, 9]
    np.testing.assert_allclose(rows.mean, POSTS.mean, rtol=0, atol=1e-9)
    np.testing.assert_allclose(rows.covariance, POSTS.covariance, rtol=0, atol=1e-9)
    np.testing.assert_allclose(pose.mean, START.mean, rtol=0, atol=1e-9)
    np.testing.assert_allclose(pose.covariance, START.covariance, rtol=0, atol=1e-9)


@pytest.mark.parametrize("kind", KINDS)
def test_measurements_of_a_known_map_correct_pose_and_heading(kind):
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


FASTSLAM = FastSlam(motion=BICYCLE, rays=ray_config(), settings=FastSlamConfig(particles=500))


def test_fastslam_holds_a_known_map_in_every_particle():
    belief = FASTSLAM.knowing(FASTSLAM.init(START), POSTS)
    rows = belief.landmarks()
    assert isinstance(FASTSLAM, AcceptsMap)
    assert rows.landmark.tolist() == [7, 9]
    np.testing.assert_array_equal(rows.mean, POSTS.mean)
    np.testing.assert_array_equal(rows.covariance, POSTS.covariance)
    assert rows.weight.tolist() == [1.0, 1.0]
    assert belief.full == 2.0
    np.testing.assert_allclose(belief.pose().covariance, START.covariance, rtol=0, atol=1e-9)


def test_fastslam_updates_from_a_known_map_like_the_ekf():
    rng, belief = np.random.default_rng(7), FASTSLAM.knowing(FASTSLAM.init(START), POSTS)
    distance, bearing = range_and_bearing(START.mean, POSTS.mean)
    heard = scan_with([7, 9], bearing, distance, range_std=0.1, bearing_std=0.05)
    after = FASTSLAM.update(belief, heard, rng).pose()
    exact = EkfSlam(motion=BICYCLE, rays=ray_config())
    told = exact.update(exact.knowing(exact.init(START), POSTS), heard).pose()
    spread = np.sqrt(np.diag(told.covariance))
    assert np.all(np.abs(after.mean - told.mean) < 0.3 * spread)
    np.testing.assert_allclose(np.sqrt(np.diag(after.covariance)), spread, rtol=0.15)


@pytest.mark.parametrize("kind", KINDS)
def test_a_moving_caller_in_the_known_map_is_refused(kind):
    slam = kind(motion=BICYCLE, rays=ray_config())
    scan = make_scan(1.0, np.array([9]), np.array([0.2]), bearing_std=0.1)
    drive = Drive(
        motion=BICYCLE, start=START, time=np.arange(2.0), controls=np.ones((1, 2)), known=POSTS
    )
    run_filter(slam, drive, [scan], np.random.default_rng(7))
    for told, heard in (
        (replace(drive, moving={9: "boat"}), scan),
        (drive, replace(scan, moving=np.array([9]))),
    ):
        with pytest.raises(InputError, match=r"known beforehand: found \[9\], which move"):
            run_filter(slam, told, [heard], np.random.default_rng(7))


@pytest.mark.parametrize("kind", KINDS)
def test_the_gate_drops_a_bearing_that_cannot_be_and_keeps_its_excess_path(kind):
    slam = kind(motion=BICYCLE, rays=ray_config(), gate=0.999)
    still = replace(START, covariance=1e-6 * np.eye(3))
    post, caller = POSTS.mean
    known = map_with([7, 9], POSTS.mean, [0.04 * np.eye(2), 1e-6 * np.eye(2)])
    (bearing,) = range_and_bearing(START.mean, post[None])[1]
    scan = make_scan(
        0.0, np.array([7]), np.array([bearing + 1.0]),
        caller=1, excess_path=excess_path_of(START.mean[:2], post, caller), excess_path_std=0.02,
        bearing_std=0.01,
    )  # fmt: skip
    scan = replace(scan, callers=np.array([-1, 9]))
    after = slam.update(slam.knowing(slam.init(still), known), scan)
    rows = after.landmarks()
    (spread,) = rows.covariance[rows.landmark == 7]
    assert after.gated == 1
    least, most = np.linalg.eigvalsh(spread)
    assert least < 0.02**2
    assert most == pytest.approx(0.04, rel=0.05), "along the ellipse nothing is told"
