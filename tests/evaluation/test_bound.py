"""The bound along the true path, and what NEES a consistent filter has after an exact start."""

from collections import deque
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from pipistrelle.config import Config, RayConfig, ScenarioConfig
from pipistrelle.detection.scans import rows_of, with_columns
from pipistrelle.estimation.beliefs import Gaussian
from pipistrelle.estimation.motion import motion_step
from pipistrelle.estimation.smoother.filter import Smoother
from pipistrelle.evaluation.bound import PRIOR_STD, nees_of_exact_start, path_bound, pose_bound
from pipistrelle.evaluation.consistency import anees_bounds_about
from pipistrelle.experiments.drives import Drive, Truth
from pipistrelle.experiments.hearing.listening import listen
from pipistrelle.experiments.hearing.scenario import standing_landmarks, world_of
from pipistrelle.experiments.runs.heard_world import drive_of, scans_of
from pipistrelle.experiments.runs.trial import run_filter
from pipistrelle.geometry import range_and_bearing, wrap
from reference.ekf_slam import moved
from reference.missions import BICYCLE, CIRCLE, START, scan_with, scattered
from reference.odometry import as_poses
from reference.optimum import from_the_truth, poses_of

STEPS, EVERY, STEP = 60, 4, 0.125
SETTINGS = Config(scenario=ScenarioConfig(steps=STEPS, landmarks=12, radius=12.0))
WORLD = world_of(SETTINGS)
DRIVE = drive_of(WORLD, SETTINGS)
PLACES = standing_landmarks(WORLD)


def heard(strategy, noise="constant"):
    (frames,) = listen(WORLD, SETTINGS, [0.0025])
    told = SETTINGS.filter.model_copy(update={"noise": noise})
    return scans_of(frames, strategy, SETTINGS.model_copy(update={"filter": told}))


def bound_of(scans, *, motion=DRIVE.motion, places=PLACES):
    return pose_bound(motion, DRIVE.controls, DRIVE.time, WORLD.path, places, scans)


def true_control(k):
    """Speed and steering angle that truly led to step k: the front wheel's way and direction."""
    (x, y, heading), (to_x, to_y, _) = WORLD.path[k - 1 : k + 1]
    way = np.array([to_x - x, to_y - y])
    return np.hypot(*way) / STEP, wrap(np.arctan2(way[1], way[0]) - heading)


def conditioned_bound(scans, last):
    """Compute the same at a step at once: the prior of all poses and landmarks, given all heard.

    Independent of every kernel: the errors of all poses are a linear function of the controls'
    noise, landmarks have their flat prior, and all measurements are one linear observation.
    """
    labels, places = PLACES
    poses, noise = 3 * (last + 1), 2 * last
    spread = np.zeros((poses, noise))
    for k in range(1, last + 1):
        _, F, U = moved(DRIVE.motion, WORLD.path[k - 1], true_control(k), STEP)
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


@pytest.mark.parametrize("strategy", ["active", "fused", "passive"])
def test_a_heading_once_lost_is_never_known_again(strategy):
    """What is heard is relative to the vehicle: of how it stood in the world it tells nothing."""
    scans = heard(strategy, "measured")
    first = round(min(scan.time for scan in scans if len(scan.landmark)) / STEP)
    heading = bound_of(scans)[:, 2, 2]
    assert heading[first] > 0.01**2
    assert np.all(heading[first:] >= heading[first] * (1.0 - 1e-3))


def test_odometry_as_poses_has_the_same_bound():
    truly = np.array([true_control(k) for k in range(1, STEPS + 1)])
    scans, told = heard("fused"), as_poses(replace(DRIVE, controls=truly))
    same = pose_bound(told.motion, told.controls, told.time, WORLD.path, PLACES, scans)
    np.testing.assert_allclose(same, bound_of(scans), rtol=0, atol=1e-13)
    assert same[-1].any()


def test_the_bound_depends_on_labels_and_noise_and_not_on_values():
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


def test_the_bound_of_a_path_is_the_rms_over_its_steps():
    bound = bound_of(heard("fused"))
    position, heading = path_bound(bound)
    squared = bound[1:, 0, 0] + bound[1:, 1, 1]
    assert position == pytest.approx(np.sqrt(squared.sum() / STEPS), rel=1e-12)
    assert heading == pytest.approx(np.sqrt(bound[1:, 2, 2].sum() / STEPS), rel=1e-12)
    assert path_bound(bound[:1]) == (0.0, 0.0)


def test_rows_of_unknown_labels_and_empty_frames_do_not_count():
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


def test_a_wrong_start_turns_and_shifts_the_whole_path():
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


def drawn(seed, frames=60):
    """A world of noise exactly as it is told, its start exact: drive, scans, places by label."""
    rng = np.random.default_rng(seed)
    controls = np.tile(CIRCLE, (frames * EVERY, 1))
    path, points = [START.mean], scattered(rng, 100)
    points = points[np.hypot(*points.T) > 11.0][:40]  # the drive is a circle of radius 7.4 m
    for control in controls:
        noisy = control + rng.normal(size=2) * BICYCLE.control_std
        path.append(motion_step(BICYCLE, path[-1], noisy, STEP))
    scans = []
    for k in range(EVERY, len(path), EVERY):
        distance, bearing = range_and_bearing(path[k], points)
        near = np.flatnonzero(distance < 18.0)
        ranged = np.where(distance < 8.0, distance + rng.normal(0, 0.2, 40), np.nan)
        turned = wrap(bearing + rng.normal(0, 0.05, 40))
        scans.append(
            scan_with(near + 1, turned[near], ranged[near], time=k * STEP, bearing_std=0.05)
        )
    time, labels = STEP * np.arange(len(path)), np.arange(1, 41)
    truth = Truth(time=time, path=np.array(path), landmarks=(labels, points))
    start = Gaussian(mean=START.mean, covariance=np.zeros((3, 3)))
    drive = Drive(motion=BICYCLE, start=start, time=time, controls=controls, truth=truth)
    return drive, scans, dict(zip(labels.tolist(), points, strict=True))


