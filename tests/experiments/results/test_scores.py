"""What no estimator avoids: the turn and shift before the first scan, and the bound."""

from dataclasses import replace

import numpy as np
import pytest

from pipistrelle.config import Config, ScenarioConfig
from pipistrelle.detection.scans import BEARING_STD, RANGE_STD
from pipistrelle.evaluation.accuracy import alignment, moved, rmse
from pipistrelle.experiments.drives import NO_TRUTH, Truth
from pipistrelle.experiments.hearing.scenario import world_of
from pipistrelle.experiments.named_settings import Case
from pipistrelle.experiments.results.scores import drive_bound, position_floor, with_bound
from pipistrelle.experiments.runs.heard_world import drive_of
from pipistrelle.experiments.runs.trial import run_trial
from reference.ekf_slam import moved as driven
from reference.missions import scan_with

CONFIG = Config(scenario=ScenarioConfig(steps=400))
WORLD = world_of(CONFIG)
DRIVE = drive_of(WORLD, CONFIG)


def heard_at(*steps):
    return [scan_with([1], [0.1], time=float(DRIVE.time[step])) for step in steps]


def reckoned(steps):
    """Return the pose that the controls alone lead to, by the slow reference's motion."""
    pose = np.array(DRIVE.start.mean)
    for control in DRIVE.controls[:steps]:
        pose, _, _ = driven(DRIVE.motion, pose, control, CONFIG.scenario.step)
    return pose


def as_matrix(pose):
    c, s = np.cos(pose[2]), np.sin(pose[2])
    return np.array([[c, -s, pose[0]], [s, c, pose[1]], [0.0, 0.0, 1.0]])


def test_the_floor_is_the_true_path_led_on_from_where_reckoning_had_arrived():
    true, lost = WORLD.path, as_matrix(reckoned(4))
    motions = [np.linalg.inv(as_matrix(true[4])) @ as_matrix(pose) for pose in true[4:]]
    led = np.array([(lost @ motion)[:2, 2] for motion in motions])
    before = np.array([reckoned(k)[:2] for k in range(1, 4)])
    error = np.concatenate([before, led]) - true[1:, :2]
    expected = np.sqrt(np.mean(np.sum(error**2, axis=1)))
    assert position_floor(DRIVE, heard_at(4, 8, 12)) == pytest.approx(expected, rel=1e-12)
    assert 0.02 < expected < 1.0


def test_an_empty_scan_does_not_change_the_floor():
    empty = scan_with(time=float(DRIVE.time[4]))
    later = [empty, *heard_at(8)]
    assert position_floor(DRIVE, later) == position_floor(DRIVE, heard_at(8))
    assert position_floor(DRIVE, later) != position_floor(DRIVE, heard_at(4))


def test_the_floor_without_measurements_is_dead_reckoning():
    everywhere = np.array([reckoned(k)[:2] for k in range(1, 401)])
    expected = rmse(np.hypot(*(everywhere - WORLD.path[1:, :2]).T))
    assert position_floor(DRIVE, []) == pytest.approx(expected, rel=1e-9)
    assert position_floor(DRIVE, [scan_with(time=0.5)]) == position_floor(DRIVE, [])


def test_without_the_truth_there_is_no_floor():
    assert position_floor(replace(DRIVE, truth=NO_TRUTH), heard_at(4)) is None
    path = WORLD.path.copy()
    path[4] = np.nan
    unknown = replace(DRIVE, truth=Truth(time=DRIVE.time, path=path))
    assert position_floor(unknown, heard_at(4)) is None
    assert position_floor(unknown, heard_at(8)) is not None


def test_a_filter_with_exact_measurements_is_near_the_floor_before_alignment():
    """Exact ranges and bearings of all landmarks: what is left is the turn before them."""
    labels = np.arange(1, 51)
    scans = []
    for k in range(4, 401, 4):
        offset = WORLD.landmarks - WORLD.path[k, :2]
        bearing = np.arctan2(offset[:, 1], offset[:, 0]) - WORLD.path[k, 2]
        bearing = (bearing + np.pi) % (2.0 * np.pi) - np.pi
        rows = scan_with(labels, bearing, np.hypot(*offset.T), time=float(DRIVE.time[k]))
        scans.append(replace(rows, numbers=told(rows.numbers)))
    scores = run_trial(Case(strategy="active", filter="ekf"), DRIVE, scans, CONFIG).scores
    assert scores.position_rmse_m == pytest.approx(scores.position_floor_m, rel=0.2)
    assert scores.position_rmse_aligned_m < 0.2 * scores.position_floor_m
    pose = WORLD.path[:, :2]
    turned = moved(pose, np.array([0.3, -0.1, 0.02]))
    assert rmse(np.hypot(*(moved(turned, alignment(turned, pose)) - pose).T)) < 1e-9


def told(numbers):
    """Say of every row that it is good to 2 cm and 0.02 rad."""
    numbers = numbers.copy()
    numbers[BEARING_STD], numbers[RANGE_STD] = 0.02, 0.02
    return numbers


# The bound


def sure(*steps, bearing_std=0.05):
    """Scans of three landmarks by bearing and range."""
    rows = [1, 2, 3], [0.1, 0.2, 0.3], [4.0, 5.0, np.nan]
    return [
        scan_with(*rows, time=float(DRIVE.time[step]), bearing_std=bearing_std) for step in steps
    ]


def test_the_bound_is_added_without_changing_other_scores():
    scans = sure(4, 8, 12)
    scores = run_trial(Case(strategy="active", filter="ekf"), DRIVE, scans, CONFIG).scores
    bound = drive_bound(DRIVE, scans, Config())
    beside = with_bound(scores, bound)
    squared = np.mean(bound[1:], axis=0).diagonal()
    assert beside.position_bound_m == pytest.approx(np.sqrt(squared[0] + squared[1]))
    assert beside.heading_bound_rad == pytest.approx(np.sqrt(squared[2]))
    assert replace(beside, position_bound_m=None, heading_bound_rad=None) == scores
    assert with_bound(scores, None) is scores


def test_the_bound_is_independent_of_the_start_and_grows_with_noise():
    apart = replace(DRIVE.start, covariance=np.eye(3))
    unsure = drive_bound(replace(DRIVE, start=apart), sure(4, 8, 12), Config())
    np.testing.assert_array_equal(unsure, drive_bound(DRIVE, sure(4, 8, 12), Config()))
    position = [with_bound_of(std) for std in (0.05, 0.1, 0.2)]
    assert position[0] < position[1] < position[2]


def with_bound_of(bearing_std):
    """Trace of the bound over all steps."""
    bound = drive_bound(DRIVE, sure(*range(4, 401, 4), bearing_std=bearing_std), Config())
    return float(np.trace(bound.sum(axis=0)))


def test_where_the_truth_is_not_whole_there_is_no_bound():
    path = WORLD.path.copy()
    path[300] = np.nan
    holes = Truth(time=DRIVE.time, path=path, landmarks=DRIVE.truth.landmarks)
    for truth in (NO_TRUTH, holes, replace(DRIVE.truth, landmarks=None)):
        assert drive_bound(replace(DRIVE, truth=truth), sure(4), Config()) is None
    assert drive_bound(DRIVE, sure(4), Config()) is not None
