"""From costs to decisions: against all assignments, written out."""

from itertools import product

import numpy as np
import pytest

from pipistrelle.estimation.data_association.pairs import NOTHING, _shares, marginal, nearest


def costs_of(seed, rows=4, landmarks=3):
    """Return costs about 0, a third of them infinite."""
    rng = np.random.default_rng(seed)
    costs = rng.normal(-2.0, 4.0, (rows, landmarks))
    return np.where(rng.random(costs.shape) < 0.3, np.inf, costs)


def probabilities(costs):
    """Return the probability that each row is of each landmark; the rest is clutter."""
    (rows, landmarks, values), shares = _shares(costs), np.zeros(costs.shape)
    shares[rows, landmarks] = values
    return shares


def assignments(costs):
    """Return every assignment of rows to landmarks, each once at most, with its whole cost."""
    rows, landmarks = costs.shape
    for choice in product(range(NOTHING, landmarks), repeat=rows):
        taken = [j for j in choice if j != NOTHING]
        if len(taken) == len(set(taken)):
            yield choice, sum(costs[i, j] for i, j in enumerate(choice) if j != NOTHING)


@pytest.mark.parametrize("seed", range(20))
def test_the_nearest_assignment_costs_least_of_all(seed):
    costs = costs_of(seed)
    best, least = min(assignments(costs), key=lambda one: one[1])
    found = nearest(costs)
    whole = sum(costs[i, j] for i, j in enumerate(found) if j != NOTHING)
    assert whole == pytest.approx(least)
    assert tuple(found) == best


@pytest.mark.parametrize("seed", range(20))
def test_message_passing_is_near_the_sum_over_all_assignments(seed):
    costs = costs_of(seed)
    exact = np.zeros_like(costs)
    total = 0.0
    for choice, cost in assignments(costs):
        weight = np.exp(-0.5 * cost) if np.isfinite(cost) else 0.0
        total += weight
        for i, j in enumerate(choice):
            if j != NOTHING:
                exact[i, j] += weight
    found = probabilities(costs)
    assert np.abs(found - exact / total).max() < 0.12, "loops make it approximate"
    assert (found.sum(axis=1) <= 1.0 + 1e-12).all()
    assert (found.sum(axis=0) <= 1.0 + 1e-6).all()


def test_message_passing_is_exact_where_no_loop_is():
    costs = np.array([[-3.0, np.inf], [1.0, -2.0]])
    weight = np.exp(-0.5 * costs)
    a, b, c = weight[0, 0], weight[1, 0], weight[1, 1]
    total = 1.0 + a + b + c + a * c
    exact = np.array([[a + a * c, 0.0], [b, c + a * c]]) / total
    np.testing.assert_allclose(probabilities(costs), exact, rtol=1e-6)


@pytest.mark.parametrize("seed", range(20))
def test_pairs_beyond_the_gate_have_zero_weight(seed):
    rng = np.random.default_rng(seed)
    costs = rng.normal(-3.0, 8.0, (6, 5))
    costs[rng.random((6, 5)) < 0.5] = np.inf
    weightless = np.where(np.isinf(costs), 1e6, costs)  # exp(-5e5) is 0
    np.testing.assert_array_equal(probabilities(costs), probabilities(weightless))


def test_ambiguous_rows_and_clutter_are_not_matched():
    assert marginal(np.array([[-9.0, -8.5]])).tolist() == [NOTHING]
    assert marginal(np.array([[-9.0, 2.0]])).tolist() == [0]
    assert marginal(np.array([[0.5, np.inf]])).tolist() == [NOTHING]
    assert marginal(np.empty((2, 0))).tolist() == [NOTHING, NOTHING]
    assert nearest(np.empty((0, 3))).tolist() == []
