"""Placing by an excess path: how sure a range is, and that what is not sure places nothing."""

from dataclasses import replace

import numpy as np
import pytest

from pipistrelle.estimation.beliefs import Gaussian, placed
from pipistrelle.estimation.measurement import excess_path_of
from pipistrelle.estimation.motion import Motion
from pipistrelle.estimation.smoother.delayed_initialization import Bearing
from pipistrelle.estimation.smoother.filter import Smoother
from pipistrelle.estimation.smoother.tdoa import ExcessPath
from pipistrelle.estimation.smoother.tdoa_initialization import (
    MAX_RELATIVE_RANGE_STD,
    LastPose,
    place_by_excess_paths,
    unscented_range,
)
from reference.missions import ray_config, scan_with

UNICYCLE = Motion(model="unicycle", control_std=(0.05, 0.02), noise_at_rest=False)
SURE = Gaussian(mean=np.zeros(3), covariance=1e-8 * np.eye(3))
HERE, CALLER = np.zeros(2), np.array([9.0, -2.0])
BESIDE = np.array([3.0, 6.0])


def bearing_of(place):
    return float(np.arctan2(place[1], place[0]))


def way_to(place, caller=CALLER):
    """The way to the caller, the landmark's direction, and its excess path."""
    return np.array([*caller, bearing_of(place), excess_path_of(HERE, place, caller)])


# How sure


def test_the_range_by_an_excess_path_is_that_of_the_landmark_and_of_the_caller():
    no_noise = np.zeros((4, 4))
    assert unscented_range(way_to(BESIDE), no_noise, caller=False) == pytest.approx(
        (np.hypot(*BESIDE), 0.0)
    )
    way = np.array([*BESIDE, bearing_of(CALLER), excess_path_of(HERE, BESIDE, CALLER)])
    found = unscented_range(way, no_noise, caller=True)
    assert found == pytest.approx((np.hypot(*CALLER), 0.0))


@pytest.mark.parametrize("caller", [False, True])
def test_its_deviation_is_that_of_draws_where_noise_is_small(caller):
    rng = np.random.default_rng(1)
    L = 0.02 * rng.normal(size=(4, 4))
    spread = L @ L.T
    way = way_to(BESIDE)
    if caller:
        way = np.array([*BESIDE, bearing_of(CALLER), way[3]])
    distance, share = unscented_range(way, spread, caller=caller)
    draws = rng.multivariate_normal(way, spread, 4000)
    ranges = [unscented_range(one, np.zeros((4, 4)), caller=caller)[0] for one in draws]
    assert share * distance == pytest.approx(np.std(ranges), rel=0.06)


@pytest.mark.parametrize("along", [0.2, 0.5, 0.8])
@pytest.mark.parametrize("off", [-0.04, 0.0, 0.04, 0.14])
def test_between_vehicle_and_caller_no_range_is_sure_whatever_the_excess_path_is_off(along, off):
    way = way_to(along * CALLER)
    way[3] += off
    assert (
        unscented_range(way, np.diag([0.01, 0.01, 0.01, 0.05]) ** 2, caller=False)[1]
        > MAX_RELATIVE_RANGE_STD
    )


def test_an_excess_path_that_may_be_none_tells_no_range():
    way = way_to(BESIDE)
    for std, known in ((way[3] / 2.99, False), (way[3] / 20.0, True)):
        share = unscented_range(way, np.diag([0.0, 0.0, 0.0, std**2]), caller=False)[1]
        assert (share <= MAX_RELATIVE_RANGE_STD) == known


# In the graph


def slam():
    return Smoother(motion=UNICYCLE, rays=ray_config())


def scan(*rows, caller=9, std=0.02):
    """A scan of rows (label, place, range or NaN, excess path or NaN) seen from the origin."""
    label, place, distance, excess_path = zip(*rows, strict=True)
    told = {
        "excess_path": np.array(excess_path),
        "excess_path_std": std,
        "bearing_std": 0.01,
        "range_std": 0.05,
    }
    heard = scan_with(label, [bearing_of(one) for one in place], distance, caller=1, **told)
    return replace(heard, callers=np.array([-1, caller]))


def knowing(label, place, times=3):
    """A belief of one landmark, by its range."""
    belief = slam().init(SURE)
    for _ in range(times):
        known = (label, place, np.hypot(*place), np.nan)
        belief = slam().update(belief, scan(known))
    return belief


