"""The bound along the true path, and what NEES a consistent filter has after an exact start."""

import numpy as np
import pytest
from scipy.stats import chi2

from pipistrelle.config import Config, ScenarioConfig
from pipistrelle.evaluation.bound import PRIOR_STD, nees_of_exact_start, pose_bound
from pipistrelle.evaluation.consistency import anees_bounds_about
from pipistrelle.experiments.hearing.listening import listen
from pipistrelle.experiments.hearing.scenario import standing_landmarks, world_of
from pipistrelle.experiments.runs.trial import drive_of, scans_of
from reference.ekf_slam import moved
from reference.missions import scan_with

STEPS, EVERY, STEP = 60, 4, 0.125
SETTINGS = Config(scenario=ScenarioConfig(steps=STEPS, landmarks=12, radius=12.0))
WORLD = world_of(SETTINGS)
DRIVE = drive_of(WORLD, SETTINGS)
PLACES = standing_landmarks(WORLD)


def heard(strategy):
    (frames,) = listen(WORLD, SETTINGS, [0.0025])
    return scans_of(frames, strategy, SETTINGS)


def bound_of(scans, *, motion=DRIVE.motion, places=PLACES):
    return pose_bound(motion, DRIVE.controls, DRIVE.time, WORLD.path, places, scans)


