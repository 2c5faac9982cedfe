"""Ranges without bearings: places, mirrors, updates, drives to the bound, and refusals."""

from dataclasses import replace

import numpy as np
import pytest

from pipistrelle.config import Config, FilterConfig, InputError, RayConfig
from pipistrelle.detection.scans import labelled, make_scan, with_columns, without_excess_paths
from pipistrelle.estimation.catalogue import entry
from pipistrelle.estimation.ekf.filter import EkfSlam, InvariantEkfSlam
from pipistrelle.estimation.observations.range import Ranges, located, refined
from pipistrelle.estimation.observations.rows import CAUCHY, HUBER, SQUARED, robust_loss
from pipistrelle.estimation.smoother.filter import Smoother
from pipistrelle.estimation.smoother.preintegration import calibration_of
from pipistrelle.evaluation.bound import path_bound, pose_bound
from reference.beacons import DT, EVERY, EXACT, UNICYCLE, bent, ranging, winding

KINDS = [EkfSlam, InvariantEkfSlam, Smoother]


def slam_of(kind, **changes):
    return kind(motion=UNICYCLE, rays=RayConfig(), **changes)


def ranges_of(points, distance, std, P=None):
    """Return ranges from positions with the covariance P; the newest position is exact."""
    n = len(points)
    whole = np.zeros((2 + 2 * n, 2 + 2 * n))
    if P is not None:
        whole[2:, 2:] = P
    at, variance = 2 + 2 * np.arange(n), np.full(n, std * std)
    return Ranges(points.ravel().copy(), distance, variance, at, whole, n, np.zeros((n + 3, n)))


@pytest.mark.parametrize("seed", range(20))
@pytest.mark.parametrize("turned", [False, True])
def test_positions_on_a_line_leave_two_mirrored_places_and_a_turn_one(seed, turned):
    rng, std = np.random.default_rng(seed), 0.02
    beacon, points = rng.uniform([0.0, 3.0], [12.0, 9.0]), np.zeros((9, 2))
    points[:, 0] = 1.5 * np.arange(9)
    if turned:
        points[5:] = np.column_stack([np.full(4, 6.0), 1.5 * np.arange(1, 5)])
    distance = np.hypot(*(points - beacon).T) + std * rng.standard_normal(9)
    count, one, other = located(ranges_of(points, distance, std), *points[-1], SQUARED)
    assert count == (1 if turned else 2)
    mirrors = [one] if turned else [one, other]
    spread = [np.array([[xx, xy], [xy, yy]]) for *_, xx, xy, yy in mirrors]
    off = [beacon - place[:2] for place in mirrors]
    assert min(e @ np.linalg.solve(C, e) for e, C in zip(off, spread, strict=True)) < 18.4
    if not turned:
        np.testing.assert_allclose(one[:2], [other[0], -other[1]], rtol=0, atol=1e-6)


@pytest.mark.parametrize("loss", [SQUARED, CAUCHY])
def test_derivatives_and_covariance_of_a_place_match_finite_differences(loss):
    rng, std = np.random.default_rng(4), 0.05
    points, beacon = np.cumsum(rng.uniform(-1.0, 2.0, (7, 2)), axis=0), np.array([9.0, -4.0])
    distance = np.hypot(*(points - beacon).T) + 0.001 * rng.standard_normal(7)
    root = 0.02 * rng.standard_normal((14, 14))
    ranges = ranges_of(points, distance, std, root @ root.T)
    place = refined(ranges, *beacon, loss)
    slopes = ranges.work[:2].copy()
    for j in range(7):
        further, nearer = distance.copy(), distance.copy()
        further[j], nearer[j] = distance[j] + 1e-5, distance[j] - 1e-5
        both = [refined(ranges._replace(distance=d), *beacon, loss)[:2] for d in (further, nearer)]
        expected = (np.array(both[0]) - both[1]) / 2e-5
        np.testing.assert_allclose(slopes[:, j], expected, rtol=0, atol=1e-3)
    U = (np.array(place[:2]) - points) / np.hypot(*(np.array(place[:2]) - points).T)[:, None]
    wide = np.zeros((7, 14))
    for j in range(7):
        wide[j, 2 * j : 2 * j + 2] = U[j]
    R = std**2 * np.eye(7) + wide @ root @ root.T @ wide.T
    expected = np.linalg.inv(U.T @ np.linalg.solve(R, U))
    np.testing.assert_allclose([place[3], place[4], place[5]], expected[[0, 0, 1], [0, 1, 1]], 2e-2)


@pytest.mark.parametrize("kind", [EkfSlam, InvariantEkfSlam])
def test_a_new_landmark_is_correlated_with_the_stored_positions(kind):
    """By differences of the update in all positions and ranges."""
    drive, slam = ranging(2, winding(), np.array([[6.0, 9.0]])), slam_of(kind)
    belief, dt = slam.init(EXACT), np.full(EVERY, DT)
    for k, scan in enumerate(drive.scans):
        before, _ = slam.predict(belief, drive.controls[EVERY * k : EVERY * (k + 1)], dt)
        belief = slam.update(before, scan)
        if (belief.weight >= 0.0).any():
            break
    stored, all_of = before.landmark.size, np.ones(before.landmark.size, bool)
    assert stored > 3

    def moved(step, e):
        """Return the mean after the update, with a number of the state or a range changed."""
        mean, weight, last = before.mean.copy(), before.weight.copy(), scan
        if e < mean.size:
            mean[e] += step
        elif e < mean.size + stored:
            weight[e - mean.size] -= step
        else:
            last = with_columns(scan, range=scan.range + step)
        return slam.update(replace(before, mean=mean, weight=weight), last).mean

    size = before.mean.size + stored + 1
    J = np.array([moved(1e-4, e) - moved(-1e-4, e) for e in range(size)]).T / 2e-4
    _, P = before._linear(all_of, with_pose=True)
    expected = J[:, : len(P)] @ P @ J[:, : len(P)].T + 0.01 * J[:, len(P) :] @ J[:, len(P) :].T
    found = belief.joint().covariance
    np.testing.assert_allclose(found, expected, rtol=0, atol=0.02 * np.abs(expected).max())


