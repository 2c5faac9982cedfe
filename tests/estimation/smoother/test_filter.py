"""The smoother against everything at once by numpy, from the truth, and by its laws."""

from dataclasses import replace

import numpy as np
import pytest

from pipistrelle.detection.scans import EXCESS_PATH, rows_of, with_columns
from pipistrelle.estimation.beliefs import Gaussian, placed
from pipistrelle.estimation.motion import Motion
from pipistrelle.estimation.observations.excess_path import excess_path_of
from pipistrelle.estimation.smoother.filter import Smoother
from pipistrelle.evaluation.accuracy import alignment, moved
from pipistrelle.experiments.drives import Drive
from pipistrelle.experiments.runs.trial import run_filter
from pipistrelle.geometry import wrap
from reference.everything import Everything
from reference.missions import (
    BICYCLE,
    CIRCLE,
    SENSING,
    START,
    STEP,
    STEPS_PER_FRAME,
    draw_mission,
    followed,
    measured_to,
    paper_mission,
    ray_config,
    scan_of,
    scan_with,
    scattered,
    steady,
)
from reference.optimum import from_the_truth, poses_of
from reference.timing import excess_path_jacobians, timed

STD = {"range_std": 0.2, "bearing_std": 0.05}
STOPS = 2e-3
"""Share of a deviation within which Levenberg and Marquardt stop, at the paper's noise."""
STANDING = replace(BICYCLE, noise_at_rest=False)


def smoother(motion=BICYCLE, **changes):
    return Smoother(motion=motion, rays=ray_config(), **changes)


def scaled_mission(strategy, scale, frames=30, seed=5, callers=(), **changes):
    """A drive in the paper's circle, all noise on it scaled; returns its motion and start too."""
    rng = np.random.default_rng(seed)
    motion = replace(BICYCLE, control_std=(0.1 * scale, 0.03 * scale))
    start = Gaussian(mean=START.mean, covariance=scale**2 * START.covariance)
    std = {name: scale * value for name, value in STD.items()}
    field, drive = scattered(rng, 50), steady(CIRCLE, frames)
    mission = draw_mission(rng, motion, start, field, drive, **SENSING[strategy], **std, **changes)
    mission = replace(mission, scans=[measured_to(scan, **std) for scan in mission.scans])
    if callers:
        mission = timed(mission, callers, rng, std=0.05 * scale)
    return mission, motion, start


def without_noise(mission, start):
    """The mission as it would be had nothing been off: no step, no bearing, no range."""
    exact = replace(START, mean=start.mean, covariance=np.zeros((3, 3)))
    motion, rng = replace(BICYCLE, control_std=(0.0, 0.0)), np.random.default_rng(0)
    silent = draw_mission(
        rng, motion, exact, mission.landmarks, mission.controls,
        **SENSING["fused"], range_std=0.0, bearing_std=0.0,
    )  # fmt: skip
    return replace(silent, scans=[measured_to(scan, **STD) for scan in silent.scans])


def at_once(belief, mission, motion, start, *, robust=False):
    """Everything at once, of the landmarks that the belief has placed; it is told their priors."""
    rows = [
        (leg, *row)
        for leg, scan in enumerate(mission.scans, start=1)
        for row in zip(
            scan.landmark.tolist(), scan.bearing, scan.range, scan.bearing_std, scan.range_std,
            strict=True,
        )
        if np.isfinite(row[1])
    ]  # fmt: skip
    excess_paths = [
        (leg, label, scan.callers[caller], excess_path, along)
        for leg, scan in enumerate(mission.scans, start=1)
        for label, caller, excess_path, along in zip(
            scan.landmark.tolist(), scan.caller, scan.excess_path, scan.excess_path_std, strict=True
        )
        if np.isfinite(excess_path)
    ]
    places, information = belief.history.known
    priors = zip(places, information[:, 0] ** -0.5, strict=True)
    entered = dict(zip(belief.history.placed, priors, strict=True))
    legs = list(zip(mission.controls, mission.dt, strict=True))
    every = Everything(motion, start, legs, rows, entered, excess_paths=excess_paths, robust=robust)
    x = every.solved(every.begun({label: mission.landmarks[label - 1] for label in entered}))
    return every.labels, *every.told(x)


