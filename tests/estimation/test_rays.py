import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipistrelle.config import RayConfig
from pipistrelle.estimation.rays import ray_members, survivors, update_params, weigh_and_share
from reference.ekf_slam import ray_ranges

configs = st.builds(
    RayConfig,
    relative_std=st.floats(0.05, 0.5),
    range_ratio=st.floats(1.2, 5),
    range_bounds=st.tuples(st.floats(0.1, 5), st.floats(6, 100)),
)
logs = st.lists(st.floats(-1e4, 1e3), min_size=1, max_size=8).map(np.array)


def shared(log_likelihood, weights, power=1.0, aggregated=False):
    """Aggregated likelihoods and shares after one bearing."""
    weights, share = np.array(weights, float), np.empty(len(weights))
    weigh_and_share(
        np.asarray(log_likelihood, float), weights, len(weights), power, aggregated, share
    )
    return weights, share


def pruned(weights, prune):
    """Which members stay, and the weights of those that do."""
    weights, keep = np.array(weights, float), np.empty(len(weights), dtype=bool)
    assert survivors(weights, len(weights), prune, keep) == keep.sum()
    return keep.tolist(), weights[keep]


def test_table_1_makes_a_ray_of_four_members():
    ranges, stds = ray_members(RayConfig())
    np.testing.assert_allclose(ranges, 0.5 / 0.7 * np.array([1, 3, 9, 27]), rtol=1e-15)
    np.testing.assert_allclose(stds, 0.3 * ranges, rtol=1e-15)


@given(configs)
def test_ray_reaches_from_the_nearest_to_the_farthest_range_with_no_member_to_spare(rays):
    ranges, stds = ray_members(rays)
    near, far = rays.range_bounds
    reached = (ranges + stds) * (1 + 1e-12)
    assert ranges[0] - stds[0] == pytest.approx(near, rel=1e-12)
    assert reached[-1] >= far
    assert len(ranges) == 1 or (ranges + stds)[-2] < far * (1 + 1e-12)
    np.testing.assert_allclose(stds / ranges, rays.relative_std, rtol=1e-12)
    np.testing.assert_allclose(ranges[1:] / ranges[:-1], rays.range_ratio, rtol=1e-12)


@given(configs)
def test_ray_members_match_the_slow_reference(rays):
    np.testing.assert_allclose(ray_members(rays)[0], ray_ranges(rays), rtol=1e-12)


@given(st.floats(1e-6, 0.2), st.floats(1, 1e9))
def test_shares_sum_to_1_at_any_sharpness(least, power):
    weights, share = shared(
        [0.0, 0.0, 0.0], [least, (1 - least) / 3, 2 * (1 - least) / 3], power, True
    )
    assert share.sum() == pytest.approx(1.0, abs=0.1)  # small ones are none
    assert np.isfinite(weights).all()
    assert np.argmax(share) == 2


def test_the_ray_that_filters_share_is_changed_by_none():
    shared_by_all = update_params(RayConfig(), 0.999)
    assert shared_by_all is update_params(RayConfig(), 0.999)
    for column in (shared_by_all.ray_ranges, shared_by_all.ray_stds):
        with pytest.raises(ValueError, match="read-only"):
            column[0] = 0.0
    assert ray_members(RayConfig())[0].flags.writeable


def test_neighbours_meet_within_two_deviations_and_would_not_as_printed():
    ranges, stds = ray_members(RayConfig())
    printed = np.array([stds[0], *(0.3 * ranges[:-1])])
    meeting = {
        name: (ranges[1:] - ranges[:-1]) / (std[1:] + std[:-1])
        for name, std in (("mended", stds), ("printed", printed))
    }
    np.testing.assert_allclose(meeting["mended"], 5 / 3, rtol=1e-12)
    np.testing.assert_allclose(meeting["printed"], [10 / 3, 5, 5], rtol=1e-12)


def test_ray_shorter_than_its_first_member_has_one_member():
    ranges, _ = ray_members(RayConfig(range_bounds=(1.0, 1.2)))
    assert len(ranges) == 1


