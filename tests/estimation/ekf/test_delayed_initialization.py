"""Precise bearings wait until another crosses them: references, geometry, what is won."""

from dataclasses import replace

import numpy as np
import pytest

from pipistrelle.config import Config, RayConfig
from pipistrelle.estimation.beliefs import Gaussian, placed
from pipistrelle.estimation.ekf.filter import EkfSlam, InvariantEkfSlam
from pipistrelle.estimation.motion import motion_step
from pipistrelle.experiments.runs.trial import run_filter
from pipistrelle.settings import from_flags, resolve
from reference.drives import aligned_rmse, turn_and_drive
from reference.ekf_slam import SlowEkfSlam
from reference.invariant_ekf import SlowInvariantEkfSlam
from reference.missions import (
    BICYCLE,
    START,
    beside,
    followed,
    paper_filter,
    paper_mission,
    scan_with,
)

FITTED = RayConfig(precise_bearings="auto", prune_threshold=1e-3, exponent=1.0)
SHARP = {"range_std": 0.05, "bearing_std": 0.01}
KINDS = [EkfSlam, InvariantEkfSlam]


@pytest.mark.parametrize("strategy", ["fused", "passive"])
@pytest.mark.parametrize(
    ("kind", "reference"), [(EkfSlam, SlowEkfSlam), (InvariantEkfSlam, SlowInvariantEkfSlam)]
)
def test_a_run_with_precise_bearings_equals_the_slow_reference(kind, reference, strategy):
    mission = paper_mission(strategy, frames=40, bearing_std=0.01, range_std=0.05)
    slow = reference(BICYCLE, 0.05, 0.01, FITTED)
    counts = set()
    for belief, *_ in beside(paper_filter(kind, rays=FITTED, **SHARP), slow, mission):
        np.testing.assert_array_equal(belief.landmark, slow.landmark)
        np.testing.assert_array_equal(belief.weight, slow.weight)
        np.testing.assert_allclose(belief.pose().mean, slow.mean[:3], rtol=0, atol=1e-9)
        full = placed(belief.landmarks())
        mapped = slow.mean[3:].reshape(-1, 2)
        np.testing.assert_allclose(belief.landmarks().mean[full], mapped[full], rtol=0, atol=1e-8)
        linear = slow.linear()
        own = np.array([linear[i : i + 2, i : i + 2] for i in range(3, len(linear), 2)])
        covariance = belief.landmarks().covariance
        np.testing.assert_allclose(covariance[full], own[full], rtol=0, atol=1e-8)
        counts |= {(np.sum(full), np.sum(~full))}
    assert max(full for full, _ in counts) > 5
    assert max(waiting for _, waiting in counts) > 5


def heard_from(kind, *bearings, std=0.01, at=(0.0, 2.0), robust="none"):
    """Hear landmark 4 from the origin and, sure of both, from another place at right angles."""
    slam = kind(motion=BICYCLE, rays=FITTED, robust=robust)
    belief = slam.init(Gaussian(mean=np.zeros(3), covariance=1e-12 * np.eye(3)))
    belief = slam.update(belief, scan_with([4], bearings[:1], bearing_std=std))
    if len(bearings) > 1:
        shifted = belief.mean.copy()
        shifted[:2] += at
        belief = slam.update(
            replace(belief, mean=shifted), scan_with([4], bearings[1:2], bearing_std=std)
        )
    return belief


@pytest.mark.parametrize("kind", KINDS)
def test_a_waiting_bearing_is_reported_as_a_partial_landmark(kind):
    rows = heard_from(kind, 0.3).landmarks()
    assert rows.landmark.tolist() == [4, 4]
    assert rows.weight.tolist() == [0.5, 0.5]
    np.testing.assert_allclose(np.arctan2(rows.mean[:, 1], rows.mean[:, 0]), 0.3)
    ranges = np.hypot(*rows.mean.T)
    u = np.array([np.cos(0.3), np.sin(0.3)])
    np.testing.assert_allclose([np.sqrt(u @ P @ u) for P in rows.covariance], ranges / 2, rtol=1e-6)
    assert not placed(rows).any()


