"""Errors of paths and maps: closed forms, the group's laws, and evo as an oracle."""

import numpy as np
import pytest
from evo.core.metrics import APE, PoseRelation, StatisticsType
from evo.core.trajectory import PosePath3D
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from pipistrelle.evaluation.accuracy import (
    MapEstimate,
    alignment,
    heaviest,
    moved,
    pose_error,
    position_error,
    rmse,
    scored_landmarks,
)
from reference.missions import map_with

COORDINATE = st.floats(-100.0, 100.0)
POINTS = st.integers(2, 30).flatmap(lambda n: arrays(np.float64, (n, 2), elements=COORDINATE))
MOTION = st.tuples(COORDINATE, COORDINATE, st.floats(-np.pi, np.pi)).map(np.array)
# 30 points within 300 m of the origin: a few hundred roundings of 300 * 2.2e-16 m.
ROUNDING = 1e-11


def hypotheses(labels, weights):
    h = len(labels)
    mean = np.column_stack([np.arange(h), np.zeros(h)])
    return map_with(labels, mean, np.arange(h)[:, None, None] * np.eye(2), weights)


def loop(n):
    angle = np.linspace(0.0, 5.0, n)
    return np.column_stack([7.4 * np.sin(angle), -7.4 * np.cos(angle), angle])


@given(POINTS, MOTION)
def test_alignment_recovers_any_rigid_motion(points, motion):
    reference = moved(points, motion)
    assert moved(points, alignment(points, reference)) == pytest.approx(reference, abs=ROUNDING)


@given(POINTS, MOTION)
def test_no_other_rigid_motion_fits_better_than_the_alignment(points, other):
    reference = points[::-1]
    best = alignment(points, reference)
    aligned = position_error(moved(points, best), reference)
    moved_on = position_error(moved(points, best + 0.01 * other), reference)
    assert rmse(aligned) <= rmse(moved_on) + ROUNDING


def test_alignment_of_points_that_fix_no_rotation_is_a_translation():
    assert alignment(np.ones((1, 2)), np.zeros((1, 2))).tolist() == [-1.0, -1.0, 0.0]
    assert alignment(np.ones((3, 2)), np.zeros((3, 2))).tolist() == [-1.0, -1.0, 0.0]


def test_alignment_never_mirrors():
    left_turn = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0]])
    right_turn = left_turn * [1.0, -1.0]
    fitted = moved(left_turn, alignment(left_turn, right_turn))
    (ax, ay), (bx, by) = fitted[1] - fitted[0], fitted[2] - fitted[0]
    assert ax * by - ay * bx == pytest.approx(1.0)
    assert rmse(position_error(fitted, right_turn)) > 0.1


@given(POINTS, MOTION)
def test_the_rmse_of_positions_does_not_depend_on_the_frame(points, motion):
    true = points[::-1]
    here = rmse(position_error(points, true))
    there = rmse(position_error(moved(points, motion), moved(true, motion)))
    assert there == pytest.approx(here, abs=ROUNDING)


def test_the_rmse_of_a_constant_offset_is_the_offset():
    path, offset = loop(100), np.array([0.3, -0.4, 0.0])
    assert rmse(position_error(path + offset, path)) == pytest.approx(0.5, rel=1e-12)


def test_rmse_weighs_large_errors_more_than_the_mean_does():
    assert rmse(np.array([0.0, 0.0, 0.0, 2.0])) == 1.0


def test_rmse_of_nothing_is_refused():
    with pytest.raises(ValueError, match="at least one error"):
        rmse(np.empty(0))


def test_rmse_shows_an_error_that_is_not_a_number():
    assert np.isnan(rmse(np.array([1.0, np.nan])))


@given(st.floats(-3.0, 3.0), st.integers(-3, 3))
def test_heading_errors_forget_whole_turns(difference, turns):
    path = np.array([[0.0, 0.0, 1.0 + difference + 2.0 * np.pi * turns]])
    error = pose_error(path, np.array([[0.0, 0.0, 1.0]]))
    assert error[0, 2] == pytest.approx(difference, abs=1e-13)


def test_pose_error_does_not_change_its_arguments():
    path, true = np.full((2, 3), 3.0), np.full((2, 3), -3.0)
    pose_error(path, true)
    assert (path == 3.0).all()
    assert (true == -3.0).all()


def test_a_landmark_with_one_hypothesis_is_full_and_with_several_partial():
    estimate = heaviest(hypotheses([5, 2, 2, 9], [1.0, 0.5, 0.5, 1.0]))
    assert estimate.full.tolist() == [True, False, True]


def test_a_partial_landmark_is_its_heaviest_hypothesis_and_the_first_of_equals():
    estimate = heaviest(hypotheses([4, 4, 4, 1, 1], [0.2, 0.4, 0.4, 0.1, 0.9]))
    assert estimate.mean[:, 0].tolist() == [1.0, 4.0]
    assert estimate.covariance[:, 0, 0].tolist() == [1.0, 4.0]


def test_landmarks_keep_their_order_in_the_map():
    estimate = heaviest(hypotheses([30, 7, 30, 12, 7], [0.1, 0.2, 0.9, 1.0, 0.8]))
    assert estimate.landmark.tolist() == [30, 7, 12]
    assert estimate.mean[:, 0].tolist() == [2.0, 4.0, 3.0]


def test_an_empty_map_has_no_landmarks():
    assert heaviest(hypotheses([], [])).landmark.shape == (0,)
    assert heaviest(hypotheses([], [])).covariance.shape == (0, 2, 2)


def test_only_full_landmarks_with_a_known_position_are_scored():
    estimate = MapEstimate(
        landmark=np.array([3, 1, 2, 8]),
        mean=np.array([[3.0, 0.0], [1.0, 0.0], [2.0, 0.0], [8.0, 0.0]]),
        covariance=np.zeros((4, 2, 2)),
        full=np.array([True, True, False, True]),
    )
    labels, positions = np.array([1, 2, 3]), np.array([[1.5, 0.0], [2.5, 0.0], [3.5, 0.0]])
    mapped, true = scored_landmarks(estimate, labels, positions)
    assert mapped[:, 0].tolist() == [3.0, 1.0]
    assert true[:, 0].tolist() == [3.5, 1.5]
    mapped, true = scored_landmarks(estimate, np.array([99]), np.zeros((1, 2)))
    assert mapped.shape == true.shape == (0, 2)


def test_the_aligned_position_error_is_evos():
    rng = np.random.default_rng(3)
    true = loop(300)
    estimate = true + np.cumsum(rng.normal(0.0, 0.02, (300, 3)), axis=0)
    estimate[:, :2] = moved(estimate[:, :2], np.array([1.0, -2.0, 0.4]))

    def evo_path(points):
        upright = np.tile([1.0, 0.0, 0.0, 0.0], (len(points), 1))
        positions = np.column_stack([points[:, :2], np.zeros(len(points))])
        return PosePath3D(positions_xyz=positions, orientations_quat_wxyz=upright)

    reference, aligned = evo_path(true), evo_path(estimate)
    aligned.align(reference, correct_scale=False)
    metric = APE(PoseRelation.translation_part)
    metric.process_data((reference, aligned))
    expected = metric.get_statistic(StatisticsType.rmse)

    motion = alignment(estimate[:, :2], true[:, :2])
    ours = rmse(position_error(moved(estimate[:, :2], motion), true))
    assert ours == pytest.approx(expected, rel=1e-10)
    assert rmse(position_error(estimate, true)) > 1.5 * ours