@given(logs, st.floats(0.5, 8))
def test_weights_sum_to_one_and_instantaneous_shares_too(log_likelihood, power):
    count = len(log_likelihood)
    weights, share = shared(log_likelihood, np.full(count, 1 / count), power)
    assert weights.sum() == pytest.approx(1, abs=1e-14 * count)
    assert share.sum() == pytest.approx(1, abs=1e-12 * count)
    assert set(share[share < 1e-12]) <= {0.0}


def test_likelihoods_that_underflow_still_weigh():
    weights, share = shared([-1e5, -1e5 - np.log(3)], [0.5, 0.5])
    np.testing.assert_allclose(weights, [0.75, 0.25], rtol=1e-10)
    np.testing.assert_allclose(share, [0.75, 0.25], rtol=1e-10)


def test_instantaneous_shares_forget_earlier_bearings_and_aggregated_ones_do_not():
    log_likelihood = np.log([0.2, 0.8])
    weights, instantaneous = shared(log_likelihood, [0.8, 0.2])
    _, aggregated = shared(log_likelihood, [0.8, 0.2], aggregated=True)
    np.testing.assert_allclose(weights, [0.5, 0.5], rtol=1e-14)
    np.testing.assert_allclose(instantaneous, [0.2, 0.8], rtol=1e-14)
    np.testing.assert_allclose(aggregated, [0.5, 0.5], rtol=1e-14)


def test_aggregated_shares_under_a_twentieth_are_skipped_and_not_handed_on():
    weights, share = shared(np.zeros(3), [0.04, 0.36, 0.6], aggregated=True)
    np.testing.assert_allclose(weights, [0.04, 0.36, 0.6], rtol=1e-14)
    np.testing.assert_allclose(share, [0, 0.36, 0.6], rtol=1e-14)


def test_power_sharpens_shares_and_keeps_weights():
    log_likelihood = np.log([0.4, 0.6])
    weights, share = shared(log_likelihood, [0.5, 0.5], power=3.0)
    np.testing.assert_allclose(weights, [0.4, 0.6], rtol=1e-14)
    np.testing.assert_allclose(share, np.array([8, 27]) / 35, rtol=1e-14)
    _, sharpest = shared(log_likelihood, [0.5, 0.5], power=1e3)
    assert sharpest.tolist() == [0, 1]


def test_member_of_no_weight_stays_without_weight():
    weights, share = shared([0.0, -1.0], [0.0, 1.0], aggregated=True)
    assert weights.tolist() == [0, 1]
    assert share.tolist() == [0, 1]


def test_members_under_the_threshold_go_and_the_rest_sum_to_one():
    keep, weights = pruned([0.0099, 0.5, 0.0101, 0.48], prune=0.04)
    assert keep == [False, True, True, True]
    np.testing.assert_allclose(weights, np.array([0.5, 0.0101, 0.48]) / 0.9901, rtol=1e-14)


def test_threshold_is_shared_among_the_members_before_the_prune():
    assert pruned([0.3, 0.7], prune=0.5)[0] == [True, True]
    assert pruned([0.3, 0.7, 0.0, 0.0], prune=0.5)[0] == [True, True, False, False]
    assert pruned([0.1, 0.9], prune=0.5)[0] == [False, True]
    assert pruned([0.1, 0.9, 0.0, 0.0, 0.0], prune=0.5)[0] == [True, True, False, False, False]


@given(st.lists(st.floats(0, 1), min_size=1, max_size=8).filter(any), st.floats(0, 100))
def test_the_heaviest_always_survives(weights, prune):
    weights = np.array(weights) / sum(weights)
    keep, left = pruned(weights, prune)
    assert keep[int(np.argmax(weights))]
    assert left.sum() == pytest.approx(1, abs=1e-14 * len(weights))


def test_the_first_of_equals_survives():
    assert pruned([0.25, 0.25, 0.25, 0.25], prune=2.0)[0] == [True, False, False, False]
