"""Huber's rule: references, the influence of one surprise, what is won against gross errors."""

from dataclasses import replace

import numpy as np
import pytest

from pipistrelle.config import RayConfig
from pipistrelle.estimation.beliefs import Gaussian
from pipistrelle.estimation.ekf.filter import EkfSlam, InvariantEkfSlam
from pipistrelle.evaluation.accuracy import position_error, rmse
from pipistrelle.experiments.runs.trial import run_filter
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
    ray_config,
    scan_with,
)

KINDS = [EkfSlam, InvariantEkfSlam]
PAIRS = [(EkfSlam, SlowEkfSlam), (InvariantEkfSlam, SlowInvariantEkfSlam)]
FITTED = RayConfig(precise_bearings="auto", prune_threshold=1e-3, exponent=1.0)
BELIEVED = 2.0
NAN = np.nan


# Against the references


def check_reference(kind, reference, strategy, rays, bearing_std, *, gate=1.0, **changes):
    """Follow a mission of precise noise and gross errors with a filter and its slow reference."""
    known = {"range_std": 0.05, "bearing_std": bearing_std}
    mission = paper_mission(strategy, outliers=0.05, **known, **changes)
    slam = paper_filter(kind, rays=rays, gate=gate, robust="huber", **known)
    slow = reference(BICYCLE, 0.05, bearing_std, rays, gate, robust=True)
    for belief, *_ in beside(slam, slow, mission):
        spread = slow.linear()[:3, :3]
        np.testing.assert_array_equal(belief.landmark, slow.landmark)
        np.testing.assert_allclose(belief.weight, slow.weight, rtol=0, atol=1e-9)
        np.testing.assert_allclose(belief.pose().mean, slow.mean[:3], rtol=0, atol=1e-9)
        np.testing.assert_allclose(belief.pose().covariance, spread, rtol=0, atol=1e-9)
    assert belief.gated == slow.gated
    rows = sum(scan.landmark.size for scan in mission.scans)
    assert 0.02 * rows < slow.tempered < 0.8 * rows, "some surprise, and not all"


@pytest.mark.parametrize(("kind", "reference"), PAIRS)
@pytest.mark.parametrize(
    ("strategy", "rays", "bearing_std"),
    [("active", FITTED, 0.01), ("fused", FITTED, 0.01), ("passive", ray_config(), 0.03)],
)
def test_a_robust_run_equals_the_slow_reference(kind, reference, strategy, rays, bearing_std):
    check_reference(kind, reference, strategy, rays, bearing_std, frames=15, hearing=8.0)


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "reference"), PAIRS)
@pytest.mark.parametrize("strategy", ["active", "fused", "passive"])
@pytest.mark.parametrize(("rays", "bearing_std"), [(FITTED, 0.01), (ray_config(), 0.03)])
@pytest.mark.parametrize("gate", [1.0, 0.99])
def test_every_robust_run_equals_the_slow_reference(
    kind, reference, strategy, rays, bearing_std, gate
):
    check_reference(kind, reference, strategy, rays, bearing_std, frames=50, gate=gate)


# One surprise

SURE = Gaussian(mean=np.zeros(3), covariance=np.zeros((3, 3)))
FAR, SPREAD, TURN = 4.0, 0.2, 0.05
"""Range of a post ahead [m], standard deviations of its range [m] and bearing [rad]."""


def post_ahead(kind, robust, **changes):
    """Return a filter that is sure of its pose, and its belief after it measured a post once."""
    slam = paper_filter(kind, robust=robust, range_std=SPREAD, bearing_std=TURN, **changes)
    return slam, slam.update(slam.init(SURE), scan_with([7], [0.0], [FAR]))


def corrected(kind, robust, off, farther=NAN):
    """Shift of the post along and across, by a measurement so many sigma S off in each."""
    slam, belief = post_ahead(kind, robust)
    bearing, distance = off * np.sqrt(2.0) * TURN, FAR + farther * np.sqrt(2.0) * SPREAD
    after = slam.update(belief, scan_with([7], [bearing], [distance]))
    return after, after.landmarks().mean[0] - belief.landmarks().mean[0]


def same(one, other):
    """Whether two beliefs agree to the bit."""
    names = ("mean", "covariance", "landmark", "weight")
    return all(getattr(one, name).tobytes() == getattr(other, name).tobytes() for name in names)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("off", "farther"), [(1.999, NAN), (-1.999, NAN), (1.99, -1.99), (0, 0)])