def differences(belief, labels, path, spread, places, known):
    """Greatest differences: of poses and landmarks in deviations, of covariances as shares.

    Poses first those of the graph, then all; then landmarks.
    """
    found, rows = belief.path(), belief.landmarks()
    off = found.mean - path
    off[:, 2] = wrap(off[:, 2])
    off /= np.sqrt(np.diagonal(spread, axis1=1, axis2=2))
    share = relative(found.covariance, spread)
    full = np.array([np.flatnonzero(rows.landmark == label)[0] for label in labels])
    far = (rows.mean[full] - places) / np.sqrt(np.diagonal(known, axis1=1, axis2=2))
    nodes = slice(None, None, STEPS_PER_FRAME)
    return (
        (np.abs(off[nodes]).max(), share[nodes].max()),
        (np.abs(off).max(), share.max()),
        (np.abs(far).max(), relative(rows.covariance[full], known).max()),
    )


def without_excess_paths(mission):
    """The mission as it is heard without timing."""
    bare = [rows_of(scan, np.isfinite(scan.bearing)) for scan in mission.scans]
    return replace(mission, scans=[with_columns(scan, excess_path=np.nan) for scan in bare])


def spread_of(belief):
    """Mean standard deviation of the path [m]."""
    spread = belief.path().covariance[:, :2, :2]
    return np.sqrt(np.trace(spread, axis1=1, axis2=2)).mean()


def aligned(path, true):
    """Differences of positions after the best rigid motion [m]."""
    points = path[:, :2]
    return moved(points, alignment(points, true[:, :2])) - true[:, :2]


def relative(found, expected):
    """Greatest difference of each covariance, as a share of its greatest number."""
    return np.abs(found - expected).max(axis=(1, 2)) / np.abs(expected).max(axis=(1, 2))


# Everything at once


@pytest.mark.parametrize("strategy", SENSING)
def test_poses_and_map_match_the_batch_solution(strategy):
    """The paper's noise; between the scans a leg is linear, which shows: see the next two."""
    mission, motion, start = scaled_mission(strategy, 1.0)
    *_, (belief, _) = followed(smoother(motion), mission, start)
    nodes, every, places = differences(belief, *at_once(belief, mission, motion, start))
    assert len(belief.history.placed) > 15
    assert max(nodes) < STOPS
    assert max(places) < 10 * STOPS
    assert every[0] < 0.06
    assert every[1] < 0.01


@pytest.mark.parametrize("strategy", SENSING)
@pytest.mark.parametrize("scale", [1e-2, 1e-4])
def test_poses_between_scans_match_the_batch_solution_with_small_noise(strategy, scale):
    mission, motion, start = scaled_mission(strategy, scale)
    *_, (belief, _) = followed(smoother(motion), mission, start)
    nodes, every, places = differences(belief, *at_once(belief, mission, motion, start))
    assert max(*nodes, *places) < max(1e-6, 1e-3 * scale)
    assert every[0] < max(1e-6, 0.06 * scale)
    assert every[1] < max(1e-6, 0.01 * scale)


def test_covariances_without_noise_match_the_batch_solution():
    mission, motion, start = scaled_mission("fused", 1.0)
    mission = without_noise(mission, start)
    *_, (belief, _) = followed(smoother(motion), mission, start)
    nodes, every, places = differences(belief, *at_once(belief, mission, motion, start))
    assert every[0] < 1e-6
    assert max(nodes[1], every[1], places[1]) < 1e-6


@pytest.mark.parametrize("strategy", ["fused", "passive"])
@pytest.mark.parametrize("callers", [(13,), (13, 45, 31)], ids=["one caller", "three callers"])
def test_poses_and_map_with_excess_paths_match_the_batch_solution(strategy, callers):
    mission, motion, start = scaled_mission(strategy, 1e-2, callers=callers)
    *_, (belief, _) = followed(smoother(motion), mission, start)
    nodes, every, places = differences(belief, *at_once(belief, mission, motion, start))
    assert max(*nodes, *places) < 1e-4
    assert every[0] < 1e-3
    *_, (deaf, _) = followed(smoother(motion), without_excess_paths(mission), start)
    assert set(belief.history.placed) > set(deaf.history.placed)
    assert spread_of(belief) < 0.98 * spread_of(deaf)


