"""Callers that move in the graph: their law, when they enter, and how well they are followed."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from pipistrelle.detection.scans import NO_CALLERS, rows_of
from pipistrelle.estimation.beliefs import placed
from pipistrelle.estimation.smoother.filter import Smoother
from pipistrelle.experiments.drives import Drive
from pipistrelle.experiments.runs.trial import run_filter
from reference.missions import followed, ray_config
from reference.walking import CALLER, roaming_mission, scaled

SPEED, WALK = 0.7, 0.3
MOTION, START = scaled(0.1)


def smoother(**changes):
    told = {"speed_std": SPEED, "walk_std": WALK} | changes
    return Smoother(motion=MOTION, rays=ray_config(), **told)


def surprise(off, covariance):
    return float(off @ np.linalg.solve(covariance, off))


@pytest.fixture(scope="module")
def roaming():
    """A mission and its beliefs, frame by frame."""
    mission, places = roaming_mission(np.random.default_rng(4), frames=16)
    return mission, places, [belief for belief, _ in followed(smoother(), mission, START)]


# When they enter


def test_a_moving_caller_is_tracked_and_is_no_landmark(roaming):
    _, places, beliefs = roaming
    last = beliefs[-1]
    assert CALLER not in last.landmarks().landmark
    now = last.moving()
    assert now.landmark.tolist() == [CALLER]
    assert surprise(now.mean[0] - places[-1], now.covariance[0]) < 16.0
    assert np.sqrt(np.trace(now.covariance[0])) < 2.0


def test_the_joint_gaussian_holds_the_callers_predicted_position(roaming):
    mission, _, beliefs = roaming
    belief = smoother().predict(beliefs[-1], mission.controls[0], mission.dt[0])[0]
    joint, now = belief.joint(), belief.moving()
    i = 3 + 2 * joint.landmark.tolist().index(CALLER)
    here = slice(i, i + 2)
    np.testing.assert_allclose(joint.mean[here], now.mean[0], rtol=1e-12)
    np.testing.assert_allclose(joint.covariance[here, here], now.covariance[0], rtol=1e-9)
    assert np.hypot(*(joint.mean[here] - beliefs[-1].moving().mean[0])) > 0.05, "it has moved"


def test_an_uninitialised_moving_caller_is_a_ray_when_just_measured():
    mission, _ = roaming_mission(np.random.default_rng(4), frames=3)
    first = mission.scans[0]
    alone = rows_of(first, first.landmark == CALLER)
    slam = smoother()
    belief = slam.predict(slam.init(START), mission.controls[0], mission.dt[0])[0]
    belief = slam.update(belief, alone)
    assert not belief.landmarks().landmark.size
    assert not placed(belief.moving()).any()
    assert belief.moving().landmark.size > 1
    others = rows_of(mission.scans[1], mission.scans[1].landmark != CALLER)
    belief = slam.predict(belief, mission.controls[1], mission.dt[1])[0]
    assert not slam.update(belief, others).moving().landmark.size


def test_crossing_bearings_initialise_fixed_but_not_moving_callers():
    mission, _ = roaming_mission(np.random.default_rng(4), 40, speed_std=1e-9, walk_std=0.0)
    callers = [rows_of(scan, scan.landmark == CALLER) for scan in mission.scans]
    standing = [replace(scan, moving=NO_CALLERS) for scan in callers]
    *_, (stands, _) = followed(smoother(), replace(mission, scans=standing), START)
    *_, (moves, _) = followed(smoother(), replace(mission, scans=callers), START)
    assert stands.history.placed == (CALLER,)
    assert not moves.history.callers


def test_a_caller_joins_the_chain_at_the_node_that_places_it(roaming):
    mission, _, beliefs = roaming
    entered = next(k for k, belief in enumerate(beliefs) if belief.history.callers)
    (first,) = beliefs[-1].history.first
    assert 1 <= entered == first - 1
    assert np.isfinite(mission.scans[0].excess_path).any()


def test_a_range_initialises_a_moving_caller_immediately():
    mission, places = roaming_mission(np.random.default_rng(2), frames=1, ranges=1)
    *_, (belief, _) = followed(smoother(), mission, START)
    assert (belief.history.callers, belief.history.first.tolist()) == ((CALLER,), [1])
    now = belief.moving()
    assert surprise(now.mean[0] - places[1], now.covariance[0]) < 16.0


def test_landmarks_are_initialised_by_a_moving_callers_call(roaming):
    _, _, beliefs = roaming
    assert len(beliefs[-1].history.placed) > 15


def test_a_callers_prediction_equals_its_estimate_after_an_empty_update(roaming):
    mission, _, beliefs = roaming
    (first,) = beliefs[-1].history.first
    leg = smoother().predict(beliefs[first + 1], mission.controls[0], mission.dt[0])[0]
    unknown = rows_of(mission.scans[0], np.array([0]))
    new = replace(unknown, landmark=np.array([77]))  # it waits, and only the leg enters
    new = replace(new, numbers=np.where(np.arange(8)[:, None] == 0, 0.3, unknown.numbers))
    new.numbers[[1, 2]] = np.nan
    gone = smoother().update(leg, new)
    before, after = leg.moving(), gone.moving()
    np.testing.assert_allclose(before.mean, after.mean, rtol=0, atol=1e-9)
    np.testing.assert_allclose(before.covariance, after.covariance, rtol=0, atol=1e-6)


def test_a_moving_caller_is_tracked_while_the_vehicle_is_at_rest():
    motion = replace(MOTION, noise_at_rest=False)
    mission, _ = roaming_mission(np.random.default_rng(2), frames=4, ranges=1)
    slam = replace(smoother(), motion=motion)
    still = replace(mission, controls=np.zeros_like(mission.controls))
    beliefs = [belief for belief, _ in followed(slam, still, START)]
    assert np.isfinite(beliefs[-1].tracks()[CALLER].mean[4::4]).all()


# How well they are followed


def test_a_moving_caller_without_motion_equals_a_landmark():
    mission, _ = roaming_mission(
        np.random.default_rng(8), 16, ranges=2, speed_std=1e-9, walk_std=0.0
    )
    standing = [replace(scan, moving=NO_CALLERS) for scan in mission.scans]
    *_, (moves, _) = followed(smoother(speed_std=1e-4, walk_std=0.0), mission, START)
    *_, (stands, _) = followed(smoother(), replace(mission, scans=standing), START)
    rows, track = stands.landmarks(), moves.tracks()[CALLER]
    (row,) = np.flatnonzero(rows.landmark == CALLER)
    std = np.sqrt(rows.covariance[row].diagonal().min())
    for k in (4, 32, 64):
        np.testing.assert_allclose(track.mean[k], rows.mean[row], rtol=0, atol=0.02 * std)
        np.testing.assert_allclose(
            track.covariance[k], rows.covariance[row], rtol=0, atol=0.02 * std**2
        )
    for found, expected in ((moves.path(), stands.path()), (moves.pose(), stands.pose())):
        np.testing.assert_allclose(found.mean, expected.mean, rtol=0, atol=2e-3)
        np.testing.assert_allclose(found.covariance, expected.covariance, rtol=0, atol=1e-4)


def nees(seed, walk_std):
    """Surprises of the caller's last place, online and at the end, and of one halfway."""
    mission, places = roaming_mission(np.random.default_rng(1000 + seed), frames=20)
    *_, (belief, _) = followed(smoother(walk_std=walk_std), mission, START)
    now, track = belief.moving(), belief.tracks()[CALLER]
    return [
        surprise(now.mean[0] - places[20], now.covariance[0]),
        surprise(track.mean[80] - places[20], track.covariance[80]),
        surprise(track.mean[48] - places[12], track.covariance[48]),
    ]


