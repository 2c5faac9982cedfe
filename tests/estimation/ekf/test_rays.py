"""Rays inside the filter: born, weighed, pruned, given a range."""

import numpy as np
import pytest
from scipy.stats import chi2

from pipistrelle.estimation.beliefs import Gaussian
from pipistrelle.geometry import wrap
from reference.ekf_slam import SlowEkfSlam
from reference.missions import (
    BICYCLE,
    CIRCLE,
    KINDS,
    START,
    STEP,
    draw_mission,
    paper_filter,
    ray_config,
    scan_of,
    scattered,
    steady,
)

KNOWN_POSE = Gaussian(mean=np.zeros(3), covariance=np.zeros((3, 3)))
TRUTH = np.array([1.0, -4.9])
RANGES = 0.5 / 0.7 * np.array([1, 3, 9, 27])


def seen_along_a_line(slam, *, frames=12, speed=2.0):
    """Beliefs while the vehicle drives along x and hears exact bearings of TRUTH (label 7)."""
    belief = slam.update(slam.init(START), scan_of((1, 3.0, -1.0)))
    for frame in range(frames):
        x, y = START.mean[0] + frame * speed * STEP, START.mean[1]
        bearing = np.arctan2(TRUTH[1] - y, TRUTH[0] - x)
        belief = slam.update(belief, scan_of((7, np.nan, bearing)))
        yield belief
        belief, _ = slam.predict(belief, np.array([[speed, 0.0]]), np.array([STEP]))


def bearing_of(point, pose):
    """Bearing of a point from a pose."""
    return wrap(np.arctan2(point[1] - pose[1], point[0] - pose[0]) - pose[2])


def mixture_of(belief, label):
    """Mean and covariance of a landmark's mixture, and its covariance with the pose."""
    members = np.flatnonzero(belief.landmark == label)
    rows, w = 3 + 2 * members[:, None] + np.arange(2), belief.weight[members]
    means = belief.mean[rows]
    mean = w @ means
    own = sum(
        share * (belief.covariance[np.ix_(row, row)] + np.outer(m - mean, m - mean))
        for share, row, m in zip(w, rows, means, strict=True)
    )
    return mean, own, sum(s * belief.covariance[row, :3] for s, row in zip(w, rows, strict=True))


def test_landmark_heard_once_is_a_ray_along_its_bearing_and_not_fully_initialised():
    slam = paper_filter()
    belief = slam.update(slam.init(START), scan_of((5, np.nan, 0.4)))
    rows = belief.landmarks()
    assert rows.landmark.tolist() == [5, 5, 5, 5]
    np.testing.assert_allclose(rows.weight, 0.25, rtol=1e-15)
    direction = np.array([np.cos(0.4), np.sin(0.4)])
    points = START.mean[:2] + RANGES[:, None] * direction
    np.testing.assert_allclose(rows.mean, points, rtol=0, atol=1e-14)


def test_members_of_a_ray_are_correlated_only_through_the_pose():
    slam = paper_filter()
    belief = slam.update(slam.init(START), scan_of((5, np.nan, 0.4)))
    c, s = np.cos(0.4), np.sin(0.4)
    for i, ri in enumerate(RANGES):
        for j, rj in enumerate(RANGES):
            Gi, Gj = (np.array([[1, 0, -r * s], [0, 1, r * c]]) for r in (ri, rj))
            own = np.diag([(0.3 * ri) ** 2, (0.15 * ri) ** 2]) * (i == j)
            along = np.array([[c, -s], [s, c]])
            block = belief.covariance[3 + 2 * i : 5 + 2 * i, 3 + 2 * j : 5 + 2 * j]
            expected = Gi @ START.covariance @ Gj.T + along @ own @ along.T
            np.testing.assert_allclose(block, expected, rtol=0, atol=1e-13)


def test_bearings_from_one_known_position_never_change_the_weights():
    slam = paper_filter()
    belief = slam.init(KNOWN_POSE)
    for bearing in (0.4, 0.5, 0.2, 0.9, 0.3):
        belief = slam.update(belief, scan_of((5, np.nan, bearing)))
    np.testing.assert_allclose(belief.weight, 0.25, rtol=1e-12)