def test_poses_and_map_without_excess_paths_do_not_match_the_batch_solution():
    mission, motion, start = scaled_mission("passive", 1e-2, callers=(13,))
    *_, (belief, _) = followed(smoother(motion), mission, start)
    bare = without_excess_paths(mission)
    nodes, *_ = differences(belief, *at_once(belief, bare, motion, start))
    assert max(nodes) > 0.1


@pytest.mark.parametrize("callers", [(13,), (13, 45)], ids=["one caller", "two callers"])
def test_excess_paths_that_are_off_by_far_count_by_hubers_loss(callers):
    """A direct call in ten is another sound: all the excess paths of its frame are off alike."""
    mission, motion, start = scaled_mission("passive", 1.0, callers=callers)
    for scan in mission.scans[4::10]:
        scan.numbers[EXCESS_PATH] += 3.0
    *_, (belief, _) = followed(smoother(motion, robust="huber"), mission, start)
    best = at_once(belief, mission, motion, start, robust=True)
    nodes, _, places = differences(belief, *best)
    assert max(nodes) < 3 * STOPS
    assert max(places) < 30 * STOPS
    *_, (trusting, _) = followed(smoother(motion), mission, start)
    off = [
        np.abs(aligned(b.path().mean[4::4], mission.path[1:])).mean() for b in (belief, trusting)
    ]
    assert off[0] < 0.7 * off[1]


@pytest.mark.parametrize("strategy", SENSING)
def test_outliers_count_by_hubers_loss(strategy):
    mission, motion, start = scaled_mission(strategy, 1.0, outliers=0.05)
    *_, (belief, _) = followed(smoother(motion, robust="huber"), mission, start)
    best = at_once(belief, mission, motion, start, robust=True)
    nodes, _, places = differences(belief, *best)
    assert max(nodes) < 3 * STOPS
    assert max(places) < 30 * STOPS
    *_, (trusting, _) = followed(smoother(motion), mission, start)
    off = [np.hypot(*(b.path().mean[4::4] - mission.path[1:])[:, :2].T) for b in (belief, trusting)]
    assert off[0].mean() < 0.7 * off[1].mean()


def nees(seed, off):
    """Errors of last pose and median landmark when excess paths are so much worse than said."""
    mission, motion, start = scaled_mission("passive", 0.1, frames=24, seed=seed)
    labels = [scan.landmark for scan in mission.scans]
    caller = sorted(set.intersection(*map(set, labels)))[0]
    mission = timed(mission, (caller,), np.random.default_rng(seed), std=0.02, off=0.02 * off)
    *_, (belief, _) = followed(smoother(motion), mission, start)
    pose, rows = belief.pose(), belief.landmarks()
    own = mission.path[-1] - pose.mean
    own[2] = wrap(own[2])
    full = placed(rows)
    far = mission.landmarks[rows.landmark[full] - 1] - rows.mean[full]
    of_map = np.einsum("ni,nij,nj->n", far, np.linalg.inv(rows.covariance[full]), far)
    return own @ np.linalg.solve(pose.covariance, own), np.median(of_map)


def test_pose_and_map_are_consistent_only_with_true_excess_path_noise():
    """Chi-square of 72, within 0.1 %; landmarks of a world are off together, so of 48 in all."""
    pose, of_map = np.transpose([nees(seed, 1.0) for seed in range(24)])
    assert 39.0 < pose.sum() < 116.0
    assert 22.0 < of_map.sum() < 84.0
    pose, of_map = np.transpose([nees(seed, 6.0) for seed in range(24)])
    assert pose.sum() > 116.0
    assert of_map.sum() > 84.0


# From the truth


def assert_the_same_optimum(belief, path, places, within=1e-3):
    best, other = from_the_truth(belief, path, places)
    off = poses_of(other) - poses_of(best)
    assert np.hypot(off[:, 0], off[:, 1]).max() < within
    assert np.abs(wrap(off[:, 2])).max() < within