@pytest.mark.slow
def test_the_smoother_online_and_the_best_from_the_truth_have_the_errors_of_the_bound():
    """Over 12 worlds the squares of errors are what the bound says, to the chance of one in 500."""
    squares, slam = [], Smoother(motion=BICYCLE, rays=RayConfig())
    for seed in range(12):
        drive, scans, places = drawn(seed)
        last, true = deque(maxlen=1), drive.truth.path
        track = run_filter(slam, drive, scans, None, watch=lambda *seen, to=last: to.append(seen))
        _, best = from_the_truth(last[0][1], true, places)
        bound = pose_bound(BICYCLE, drive.controls, drive.time, true, drive.truth.landmarks, scans)
        for estimate in (track.online.mean[-1], poses_of(best)[-1].copy()):
            error = estimate - true[-1]
            error[2] = wrap(error[2])
            squares.append(error @ np.linalg.solve(bound[-1], error))
    for one in (squares[::2], squares[1::2]):
        low, high = chi2.ppf([0.001, 0.999], 3 * 12)
        assert low < np.sum(one) < high


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


# Callers that move


def with_boat(scans, route, excess_path_std=0.05):
    """Scans in which label 12 is a caller on a route, heard always and with its excess paths."""
    timed, labels = [], PLACES[0]
    for scan in scans:
        rows = rows_of(scan, scan.landmark != 12)
        e = {
            "excess_path": np.ones(len(rows.landmark)),
            "excess_path_std": excess_path_std,
            "caller": 1,
        }
        timed.append(replace(with_columns(rows, **e), callers=np.array([-1, 12])))
    assert 12 in labels
    return timed


def bound_with_boat(route, wander, excess_path_std=0.05):
    rest = PLACES[0] != 12
    return pose_bound(
        DRIVE.motion, DRIVE.controls, DRIVE.time, WORLD.path, (PLACES[0][rest], PLACES[1][rest]),
        with_boat(heard("fused"), route, excess_path_std), {12: route}, wander,
    )  # fmt: skip


def test_a_caller_without_speed_has_the_bound_of_a_fixed_caller():
    stands = np.tile(PLACES[1][PLACES[0] == 12], (STEPS + 1, 1))
    still = bound_of(with_boat(heard("fused"), stands))
    np.testing.assert_allclose(bound_with_boat(stands, (1e-9, 0.0)), still, rtol=0, atol=1e-9)


def test_the_bound_grows_with_the_walk_of_a_caller():
    route = np.column_stack([np.linspace(3.0, 9.0, STEPS + 1), np.full(STEPS + 1, 4.0)])
    bounds = [path_bound(bound_with_boat(route, (1.0, walk)))[0] for walk in (0.0, 0.3, 3.0, 1e4)]
    assert bounds == sorted(bounds)
    assert bounds[0] < bounds[-1] - 1e-6
    deaf = path_bound(bound_with_boat(route, (1.0, 0.3), excess_path_std=1e6))[0]
    assert bounds[-1] < deaf, "many excess paths at once place even one that may be anywhere"


@pytest.mark.parametrize("odd_step", [STEP, 1.5 * STEP])
def test_a_heading_that_is_lost_is_not_known_again_by_how_a_caller_strays(odd_step):
    """What it does at random is as likely turned: nothing tells which way it was."""
    rng = np.random.default_rng(6)
    time = np.append(0.0, np.cumsum(np.where(np.arange(STEPS) % 2, odd_step, STEP)))
    walk = np.cumsum(rng.normal(0.0, 1.0, (STEPS + 1, 2)), axis=0) * STEP + [3.0, 4.0]
    straight = np.array([3.0, 4.0]) + [2.0, 0.0] * (time / time[-1])[:, None]
    rest = PLACES[0] != 12
    scans = [replace(scan, time=time[round(scan.time / STEP)]) for scan in heard("fused")]
    for route in (straight, walk):
        bound = pose_bound(
            DRIVE.motion, DRIVE.controls, time, WORLD.path, (PLACES[0][rest], PLACES[1][rest]),
            with_boat(scans, route, 1e-3), {12: route}, (1.0, 0.02),
        )  # fmt: skip
        heading = bound[EVERY:, 2, 2]
        assert heading.min() / heading[0] == pytest.approx(1.0, abs=1e-6)


def test_a_caller_measured_late_is_bounded_by_its_measurements():
    """Until then its place and velocity hang together, and turn with the heading."""
    rng = np.random.default_rng(6)
    walk = np.cumsum(rng.normal(0.0, 1.0, (STEPS + 1, 2)), axis=0) * STEP + [3.0, 4.0]
    rest = PLACES[0] != 12
    known = PLACES[0][rest], PLACES[1][rest]
    scans = with_boat(heard("fused"), walk)
    late = [
        replace(scan, callers=np.array([-1, -1])) if i < len(scans) - 3 else scan
        for i, scan in enumerate(scans)
    ]
    world = DRIVE.motion, DRIVE.controls, DRIVE.time, WORLD.path, known
    vague = [
        with_columns(scan, excess_path_std=1e9) if i < len(scans) - 3 else scan
        for i, scan in enumerate(scans)
    ]
    last, same, ever = (
        pose_bound(*world, told, {12: walk}, (1.0, 0.5)) for told in (late, vague, scans)
    )
    np.testing.assert_allclose(last, same, rtol=1e-6, atol=1e-12)
    assert path_bound(ever)[0] < path_bound(last)[0]
