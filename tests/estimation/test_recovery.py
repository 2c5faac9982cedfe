"""Odometry that fails: it is discarded where the measurements of a scan say so, and only there."""

from dataclasses import replace

import numpy as np
import pytest

from pipistrelle.config import RayConfig
from pipistrelle.detection.scans import make_scan, with_columns
from pipistrelle.estimation.beliefs import Gaussian
from pipistrelle.estimation.ekf.filter import EkfSlam, InvariantEkfSlam
from pipistrelle.estimation.motion import Motion, motion_step
from pipistrelle.estimation.recovery import correction, odometry_bound, recovered
from pipistrelle.estimation.smoother.filter import Smoother
from pipistrelle.geometry import range_and_bearing, wrap

KINDS = (EkfSlam, InvariantEkfSlam, Smoother)
MOTION = Motion(model="unicycle", control_std=(0.05, 0.05))
CONTROL, STEP, STEPS = np.array([0.7, 0.0875]), 0.1, 5
STDS = {"range_std": 0.02, "bearing_std": 0.012}
START = Gaussian(mean=np.array([8.0, 0.0, np.pi / 2]), covariance=1e-6 * np.eye(3))
POSTS = np.random.default_rng(3).uniform(-14.0, 14.0, (24, 2))


def slam_of(kind, gate=0.999):
    return kind(motion=MOTION, rays=RayConfig(), gate=gate)


def driven(frames, seed=1, *, push=None, posts_of=lambda frame: POSTS):
    """Drive a circle and hear posts within 10 m ahead; ``push``: more of x, y, heading by frame."""
    rng, pose, poses, scans = np.random.default_rng(seed), START.mean, [], []
    for frame in range(frames):
        for _ in range(STEPS):
            noisy = CONTROL + rng.normal(0.0, MOTION.control_std)
            pose = motion_step(MOTION, pose, noisy, STEP)
        pose = pose + (push or {}).get(frame, np.zeros(3))
        distance, bearing = range_and_bearing(pose, posts_of(frame))
        near = np.flatnonzero((distance < 10.0) & (np.abs(bearing) < np.pi / 2))
        measured = wrap(bearing[near] + rng.normal(0.0, STDS["bearing_std"], near.size))
        ranges = distance[near] + rng.normal(0.0, STDS["range_std"], near.size)
        time = STEP * STEPS * (frame + 1)
        scans.append(make_scan(time, near, measured, range=ranges, **STDS))
        poses.append(pose)
    return np.array(poses), scans


def followed(slam, scans):
    """Return the belief before and after each scan."""
    belief, beliefs = slam.init(START), []
    for scan in scans:
        before, _ = slam.predict(belief, np.tile(CONTROL, (STEPS, 1)), np.full(STEPS, STEP))
        belief = slam.update(before, scan)
        beliefs.append((before, belief))
    return beliefs


def largest_error(poses, beliefs):
    return max(
        np.hypot(*(after.pose().mean - pose)[:2])
        for pose, (_, after) in zip(poses, beliefs, strict=True)
    )


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    "push", [(0.0, 0.0, 0.5), (-0.4, 0.3, 0.0), (3.0, -2.0, 2.5)], ids=["skid", "slip", "carried"]
)
def test_a_vehicle_that_is_pushed_is_found_again_at_once(kind, push):
    poses, scans = driven(60, push={30: np.array(push)})
    after = followed(slam_of(kind), scans)[30:]
    assert largest_error(poses[30:], after) < 0.1
    assert after[-1][1].gated < 20


@pytest.mark.parametrize("kind", KINDS)
def test_without_a_gate_nothing_is_discarded(kind):
    _, scans = driven(40, push={20: np.array([0.0, 0.0, 0.5])})
    assert all(after.doubt == 0.0 for _, after in followed(slam_of(kind, gate=1.0), scans))


@pytest.mark.parametrize("kind", KINDS)
def test_posts_that_were_moved_do_not_move_the_vehicle(kind):
    moved = POSTS + (np.arange(len(POSTS)) % 8 == 0)[:, None] * np.array([1.0, 0.5])
    poses, scans = driven(80, posts_of=lambda frame: moved if frame > 40 else POSTS)
    beliefs = followed(slam_of(kind), scans)
    assert largest_error(poses[40:], beliefs[40:]) < 0.3  # the posts were moved by 1.1 m
    assert beliefs[-1][1].gated > 10


@pytest.mark.parametrize("kind", KINDS)
def test_a_drive_that_matches_the_model_is_never_doubted_for_long(kind):
    bound = odometry_bound(0.999)
    for seed in range(3):
        _, scans = driven(100, seed)
        assert all(after.doubt < 0.5 * bound for _, after in followed(slam_of(kind), scans))


@pytest.mark.parametrize("kind", KINDS)
def test_a_single_wrong_row_does_not_raise_doubt(kind):
    slam = slam_of(kind)
    (_, belief) = followed(slam, driven(30)[1])[-1]
    before, _ = slam.predict(belief, np.tile(CONTROL, (STEPS, 1)), np.full(STEPS, STEP))
    joint = before.joint()
    distance, bearing = range_and_bearing(joint.mean[:3], joint.mean[3:].reshape(-1, 2))
    one = int(np.argmin(distance))
    wrong = make_scan(
        99.0, joint.landmark[[one]], wrap(bearing[[one]] + 0.3), range=distance[[one]] + 1.0, **STDS
    )
    after = slam.update(before, wrong)
    assert after.gated == before.gated + 1
    assert after.doubt == 0.0