def check_reached(strategy, frames, seed):
    mission = paper_mission(strategy, frames=frames, seed=seed)
    scans = [measured_to(scan, **STD) for scan in mission.scans]
    *_, (belief, _) = followed(smoother(), replace(mission, scans=scans))
    belief.path()
    stepwise = np.repeat(mission.path, STEPS_PER_FRAME, axis=0)[STEPS_PER_FRAME - 1 :]
    assert_the_same_optimum(belief, stepwise, dict(enumerate(mission.landmarks, start=1)))


@pytest.mark.parametrize("strategy", SENSING)
@pytest.mark.parametrize("seed", range(3))
def test_the_optimum_from_online_poses_equals_the_optimum_from_the_truth(strategy, seed):
    check_reached(strategy, 60, seed)


@pytest.mark.slow
@pytest.mark.parametrize("strategy", SENSING)
@pytest.mark.parametrize("seed", range(8))
def test_the_optimum_of_a_whole_mission_equals_the_optimum_from_the_truth(strategy, seed):
    check_reached(strategy, 375, seed)


# Turned and shifted


@pytest.mark.parametrize("strategy", SENSING)
@pytest.mark.parametrize(
    ("turn", "within"),
    [pytest.param(np.pi / 2, 1e-6, id="by a quarter"), pytest.param(2.0, 3e-3, id="by any angle")],
)
def test_turning_and_shifting_the_world_turns_and_shifts_the_belief(strategy, turn, within):
    """A landmark is linearised anew when x or y has moved: exactly so by a quarter alone."""
    mission, shift = paper_mission(strategy, frames=30), np.array([300.0, -40.0])
    c, s = np.cos(turn), np.sin(turn)
    R, whole = np.array([[c, -s], [s, c]]), np.eye(3)
    whole[:2, :2] = R
    moved = Gaussian(
        mean=np.array([*(R @ START.mean[:2] + shift), wrap(START.mean[2] + turn)]),
        covariance=whole @ START.covariance @ whole.T,
    )
    *_, (belief, _) = followed(smoother(), mission)
    *_, (other, _) = followed(smoother(), mission, moved)
    for one, there in ((belief.pose(), other.pose()), (belief.path(), other.path())):
        at, expected = there.mean[..., :2], one.mean[..., :2] @ R.T + shift
        np.testing.assert_allclose(at, expected, rtol=0, atol=within)
        heading = wrap(there.mean[..., 2] - one.mean[..., 2] - turn)
        np.testing.assert_allclose(heading, 0.0, rtol=0, atol=within)
        turned = whole @ one.covariance @ whole.T
        np.testing.assert_allclose(there.covariance, turned, rtol=0, atol=within)
    known, found = belief.landmarks(), other.landmarks()
    np.testing.assert_array_equal(found.landmark, known.landmark)
    np.testing.assert_allclose(found.mean, known.mean @ R.T + shift, rtol=0, atol=20 * within)
    assert relative(found.covariance, R @ known.covariance @ R.T).max() < 20 * within


# A pose for every step


def drive_of(controls, scans, start=START, motion=STANDING):
    """Return the drive of these controls, each a step long, and the scans, each at a step."""
    time = STEP * np.arange(len(controls) + 1)
    heard = [replace(scan, time=float(time[step])) for step, scan in scans]
    return Drive(motion=motion, start=start, time=time, controls=np.array(controls, float)), heard


def test_scans_before_any_step_at_one_time_and_while_standing_leave_a_pose_for_every_step():
    near, far = scan_of((1, 4.0, 0.3), (2, np.nan, -0.5)), scan_of((2, np.nan, -0.45))
    still, ahead = [(0.0, 0.0)] * 3, [CIRCLE] * 5
    scans = [(0, near), (0, far), (3, near), (3, far), (6, near), (8, near), (8, far), (11, far)]
    drive, heard = drive_of([*still, *ahead, *still], scans)
    track = run_filter(smoother(STANDING), drive, heard, None)
    assert track.pose.mean.shape == (12, 3)
    assert np.isfinite(track.pose.mean).all()
    assert np.isfinite(track.pose.covariance).all()
    np.testing.assert_allclose(
        track.pose.mean[:4], np.tile(track.pose.mean[0], (4, 1)), rtol=0, atol=1e-12
    )
    np.testing.assert_allclose(
        track.pose.mean[8:], np.tile(track.pose.mean[8], (4, 1)), rtol=0, atol=1e-12
    )
    assert np.all(np.diff(track.pose.mean[3:9, 0]) > 0.05)