def test_tracked_positions_are_consistent_only_with_the_true_walk():
    runs = 36
    low, high = stats.chi2(2 * runs).ppf([5e-4, 1.0 - 5e-4]) / runs
    means = np.mean([nees(seed, WALK) for seed in range(runs)], axis=0)
    assert np.all((low < means) & (means < high)), means
    deceived = np.mean([nees(seed, 1e-3) for seed in range(8)], axis=0)
    assert np.all(deceived > 3.0 * high), deceived


def test_later_scans_improve_a_callers_earlier_positions(roaming):
    _, places, beliefs = roaming
    revised = beliefs[-1].tracks()[CALLER]
    heard = np.arange(beliefs[-1].history.first[0], 17)
    rows = 4 * heard
    assert np.flatnonzero(np.isfinite(revised.mean[:, 0])).tolist() == rows.tolist()
    online = np.array([beliefs[k - 1].moving().mean[0] for k in heard])
    late = np.sqrt(np.mean((revised.mean[rows] - places[heard]) ** 2))
    assert late < np.sqrt(np.mean((online - places[heard]) ** 2))


def test_a_track_contains_the_final_belief(roaming):
    mission, _, beliefs = roaming
    drive = Drive(
        motion=MOTION,
        start=START,
        time=np.append(0.0, np.cumsum(mission.dt)),
        controls=mission.controls.reshape(-1, mission.controls.shape[-1]),
    )
    scans = [replace(scan, time=drive.time[4 * k]) for k, scan in enumerate(mission.scans, 1)]
    track = run_filter(smoother(), drive, scans, np.random.default_rng(0))
    np.testing.assert_array_equal(track.callers[CALLER].mean, beliefs[-1].tracks()[CALLER].mean)
    assert len(track.pose.mean) == len(track.callers[CALLER].mean)