def conditioned_bound(scans, last):
    """Compute the same at a step at once: the prior of all poses and landmarks, given all heard.

    Independent of every kernel: the errors of all poses are a linear function of the controls'
    noise, landmarks have their flat prior, and all measurements are one linear observation.
    """
    labels, places = PLACES
    poses, noise = 3 * (last + 1), 2 * last
    spread = np.zeros((poses, noise))
    for k in range(1, last + 1):
        _, F, U = moved(DRIVE.motion, WORLD.path[k - 1], DRIVE.controls[k - 1], STEP)
        spread[3 * k : 3 * k + 3] = F @ spread[3 * k - 3 : 3 * k]
        spread[3 * k : 3 * k + 3, 2 * k - 2 : 2 * k] = U * DRIVE.motion.control_std
    C = np.zeros((poses + places.size, poses + places.size))
    C[:poses, :poses], C[poses:, poses:] = spread @ spread.T, PRIOR_STD**2 * np.eye(places.size)
    rows, R = [], []
    for scan in scans:
        k = round(scan.time / STEP)
        for label, distance in zip(scan.landmark, scan.range, strict=True):
            n = poses + 2 * int(np.flatnonzero(labels == label)[0])
            dx, dy = places[(n - poses) // 2] - WORLD.path[k, :2]
            d = np.hypot(dx, dy)
            for slope, std in (((dx / d, dy / d), 0.2), ((-dy / d**2, dx / d**2), 0.15)):
                row = np.zeros(len(C))
                if k <= last and not (std == 0.2 and np.isnan(distance)):
                    row[n : n + 2], row[3 * k : 3 * k + 2] = slope, np.negative(slope)
                    row[3 * k + 2] = -1.0 if std == 0.15 else 0.0
                    rows.append(row)
                    R.append(std**2)
    H = np.array(rows)
    gain = C @ H.T @ np.linalg.inv(H @ C @ H.T + np.diag(R))
    return (C - gain @ H @ C)[poses - 3 : poses, poses - 3 : poses]


@pytest.mark.parametrize("strategy", ["active", "fused", "passive"])
def test_the_bound_is_the_prior_of_everything_given_everything_heard_at_once(strategy):
    scans = heard(strategy)
    assert sum(len(scan.landmark) for scan in scans) > 20
    bound = bound_of(scans)
    for k in (EVERY, 18, STEPS):
        np.testing.assert_allclose(bound[k], conditioned_bound(scans, k), rtol=0, atol=1e-11)


def test_the_bound_hangs_on_no_measurement_but_on_who_was_heard_how_surely():
    scans = heard("fused")
    wrong = [
        scan_with(
            scan.landmark, scan.bearing + 0.3, scan.range * 1.1, time=scan.time
        ) for scan in scans
    ]  # fmt: skip
    np.testing.assert_array_equal(bound_of(scans), bound_of(wrong))


def test_twice_the_noise_raises_the_bound_and_more_to_hear_lowers_it():
    def area(scans, **more):
        return np.trace(bound_of(scans, **more)[:, :2, :2], axis1=1, axis2=2)[EVERY:].mean()

    louder = SETTINGS.filter.model_copy(update={"range_std": 0.4, "bearing_std": 0.3})
    (frames,) = listen(WORLD, SETTINGS, [0.0025])
    noisy = scans_of(frames, "fused", SETTINGS.model_copy(update={"filter": louder}))
    assert area(heard("fused")) < area(noisy)
    assert area(heard("fused")) < area(heard("active"))
    assert area(heard("fused")) < area(heard("passive")) < area([])


def test_rows_of_unknown_labels_and_frames_without_rows_tell_nothing():
    scans = heard("active")
    stranger = scan_with([999], [0.1], [3.0], time=0.25)
    with_more = sorted([*scans, stranger, scan_with(time=0.375)], key=lambda scan: scan.time)
    np.testing.assert_array_equal(bound_of(scans), bound_of(with_more))


def test_labels_and_their_order_are_only_names():
    scans, (labels, places) = heard("fused"), PLACES
    turned = labels[::-1].copy(), places[::-1].copy()
    np.testing.assert_allclose(bound_of(scans), bound_of(scans, places=turned), rtol=1e-9)


def test_an_exact_start_leaves_a_consistent_filter_under_three():
    """Errors drawn from the bound, told the bound and the start's own covariance beside it."""
    start = DRIVE.start.covariance
    bound = bound_of(heard("active"))
    mean, variance = nees_of_exact_start(bound, WORLD.path, start)
    rng, runs = np.random.default_rng(5), 20_000
    for k in (EVERY, 20, STEPS):
        G = np.eye(3)
        G[0, 2], G[1, 2] = WORLD.path[0, 1] - WORLD.path[k, 1], WORLD.path[k, 0] - WORLD.path[0, 0]
        told = bound[k] + G @ start @ G.T
        errors = rng.multivariate_normal(np.zeros(3), bound[k], runs, method="cholesky")
        nees = np.einsum("ni,ij,nj->n", errors, np.linalg.inv(told), errors)
        assert nees.mean() == pytest.approx(mean[k], abs=4.5 * np.sqrt(variance[k] / runs))
        assert nees.var() == pytest.approx(variance[k], rel=0.1)
        assert 0.0 < mean[k] < 3.0
    drawn = rng.multivariate_normal(np.zeros(3), told, runs, method="cholesky")
    nees = np.einsum("ni,ij,nj->n", drawn, np.linalg.inv(told), drawn)
    assert nees.mean() == pytest.approx(3.0, abs=0.1)  # the control: a start drawn from P_0


def test_the_wronged_start_turns_and_shifts_the_whole_path():
    """G is the derivative of every later pose by the first: the filter can never tell it."""
    path = WORLD.path
    for axis in range(3):
        moved_start = path[0] + 1e-6 * np.eye(3)[axis]
        turn = moved_start[2] - path[0, 2]
        c, s = np.cos(turn), np.sin(turn)
        offset = (path[:, :2] - path[0, :2]) @ np.array([[c, s], [-s, c]])
        shifted = np.column_stack([moved_start[:2] + offset, path[:, 2] + turn])
        slope = (shifted - path) / 1e-6
        cov = np.zeros((3, 3))
        cov[axis, axis] = 1.0
        mean, _ = nees_of_exact_start(np.tile(1e6 * np.eye(3), (len(path), 1, 1)), path, cov)
        share = np.sum(slope**2, axis=1)  # tr (b I + s s^T)^-1 b = 3 - |s|^2 / (b + |s|^2)
        np.testing.assert_allclose(3.0 - mean, share / (1e6 + share), rtol=1e-4)


@pytest.mark.slow
def test_over_the_papers_mission_it_is_some_two_and_a_quarter_for_active_sensing_at_180_degrees():
    values = []
    for seed in range(4):
        config = Config(seed=1000 + seed)
        world = world_of(config)
        drive = drive_of(world, config)
        (frames,) = listen(world, config, [0.0025])
        bound = pose_bound(
            drive.motion, drive.controls, drive.time, world.path, standing_landmarks(world),
            scans_of(frames, "active", config),
        )  # fmt: skip
        values.append(nees_of_exact_start(bound, world.path, drive.start.covariance)[0][1:].mean())
    assert np.mean(values) == pytest.approx(2.24, abs=0.1)  # by a linear simulation


def test_bounds_about_another_mean_are_chi_squares_where_the_weights_are_equal():
    low, high = anees_bounds_about(np.array([2.0]), np.array([4.0]), 10)
    exact = chi2.ppf([0.025, 0.975], 20) / 10
    np.testing.assert_allclose([low[0], high[0]], exact, rtol=1e-9)
    rng, weights = np.random.default_rng(3), np.array([0.9, 0.7, 0.2])
    means = (rng.chisquare(1, (20_000, 30, 3)) @ weights).mean(axis=1)
    low, high = anees_bounds_about(
        np.array([weights.sum()]), np.array([2 * (weights**2).sum()]), 30
    )
    assert np.mean((means > low) & (means < high)) == pytest.approx(0.95, abs=0.006)