@pytest.mark.parametrize("kind", KINDS)
def test_a_straight_drive_leaves_mirrored_beacons_off_the_map_or_as_two_places(kind):
    *_, belief = ranging(1, np.zeros(300), np.array([[10, 6], [18, -8]])).followed(slam_of(kind))
    known = belief.landmarks()
    assert (known.weight < 0.99).all()
    if kind is Smoother:
        assert known.landmark.tolist() == [1, 1, 2, 2]
        assert (known.weight[::2] >= 0.5).all(), "the likelier is the first"
        np.testing.assert_allclose(known.mean[::2, 0], known.mean[1::2, 0], rtol=0, atol=1.0)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("worlds", [4, pytest.param(40, marks=pytest.mark.slow)])
def test_a_turn_by_ninety_degrees_excludes_the_mirrored_place(kind, worlds):
    right = []
    for seed in range(worlds):
        beacon = np.random.default_rng(seed).uniform([15.0, -15.0], [45.0, 25.0], (1, 2))
        drive = ranging(seed, bent(), beacon, reach=60.0)
        *_, belief = drive.followed(slam_of(kind))
        known = belief.landmarks()
        full = known.weight == 1.0
        off = np.hypot(*(known.mean[full] - beacon).T) if full.any() else []
        stds = 5.0 * np.sqrt(np.trace(known.covariance[full], axis1=1, axis2=2)) + 0.5
        assert (off < stds).all(), "none is silently wrong"
        right.append(full.any())
    assert np.mean(right) >= 0.95


@pytest.mark.parametrize(("kind", "most"), [(InvariantEkfSlam, 1.5), (Smoother, 1.1)])
@pytest.mark.parametrize("worlds", [3, pytest.param(16, marks=pytest.mark.slow)])
def test_errors_of_drives_with_ranges_only_are_near_the_bound(kind, most, worlds):
    errors, bounds = [], []
    for seed in range(worlds):
        drive = ranging(seed, winding())
        beliefs = list(drive.followed(slam_of(kind)))
        smoothed = beliefs[-1].path().mean[5::5] if kind is Smoother else None
        path = [belief.pose().mean for belief in beliefs] if smoothed is None else smoothed
        errors.append(np.mean(np.sum((path - drive.path[5::5])[:, :2] ** 2, axis=1)))
        time, known = DT * np.arange(len(drive.path)), (np.arange(1, 7), drive.beacons)
        bound = pose_bound(UNICYCLE, drive.controls, time, drive.path, known, drive.scans)
        bounds.append(path_bound(bound)[0] ** 2)
    assert np.sqrt(np.sum(errors) / np.sum(bounds)) < most


def test_scale_and_bias_of_ranges_are_calibrated():
    asked = Config(filter=FilterConfig(calibrate=("range_scale", "range_bias")))
    slam = slam_of(Smoother, calibration=calibration_of(asked, UNICYCLE))
    *_, belief = ranging(0, winding(), scale=1.05, bias=0.4).followed(slam)
    found = belief.calibration()
    for name, value in (("range_scale", 1.05), ("range_bias", 0.4)):
        assert abs(found[name][0] - value) < 3.0 * found[name][1]
        assert found[name][1] < 0.1


def test_robust_losses_match_their_formulae():
    for squared in (0.25, 4.0, 9.0, 100.0):
        e = np.sqrt(squared)
        assert robust_loss(squared, SQUARED) == (1.0, squared)
        expected = (1.0, squared) if e <= 2.0 else (e / 2.0, 2.0 * (2.0 * e - 2.0))
        assert robust_loss(squared, HUBER) == pytest.approx(expected)
        factor = 1.0 + squared / 2.385**2
        assert robust_loss(squared, CAUCHY) == pytest.approx((factor, 2.385**2 * np.log(factor)))


def test_rows_without_a_bearing_keep_their_ranges_when_merged():
    columns = {"range": np.array([3.0, 4.0, np.nan]), "excess_path": np.array([np.nan, 2.0, 1.0])}
    whose = {"caller": np.array([0, 1, 1])}
    scan = make_scan(0.0, np.array([7, 7, 7]), np.array([np.nan, 0.1, np.nan]), **columns, **whose)
    merged = labelled(scan, scan.landmark)
    np.testing.assert_array_equal(merged.range, [4.0, 3.0, np.nan])
    np.testing.assert_array_equal(without_excess_paths(merged).range, [4.0, 3.0])


def test_fastslam_refuses_a_range_without_a_bearing():
    slam = entry("fastslam").build(Config(), UNICYCLE)
    scan = ranging(0, winding(2.0), np.array([[3.0, 3.0]])).scans[0]
    with pytest.raises(InputError, match="found a range without a bearing"):
        slam.update(slam.init(EXACT), scan, np.random.default_rng(1))
