"""Scans from before there was a map, labelled by the map that came of them."""

from dataclasses import replace

import numpy as np
import pytest

from pipistrelle.config import AssociationConfig, Config
from pipistrelle.detection.scans import RANGE, UNLABELLED, make_scan
from pipistrelle.estimation.beliefs import Gaussian, JointGaussian
from pipistrelle.estimation.data_association.caller_search import (
    RANGE_SHARE,
    _turn,
    labelled_by_map,
)
from pipistrelle.estimation.data_association.pairs import UNPLACED
from pipistrelle.estimation.data_association.rows import EarlyScan, rows_of_scan
from pipistrelle.estimation.data_association.sequential import association_of
from pipistrelle.experiments.runs.trial import run_mission

HEADING_STD, CALLER = 0.06, 40


def world(seed, turn, size=16):
    """Return a joint Gaussian of landmarks and a caller, turned about the origin, and the truth."""
    rng = np.random.default_rng(seed)
    angle, far = rng.uniform(-3.0, 3.0, size + 1), rng.uniform(4.0, 12.0, size + 1)
    places = np.stack([far * np.cos(angle), far * np.sin(angle)], axis=1)
    c, s = np.cos(turn), np.sin(turn)
    turned = places @ np.array([[c, s], [-s, c]])
    around = np.stack([-turned[:, 1], turned[:, 0]], axis=1).ravel()
    covariance = np.zeros((5 + 2 * size, 5 + 2 * size))
    covariance[3:, 3:] = HEADING_STD**2 * np.outer(around, around)
    covariance += 1e-5 * np.eye(len(covariance))
    mean = np.concatenate([np.zeros(3), turned.ravel()])
    landmark = np.append(10 + np.arange(size), CALLER)
    return JointGaussian(landmark=landmark, mean=mean, covariance=covariance), places


def early_scan(places, with_direct, rng):
    """Return what the origin hears of places by the call of the last one, in another order."""
    order = rng.permutation(len(places) - 1)
    heard = np.append(order, len(places) - 1) if with_direct else order
    off = places[heard]
    bearing = np.arctan2(off[:, 1], off[:, 0]) + 0.004 * rng.standard_normal(len(off))
    way = np.hypot(*off.T) + np.hypot(*(off - places[-1]).T) - np.hypot(*places[-1])
    labels, ones = np.full(len(off), UNLABELLED), np.ones(len(off), int)
    stds = {"bearing_std": 0.01, "excess_path_std": 0.02}
    way = way if with_direct else np.full(len(off), np.nan)
    scan = make_scan(0.0, labels, bearing, caller=ones, excess_path=way, **stds)
    direct = np.array([-1, len(off) - 1 if with_direct else -1])
    pose = Gaussian(mean=np.zeros(3), covariance=np.diag([1e-6, 1e-6, 1e-6]))
    rows = rows_of_scan(scan, (0.05, 0.35, 0.25), ())
    return EarlyScan(0, scan, rows, direct, pose), 10 + order


def labelled(early, joint, at, method="marginal"):
    """Return the early scan, labelled."""
    stage = association_of(Config(association=AssociationConfig(method=method)))
    return labelled_by_map(early, joint, joint.landmark, {1: at}, stage.match, stage.chances)


@pytest.mark.parametrize("method", ["nearest", "joint", "marginal"])
@pytest.mark.parametrize("seed", range(4))
def test_bearings_are_labelled_though_the_map_is_turned_beyond_their_spacing(seed, method):
    joint, places = world(seed, turn=[-0.15, 0.1, 0.12, 0.16][seed])
    early, truth = early_scan(places, False, np.random.default_rng(seed))
    scan = labelled(early, joint, UNPLACED, method)
    named = scan.landmark != UNLABELLED
    assert np.mean(named) > 0.6
    assert np.mean(scan.landmark[named] == truth[named]) >= 0.99
    far = np.hypot(*places[scan.landmark[named] - 10].T)
    np.testing.assert_allclose(scan.range[named], far, rtol=0.02)
    np.testing.assert_allclose(scan.range_std[named], RANGE_SHARE * far, rtol=0.02)
    assert np.isnan(scan.range[~named]).all()