def test_a_landmark_is_placed_at_once_by_bearing_and_excess_path_of_a_caller_that_is_known():
    row = (4, BESIDE, np.nan, excess_path_of(HERE, BESIDE, CALLER))
    belief = slam().update(knowing(9, CALLER), scan(row))
    assert belief.mapped == (9, 4)
    assert not belief.waiting
    assert not belief.excess_paths
    rows = belief.landmarks()
    assert placed(rows).all()
    np.testing.assert_allclose(rows.mean[1], BESIDE, rtol=0, atol=0.02)
    deaf = slam().update(knowing(9, CALLER), scan((4, BESIDE, np.nan, np.nan)))
    assert deaf.mapped == (9,)


def test_a_caller_is_placed_at_once_by_bearing_and_the_excess_path_over_a_landmark_that_is_known():
    over = (4, BESIDE, np.hypot(*BESIDE), excess_path_of(HERE, BESIDE, CALLER))
    belief = slam().update(knowing(4, BESIDE), scan(over, (9, CALLER, np.nan, np.nan)))
    assert belief.mapped == (4, 9)
    np.testing.assert_allclose(belief.landmarks().mean[1], CALLER, rtol=0, atol=0.02)
    assert not belief.excess_paths


@pytest.mark.parametrize("off", [-0.1, -0.03, 0.0, 0.03, 0.1])
def test_a_landmark_between_vehicle_and_caller_is_not_placed_and_does_no_harm(off):
    before = knowing(9, CALLER)
    between = 0.4 * CALLER
    row = (4, between, np.nan, excess_path_of(HERE, between, CALLER) + off)
    belief = slam().update(before, scan(row, std=0.05))
    assert belief.mapped == (9,)
    assert len(belief.excess_paths) == len(belief.waiting) == 1
    np.testing.assert_array_equal(belief.pose().mean, before.pose().mean)


def test_one_between_them_that_is_known_by_its_range_is_left_where_it_is():
    """Slopes along the line are none there: e says how far beside it stands, at most."""
    before, between = knowing(9, CALLER), 0.4 * CALLER
    known = (4, between, np.hypot(*between), np.nan)
    alone = slam().update(before, scan(known))
    with_it = slam().update(alone, scan((4, between, np.nan, 0.03), std=0.05))
    rows = with_it.landmarks()
    off = rows.mean[1] - between
    assert np.abs(off @ CALLER) / np.hypot(*CALLER) < 0.01
    assert np.hypot(*off) < 0.1
    assert np.isfinite(with_it.path().covariance).all()


def test_what_is_known_together_is_what_the_graph_says_when_the_vehicle_has_gone_on():
    belief = slam().predict(knowing(9, CALLER), np.array([[1.0, 0.3]] * 3), np.ones(3))[0]
    around = LastPose(
        isam=belief.solver.reach(belief.link),
        node=0,
        odometry=belief.odometry,
        pose=belief.pose().mean,
    )
    told = around.joint(9)
    gone = slam().update(belief, scan((5, BESIDE, np.nan, np.nan)))
    after = LastPose(
        isam=gone.solver.reach(gone.link), node=gone.link.node, odometry=None, pose=gone.pose().mean
    )
    assert gone.link.node == 1
    np.testing.assert_allclose(told, after.joint(9), rtol=0, atol=1e-9)
    np.testing.assert_allclose(told[:3, :3], belief.pose().covariance, rtol=0, atol=1e-9)


def test_of_several_excess_paths_the_surest_places():
    belief = knowing(9, CALLER)
    around = LastPose(
        isam=belief.solver.reach(belief.link), node=0, odometry=None, pose=np.zeros(3)
    )
    true = excess_path_of(HERE, BESIDE, CALLER)
    clues = [ExcessPath(0, 4, 9, true + 0.5, 0.5), ExcessPath(0, 4, 9, true, 0.02)]
    for order in (clues, clues[::-1]):
        place = place_by_excess_paths(around, Bearing(0, bearing_of(BESIDE), 0.01), 4, order)
        np.testing.assert_allclose(place, BESIDE, rtol=0, atol=0.02)
    vague = place_by_excess_paths(
        around, Bearing(0, bearing_of(BESIDE), 0.01), 4, [ExcessPath(0, 4, 9, true, 2.0)]
    )
    assert vague is None


def test_how_sure_the_caller_is_counts():
    """The same bearing and excess path: a caller whose range has a std of 2 m places nothing."""
    row = (4, BESIDE, np.nan, excess_path_of(HERE, BESIDE, CALLER))
    vague = slam().init(SURE)
    told = {"range_std": 4.0, "bearing_std": 0.3}
    vague = slam().update(vague, scan_with([9], [bearing_of(CALLER)], [np.hypot(*CALLER)], **told))
    assert slam().update(vague, scan(row)).mapped == (9,)
    assert slam().update(knowing(9, CALLER), scan(row)).mapped == (9, 4)