def test_a_drive_without_measurements_is_dead_reckoned():
    drive, _ = drive_of([CIRCLE] * 6, [])
    track = run_filter(smoother(), drive, [], None)
    np.testing.assert_allclose(track.pose.mean, track.online.mean, rtol=0, atol=1e-12)
    np.testing.assert_allclose(track.pose.covariance, track.online.covariance, rtol=0, atol=2e-12)


# Beliefs


def all_told(belief):
    path, pose, rows = belief.path(), belief.pose(), belief.landmarks()
    return (*vars_of(path), *vars_of(pose), rows.landmark, rows.mean, rows.covariance, rows.weight)


def vars_of(gaussian):
    return gaussian.mean, gaussian.covariance


def test_a_belief_kept_aside_answers_to_the_same_bits_after_others_went_on():
    mission = paper_mission("fused", frames=24)
    beliefs = [belief for belief, _ in followed(smoother(), mission)]
    kept = beliefs[9]
    before = [np.copy(answer) for answer in all_told(kept)]
    beliefs[-1].path()
    for answers in (all_told(kept), all_told(replace(kept))):
        for now, then in zip(answers, before, strict=True):
            np.testing.assert_array_equal(now, then)


def test_a_belief_left_behind_goes_on_to_the_same_bits_with_excess_paths():
    mission, motion, start = scaled_mission("passive", 1.0, callers=(13, 45))
    slam = smoother(motion)
    beliefs = [belief for belief, _ in followed(slam, mission, start)]
    for left in (3, 20):
        other = beliefs[left]
        for frame in range(left + 1, 28):
            other, _ = slam.predict(other, mission.controls[frame], mission.dt[frame])
            other = slam.update(other, mission.scans[frame])
        for now, then in zip(all_told(other), all_told(beliefs[27]), strict=True):
            np.testing.assert_array_equal(now, then)


def test_excess_paths_of_an_unmeasured_caller_change_no_bit():
    mission, motion, start = scaled_mission("passive", 1.0, callers=(13,), frames=50)
    silent = [replace(scan, callers=np.array([-1, 99])) for scan in mission.scans]
    *_, (belief, _) = followed(smoother(motion), replace(mission, scans=silent), start)
    *_, (deaf, _) = followed(smoother(motion), without_excess_paths(mission), start)
    for now, then in zip(all_told(belief), all_told(deaf), strict=True):
        np.testing.assert_array_equal(now, then)


def test_two_continuations_of_a_belief_are_independent():
    mission, slam = paper_mission("fused", frames=12), smoother()
    *_, (kept, _) = followed(slam, mission)
    here = slam.predict(kept, mission.controls[0], mission.dt[0])[0]
    one = slam.update(here, scan_of((90, 3.0, 0.5)))
    other = slam.update(here, scan_of((91, 2.0, -0.5)))
    assert 90 in one.landmarks().landmark
    assert 90 not in other.landmarks().landmark
    assert 91 not in one.landmarks().landmark


# The gate


def known_landmark(gate):
    """A filter and its belief of landmark 1, heard three times at 5 m, to the left."""
    slam = smoother(STANDING, gate=gate)
    sure = Gaussian(mean=np.zeros(3), covariance=1e-8 * np.eye(3))
    belief = slam.init(sure)
    for _ in range(3):
        belief = slam.update(belief, scan_of((1, 5.0, 0.3)))
    return slam, belief


def two_landmarks(gate):
    """A filter and its belief of landmarks 1 and 2, heard three times, and where they are."""
    slam = smoother(STANDING, gate=gate)
    belief = slam.init(Gaussian(mean=np.zeros(3), covariance=1e-12 * np.eye(3)))
    for _ in range(3):
        belief = slam.update(belief, scan_of((1, 5.0, 0.3), (2, 8.0, 1.2)))
    return slam, belief, belief.landmarks().mean