def test_innovations_within_two_sigma_update_unchanged_to_the_bit(kind, off, farther):
    plain, robust = (corrected(kind, robust, off, farther)[0] for robust in ("none", "huber"))
    assert same(plain, robust)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("off", "farther"), [(2.001, NAN), (-2.001, 0.0), (0.0, 2.001)])
def test_innovations_beyond_two_sigma_update_differently(kind, off, farther):
    plain, robust = (corrected(kind, robust, off, farther)[0] for robust in ("none", "huber"))
    assert not same(plain, robust)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("off", [2.5, -3.0, 5.0, -12.0, 30.0])
def test_a_bearing_beyond_two_sigma_corrects_by_two_sigma(kind, off):
    """The pose is known and P half of S, so that K nu k / e is half of 2 sqrt(S)."""
    _, (along, across) = corrected(kind, "huber", off)
    assert across == pytest.approx(np.sign(off) * FAR * np.sqrt(2.0) * TURN, rel=1e-9)
    assert along == pytest.approx(0.0, abs=1e-12)
    _, (_, allowed) = corrected(kind, "none", np.sign(off) * BELIEVED)
    assert across == pytest.approx(allowed, rel=1e-9)
    _, (_, plain) = corrected(kind, "none", off)
    assert plain == pytest.approx(across * abs(off) / BELIEVED, rel=1e-9)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("farther", [2.5, -3.0, 12.0, 30.0])
def test_a_range_beyond_two_sigma_corrects_by_two_sigma(kind, farther):
    _, (along, across) = corrected(kind, "huber", 0.0, farther)
    assert along == pytest.approx(np.sign(farther) * np.sqrt(2.0) * SPREAD, rel=1e-9)
    assert across == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize("kind", KINDS)
def test_larger_innovations_reduce_the_covariance_less(kind):
    """Of P half of S, P H^T H P / S' takes k / 2e off: it is R' = S' - P that counts."""
    for off in (1.0, 4.0, 40.0):
        after, _ = corrected(kind, "huber", off, 0.0)
        spread = after.landmarks().covariance[0]
        left = 1.0 - 0.5 * min(1.0, BELIEVED / off)
        assert spread[1, 1] == pytest.approx(left * (FAR * TURN) ** 2, rel=1e-9)
        assert spread[0, 0] == pytest.approx(SPREAD**2 / 2.0, rel=1e-9)


@pytest.mark.parametrize("kind", KINDS)
def test_range_and_bearing_are_tempered_separately(kind):
    _, calm = corrected(kind, "none", 1.0, -1.0)
    _, (along, across) = corrected(kind, "huber", 20.0, -1.0)
    assert along == pytest.approx(calm[0], rel=1e-9)
    assert across == pytest.approx(BELIEVED * calm[1], rel=1e-9)
    _, (along, across) = corrected(kind, "huber", 1.0, -8.0)
    assert along == pytest.approx(BELIEVED * calm[0], rel=1e-9)
    assert across == pytest.approx(calm[1], rel=1e-9)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("robust", ["none", "huber"])
def test_the_gate_applies_after_hubers_rule(kind, robust):
    slam, belief = post_ahead(kind, robust, gate=0.99)
    far_off = 10.0 * np.sqrt(2.0) * TURN  # of 10 sigma Huber's rule leaves sqrt(2 * 10)
    assert slam.update(belief, scan_with([7], [far_off])).gated == 1
    off = 3.0 * np.sqrt(2.0) * TURN  # 9 is beyond the gate's 6.6, and 2 * 3 is not
    assert slam.update(belief, scan_with([7], [off])).gated == (0 if robust == "huber" else 1)


# Rays, and bearings that wait


def shifted(belief, x, y):
    """Put the vehicle elsewhere, as sure of it as it was."""
    mean = belief.mean.copy()
    mean[:2] += x, y
    return replace(belief, mean=mean)


@pytest.mark.parametrize("kind", KINDS)
def test_a_bearing_expected_by_a_ray_member_is_not_tempered(kind):
    slams = [paper_filter(kind, robust=robust, bearing_std=0.05) for robust in ("none", "huber")]
    ray = slams[0].update(slams[0].init(SURE), scan_with([7], [0.0]))
    aside = shifted(ray, 0.0, -3.0)
    members = aside.landmarks().mean
    for x, y in members:
        bearing = [np.arctan2(y + 3.0, x)]
        plain, robust = (slam.update(aside, scan_with([7], bearing)) for slam in slams)
        assert same(plain, robust)
    plain, robust = (slam.update(aside, scan_with([7], [-1.0])) for slam in slams)
    assert not same(plain, robust), "to the other side nobody expects it"


