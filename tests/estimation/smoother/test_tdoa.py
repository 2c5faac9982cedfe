"""Excess paths in the graph: their factor by differences and one by one, and those that wait."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from pipistrelle.estimation.measurement import HUBER_K, excess_path_of
from pipistrelle.estimation.smoother.graph import landmark_key, pose_key
from pipistrelle.estimation.smoother.tdoa import (
    MAX_WAITING,
    ExcessPath,
    excess_path_factors,
    excess_paths_of,
    split_ready,
)
from reference.missions import scan_with

CALLERS = (9, 3)
PLACES = {1: (4.0, 1.0), 3: (-6.0, 5.0), 4: (2.0, -7.0), 7: (0.5, 3.0), 9: (12.0, 2.0)}
"""By label; 3 and 9 call, and are heard in each other's call, too."""


def graph_values(node=5, pose=(0.3, -0.8, 2.1)):
    values = gtsam.Values()
    values.insert(pose_key(node), gtsam.Pose2(*pose))
    for label, place in PLACES.items():
        values.insert(landmark_key(label), np.array(place))
    return values


def heard(off, node=5, pose=(0.3, -0.8, 2.1)):
    """All excess paths over all landmarks, each off by so many deviations."""
    pairs = [(one, call) for call in CALLERS for one in PLACES if one != call]
    rows = []
    for (one, call), z in zip(pairs, np.broadcast_to(off, len(pairs)), strict=True):
        true = excess_path_of(np.array(pose[:2]), np.array(PLACES[one]), np.array(PLACES[call]))
        rows.append(ExcessPath(node, one, call, true - z * 0.07, 0.07))
    return rows


def one_factor(rows, **settings):
    (factor,) = excess_path_factors(rows, **settings)
    return factor


def moved(values, key, step):
    """The values with one variable moved, a pose in its own axes."""
    delta = gtsam.VectorValues()
    delta.insert(key, step)
    return values.retract(delta)


def slopes_of(told, values, keys, size=1e-6):
    """Differences of what is told, by each axis of each variable."""
    return np.transpose(
        [
            (told(moved(values, key, step)) - told(moved(values, key, -step))) / (2.0 * size)
            for key in keys
            for step in size * np.eye(3 if key == pose_key(5) else 2)
        ]
    )


# What they say


def test_slopes_are_differences_of_the_misfits_by_every_variable():
    values = graph_values()
    factor = one_factor(heard(np.linspace(-1.5, 1.5, 8)), robust=False)
    A, b = factor.linearize(values).jacobian()
    expected = slopes_of(factor.unwhitenedError, values, list(factor.keys()))
    assert A.shape == (8, 13)
    np.testing.assert_allclose(A, expected, rtol=0, atol=1e-6)
    np.testing.assert_allclose(-b, factor.unwhitenedError(values), rtol=0, atol=1e-12)


@pytest.mark.parametrize("robust", [False, True])
def test_what_is_lost_falls_as_the_slopes_say_on_either_side_of_hubers_bend(robust):
    values = graph_values()
    factor = one_factor(heard([-9.0, -2.1, -1.9, -0.3, 0.4, 1.9, 2.1, 30.0]), robust=robust)
    A, b = factor.linearize(values).jacobian()
    slope = slopes_of(factor.error, values, list(factor.keys()))
    np.testing.assert_allclose(-A.T @ b, slope, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("off", [-30.0, -2.0, -1.0, 0.0, 1.9, 2.1, 7.0])
def test_what_one_loses_is_what_gtsam_has_by_hubers_loss(off):
    huber = gtsam.noiseModel.mEstimator.Huber.Create(HUBER_K)
    row = heard(off)[:1]
    factor = one_factor(row, robust=True)
    assert factor.error(graph_values()) == pytest.approx(huber.loss(off), rel=1e-9)
    plain = one_factor(row, robust=False)
    assert plain.error(graph_values()) == pytest.approx(0.5 * off**2, rel=1e-9)
    weight = factor.linearize(graph_values()).jacobian()[0] @ np.ones(7)
    whole = plain.linearize(graph_values()).jacobian()[0] @ np.ones(7)
    assert weight / whole == pytest.approx(np.sqrt(huber.weight(off)), rel=1e-9)


@pytest.mark.parametrize("robust", [False, True])
def test_a_frame_says_at_once_what_its_excess_paths_say_one_by_one(robust):
    values, rows = graph_values(), heard([-9.0, -2.1, -1.9, -0.3, 0.4, 1.9, 2.1, 30.0])
    ones = gtsam.NonlinearFactorGraph()
    for row in rows:
        ones.add(one_factor([row], robust=robust))
    whole = gtsam.NonlinearFactorGraph()
    whole.add(one_factor(rows, robust=robust))
    assert whole.error(values) == pytest.approx(ones.error(values), rel=1e-12)
    for told in zip(
        whole.linearize(values).hessian(), ones.linearize(values).hessian(), strict=True
    ):
        np.testing.assert_allclose(*told, rtol=1e-12, atol=1e-9)


def test_excess_paths_of_a_scan_are_those_of_callers_that_have_a_label():
    told = {
        "excess_path": np.array([3.0, np.nan, 2.0, 5.0]),
        "excess_path_std": np.array([0.1, 0.2, 0.3, 0.4]),
    }
    scan = scan_with([4, 1, 9, 7], np.zeros(4), caller=np.array([1, 1, 1, 2]), **told)
    assert excess_paths_of(scan, 8) == ()
    rows = excess_paths_of(replace(scan, callers=np.array([-1, 9, -1])), 8)
    assert [row[:4] for row in rows] == [(8, 4, 9, 3.0)]
    assert rows[0].std == pytest.approx(0.1)


# Those that wait


def test_no_more_wait_than_may_and_the_newest_are_kept():
    rows = [ExcessPath(node, 1, 9, 1.0, 0.1) for node in range(MAX_WAITING + 7)]
    entering, waiting = split_ready(rows, {1, 4})
    assert not entering
    assert [one.node for one in waiting] == list(range(7, MAX_WAITING + 7))


@pytest.mark.parametrize(
    ("mapped", "enter"), [((), 0), ((1,), 0), ((9,), 0), ((1, 9), 1), ((1, 4, 9), 2)]
)
def test_an_excess_path_waits_for_its_landmark_and_its_caller(mapped, enter):
    rows = [ExcessPath(0, 1, 9, 1.0, 0.1), ExcessPath(2, 4, 9, 1.0, 0.1)]
    entering, waiting = split_ready(rows, mapped)
    assert entering == tuple(rows[:enter])
    assert waiting == tuple(rows[enter:])