@pytest.mark.parametrize("kind", KINDS)
def test_a_wrong_row_after_a_push_is_gated_with_the_odometry(kind):
    poses, scans = driven(40, push={30: np.array([0.0, 0.0, 0.5])})
    wrong = np.arange(scans[30].landmark.size) < 1
    scans[30] = with_columns(scans[30], range=scans[30].range + 2.0 * wrong)
    beliefs = followed(slam_of(kind), scans)
    (before, after), gap = beliefs[30], np.abs(beliefs[30][1].pose().mean - poses[30])
    assert after.gated == before.gated + 1
    assert np.hypot(*gap[:2]) < 0.1


def test_the_covariance_of_a_freed_belief_is_the_same_by_either_error():
    pose, stds = np.array([7.0, 3.0, 2.0]), np.array([4.0, 5.0, 0.7])
    for kind in (EkfSlam, InvariantEkfSlam):
        (_, belief) = followed(slam_of(kind), driven(30)[1])[-1]
        joint, free = belief.joint(), belief.freed(pose, stds).joint()
        expected = joint.covariance.copy()
        expected[:3, :3] += np.diag(stds**2)
        np.testing.assert_allclose(free.covariance, expected, atol=1e-9)
        np.testing.assert_allclose(free.mean[:3], pose, atol=1e-12)
        np.testing.assert_array_equal(free.mean[3:], joint.mean[3:])


def test_a_freed_smoother_is_at_the_pose_and_spreads_the_change_over_the_steps():
    slam = slam_of(Smoother)
    (before, _) = followed(slam, driven(30)[1])[-1]
    pose = before.pose().mean + np.array([0.5, -0.2, 0.4])
    free = before.freed(pose, np.full(3, 10.0))
    np.testing.assert_allclose(wrap(free.pose().mean - pose), 0.0, atol=1e-12)
    shift = free.odometry.mean - before.odometry.mean
    np.testing.assert_allclose(shift, np.linspace(0.2, 1.0, STEPS)[:, None] * shift[-1])


@pytest.mark.parametrize("kind", KINDS)
def test_the_fitted_pose_is_the_true_one_though_half_of_the_rows_are_wrong(kind):
    slam = slam_of(kind)
    poses, scans = driven(60)
    (before, after) = followed(slam, scans)[-1]
    rng = np.random.default_rng(8)
    wrong = np.arange(scans[-1].landmark.size) % 2 == 1
    shift = rng.uniform(2.0, 9.0, wrong.size)
    scan = with_columns(scans[-1], range=scans[-1].range + wrong * shift)
    astray = before.freed(before.pose().mean + np.array([1.0, 1.0, 0.4]), np.full(3, 1e-6))
    found = recovered(replace(astray, doubt=1e3), replace(after, gated=99), scan, 0.999, 20.0)
    free, kept = found
    np.testing.assert_array_equal(kept.landmark, scan.landmark[~wrong])
    assert np.abs(free.pose().mean - poses[-1]).max() < 0.1


@pytest.mark.parametrize("kind", KINDS)
def test_the_joint_gaussian_of_some_landmarks_is_a_marginal(kind):
    (_, belief) = followed(slam_of(kind), driven(30)[1])[-1]
    whole, labels = belief.joint(), belief.joint().landmark[::2]
    part = belief.joint(labels)
    np.testing.assert_array_equal(np.sort(part.landmark), np.sort(labels))
    places = [3 + 2 * whole.landmark.tolist().index(label) for label in part.landmark]
    at = np.concatenate([[0, 1, 2], *([i, i + 1] for i in places)])
    np.testing.assert_array_equal(part.mean, whole.mean[at])
    np.testing.assert_allclose(part.covariance, whole.covariance[np.ix_(at, at)], atol=1e-15)


def test_a_correction_counts_the_directions_that_a_scan_narrows():
    e, narrow = np.array([1.0, 1.0, 0.0]), np.diag([0.75, 0.999, 1.0])
    assert correction(np.zeros(3), np.eye(3), e, narrow, 1.0) == (4.0, 1.0)
    A = np.random.default_rng(4).normal(size=(3, 3))
    P, Q = A @ A.T + np.eye(3), 0.5 * np.eye(3)
    assert correction(e, P, np.zeros(3), Q, 1.0) == pytest.approx(
        (e @ np.linalg.inv(P - Q) @ e, 3.0)
    )


@pytest.mark.parametrize("kind", KINDS)
def test_corrections_exceed_their_expectation_only_if_odometry_noise_is_understated(kind):
    for share, understated in ((1.0, False), (0.3, True)):
        motion = replace(MOTION, control_std=(0.05 * share, 0.05 * share))
        *_, (_, after) = followed(kind(motion=motion, rays=RayConfig()), driven(120)[1])
        squared, degrees = after.corrections
        assert (squared / degrees > 1.0 + 3.0 * np.sqrt(2.0 / degrees)) == understated