@pytest.mark.parametrize("weights", ["instantaneous", "aggregated"])
@pytest.mark.parametrize("power", [1.0, 3.0])
def test_parallax_finds_the_member_that_holds_the_landmark(weights, power):
    slam = paper_filter(bearing_std=0.05, rays=ray_config(weights=weights, exponent=power))
    *_, belief = seen_along_a_line(slam, frames=16)
    rows = belief.landmarks()
    heaviest = np.argmax(np.where(rows.landmark == 7, rows.weight, 0))
    error = rows.mean[heaviest] - TRUTH
    assert rows.weight[heaviest] > 0.9
    assert error @ np.linalg.solve(rows.covariance[heaviest], error) < chi2.ppf(0.99, 2)


def test_a_bearing_that_is_gated_prunes_nothing():
    *_, belief = seen_along_a_line(
        paper_filter(bearing_std=0.05, rays=ray_config(prune_threshold=0.0))
    )
    light = belief.weight[belief.landmark == 7] < 0.9 / 4
    assert 0 < light.sum() < light.size == 4
    strict = paper_filter(bearing_std=0.05, rays=ray_config(prune_threshold=0.9), gate=0.9)
    pose = belief.pose().mean
    expected = np.arctan2(TRUTH[1] - pose[1], TRUTH[0] - pose[0]) - pose[2]
    gated = strict.update(belief, scan_of((7, np.nan, wrap(expected + np.pi))))
    assert gated.gated == belief.gated + 1
    for field in ("mean", "covariance", "landmark", "weight"):
        np.testing.assert_array_equal(getattr(gated, field), getattr(belief, field))
    heard = strict.update(belief, scan_of((7, np.nan, wrap(expected))))
    assert heard.landmark.size < belief.landmark.size, "a bearing that is not prunes"


def test_pruning_removes_rows_and_changes_nothing_else():
    """Before and after a prune: the same numbers, to the last bit, without the pruned rows."""
    pruning = paper_filter(bearing_std=0.05)
    keeping = paper_filter(bearing_std=0.05, rays=ray_config(prune_threshold=0.0))
    belief = pruning.update(pruning.init(START), scan_of((1, 3.0, -1.0), (7, np.nan, 1.2)))
    belief = pruning.update(belief, scan_of((8, np.nan, -2.0), (9, 6.0, 2.0)))
    for frame in range(1, 20):
        belief, _ = pruning.predict(belief, np.array([[2.0, 0.0]]), np.array([STEP]))
        x, y = START.mean[0] + frame * 2.0 * STEP, START.mean[1]
        heard = scan_of((7, np.nan, np.arctan2(TRUTH[1] - y, TRUTH[0] - x)))
        pruned, kept = pruning.update(belief, heard), keeping.update(belief, heard)
        if pruned.landmark.size < kept.landmark.size:
            break
        belief = pruned
    ray = kept.landmark == 7
    dropped = ray & (kept.weight < 1e-3 / ray.sum())
    assert 0 < dropped.sum() < ray.sum()
    rows = np.concatenate([[True] * 3, np.repeat(~dropped, 2)])
    np.testing.assert_array_equal(pruned.landmark, kept.landmark[~dropped])
    np.testing.assert_array_equal(pruned.mean, kept.mean[rows])
    np.testing.assert_array_equal(pruned.covariance, kept.covariance[np.ix_(rows, rows)])
    rest = kept.weight[~dropped]
    own = pruned.landmark == 7
    np.testing.assert_array_equal(pruned.weight[~own], rest[~own])
    np.testing.assert_allclose(pruned.weight[own], rest[own] / rest[own].sum(), rtol=1e-15)


def test_a_range_replaces_a_partial_landmark():
    slam = paper_filter()
    before = slam.update(slam.init(START), scan_of((1, 3.0, 1.0), (5, np.nan, 0.4), (2, 2.0, 0.0)))
    after = slam.update(before, scan_of((5, 6.0, 0.3)))
    assert after.landmark.tolist() == [1, 5, 2]
    assert after.weight.tolist() == [1, 1, 1]
    fresh = slam.update(slam.init(START), scan_of((1, 3.0, 1.0), (5, 6.0, 0.3), (2, 2.0, 0.0)))
    np.testing.assert_allclose(after.mean, fresh.mean, rtol=0, atol=1e-14)
    np.testing.assert_allclose(after.covariance, fresh.covariance, rtol=0, atol=1e-14)


