"""Weights from logs, and stratified resampling."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipistrelle.estimation.fastslam.particles import effective_particles, normalised, stratified

logs = st.lists(st.floats(-1e5, 1e5), min_size=1, max_size=30).map(np.array)
unnormalised = st.lists(st.floats(0, 1) | st.just(0.0), min_size=1, max_size=30).filter(any)
uniform = st.floats(0, 1, exclude_max=True)


def weights_of(values):
    return np.array(values) / np.sum(values)


@given(logs)
def test_weights_sum_to_one_and_rank_as_their_logs(log_weight):
    weight = normalised(log_weight)
    assert weight.sum() == pytest.approx(1, abs=1e-12)
    assert (weight >= 0).all()
    assert (np.diff(weight[np.argsort(log_weight)]) >= 0).all()


@given(logs, st.floats(-1e5, 1e5))
def test_a_common_factor_changes_no_weight(log_weight, shift):
    # Adding the shift rounds each log by at most 2^-53 of 2e5.
    shifted = normalised(log_weight + shift)
    np.testing.assert_allclose(shifted, normalised(log_weight), rtol=1e-10, atol=1e-300)


@pytest.mark.parametrize("seed", range(10))
def test_permuted_logs_have_permuted_weights_exactly(seed):
    rng = np.random.default_rng(seed)
    log_weight, order = rng.normal(0, 2, 100), rng.permutation(100)
    np.testing.assert_array_equal(normalised(log_weight[order]), normalised(log_weight)[order])


def test_weights_are_not_lost_where_their_exponentials_are():
    np.testing.assert_allclose(
        normalised(np.array([-1e4, -1e4 + np.log(3), -2e4])), [0.25, 0.75, 0], rtol=1e-11
    )


def test_given_logs_are_not_changed():
    log_weight = np.array([-3.0, 2.0])
    normalised(log_weight)
    assert log_weight.tolist() == [-3, 2]


def test_impossible_particles_weigh_nothing_and_when_all_are_they_weigh_the_same():
    np.testing.assert_array_equal(normalised(np.array([-np.inf, 0.0, np.nan])), [0, 1, 0])
    np.testing.assert_array_equal(normalised(np.full(4, -np.inf)), 0.25)
    np.testing.assert_array_equal(normalised(np.full(4, np.nan)), 0.25)


@given(unnormalised)
def test_effective_particles_are_between_1_and_all(values):
    weight = weights_of(values)
    assert 1 - 1e-12 <= effective_particles(weight) <= weight.size * (1 + 1e-12)


@pytest.mark.parametrize("equal", [1, 3, 100])
def test_the_effective_number_of_equal_weights_is_their_count(equal):
    weight = np.concatenate([np.full(equal, 1 / equal), np.zeros(7)])
    assert effective_particles(weight) == pytest.approx(equal, rel=1e-12)


@given(unnormalised, st.data())
def test_copies_sum_to_the_particles_and_differ_from_their_share_by_less_than_two(values, data):
    weight, size = weights_of(values), len(values)
    points = data.draw(st.lists(uniform, min_size=size, max_size=size).map(np.array))
    ancestor = stratified(weight, points)
    copies = np.bincount(ancestor, minlength=size)
    assert copies.sum() == copies.size == size
    assert (np.diff(ancestor) >= 0).all()
    # The cumulated weights and the points round by 2^-53 each: a stratum's edge may be crossed.
    assert (np.abs(copies - size * weight) < 2 + 1e-12).all()


@given(unnormalised, st.data())
def test_particles_without_weight_have_no_copies(values, data):
    weight, size = weights_of(values), len(values)
    points = data.draw(st.lists(uniform, min_size=size, max_size=size).map(np.array))
    assert (weight[stratified(weight, points)] > 0).all()


def test_last_point_that_rounds_to_one_still_finds_a_particle_with_weight():
    largest = np.nextafter(1.0, 0.0)
    ancestor = stratified(np.array([0.0, 0.5, 0.5, 0.0]), np.array([0.0, 0.5, 0.5, largest]))
    assert ancestor.tolist() == [1, 1, 2, 2]


@given(st.integers(1, 50), st.data())
def test_equal_weights_leave_each_particle_one_copy(size, data):
    points = data.draw(st.lists(st.floats(0.01, 0.99), min_size=size, max_size=size).map(np.array))
    ancestor = stratified(np.full(size, 1 / size), points)
    np.testing.assert_array_equal(ancestor, np.arange(size))


def mean_copies(weight, draw, runs=20_000):
    """Mean number of copies of each particle and its standard error."""
    rng = np.random.default_rng(5)
    copies = np.array(
        [np.bincount(draw(weight, rng), minlength=weight.size) for _ in range(runs)], float
    )
    return copies.mean(axis=0), copies.std(axis=0) / np.sqrt(runs), copies.var(axis=0)


def by_strata(weight, rng):
    return stratified(weight, rng.random(weight.size))


def by_midpoints(weight, _):
    """Not a draw: without chance a particle gets its rounded share, for ever."""
    return stratified(weight, np.full(weight.size, 0.5))


def by_independent_draws(weight, rng):
    return rng.choice(weight.size, size=weight.size, p=weight)


@pytest.mark.slow
def test_mean_number_of_copies_is_the_particles_share_and_without_chance_it_is_not():
    weight = np.random.default_rng(3).dirichlet(np.full(20, 1.0))
    assert 20 * weight.min() > 0.01
    mean, error, spread = mean_copies(weight, by_strata)
    # Twenty means, each within 4 standard errors: false alarm 1.3e-3.
    assert (np.abs(mean - 20 * weight) <= 4 * error + 1e-12).all()
    assert np.abs(mean_copies(weight, by_midpoints)[0] - 20 * weight).max() > 0.1
    assert spread.sum() < 0.5 * mean_copies(weight, by_independent_draws)[2].sum()
