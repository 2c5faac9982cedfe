"""What must hold of the swarm whatever it is told."""

import numpy as np
import pytest

from pipistrelle.estimation.beliefs import Gaussian
from pipistrelle.estimation.fastslam.filter import SMALLEST_STD
from pipistrelle.estimation.fastslam.particles import normalised
from pipistrelle.geometry import wrap
from reference.missions import START, STEP, followed, scan_of
from reference.swarms import (
    Drawn,
    all_members,
    assert_same,
    began,
    drawing,
    never_resampling,
    particles_of,
    small_mission,
    swarm_filter,
    with_particles,
)

KNOWN_POSE = Gaussian(mean=np.zeros(3), covariance=np.zeros((3, 3)))


def test_half_a_turn_of_the_world_turns_the_swarm():
    """Headings pass through pi on the way; draws along x and y change their sign."""
    slam, mission = swarm_filter(), small_mission("fused", frames=20)
    shift, rng = np.array([30.0, -20.0]), drawing()
    turned = Gaussian(
        mean=np.array([*(shift - START.mean[:2]), wrap(START.mean[2] + np.pi)]),
        covariance=START.covariance,
    )
    here, there = slam.init(START), slam.init(turned)
    for controls, dt, scan in zip(mission.controls, mission.dt, mission.scans, strict=True):
        normal, uniform = rng.standard_normal((20, 3)), rng.random(20)
        here, _ = slam.predict(here, controls, dt)
        there, _ = slam.predict(there, controls, dt)
        here = slam.update(here, scan, Drawn(normal, uniform))
        there = slam.update(there, scan, Drawn(normal * [-1, -1, 1], uniform))
    np.testing.assert_allclose(there.log_weight, here.log_weight, atol=1e-9)
    np.testing.assert_allclose(there.cloud()[:, :2], shift - here.cloud()[:, :2], atol=1e-9)
    assert np.abs(wrap(there.cloud()[:, 2] - here.cloud()[:, 2] - np.pi)).max() < 1e-9
    np.testing.assert_allclose(all_members(there)[:, :, 2:], all_members(here)[:, :, 2:], atol=1e-9)
    np.testing.assert_allclose(there.landmarks().mean, shift - here.landmarks().mean, atol=1e-9)
    turn = np.diag([-1, -1, 1])
    expected = turn @ here.pose().covariance @ turn
    np.testing.assert_allclose(there.pose().covariance, expected, atol=1e-9)


def test_new_landmarks_are_placed_last_in_any_order():
    slam = swarm_filter()
    belief = began(slam, (1, 5.0, 0.3))
    known, new, ray = (1, 5.3, 0.2), (2, 4.0, -1.0), (3, np.nan, 2.0)
    first = slam.update(belief, scan_of(new, ray, known), drawing())
    last = slam.update(belief, scan_of(known, new, ray), drawing())
    assert_same(first, last)
    assert first.landmark.tolist() == [1, 2, 3]


def test_estimate_is_the_weighted_mean_and_covariance_of_the_swarm_regularised():
    slam = never_resampling(swarm_filter(50))
    *_, (belief, _) = followed(slam, small_mission("fused", frames=10), START, drawing())
    belief, _ = slam.predict(belief, np.tile([0.75, 0.027], (4, 1)), np.full(4, STEP))
    weight = normalised(belief.log_weight)
    assert weight.max() > 3 * weight.min()
    mean = weight @ belief.cloud()  # No heading is near pi here.
    spread = (belief.cloud() - mean).T @ (weight[:, None] * (belief.cloud() - mean))
    own = np.tensordot(weight, particles_of(belief).covariance, 1)
    # The mean direction and the mean heading part by the third power of the spread.
    np.testing.assert_allclose(belief.pose().mean, mean, atol=0.1**3)
    expected = spread + own + SMALLEST_STD**2 * np.eye(3)
    np.testing.assert_allclose(belief.pose().covariance, expected, atol=1e-5)