@pytest.mark.parametrize("kind", KINDS)
def test_a_range_that_initialises_a_ray_is_not_tempered(kind):
    slams = [paper_filter(kind, robust=robust) for robust in ("none", "huber")]
    ray = slams[0].update(slams[0].init(SURE), scan_with([7], [0.0]))
    plain, robust = (slam.update(ray, scan_with([7], [0.0], [1.0])) for slam in slams)
    assert same(plain, robust)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("second", [-np.pi / 4, 1.0])
def test_a_waiting_bearing_initialises_unchanged_to_the_bit(kind, second):
    slams = [
        paper_filter(kind, robust=robust, rays=FITTED, bearing_std=0.01)
        for robust in ("none", "huber")
    ]
    waiting = slams[0].update(slams[0].init(SURE), scan_with([4], [0.0]))
    aside = shifted(waiting, 0.0, 2.0)
    plain, robust = (slam.update(aside, scan_with([4], [second])) for slam in slams)
    assert same(plain, robust)
    assert (robust.landmark.size == 1) == (second < 0.0)


@pytest.mark.parametrize("kind", KINDS)
def test_a_new_landmark_is_as_sure_as_its_measurement(kind):
    slams = [paper_filter(kind, robust=robust) for robust in ("none", "huber")]
    scan = scan_with([1, 2], [3.0, -2.0], [2.0, NAN])
    plain, robust = (slam.update(slam.init(START), scan) for slam in slams)
    assert same(plain, robust)


# What is won


def aligned_error(kind, robust, seed, gross):
    """Aligned RMSE of the path [m] on precise bearings, some of which are off by half a radian."""
    drive, scans = turn_and_drive(seed, gross=gross)
    rays = RayConfig(precise_bearings="auto", range_bounds=(0.2, 8.0))
    track = run_filter(kind(motion=drive.motion, rays=rays, robust=robust), drive, scans, None)
    return aligned_rmse(track.pose.mean[:, :2], drive.truth.path[:, :2])


@pytest.mark.parametrize("drives", [5, pytest.param(30, marks=pytest.mark.slow)])
@pytest.mark.parametrize("kind", KINDS)
def test_robust_filters_withstand_gross_errors_in_precise_bearings(kind, drives):
    calm, calm_robust, plain, robust = (
        np.array([aligned_error(kind, robust, seed, gross) for seed in range(drives)])
        for gross in (0.0, 0.05)
        for robust in ("none", "huber")
    )
    assert np.median(robust) < 0.2 * np.median(plain)
    assert np.median(robust) < 5.0 * np.median(calm)
    assert np.median(calm_robust / calm) == pytest.approx(1.0, abs=0.05)


def test_gross_errors_are_a_share_of_the_bearings_and_the_drive_is_the_same():
    drive, scans = turn_and_drive(1)
    other, wrong = turn_and_drive(1, gross=0.05)
    np.testing.assert_array_equal(drive.truth.path, other.truth.path)
    off = np.concatenate([a.bearing - b.bearing for a, b in zip(scans, wrong, strict=True)])
    hit = np.abs(off) > 1e-9
    assert np.mean(hit) == pytest.approx(0.05, abs=0.02)
    np.testing.assert_allclose(np.abs(np.remainder(off[hit] + np.pi, 2 * np.pi) - np.pi), 0.5)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("strategy", ["active", "fused"])
def test_with_the_papers_constants_and_no_gross_errors_little_changes(kind, strategy):
    errors = []
    for seed in range(3, 8):
        mission = paper_mission(strategy, frames=120, seed=seed)
        paths = [
            [belief.pose().mean[:2] for belief, _ in followed(slam, mission)]
            for slam in (paper_filter(kind), paper_filter(kind, robust="huber"))
        ]
        errors.append([rmse(position_error(np.array(p), mission.path[1:, :2])) for p in paths])
    plain, robust = np.median(errors, axis=0)
    assert robust == pytest.approx(plain, rel=0.05)


@pytest.mark.parametrize("kind", KINDS)
def test_a_filter_is_not_robust_by_default(kind):
    mission = paper_mission("fused", frames=10, outliers=0.2)
    runs = [followed(paper_filter(kind, **asked), mission) for asked in ({}, {"robust": "none"})]
    for (one, _), (other, _) in zip(*runs, strict=True):
        assert same(one, other)