@pytest.mark.parametrize("kind", KINDS)
def test_members_that_agree_become_the_mixture_of_the_two(kind):
    """One member or several: mean and covariance of the landmark, with all else, are the same."""
    merging, keeping = (
        paper_filter(kind, rays=ray_config(prune_threshold=0.0, merge=merge))
        for merge in (1.0, 0.0)
    )
    for belief in seen_along_a_line(keeping, frames=40):
        heard = scan_of((7, np.nan, bearing_of(TRUTH, belief.mean)))
        apart, merged = keeping.update(belief, heard), merging.update(belief, heard)
        if merged.landmark.size < apart.landmark.size:
            break
    assert 1 < merged.landmark.size < apart.landmark.size
    for one, other in zip(mixture_of(apart, 7), mixture_of(merged, 7), strict=True):
        np.testing.assert_allclose(one, other, rtol=0, atol=1e-12)
    assert np.linalg.eigvalsh(merged.covariance).min() > -1e-12


def test_gate_drops_a_bearing_that_no_member_expected():
    slam = paper_filter(gate=0.999)
    belief = slam.update(slam.init(KNOWN_POSE), scan_of((5, np.nan, 0.0)))
    edge = np.sqrt(chi2.ppf(0.999, 1) * 2 * 0.15**2)
    outside = slam.update(belief, scan_of((5, np.nan, edge * (1 + 1e-6))))
    assert outside.gated == 1
    np.testing.assert_array_equal(outside.mean, belief.mean)
    np.testing.assert_array_equal(outside.weight, belief.weight)
    assert slam.update(belief, scan_of((5, np.nan, edge * (1 - 1e-6)))).gated == 0


@pytest.mark.slow
def test_keeping_the_members_common_bearing_noise_raises_the_nees():
    """The cross-covariance that Sola drops is an honest one, but shared updates reuse it.

    Over eight passive missions it moves the pose by a fraction of its deviation, shrinks the
    volume of the pose's ellipsoid in every mission, by a fifth on average, and raises the NEES.
    """
    moved, volume, nees = [], [], []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        field, drive = scattered(rng, 50), steady(CIRCLE, 60)
        mission = draw_mission(rng, BICYCLE, START, field, drive, beamwidth=0, hearing=14.0)
        without, keeping = (
            SlowEkfSlam(BICYCLE, 0.2, 0.15, ray_config(), common_bearing_noise=common).start(
                START.mean, START.covariance
            )
            for common in (False, True)
        )
        rows = []
        for frame, scan in enumerate(mission.scans):
            for slow in (without, keeping):
                slow.predict(mission.controls[frame], mission.dt[frame])
                slow.update(scan)
            rows.append(compared(without, keeping, mission.path[frame + 1]))
        rows = np.array(rows)
        moved.append(rows[:, 0].mean())
        volume.append(rows[:, 1].mean())
        nees.append(np.log(rows[:, 3].mean() / rows[:, 2].mean()))
    assert 0.1 < np.mean(moved) < 1
    assert max(volume) < 1
    assert 0.75 < np.mean(volume) < 0.9
    assert np.mean(nees) > 2 * np.std(nees, ddof=1) / np.sqrt(8)


def compared(without, keeping, truth):
    """Shift of the pose in deviations (rms), ratio of volumes, NEES without and with."""
    shift = keeping.X[:3] - without.X[:3]
    shift[2] = wrap(shift[2])
    variances = np.diag(without.P)[:3]
    volumes = [np.sqrt(np.linalg.det(slow.P[:3, :3])) for slow in (without, keeping)]
    nees = []
    for slow in (without, keeping):
        error = slow.X[:3] - truth
        error[2] = wrap(error[2])
        nees.append(error @ np.linalg.solve(slow.P[:3, :3], error))
    return np.sqrt(np.mean(shift**2 / variances)), volumes[1] / volumes[0], *nees


def test_filter_of_short_rays_goes_on_with_a_belief_of_long_ones():
    long, short = paper_filter(), paper_filter(rays=ray_config(range_bounds=(5.0, 6.0)))
    belief = long.update(long.init(START), scan_of((1, np.nan, 0.3), (2, np.nan, -1.0)))
    assert belief.landmark.tolist() == [1] * 4 + [2] * 4
    again = scan_of((1, np.nan, 0.31), (2, np.nan, -0.99))
    mine, other = short.update(belief, again), long.update(belief, again)
    np.testing.assert_array_equal(mine.mean, other.mean)
    np.testing.assert_array_equal(mine.covariance, other.covariance)