def timed_scan(rows, caller):
    """A scan of rows (label, bearing, excess path), of the call of a landmark."""
    label, bearing, excess_path = zip(*rows, strict=True)
    told = {"caller": 1, "excess_path": np.array(excess_path), "excess_path_std": 0.1}
    return replace(scan_with(label, bearing, **told), callers=np.array([-1, caller]))


@pytest.mark.parametrize(
    ("row", "dropped"),
    [
        pytest.param((1, 5.1, 0.35), 0, id="inside"),
        pytest.param((1, 6.5, 0.3), 1, id="range outside"),
        pytest.param((1, 5.0, 1.3), 1, id="bearing outside"),
        pytest.param((1, np.nan, 1.3), 1, id="bearing alone, outside"),
        pytest.param((1, np.nan, 0.4), 0, id="bearing alone, inside"),
        pytest.param((2, 6.5, 1.3), 0, id="of a landmark that is new"),
    ],
)
def test_rows_outside_the_gate_are_dropped_and_counted(row, dropped):
    slam, belief = known_landmark(0.999)
    after = slam.update(belief, scan_of(row))
    assert after.gated == dropped
    same = np.array_equal(after.landmarks().mean, belief.landmarks().mean)
    assert same == bool(dropped)


def test_the_gate_is_a_quantile_of_the_predicted_distribution():
    """The landmark known three times over: a fourth look is off by R (1 + 1/3)."""
    slam, belief = known_landmark(0.99)
    edge = np.sqrt(9.2103404 * 0.2**2 * 4 / 3)
    for off, dropped in ((0.99 * edge, 0), (1.01 * edge, 1)):
        assert slam.update(belief, scan_of((1, 5.0 + off, 0.3))).gated == dropped


def test_the_gate_of_a_single_bearing_has_one_degree_of_freedom():
    slam, belief = known_landmark(0.99)
    bearing = float(np.arctan2(*belief.landmarks().mean[0, ::-1]))
    edge = np.sqrt(6.6348966 * 0.15**2 * 4 / 3)
    for off, dropped in ((0.99 * edge, 0), (1.01 * edge, 1)):
        assert slam.update(belief, scan_of((1, np.nan, bearing + off))).gated == dropped


@pytest.mark.parametrize(("share", "dropped"), [(0.99, 0), (1.01, 1)])
@pytest.mark.parametrize("further", [False, True], ids=["beside a bearing", "alone"])
def test_an_excess_path_is_gated_separately_by_its_predicted_distribution(share, dropped, further):
    """Landmarks 1 and 2 are known thrice over; the excess path is off by their spread and R."""
    slam, belief, places = two_landmarks(0.99)
    C = np.zeros((4, 4))
    rows = belief.landmarks()
    C[:2, :2], C[2:, 2:] = rows.covariance
    J = np.concatenate(excess_path_jacobians(np.zeros(2), *places)[1:])
    edge = np.sqrt(6.6348966 * (J @ C @ J + 0.1**2))
    excess_path = excess_path_of(np.zeros(2), *places) + share * edge
    scan = timed_scan([(1, 0.3, excess_path)], caller=2)
    if further:
        scan = with_columns(scan, bearing=np.nan)
    after = slam.update(belief, scan)
    assert after.gated == dropped
    assert (after.history.rows.entries(0)[-1, 1] >= 0) == (dropped == 0)


def test_an_open_gate_drops_nothing():
    slam, belief = known_landmark(1.0)
    assert slam.update(belief, scan_of((1, 50.0, -2.0))).gated == 0


# The prior


def test_a_landmark_heard_once_is_as_sure_as_its_range_and_bearing():
    slam = smoother(Motion(model="unicycle", control_std=(0.1, 0.1)))
    sure = Gaussian(mean=np.zeros(3), covariance=np.zeros((3, 3)))
    rows = slam.update(slam.init(sure), scan_with([7], [0.0], [4.0])).landmarks()
    assert placed(rows).all()
    np.testing.assert_allclose(rows.mean, [[4.0, 0.0]], atol=1e-9)
    own = 1.0 / (1.0 / np.array([0.2**2, (4.0 * 0.15) ** 2]) + 1.0 / 20.0**2)
    np.testing.assert_allclose(rows.covariance[0], np.diag(own), rtol=0, atol=1e-9)
