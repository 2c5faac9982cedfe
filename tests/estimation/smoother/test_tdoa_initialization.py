"""Placing by an excess path: how sure a range is, and that what is not sure places nothing."""

import math
from dataclasses import replace

import numpy as np
import pytest

from pipistrelle.detection.scans import with_columns
from pipistrelle.estimation.beliefs import Gaussian, placed
from pipistrelle.estimation.motion import Motion
from pipistrelle.estimation.observations.excess_path import excess_path_of, unscented_range
from pipistrelle.estimation.observations.range import is_certain
from pipistrelle.estimation.smoother.filter import Smoother
from reference.missions import ray_config, scan_with

UNICYCLE = Motion(model="unicycle", control_std=(0.05, 0.02), noise_at_rest=False)
SURE = Gaussian(mean=np.zeros(3), covariance=1e-8 * np.eye(3))
HERE, CALLER = np.zeros(2), np.array([9.0, -2.0])
BESIDE = np.array([3.0, 6.0])


def bearing_of(place):
    return float(np.arctan2(place[1], place[0]))


def way_to(place, caller=CALLER):
    """The way to the caller, the landmark's direction, and its excess path."""
    return (*caller.tolist(), bearing_of(place), excess_path_of(HERE, place, caller))


# How sure


def test_an_excess_path_gives_the_range_of_landmark_or_caller():
    exact = (0.0,) * 7
    assert unscented_range(way_to(BESIDE), exact, False) == pytest.approx((np.hypot(*BESIDE), 0.0))
    way = (*BESIDE, bearing_of(CALLER), excess_path_of(HERE, BESIDE, CALLER))
    assert unscented_range(way, exact, True) == pytest.approx((np.hypot(*CALLER), 0.0))


@pytest.mark.parametrize("caller", [False, True])
def test_the_deviation_of_a_range_matches_draws_with_small_noise(caller):
    rng = np.random.default_rng(1)
    L = 0.02 * rng.normal(size=(4, 4))
    L[3, :3] = L[:3, 3] = 0.0
    P, way = L @ L.T, way_to(BESIDE)
    if caller:
        way = (*BESIDE, bearing_of(CALLER), way[3])
    spread = P[0, 0], P[0, 1], P[1, 1], P[0, 2], P[1, 2], P[2, 2], P[3, 3]
    _, variance = unscented_range(way, spread, caller)
    draws = rng.multivariate_normal(way, P, 4000).tolist()
    ranges = [unscented_range(tuple(one), (0.0,) * 7, caller)[0] for one in draws]
    assert math.sqrt(variance) == pytest.approx(np.std(ranges), rel=0.06)


@pytest.mark.parametrize("along", [0.2, 0.5, 0.8])
@pytest.mark.parametrize("off", [-0.04, 0.0, 0.04, 0.14])
def test_between_vehicle_and_caller_no_range_is_sure_whatever_the_excess_path_is_off(along, off):
    (*end, path), spread = way_to(along * CALLER), (1e-4, 0.0, 1e-4, 0.0, 0.0, 1e-4, 0.05**2)
    assert not is_certain(*unscented_range((*end, path + off), spread, False))


def test_an_excess_path_that_may_be_zero_gives_no_range():
    way = way_to(BESIDE)
    for std, known in ((way[3] / 2.99, False), (way[3] / 20.0, True)):
        assert is_certain(*unscented_range(way, (*(0.0,) * 6, std**2), False)) == known


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
    assert belief.history.placed == (9, 4)
    rows = belief.landmarks()
    assert placed(rows).all()
    np.testing.assert_allclose(rows.mean[1], BESIDE, rtol=0, atol=0.02)
    deaf = slam().update(knowing(9, CALLER), scan((4, BESIDE, np.nan, np.nan)))
    assert deaf.history.placed == (9,)


def test_a_caller_is_placed_at_once_by_bearing_and_the_excess_path_over_a_landmark_that_is_known():
    over = (4, BESIDE, np.hypot(*BESIDE), excess_path_of(HERE, BESIDE, CALLER))
    belief = slam().update(knowing(4, BESIDE), scan(over, (9, CALLER, np.nan, np.nan)))
    assert belief.history.placed == (4, 9)
    np.testing.assert_allclose(belief.landmarks().mean[1], CALLER, rtol=0, atol=0.02)


def test_a_landmark_between_vehicle_and_caller_stays_in_place():
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


def test_of_several_excess_paths_the_surest_places():
    """Two calls are heard by way of a landmark; one excess path is off, and says so."""
    true = excess_path_of(HERE, BESIDE, CALLER)
    before = slam().update(knowing(9, CALLER), scan((8, CALLER, np.hypot(*CALLER), np.nan)))
    row = scan_with([4, 4], [bearing_of(BESIDE), np.nan], bearing_std=0.01)
    for order in ([9, 8], [8, 9]):
        off = np.where(np.array(order) == 9, 0.0, 0.5)
        std = np.where(np.array(order) == 9, 0.02, 0.5)
        told = with_columns(
            row, excess_path=true + off, excess_path_std=std, caller=np.array([1, 2])
        )
        after = slam().update(before, replace(told, callers=np.array([-1, *order])))
        assert after.history.placed == (9, 8, 4)
        np.testing.assert_allclose(after.history.known[0][-1], BESIDE, rtol=0, atol=0.02)
    vague = with_columns(row, excess_path=true, excess_path_std=2.0, caller=np.array([1, 1]))
    vague = slam().update(before, replace(vague, callers=np.array([-1, 9])))
    assert vague.history.placed == (9, 8)


def test_an_imprecise_caller_initialises_no_landmark():
    """The same bearing and excess path: a caller whose range has a std of 2 m places nothing."""
    row = (4, BESIDE, np.nan, excess_path_of(HERE, BESIDE, CALLER))
    vague = slam().init(SURE)
    told = {"range_std": 4.0, "bearing_std": 0.3}
    vague = slam().update(vague, scan_with([9], [bearing_of(CALLER)], [np.hypot(*CALLER)], **told))
    assert slam().update(vague, scan(row)).history.placed == (9,)
    assert slam().update(knowing(9, CALLER), scan(row)).history.placed == (9, 4)
