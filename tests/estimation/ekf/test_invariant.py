"""The right-invariant filter against its slow reference, where it is linear, and by its laws."""

import itertools
from dataclasses import replace

import numpy as np
import pytest

from pipistrelle.estimation.beliefs import Gaussian
from pipistrelle.estimation.ekf.filter import EkfSlam, InvariantEkfSlam
from pipistrelle.estimation.motion import Motion
from pipistrelle.geometry import wrap
from reference.invariant_ekf import SlowInvariantEkfSlam
from reference.missions import (
    BICYCLE,
    SENSING,
    START,
    STEPS_PER_FRAME,
    draw_mission,
    followed,
    measured_to,
    paper_filter,
    paper_mission,
    ray_config,
    scattered,
    steady,
)
from reference.odometry import ANYONE, wandering

OPTIONS = list(
    itertools.product(("fused", "passive"), ("instantaneous", "aggregated"), ("anew", "bearing"))
)


def invariant_filter(motion=BICYCLE, gate=1.0, **changes):
    return paper_filter(InvariantEkfSlam, motion=motion, rays=ray_config(**changes), gate=gate)


def assert_equal_to_reference(slam, mission, start=START):
    """Every frame of the two filters agrees to 1e-9; returns the last belief."""
    slow = SlowInvariantEkfSlam(slam.motion, slam.range_std, slam.bearing_std, slam.rays, slam.gate)
    slow.start(start.mean, start.covariance)
    for frame, (belief, poses) in enumerate(followed(slam, mission, start)):
        means, covariances = slow.predict(mission.controls[frame], mission.dt[frame])
        slow.update(mission.scans[frame])
        linear, landmarks = slow.linear(), belief.landmarks()
        mapped = linear[3:, 3:].reshape(len(slow.landmark), 2, len(slow.landmark), 2)
        rows = np.arange(len(slow.landmark))
        for found, expected in (
            (poses.mean, means),
            (poses.covariance, covariances),
            (belief.pose().mean, slow.mean[:3]),
            (belief.pose().covariance, linear[:3, :3]),
            (landmarks.landmark, slow.landmark),
            (landmarks.mean, slow.mean[3:].reshape(-1, 2)),
            (landmarks.covariance, mapped[rows, :, rows, :]),
            (landmarks.weight, slow.weight),
        ):
            np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9)
        assert belief.gated == slow.gated
        np.testing.assert_allclose(belief.innovations, slow.innovations, rtol=1e-6)
    return belief


@pytest.mark.parametrize(("strategy", "weights", "ranged"), OPTIONS)
def test_run_equals_the_slow_reference(strategy, weights, ranged):
    merge = 1.0 if weights == "aggregated" else 0.0
    slam = invariant_filter(weights=weights, ranged=ranged, merge=merge, power=2.0, gate=0.999)
    belief = assert_equal_to_reference(slam, paper_mission(strategy, frames=24, outliers=0.06))
    assert np.unique(belief.landmark).size > 5
    assert belief.gated > 0


@pytest.mark.slow
@pytest.mark.parametrize("strategy", SENSING)
def test_whole_run_equals_the_slow_reference(strategy):
    belief = assert_equal_to_reference(invariant_filter(), paper_mission(strategy))
    assert np.unique(belief.landmark).size > 25


def test_unicycle_that_stops_turns_and_reverses_equals_the_slow_reference():
    rng = np.random.default_rng(8)
    motion = Motion(model="unicycle", control_std=(0.1, 0.15), noise_at_rest=False)
    controls = rng.uniform([-0.5, -1], [1, 1], size=(40, STEPS_PER_FRAME, 2))
    controls[rng.random(controls.shape[:2]) < 0.3] = 0
    field = scattered(rng, 20, radius=10.0)
    mission = draw_mission(rng, motion, START, field, controls, beamwidth=2.0, hearing=10.0)
    assert_equal_to_reference(invariant_filter(motion=motion), mission)


@pytest.mark.parametrize("stated", [True, False])
def test_a_drive_by_poses_equals_the_slow_reference(stated):
    rng = np.random.default_rng(8)
    motion = replace(ANYONE, noise_at_rest=stated)
    controls = wandering(rng, 40 * STEPS_PER_FRAME, stated=stated).reshape(40, STEPS_PER_FRAME, -1)
    field = scattered(rng, 20, radius=10.0)
    mission = draw_mission(rng, motion, START, field, controls, beamwidth=2.0, hearing=10.0)
    assert_equal_to_reference(invariant_filter(motion=motion), mission)