def test_best_map_is_the_heaviest_particles_and_the_first_of_equals():
    slam = never_resampling(swarm_filter(10))
    belief = began(slam, (1, 5.0, 0.3), (2, np.nan, 1.0))
    np.testing.assert_array_equal(belief.landmarks().mean, particles_of(belief).member[0, :, :2])
    belief, _ = slam.predict(belief, np.tile([0.75, 0.2], (4, 1)), np.full(4, STEP))
    belief = slam.update(belief, scan_of((1, 4.7, 0.3)), drawing(2))
    best = np.argmax(belief.log_weight)
    assert best > 0
    np.testing.assert_array_equal(belief.landmarks().mean, particles_of(belief).member[best, :, :2])
    np.testing.assert_array_equal(
        np.log(belief.landmarks().weight), particles_of(belief).member[best, :, 5]
    )


def test_mean_number_of_full_landmarks_is_weighted():
    slam = never_resampling(swarm_filter(50, bearing_std=0.05))
    mission = small_mission("passive", frames=60)
    fractional = 0
    for belief, _ in followed(slam, mission, START, drawing()):
        weight = normalised(belief.log_weight)
        expected = pytest.approx(weight @ (particles_of(belief).count == 1).sum(axis=1), abs=1e-12)
        assert belief.full == expected
        fractional += abs(belief.full - round(belief.full)) > 0.01
    assert fractional > 3


def test_resampling_below_the_threshold_keeps_the_estimates():
    slam, mission = swarm_filter(50, resample_below=1.0), small_mission("active", frames=5)
    belief, rng = slam.init(START), drawing()
    for controls, dt, scan in zip(mission.controls, mission.dt, mission.scans, strict=True):
        belief, _ = slam.predict(belief, controls, dt)
        normal, uniform = rng.standard_normal((50, 3)), rng.random(50)
        kept = never_resampling(slam).update(belief, scan, Drawn(normal, uniform))
        belief = slam.update(belief, scan, Drawn(normal, uniform))
    assert len(np.unique(belief.cloud()[:, 0])) < len(np.unique(kept.cloud()[:, 0])) == 50
    assert np.ptp(belief.log_weight) == 0 < np.ptp(kept.log_weight)
    np.testing.assert_array_equal(belief.pose().mean, kept.pose().mean)
    np.testing.assert_array_equal(belief.landmarks().mean, kept.landmarks().mean)
    assert belief.full == kept.full


# Gate


def looking_apart(slam):
    """A belief of two particles, one turned by half a radian, which know landmark 1 ahead."""
    belief = began(slam, (1, 4.0, 0.0), start=KNOWN_POSE)
    mean = belief.cloud().copy()
    mean[1, 2] = 0.5
    return with_particles(belief, mean=mean)


@pytest.mark.parametrize(("bearing", "gated"), [(0.0, 0), (-0.5, 0), (-0.25, 1), (1.0, 1)])
@pytest.mark.parametrize("distance", [4.0, np.nan])
def test_the_gate_drops_rows_that_no_particle_expects(bearing, gated, distance):
    slam = never_resampling(swarm_filter(2, gate=0.99, bearing_std=0.03))
    belief = looking_apart(slam)
    after = slam.update(belief, scan_of((1, distance, bearing)), drawing())
    assert after.gated == gated
    if gated:
        np.testing.assert_array_equal(particles_of(after).member, particles_of(belief).member)
    else:
        assert normalised(after.log_weight)[0 if bearing == 0.0 else 1] > 0.999


def test_gate_lets_new_landmarks_and_ranges_of_partial_ones_in():
    slam = swarm_filter(gate=0.5)
    belief = began(slam, (1, 4.0, 0.0), (2, np.nan, 1.0))
    after = slam.update(belief, scan_of((2, 3.0, -2.0), (3, np.nan, 2.0)), drawing())
    assert after.gated == 0
    assert after.full == pytest.approx(2, abs=1e-12)


def test_gate_of_one_drops_nothing():
    belief = began(swarm_filter(), (1, 4.0, 0.0))
    assert swarm_filter().update(belief, scan_of((1, 4e3, 3.0)), drawing()).gated == 0