def test_a_track_without_detections_is_the_prediction(roaming):
    mission, _, _ = roaming
    time = np.append(0.0, np.cumsum(mission.dt))
    controls = mission.controls.reshape(-1, mission.controls.shape[-1])
    drive = Drive(motion=MOTION, start=START, time=time, controls=controls)
    scans = [replace(scan, time=time[4 * k]) for k, scan in enumerate(mission.scans, 1)]
    for silent in (10, 15):
        scans[silent] = rows_of(scans[silent], np.arange(0))
    rows = [4 * silent + 4 for silent in (10, 15)]
    mean = run_filter(smoother(), drive, scans, np.random.default_rng(0)).callers[CALLER].mean
    assert np.isfinite(mean[rows]).all()
    assert np.abs(mean[rows] - mean[np.array(rows) - 4]).max() < 2.0, "a step away"


# Bits, and the gate


def test_an_earlier_belief_continues_to_the_same_bits(roaming):
    mission, _, beliefs = roaming
    slam, other = smoother(), beliefs[9]
    for frame in range(10, 16):
        other, _ = slam.predict(other, mission.controls[frame], mission.dt[frame])
        other = slam.update(other, mission.scans[frame])
    np.testing.assert_array_equal(other.moving().covariance, beliefs[-1].moving().covariance)
    for now, then in zip(
        (other.tracks()[CALLER], other.path()),
        (beliefs[-1].tracks()[CALLER], beliefs[-1].path()),
        strict=True,
    ):
        np.testing.assert_array_equal(now.mean, then.mean)
        np.testing.assert_array_equal(now.covariance, then.covariance)


def test_the_gate_drops_an_impossible_bearing_of_a_moving_caller(roaming):
    mission, _, beliefs = roaming
    slam, scan = smoother(gate=1.0 - 1e-9), mission.scans[12]
    numbers = scan.numbers.copy()
    numbers[0, -1] += 1.5
    gone = slam.predict(beliefs[11], mission.controls[12], mission.dt[12])[0]
    assert slam.update(gone, scan).gated == 0
    wrong = slam.update(gone, replace(scan, numbers=numbers))
    assert wrong.gated == 1
    assert np.isfinite(wrong.moving().mean).all()
