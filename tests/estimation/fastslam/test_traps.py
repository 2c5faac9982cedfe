"""What breaks the printed filter, and the traps of angles, distances and small numbers."""

import numpy as np
import pytest

from pipistrelle.estimation.beliefs import Gaussian
from pipistrelle.estimation.motion import Motion, motion_jacobians
from pipistrelle.estimation.observations.range import NEAREST
from pipistrelle.geometry import wrap
from reference.missions import BICYCLE, START, STEP, followed, ray_config, scan_of, scan_with
from reference.swarms import (
    Drawn,
    assert_same,
    assert_sound,
    began,
    drawing,
    members,
    particles_of,
    small_mission,
    swarm_filter,
    with_particles,
)

AT_REST = Motion(model="unicycle", control_std=(0.1, 0.15), noise_at_rest=False)
TURNING = Motion(model="unicycle", control_std=(0.1, 0.5))


def test_noise_of_one_step_is_sampled_in_the_two_directions_it_has():
    slam, start = swarm_filter(200), Gaussian(mean=START.mean, covariance=np.zeros((3, 3)))
    control = np.array([0.75, 0.027])
    belief, _ = slam.predict(slam.init(start), control[None], np.array([STEP]))
    normal = drawing().standard_normal((200, 3))
    sampled = slam.update(belief, scan_of((1, 5.0, 0.3)), Drawn(normal, np.full(200, 0.5)))
    _, U = motion_jacobians(BICYCLE, START.mean, control, STEP)
    noise = U * BICYCLE.control_std
    offset = (sampled.cloud() - belief.cloud()).T
    coordinates = np.linalg.lstsq(noise, offset, rcond=None)[0]
    np.testing.assert_allclose(noise @ coordinates, offset, rtol=0, atol=1e-12)
    assert np.abs(np.cov(coordinates) - np.eye(2)).max() < 4.5 * np.sqrt(2 / 200)


def test_vehicle_at_rest_without_noise_keeps_its_particles_and_divides_the_landmarks_noise():
    slam = swarm_filter(motion=AT_REST)
    belief = began(slam, (1, 5.0, 0.3))
    kept, rng = belief, drawing()
    for _ in range(9):
        rested, _ = slam.predict(belief, np.zeros((4, 2)), np.full(4, STEP))
        np.testing.assert_array_equal(rested.cloud(), belief.cloud())
        belief = slam.update(rested, scan_of((1, 5.0, 0.3)), rng)
    np.testing.assert_array_equal(belief.cloud(), kept.cloud())
    now, then = particles_of(belief).member[:, 0, 2:5], particles_of(kept).member[:, 0, 2:5]
    np.testing.assert_allclose(now, then / 10, rtol=1e-9)
    np.testing.assert_allclose(belief.log_weight, kept.log_weight, atol=1e-12)


def test_landmark_covariances_stay_positive_after_a_hundred_thousand_updates():
    slam, rng = swarm_filter(3, motion=AT_REST), drawing()
    belief = slam.init(START)
    labels, bearing = np.arange(20), rng.uniform(-3, 3, 20)
    for frame in range(5000):
        scan = scan_with(
            labels,
            distance=np.where((rng.random(20) < 0.5) & (frame > 0), np.nan, 6 + rng.normal(0, 0.2)),
            bearing=bearing + rng.normal(0, 0.15, 20),
        )
        belief = slam.update(belief, scan, rng)
    assert_sound(belief)


def test_frames_without_measurements_change_nothing_and_their_motion_accumulates():
    slam, control = swarm_filter(), np.tile([0.75, 0.027], (4, 1))
    belief = began(slam, (1, 5.0, 0.3))
    once, _ = slam.predict(belief, control, np.full(4, STEP))
    silent = slam.update(once, scan_of(), drawing())
    assert_same(silent, once)
    twice, _ = slam.predict(silent, control, np.full(4, STEP))
    both, _ = slam.predict(belief, np.tile(control, (2, 1)), np.full(8, STEP))
    np.testing.assert_array_equal(twice.cloud(), both.cloud())
    np.testing.assert_array_equal(particles_of(twice).covariance, particles_of(both).covariance)
    blank = slam.init(START)
    assert_same(slam.update(blank, scan_of(), drawing()), blank)


@pytest.mark.parametrize("row", [(1, 1e6, 0.3), (2, np.nan, -2.1)])
@pytest.mark.parametrize("mixture", ["federated", "exact"])
def test_likelihoods_that_underflow_leave_weights_that_sum_to_one(row, mixture):
    """Ten thousand deviations: every likelihood is zero in floating point."""
    slam = swarm_filter(mixture=mixture, bearing_std=1e-4, range_std=1e-4)
    belief = began(slam, (1, 5.0, 0.3), (2, np.nan, 1.0))
    for _ in range(3):
        belief, _ = slam.predict(belief, np.tile([0.75, 0.027], (4, 1)), np.full(4, STEP))
        belief = slam.update(belief, scan_of(row), drawing())
        assert_sound(belief)