def heading_variance_of_a_standing_vehicle(slam):
    """Heading's variance after 50 noisy looks at five landmarks, as a share of the start's."""
    rng = np.random.default_rng(4)
    points = scattered(rng, 5, radius=12.0)
    mission = draw_mission(
        rng, slam.motion, START, points, np.zeros((50, STEPS_PER_FRAME, 2)),
        beamwidth=7.0, reach=40.0, bearing_std=0.15,
    )  # fmt: skip
    *_, (belief, _) = followed(slam, mission)
    return belief.pose().covariance[2, 2] / START.covariance[2, 2]


def test_a_standing_vehicle_learns_nothing_of_its_heading_but_the_plain_filter_thinks_it_does():
    standing = Motion(model="bicycle", control_std=(0.1, 0.03), wheelbase=0.2, noise_at_rest=False)
    invariant = heading_variance_of_a_standing_vehicle(invariant_filter(motion=standing))
    plain = heading_variance_of_a_standing_vehicle(paper_filter(motion=standing))
    assert invariant == pytest.approx(1.0, abs=1e-9)
    assert plain < 0.9


@pytest.mark.parametrize("strategy", SENSING)
def test_turning_and_shifting_the_world_turns_and_shifts_the_estimate_and_nothing_else(strategy):
    mission, turn, shift = paper_mission(strategy, frames=60), 2.0, np.array([300.0, -40.0])
    c, s = np.cos(turn), np.sin(turn)
    R, whole = np.array([[c, -s], [s, c]]), np.eye(3)
    whole[:2, :2] = R
    moved = Gaussian(
        mean=np.array([*(R @ START.mean[:2] + shift), wrap(START.mean[2] + turn)]),
        covariance=whole @ START.covariance @ whole.T,
    )
    *_, (belief, _) = followed(invariant_filter(), mission)
    *_, (other, _) = followed(invariant_filter(), mission, moved)
    pose, there = belief.pose(), other.pose()
    np.testing.assert_allclose(there.mean[:2], R @ pose.mean[:2] + shift, rtol=0, atol=1e-8)
    assert wrap(there.mean[2] - pose.mean[2] - turn) == pytest.approx(0, abs=1e-9)
    turned = whole @ pose.covariance @ whole.T
    np.testing.assert_allclose(there.covariance, turned, rtol=0, atol=1e-9)
    known, placed = belief.landmarks(), other.landmarks()
    np.testing.assert_array_equal(placed.landmark, known.landmark)
    np.testing.assert_allclose(placed.mean, known.mean @ R.T + shift, rtol=0, atol=1e-8)
    np.testing.assert_allclose(placed.weight, known.weight, rtol=0, atol=1e-9)


def test_both_filters_agree_where_the_noise_vanishes():
    """What linearisation costs is of second order; so is what the filters differ by."""

    def difference(scale):
        motion = Motion(model="bicycle", control_std=(0.1 * scale, 0.03 * scale), wheelbase=0.2)
        start = Gaussian(mean=START.mean, covariance=scale**2 * START.covariance)
        std = {"range_std": 0.2 * scale, "bearing_std": 0.15 * scale}
        rng = np.random.default_rng(6)
        mission = draw_mission(
            rng, motion, start, scattered(rng, 10), steady((0.75, 0.1), 10),
            beamwidth=7.0, reach=60.0, **std,
        )  # fmt: skip
        scans = [measured_to(scan, **std) for scan in mission.scans]
        means = []
        for kind in (EkfSlam, InvariantEkfSlam):
            slam = kind(motion=motion, rays=ray_config())
            belief = slam.init(start)
            for controls, dt, scan in zip(mission.controls, mission.dt, scans, strict=True):
                belief, _ = slam.predict(belief, controls, dt)
                belief = slam.update(belief, scan)
            means.append(belief.pose().mean)
        return np.abs(means[0] - means[1]).max() / scale

    coarse, fine = difference(1e-2), difference(1e-3)
    assert 0 < fine < 1e-2
    assert coarse / fine == pytest.approx(10, rel=0.3)