@pytest.mark.parametrize("seed", range(4))
def test_with_its_direct_call_a_callers_rows_are_labelled_by_their_excess_paths(seed):
    joint, places = world(seed, turn=0.05)
    early, truth = early_scan(places, True, np.random.default_rng(seed))
    scan = labelled(early, joint, 3 + 2 * (len(places) - 1))
    named = scan.landmark[:-1] != UNLABELLED
    assert np.mean(named) > 0.8
    assert (scan.landmark[:-1][named] == truth[named]).all()
    assert scan.landmark[-1] == UNLABELLED, "the direct call has its name already"
    assert np.isnan(scan.numbers[RANGE]).all(), "excess paths place landmarks"


def test_a_map_that_fits_at_two_turns_labels_nothing():
    size = 24
    joint, _ = world(0, 0.0, size)
    angle = 2.0 * np.pi * np.arange(size) / size
    ring = np.vstack([6.0 * np.stack([np.cos(angle), np.sin(angle)], axis=1), [[50.0, 50.0]]])
    around = np.stack([-ring[:, 1], ring[:, 0]], axis=1).ravel()
    covariance = 1e-5 * np.eye(5 + 2 * size)
    covariance[3:, 3:] += 0.2**2 * np.outer(around, around)
    joint = replace(joint, mean=np.concatenate([np.zeros(3), ring.ravel()]), covariance=covariance)
    early, _ = early_scan(ring, False, np.random.default_rng(0))
    assert (labelled(early, joint, UNPLACED).landmark == UNLABELLED).all()


def test_inputs_are_unchanged_and_the_vehicles_echoes_stay_unlabelled():
    joint, places = world(1, 0.1)
    early, _ = early_scan(places, False, np.random.default_rng(1))
    caller = early.scan.caller.copy()
    caller[0] = 0
    early = early._replace(rows=early.rows._replace(caller=caller))
    mean, numbers = joint.mean.copy(), early.scan.numbers.copy()
    scan = labelled(early, joint, UNPLACED)
    assert scan.landmark[0] == UNLABELLED
    assert np.isnan(scan.range[0])
    np.testing.assert_array_equal(joint.mean, mean)
    np.testing.assert_array_equal(early.scan.numbers, numbers)


def test_removing_a_turn_removes_the_variance_of_the_mean_bearing():
    joint, _ = world(2, 0.1)
    rng = np.random.default_rng(2)
    root = 0.01 * rng.standard_normal((joint.mean.size, joint.mean.size))
    covariance, there = joint.covariance + root @ root.T, 3 + 2 * np.arange(8)
    spread, variance, left = _turn(joint.mean, covariance, there)

    def mean_bearing(mean):
        off = mean[there] - mean[0], mean[there + 1] - mean[1]
        return np.mean(np.arctan2(off[1], off[0])) - mean[2]

    slope = np.array(
        [mean_bearing(joint.mean + step) for step in 1e-6 * np.eye(joint.mean.size)]
    ) - mean_bearing(joint.mean)
    slope /= 1e-6
    np.testing.assert_allclose(covariance @ slope, spread, rtol=1e-3, atol=1e-8)
    assert variance == pytest.approx(slope @ covariance @ slope, rel=1e-4)
    assert slope @ left @ slope < 1e-4 * variance
    turned = mean_bearing(joint.mean + spread * (0.001 / variance))
    assert turned - mean_bearing(joint.mean) == pytest.approx(0.001, rel=0.02)


def test_a_passive_vehicle_keeps_the_heading_of_the_start():
    """Without labels for the first scan both errors of this drive are 0.4 m."""
    settings = {
        "seed": 10,
        "scenario": {"steps": 240},
        "emitter": {"level_db": 49.7},
        "beacon": {"level_db": 42.8},
        "listening": {"timing": True},
        "filter": {"noise": "measured", "robust": "huber"},
        "rays": {"power": 8.0, "prune": 1e-9, "spacing": "auto"},
    }
    known, found = (
        run_mission(
            Config.model_validate(settings | {"association": {"method": method}}),
            ["passive"],
            ["iekf", "smoother"],
        ).trials
        for method in ("known", "marginal")
    )
    for told, untold in zip(known, found, strict=True):
        assert np.count_nonzero(untold.track.labels[0] != UNLABELLED) >= 5
        assert untold.scores.position_rmse_m < 1.5 * told.scores.position_rmse_m
