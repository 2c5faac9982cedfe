"""Rows against landmarks: the kernel's costs are those of the formula, written out."""

import math

import numpy as np
import pytest

from pipistrelle.estimation.beliefs import JointGaussian
from pipistrelle.estimation.data_association.pairs import (
    OWN_CALL,
    UNPLACED,
    Rows,
    pair_costs,
    with_points,
)

CHANCES = (1e9, 0.06, 1.2, 0.8, 0.06)
CALLER = 5


def joint_of(seed, std=0.02):
    """Return a pose and four landmarks, the last of them the caller, all correlated."""
    rng = np.random.default_rng(seed)
    root = std * rng.standard_normal((11, 11))
    mean = np.concatenate([rng.normal(0.0, 1.0, 3), rng.uniform(-9.0, 9.0, 8)])
    return JointGaussian(landmark=np.array([2, 3, 4, CALLER]), mean=mean, covariance=root @ root.T)


def predicted(state, n, caller):
    """Return bearing, and range or excess path, of the landmark at index n of a joint mean."""
    here, there = state[:2], state[n : n + 2]
    east, north = there - here
    far = math.hypot(east, north)
    if caller != OWN_CALL:
        source = state[caller : caller + 2]
        far += math.dist(there, source) - math.dist(here, source)
    return np.array([math.atan2(north, east) - state[2], far])


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("own", [True, False])
def test_costs_match_the_innovations_by_finite_differences(seed, own):
    joint, rng = joint_of(seed), np.random.default_rng(seed + 100)
    bearing, way, stds = rng.uniform(-math.pi, math.pi, 6), rng.uniform(1.0, 9.0, 6), (0.05, 0.1)
    columns = bearing, np.full(6, stds[0]), way, np.full(6, stds[1]), np.ones(6)
    at = 3 + 2 * np.arange(4)
    caller = OWN_CALL if own else int(at[3])
    found = pair_costs(columns, joint.mean, joint.covariance, at, caller, CHANCES)
    sides = 1e-5 * np.eye(joint.mean.size)
    for n, place in enumerate(at[: 4 if own else 3]):
        ahead, behind = (
            np.array([predicted(joint.mean + one, place, caller) for one in sign * sides])
            for sign in (1.0, -1.0)
        )
        H = (ahead - behind).T / 2e-5
        S = H @ joint.covariance @ H.T + np.diag(np.square(stds))
        for m in range(6):
            nu = np.array([bearing[m], way[m]]) - predicted(joint.mean, place, caller)
            nu[0] = math.remainder(nu[0], math.tau)
            squared = nu @ np.linalg.solve(S, nu)
            cost = squared + math.log(np.linalg.det(2.0 * math.pi * S)) + 2.0 * math.log(0.06 / 0.8)
            assert found[m, n] == pytest.approx(cost, rel=1e-6)
    if not own:
        assert np.isinf(found[:, 3]).all(), "a caller is no echo of its own call"


def test_a_row_that_is_clutter_more_rarely_costs_less_by_twice_the_logarithm():
    joint, row = joint_of(1, std=0.01), (np.zeros(1), np.full(1, 0.01), np.ones(1), np.ones(1))
    often, rarely = (
        pair_costs((*row, share), joint.mean, joint.covariance, np.array([3]), OWN_CALL, CHANCES)
        for share in (np.ones(1), np.full(1, 0.1))
    )
    assert often - rarely == pytest.approx(-2.0 * math.log(0.1))


@pytest.mark.parametrize(("vague", "std", "told"),
                         [(0.02, 0.02, False), (0.06, 0.02, True), (0.02, 0.3, True)])  # fmt: skip
def test_a_row_matches_only_landmarks_known_as_well_as_the_row(vague, std, told):
    mean, covariance = np.array([0.0, 0.0, 0.0, 5.0, 0.0]), np.diag([0.0, 0.0, 0.0, 0.25, 0.25])
    row = np.zeros(1), np.full(1, 0.1), np.full(1, 5.0), np.full(1, std), np.ones(1)
    chances = *CHANCES[:4], vague
    costs = pair_costs(row, mean, covariance, np.array([3]), OWN_CALL, chances)
    assert np.isfinite(costs[0, 0]) == told


def test_a_bearing_is_compared_across_the_cut_behind():
    here = JointGaussian(
        landmark=np.array([7]), mean=np.array([0.0, 0.0, 0.0, -5.0, 0.1]),
        covariance=np.zeros((5, 5)),
    )  # fmt: skip
    none = np.full(1, np.nan)
    row = Rows(np.array([-math.pi + 0.01]), np.array([0.05]), none, none, none)
    costs = pair_costs(
        tuple(row), here.mean, here.covariance, np.array([3]), UNPLACED, (25.0, *CHANCES[1:])
    )
    assert np.isfinite(costs[0, 0])


def test_a_new_point_is_correlated_with_the_pose_as_the_filter_makes_it():
    joint = joint_of(3, std=0.01)
    more = with_points(joint, [9], tuple(np.array([[0.4], [3.0], [0.02], [0.1]])))
    rng = np.random.default_rng(0)
    drawn = rng.multivariate_normal(joint.mean, joint.covariance, 200_000)
    bearing, far = rng.normal(0.4, 0.02, 200_000), rng.normal(3.0, 0.1, 200_000)
    angle = drawn[:, 2] + bearing
    x, y = drawn[:, 0] + far * np.cos(angle), drawn[:, 1] + far * np.sin(angle)
    sampled = np.cov(np.column_stack([drawn, x, y]).T)
    np.testing.assert_allclose(more.covariance, sampled, atol=2e-4)
    assert more.landmark.tolist() == [*joint.landmark.tolist(), 9]


def test_new_points_at_once_are_to_the_bit_new_points_one_by_one():
    points = np.array([[0.4, -1.0, 2.0], [3.0, 0.5, 7.0], [0.02, 0.1, 0.01], [0.1, 0.2, 0.05]])
    joint = one_by_one = joint_of(3, std=0.01)
    for n in range(3):
        one_by_one = with_points(one_by_one, [7 + n], tuple(points[:, [n]]))
    at_once = with_points(joint, [7, 8, 9], tuple(points))
    np.testing.assert_array_equal(at_once.mean, one_by_one.mean)
    np.testing.assert_array_equal(at_once.covariance, one_by_one.covariance)
    np.testing.assert_array_equal(at_once.landmark, one_by_one.landmark)
