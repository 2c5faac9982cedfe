"""NEES and its bounds: closed forms, laws, statistics with a control that must fail."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import expm

from pipistrelle.detection.scans import make_scan
from pipistrelle.estimation.beliefs import Gaussian, Track, no_landmarks
from pipistrelle.evaluation.consistency import (
    anees,
    anees_bounds,
    anees_departure,
    diverged,
    nees,
    strayed_landmarks,
    track_nees,
)
from pipistrelle.geometry import range_and_bearing
from reference.missions import map_with

SEED = st.integers(0, 2**32 - 1)


def covariances(rng, n):
    """Draw covariances of pose errors: centimetres to metres, correlated."""
    factor = rng.normal(size=(n, 3, 3)) + 2.0 * np.eye(3)
    factor *= 10.0 ** rng.uniform(-2.0, 0.0, (n, 3, 1))
    return factor @ np.swapaxes(factor, 1, 2)


def draws(rng, covariance):
    factor = np.linalg.cholesky(covariance)
    return (factor @ rng.normal(size=(len(covariance), 3, 1)))[..., 0]


@given(SEED)
def test_nees_is_the_quadratic_form_of_the_inverse_covariance(seed):
    rng = np.random.default_rng(seed)
    P = covariances(rng, 20)
    error = draws(rng, P)
    expected = np.sum(error * np.linalg.solve(P, error[..., None])[..., 0], axis=1)
    worst = np.linalg.cond(P).max()
    assert nees(error, P) == pytest.approx(expected, rel=20 * np.finfo(float).eps * worst)


@given(SEED)
def test_nees_does_not_depend_on_the_units(seed):
    rng = np.random.default_rng(seed)
    P, unit = covariances(rng, 5), np.array([2.0**10, 2.0**-7, 2.0])
    error = draws(rng, P)
    assert (nees(error * unit, P * unit[:, None] * unit) == nees(error, P)).all()


def test_nees_does_not_change_its_arguments():
    error, P = np.ones((4, 3)), covariances(np.random.default_rng(1), 4)
    before = P.tobytes()
    nees(error, P)
    assert (error == 1.0).all()
    assert P.tobytes() == before


def test_nees_of_independent_errors_is_their_sum_of_squared_ratios():
    expected = pytest.approx([1.0 + 4.0 + 1.0], rel=1e-12)
    assert nees(np.array([[0.3, 0.4, 0.1]]), np.diag([0.09, 0.04, 0.01])[None]) == expected


@pytest.mark.parametrize(
    "covariance",
    [
        np.zeros((3, 3)),
        np.diag([1.0, 1.0, 0.0]),
        np.diag([1.0, -1.0, 1.0]),
        np.array([[0.1, 0.3, 0.0], [0.3, 0.9, 0.0], [0.0, 0.0, 1.0]]),
        np.full((3, 3), 1.0),
        np.diag([1.0, np.nan, 1.0]),
        np.diag([1.0, np.inf, 1.0]),
    ],
)
def test_nees_is_infinite_where_the_covariance_cannot_be_inverted(covariance):
    both = nees(np.ones((2, 3)), np.stack([covariance, np.eye(3)]))
    assert both.tolist() == [np.inf, 3.0]


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e200])
def test_nees_is_infinite_where_the_error_is_too_large_or_no_number(value):
    assert nees(np.array([[value, 0.0, 0.0]]), np.eye(3)[None]).tolist() == [np.inf]


EXACT = np.zeros((3, 3))
ONE_STEP = np.array([[1.0, 2.0, 0.0], [2.0, 4.0, 0.0], [0.0, 0.0, 1.0]])
"""After a step along the heading from an exact start: of rank 2."""
BROKEN = np.diag([1.0, np.nan, 1.0])


def of_ones(*covariances):
    """Return the NEES of a track that is off by one in all states."""
    k = len(covariances)
    pose = Gaussian(mean=np.ones((k, 3)), covariance=np.stack(covariances))
    return track_nees(pose, np.zeros((k, 3)))


def test_after_an_exact_start_there_is_no_nees_until_the_covariance_is_positive_definite():
    np.testing.assert_array_equal(
        of_ones(EXACT, ONE_STEP, np.eye(3), 2.0 * np.eye(3)), [np.nan, np.nan, 3.0, 1.5]
    )


def test_a_covariance_that_becomes_singular_later_is_a_divergence():
    np.testing.assert_array_equal(
        of_ones(EXACT, np.eye(3), ONE_STEP, np.eye(3)), [np.nan, 3.0, np.inf, 3.0]
    )


@pytest.mark.parametrize("track", [(EXACT,), (EXACT, ONE_STEP), (EXACT, BROKEN)])
def test_a_covariance_that_is_never_positive_definite_is_a_divergence(track):
    assert (of_ones(*track) == np.inf).all()


def test_a_covariance_that_is_not_finite_is_a_divergence_before_the_first_definite_one_too():
    np.testing.assert_array_equal(of_ones(EXACT, BROKEN, np.eye(3)), [np.nan, np.inf, 3.0])


def test_an_uncertain_start_has_the_nees_of_its_poses_bit_for_bit():
    rng = np.random.default_rng(4)
    P = covariances(rng, 50)
    error = draws(rng, P) * [1.0, 1.0, 0.01]
    P[30] = ONE_STEP
    assert (
        track_nees(Gaussian(mean=error, covariance=P), np.zeros_like(error)) == nees(error, P)
    ).all()


@given(SEED)
def test_the_nees_of_a_track_forgets_whole_turns_of_the_heading(seed):
    rng = np.random.default_rng(seed)
    P = covariances(rng, 20)
    error = draws(rng, P) * [1.0, 1.0, 0.01]
    turns = 2.0 * np.pi * rng.integers(-2, 3, 20)
    true = rng.uniform(-3.0, 3.0, (20, 3))
    wound = true + error + np.column_stack([0.0 * turns, 0.0 * turns, turns])
    worst = np.linalg.cond(P).max()
    expected = pytest.approx(nees(error, P), rel=1e-13 * worst, abs=1e-9)
    assert track_nees(Gaussian(mean=wound, covariance=P), true) == expected


def test_the_nees_of_an_invariant_error_is_chi_square_however_far_the_turn_carries_a_pose():
    """Truths are drawn as exp(xi) times a pose 30 m from the start, unsure by 0.3 rad."""
    rng, runs = np.random.default_rng(5), 4000
    P = np.diag([0.2**2, 0.1**2, 0.3**2])
    xi = rng.multivariate_normal(np.zeros(3), P, runs)
    truth, T = [], np.array([[1.0, 0, 0], [0, 1, -30.0], [0, 0, 1]])  # of (30, 0)
    for x, y, turn in xi:
        lie = expm(np.array([[0, -turn, x], [turn, 0, y], [0, 0, 0]]))
        truth.append([*(lie @ [30.0, 0.0, 1.0])[:2], 0.4 + turn])
    back = np.linalg.inv(T)
    mean = np.tile([30.0, 0.0, 0.4], (runs, 1))
    covariance = np.tile(back @ P @ back.T, (runs, 1, 1))

    def mean_nees(invariant):
        start = {"mean": np.zeros((1, 3)), "covariance": np.eye(3)[None]}
        parts = {
            name: np.concatenate([start[name], part])
            for name, part in (("mean", mean), ("covariance", covariance))
        }
        true = np.concatenate([np.zeros((1, 3)), truth])
        return track_nees(Gaussian(**parts, invariant=invariant), true)[1:].mean()

    assert mean_nees(invariant=True) == pytest.approx(3.0, abs=4 * np.sqrt(6 / runs))
    assert mean_nees(invariant=False) > 100


def test_there_is_no_nees_without_truth_and_an_infinite_one_of_a_lost_estimate():
    mean, true = np.ones((4, 3)), np.zeros((4, 3))
    true[1:3] = np.nan
    mean[2:] = np.nan
    P = np.tile(np.eye(3), (4, 1, 1))
    np.testing.assert_array_equal(
        track_nees(Gaussian(mean=mean, covariance=P), true), [3.0, np.nan, np.nan, np.inf]
    )


def test_the_nees_of_a_consistent_filter_averages_to_three_and_of_an_overconfident_one_to_more():
    rng = np.random.default_rng(11)
    runs = 20_000
    P = covariances(rng, runs)
    error = draws(rng, P)
    low, high = anees_bounds(runs, confidence=1 - 1e-6)
    assert low < nees(error, P).mean() < high
    assert nees(error, 0.95 * P).mean() > high
    assert nees(error, 1.05 * P).mean() < low


def test_the_bounds_hold_the_anees_as_often_as_they_promise():
    rng = np.random.default_rng(5)
    steps, runs = 4000, 10
    average = anees(rng.chisquare(3, (runs, steps)))
    low, high = anees_bounds(runs, confidence=0.9)
    spread = np.sqrt(0.9 * 0.1 / steps)
    assert np.mean((low < average) & (average < high)) == pytest.approx(0.9, abs=4 * spread)
    low, high = anees_bounds(runs + 5, confidence=0.9)
    assert np.mean((low < average) & (average < high)) < 0.9 - 4 * spread


def test_the_bounds_close_around_the_number_of_states():
    for states in (2, 3):
        low, high = anees_bounds(10**6, states=states)
        width = 1.959964 * np.sqrt(2 * states / 10**6)
        assert (low, high) == pytest.approx((states - width, states + width), abs=1e-5)


def test_anees_averages_over_runs_step_by_step():
    assert anees(np.array([[1.0, 2.0, np.inf], [3.0, 4.0, 5.0]])).tolist() == [2.0, 3.0, np.inf]


@pytest.mark.parametrize("limit", [50.0, 2750.0])
def test_a_run_diverges_by_one_nees_above_the_limit_and_not_by_one_at_it(limit):
    assert not diverged(np.array([0.0, limit]), limit)
    assert diverged(np.array([0.0, np.nextafter(limit, np.inf), 0.0]), limit)


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_run_diverges_by_one_nees_that_is_no_number(value):
    assert diverged(np.array([0.0, value]), 50.0)


POSTS = np.array([[4.0, 3.0], [6.0, -2.0], [9.0, 1.0]])


def track_past(posts, steps=60):
    """Return the track of a vehicle that drives east past posts, and knows where all is."""
    path = np.column_stack([np.linspace(0.0, 3.0, steps), np.zeros((steps, 2))])
    small, size = 1e-6 * np.eye(3), len(posts)
    landmarks = map_with(np.arange(size), posts, np.tile(small[:2, :2], (size, 1, 1)))
    pose = Gaussian(mean=path, covariance=np.tile(small, (steps, 1, 1)))
    return Track(time=np.arange(float(steps)), pose=pose, landmarks=landmarks, gated=0)


def heard_on(track, posts_at, rng=None):
    """Return a scan at each step of a track: bearings and ranges, a bearing only of the last."""
    scans = []
    for time, pose in zip(track.time, track.pose.mean, strict=True):
        distance, bearing = range_and_bearing(pose, posts_at(time))
        noise = rng.standard_normal((2, distance.size)) if rng else np.zeros((2, distance.size))
        distance[-1] = np.nan
        known = {"range": distance + 0.1 * noise[0], "range_std": 0.1, "bearing_std": 0.02}
        labels = np.arange(distance.size)
        scans.append(make_scan(time, labels, bearing + 0.02 * noise[1], **known))
    return scans


@pytest.mark.parametrize("moved", [0, 2])
def test_a_landmark_that_was_moved_has_strayed_and_no_other(moved):
    track = track_past(POSTS)
    shift = np.eye(3)[moved][:, np.newaxis] * np.array([0.0, 1.0])
    scans = heard_on(track, lambda time: POSTS + shift * (20 <= time < 33))
    assert strayed_landmarks(track, scans, 0.999, 1e-3) == {moved: (20.0, 32.0, 13)}


def test_a_landmark_far_off_by_chance_has_not_strayed():
    track, rng = track_past(POSTS), np.random.default_rng(5)
    assert strayed_landmarks(track, heard_on(track, lambda _: POSTS, rng), 0.9, 0.1) == {}
    once = heard_on(track, lambda time: POSTS + (time == 20.0))
    assert strayed_landmarks(track, once, 0.999, 1e-3) == {}


def test_a_map_without_landmarks_has_none_that_strayed():
    track = replace(track_past(POSTS), landmarks=no_landmarks())
    assert strayed_landmarks(track, heard_on(track, lambda _: POSTS), 0.999, 1e-3) == {}
    assert strayed_landmarks(track, [], 0.999, 1e-3) == {}


@pytest.mark.parametrize(("factor", "expected"), [(1.0, 0.0), (np.e, 1.0), (1.0 / np.e, 1.0)])
def test_departure_counts_over_and_under_confidence_equally(factor, expected):
    for ideal in (3.0, 2.2):
        assert anees_departure(np.full(10, factor * ideal), np.full(10, ideal)) == pytest.approx(
            expected, abs=1e-12
        )