@pytest.mark.parametrize("kind", KINDS)
def test_two_bearings_place_a_landmark_where_they_cross(kind):
    """From (0, 0) straight ahead, from (0, 2) by 45 degrees to the right: at (2, 0)."""
    rows = heard_from(kind, 0.0, -np.pi / 4).landmarks()
    assert rows.landmark.tolist() == [4]
    np.testing.assert_allclose(rows.mean, [[2.0, 0.0]], rtol=0, atol=1e-9)
    # Across the first ray 2 m x 0.01; across the second 2 sqrt(2) m x 0.01, at 45 degrees to it.
    J = np.array([[0.0, 1.0], [1.0, 1.0]]) / np.array([[1.0], [np.sqrt(2)]])
    R = np.diag([(2 * 0.01) ** 2, (np.sqrt(8) * 0.01) ** 2])
    expected = np.linalg.inv(J.T @ np.linalg.inv(R) @ J)
    np.testing.assert_allclose(rows.covariance[0], expected, rtol=0, atol=1e-9)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    "second",
    [
        pytest.param(0.0, id="parallel"),
        pytest.param(np.pi / 4, id="apart, crossing behind"),
        pytest.param(-0.02, id="too far to be sure of"),
    ],
)
def test_a_bearing_that_does_not_cross_surely_ahead_places_nothing(kind, second):
    belief = heard_from(kind, 0.0, second)
    assert belief.landmarks().landmark.tolist() == [4, 4]
    assert np.isfinite(belief.covariance).all()


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("degrees", "robust"), [(15.0, 2), (28.0, 2), (30.0, 1), (45.0, 1)])
def test_robust_initialization_needs_bearings_that_cross_clearly(kind, degrees, robust):
    plain, careful = (
        heard_from(kind, 0.0, -np.radians(degrees), robust=how).landmarks()
        for how in ("none", "huber")
    )
    assert (len(plain.landmark), len(careful.landmark)) == (1, robust)


@pytest.mark.parametrize("kind", KINDS)
def test_coarse_bearings_and_the_papers_spacing_are_as_ever_to_the_bit(kind):
    mission = paper_mission("fused", frames=30)
    runs = [
        [belief for belief, _ in followed(kind(motion=BICYCLE, rays=rays), mission)]
        for rays in (FITTED, FITTED.model_copy(update={"spacing": "paper"}))
    ]
    for one, other in zip(*runs, strict=True):
        np.testing.assert_array_equal(one.mean, other.mean)
        np.testing.assert_array_equal(one.covariance, other.covariance)


def test_a_range_initialises_a_landmark_with_a_waiting_bearing():
    slam = EkfSlam(motion=BICYCLE, rays=FITTED)
    belief = slam.init(Gaussian(mean=np.zeros(3), covariance=1e-12 * np.eye(3)))
    belief = slam.update(belief, scan_with([4], [0.0], bearing_std=0.01))
    belief = slam.update(belief, scan_with([4], [0.0], [3.0], bearing_std=0.01, range_std=0.1))
    np.testing.assert_allclose(belief.landmarks().mean, [[3.0, 0.0]], atol=1e-9)


@pytest.mark.parametrize("kind", KINDS)
def test_a_precise_bearing_updates_a_ray_within_its_members_linearity(kind):
    """A coarse bearing casts the ray; of two that follow, one is as precise as members allow."""

    def after(std):
        slam = kind(motion=BICYCLE, rays=FITTED)
        belief = slam.init(START)
        for bearing, known in ((0.3, 0.15), (0.32, std)):
            belief = slam.update(belief, scan_with([4], [bearing], bearing_std=known))
        return belief

    linear_to = FITTED.relative_std**2 / 2
    sharp, members = after(0.003), after(linear_to * (1 + 1e-12))
    assert members.landmark.size > 2
    np.testing.assert_allclose(sharp.mean, members.mean, rtol=0, atol=1e-9)
    np.testing.assert_allclose(sharp.covariance, members.covariance, rtol=0, atol=1e-9)


def test_fitted_rays_with_the_printed_likelihood_are_refused():
    with pytest.raises(ValueError, match='precise_bearings "auto" needs likelihood "normal"'):
        RayConfig(precise_bearings="auto", likelihood="printed")
    assert resolve(from_flags({"rays": {"precise_bearings": "auto"}})) != Config()


def errors(kind, spacing, seeds):
    """Aligned RMSE of the path [m] on precise bearings, and of dead reckoning, by seed."""
    found = []
    for seed in seeds:
        drive, scans = turn_and_drive(seed)
        rays = RayConfig(precise_bearings=spacing, range_bounds=(0.2, 8.0))
        track = run_filter(kind(motion=drive.motion, rays=rays), drive, scans, None)
        reckoned = [drive.start.mean]
        for control, dt in zip(drive.controls, np.diff(drive.time), strict=True):
            reckoned.append(motion_step(drive.motion, reckoned[-1], control, dt))
        true = drive.truth.path[:, :2]
        paths = track.pose.mean[:, :2], np.array(reckoned)[:, :2]
        found.append([aligned_rmse(path, true) for path in paths])
    return np.array(found)


@pytest.mark.parametrize("kind", KINDS)
def test_precise_bearings_beat_dead_reckoning_fitted_and_are_lost_with_the_papers_rays(kind):
    fitted = errors(kind, "auto", range(5))
    assert np.median(fitted[:, 0]) < 0.15
    assert np.median(fitted[:, 0]) < 0.2 * np.median(fitted[:, 1])
    coarse = errors(kind, "paper", range(5))
    assert np.median(coarse[:, 0]) > np.median(coarse[:, 1])
