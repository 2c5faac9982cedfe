"""Joint compatibility against a search through all sets, and innovations against a slow version."""

from functools import partial
from itertools import product

import numpy as np
import pytest

from pipistrelle.detection.scans import make_scan
from pipistrelle.estimation.association import expected
from pipistrelle.estimation.beliefs import JointGaussian
from pipistrelle.estimation.data_association.pairs import (
    MOST_ROWS,
    OWN_CALL,
    gates,
    jointly_compatible,
    pair_costs,
    pair_innovations,
)

CHANCES = (25.0, 0.06, 1.3, 0.8, 0.06)


def drawn(seed, rows=5, landmarks=5, heading_std=0.15):
    """Return a joint Gaussian and rows of its landmarks, all seen from a pose that is off."""
    rng = np.random.default_rng(seed)
    places = rng.uniform((1.0, -6.0), (13.0, 6.0), (landmarks, 2))
    covariance = np.zeros((3 + 2 * landmarks,) * 2)
    covariance[2, 2] = heading_std**2
    covariance[3:, 3:] = 0.02**2 * np.eye(2 * landmarks)
    joint = JointGaussian(
        landmark=np.arange(landmarks),
        mean=np.concatenate([np.zeros(3), places.ravel()]),
        covariance=covariance,
    )
    seen = places[rng.permutation(landmarks)[:rows]]
    off = heading_std * rng.standard_normal()
    bearing = np.arctan2(seen[:, 1], seen[:, 0]) + off + 0.01 * rng.standard_normal(rows)
    way = np.hypot(*seen.T) + 0.03 * rng.standard_normal(rows)
    way[0] = np.nan if seed % 3 == 0 else way[0]
    stds = np.full(rows, 0.01), np.full(rows, 0.03)
    return joint, (bearing, stds[0], way, stds[1], np.ones(rows))


def costs_and_innovations(joint, columns):
    at = 3 + 2 * np.arange(joint.landmark.size)
    costs = pair_costs(columns, joint.mean, joint.covariance, at, OWN_CALL, CHANCES)
    return costs, partial(pair_innovations, columns, joint.mean, joint.covariance, at, OWN_CALL)


def best_of_all(costs, innovate):
    """Return the largest compatible set, of those the nearest, by trying each."""
    best = (0, -0.0, np.full(len(costs), -1))
    options = [[-1, *np.flatnonzero(row < 0.0).tolist()] for row in costs]
    for labels in product(*options):
        row = np.flatnonzero(np.array(labels) >= 0)
        landmark = np.array(labels)[row]
        if not row.size or len({*landmark.tolist()}) < row.size:
            continue
        nu, S, numbers = innovate((row, landmark))
        squared = float(nu @ np.linalg.solve(S, nu))
        if squared <= gates(numbers.sum())[-1] and (row.size, -squared) > best[:2]:
            best = row.size, -squared, np.array(labels)
    return best[2]


@pytest.mark.parametrize("seed", range(24))
def test_the_search_finds_the_best_of_all_sets(seed):
    costs, innovate = costs_and_innovations(*drawn(seed))
    found = jointly_compatible(costs, innovate)
    assert found.tolist() == best_of_all(costs, innovate).tolist()


@pytest.mark.parametrize("seed", range(4))
def test_innovations_match_the_slow_version(seed):
    joint, columns = drawn(seed)
    row, landmark = np.array([0, 1, 3]), np.array([2, 0, 4])
    _, innovate = costs_and_innovations(joint, columns)
    nu, S, numbers = innovate((row, landmark))
    bearing, bearing_std, way, way_std, _ = columns
    scan = make_scan(0.0, np.full(bearing.size, -1), bearing, range=way,
                     bearing_std=bearing_std[0], range_std=way_std[0])  # fmt: skip
    slow = expected(joint, scan, row, landmark)
    for p in range(row.size):
        count = numbers[p]
        assert nu[2 * p : 2 * p + count] == pytest.approx(slow.difference[p, :count], abs=1e-12)
        for q in range(row.size):
            block = S[2 * p : 2 * p + count, 2 * q : 2 * q + numbers[q]]
            assert block == pytest.approx(slow.covariance[p, :count, q, : numbers[q]], abs=1e-12)


def test_a_heading_error_is_resolved_by_joint_but_not_single_compatibility():
    ring = np.linspace(0.0, 2.0 * np.pi, 12, endpoint=False)
    places = 5.0 * np.stack([np.cos(ring), np.sin(ring)], axis=-1)
    covariance = 1e-6 * np.eye(27)
    covariance[2, 2] = 0.4**2
    joint = JointGaussian(
        landmark=np.arange(12), mean=np.append(np.zeros(3), places), covariance=covariance
    )
    bearing = np.arctan2(places[:5, 1], places[:5, 0]) + 0.3  # a landmark is every 0.52 rad
    way = np.full(5, 5.0)
    columns = bearing, np.full(5, 0.01), way, np.full(5, 0.03), np.ones(5)
    costs, innovate = costs_and_innovations(joint, columns)
    assert costs.argmin(axis=1).tolist() == [1, 2, 3, 4, 5]
    found = jointly_compatible(costs, innovate)
    assert np.all((found - np.arange(5) == found[0]) | (found < 0)), "one turn for all"


def test_a_scan_of_many_rows_ends_within_its_bound():
    joint, columns = drawn(5, rows=40, landmarks=40, heading_std=0.5)
    costs, innovate = costs_and_innovations(joint, columns)
    assert np.count_nonzero(jointly_compatible(costs, innovate) >= 0) >= 10


def test_no_rows_or_no_landmarks_give_no_pairs():
    assert jointly_compatible(np.empty((0, 3)), None).tolist() == []
    assert jointly_compatible(np.empty((2, 0)), None).tolist() == [-1, -1]


def test_more_rows_than_are_tested_together_find_their_landmarks_too():
    rng = np.random.default_rng(2)
    size = 2 * MOST_ROWS + 7
    places = rng.uniform(-300.0, 300.0, (size, 2))
    joint = JointGaussian(
        landmark=np.arange(size), mean=np.append(np.zeros(3), places),
        covariance=1e-6 * np.eye(3 + 2 * size),
    )  # fmt: skip
    order = rng.permutation(size)
    bearing = np.arctan2(places[order, 1], places[order, 0])
    way, ones = np.hypot(*places[order].T), np.ones(size)
    columns = bearing, 0.001 * ones, way, 0.03 * ones, ones
    costs, innovate = costs_and_innovations(joint, columns)
    np.testing.assert_array_equal(jointly_compatible(costs, innovate), order)