def test_a_swarm_with_headings_around_pi_has_the_wrapped_mean():
    slam = swarm_filter(500, motion=TURNING)
    start = Gaussian(mean=np.array([0, 0, np.pi - 1e-3]), covariance=START.covariance)
    belief = began(slam, (1, 5.0, 0.3), start=start)
    assert belief.cloud()[:, 2].min() < -3 < 3 < belief.cloud()[:, 2].max()
    assert abs(wrap(belief.pose().mean[2] - start.mean[2])) < 4.5 * 0.0436 / np.sqrt(500)
    assert belief.pose().covariance[2, 2] == pytest.approx(0.0436**2, rel=4.5 * np.sqrt(2 / 500))
    place = [-5 * np.cos(0.3), -5 * np.sin(0.3)]
    assert np.hypot(*(particles_of(belief).member[:, 0, :2].mean(axis=0) - place)) < 0.05
    belief, poses = slam.predict(belief, np.array([[0.0, 0.02]]), np.ones(1))
    assert abs(wrap(poses.mean[0, 2] - start.mean[2] - 0.02)) < 4.5 * 0.0436 / np.sqrt(500)
    after = slam.update(belief, scan_of((1, 5.0, 0.28)), drawing())
    assert (np.abs(after.cloud()[:, 2]) <= np.pi).all()
    assert after.pose().covariance[2, 2] < 0.1


@pytest.mark.parametrize("row", [(1, 0.01, 0.5), (1, np.nan, 0.5)])
def test_a_landmark_at_the_vehicles_position_weighs_and_corrects_nothing(row):
    slam = swarm_filter(motion=AT_REST)
    belief = began(slam, (1, NEAREST / 2, 0.0), (2, 4.0, 1.0))
    assert_same(slam.update(belief, scan_of(row), drawing()), belief)


@pytest.mark.parametrize("row", [(1, 0.01, 0.5), (1, np.nan, 0.5)])
def test_landmark_a_little_farther_corrects_and_all_stays_sound(row):
    slam = swarm_filter(motion=AT_REST)
    belief = began(slam, (1, NEAREST * 2, 0.0), (2, 4.0, 1.0))
    after = slam.update(belief, scan_of(row), drawing())
    assert not np.array_equal(particles_of(after).member, particles_of(belief).member)
    assert_sound(after)


@pytest.mark.parametrize("row", [(1, 0.01, 0.5), (1, np.nan, 0.5)])
@pytest.mark.parametrize("mixture", ["federated", "exact"])
def test_a_ray_through_the_vehicles_position_stays_sound(row, mixture):
    rays = ray_config(range_bounds=(1e-4, 20.0))
    slam = swarm_filter(mixture=mixture, motion=AT_REST, rays=rays)
    belief = began(slam, (1, np.nan, 0.0), (2, 4.0, 1.0))
    assert np.hypot(*(particles_of(belief).member[0, 0, :2] - belief.cloud()[0, :2])) < NEAREST
    for _ in range(3):
        belief = slam.update(belief, scan_of(row), drawing())
        assert_sound(belief)


@pytest.mark.parametrize("particles", [1, 2])
def test_few_particles_have_a_pose_with_an_inverse_covariance(particles):
    slam = swarm_filter(particles)
    for belief, poses in followed(slam, small_mission("fused", frames=20), START, drawing()):
        assert_sound(belief)
        assert (np.linalg.eigvalsh(poses.covariance)[:, 0] > 0).all()


def test_a_bearing_neither_prunes_a_member_too_near_to_foresee_it_nor_loses_the_ray():
    rays = ray_config(prune_threshold=0.0)
    slam = swarm_filter(1, rays=rays)
    belief = slam.update(slam.init(START), scan_of((1, np.nan, 0.3)), np.random.default_rng(1))
    member = particles_of(belief).member.copy()
    member[0, 0, :2] = belief.cloud()[0, :2]
    member[0, :, 5] = [0.0, -np.inf, -np.inf, -np.inf]
    crafted = with_particles(belief, member=member, covariance=np.zeros((1, 3, 3)))
    after = slam.update(crafted, scan_of((1, np.nan, 0.3)), np.random.default_rng(1))
    assert np.isfinite(particles_of(after).member[:, :, :5]).all()
    weight = members(after, 0, 1)[:, 5]
    np.testing.assert_allclose(weight, [1.0, 0.0, 0.0, 0.0], atol=1e-12)


def test_filter_of_short_rays_goes_on_with_a_belief_of_long_ones():
    long = swarm_filter(40)
    short = swarm_filter(40, rays=ray_config(range_bounds=(5.0, 6.0)))
    belief = began(long, (1, np.nan, 0.3), (2, np.nan, -1.0))
    assert (belief.count == 4).all()
    again = scan_of((1, np.nan, 0.31), (2, np.nan, -0.99))
    assert_same(short.update(belief, again, drawing()), long.update(belief, again, drawing()))
