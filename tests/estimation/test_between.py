"""What stands between vehicle and caller: an excess path's error makes ranges that seem sure."""

from dataclasses import replace

import numpy as np
import pytest

from pipistrelle.detection.scans import make_scan
from pipistrelle.estimation.beliefs import Gaussian, placed
from pipistrelle.estimation.ekf.filter import EkfSlam, InvariantEkfSlam
from pipistrelle.estimation.observations.excess_path import excess_path_of
from pipistrelle.estimation.smoother.filter import Smoother
from reference.missions import BICYCLE, map_with, ray_config

ESTIMATORS = [
    EkfSlam(motion=BICYCLE, rays=ray_config()),
    InvariantEkfSlam(motion=BICYCLE, rays=ray_config()),
    Smoother(motion=BICYCLE, rays=ray_config()),
]
HERE, CALLER = np.zeros(2), np.array([10.0, 0.0])
BEARING_STD, EXCESS_PATH_STD = 0.02, 0.05
COMMON = 13.8
"""Squared deviation of two numbers that one in a thousand exceeds."""


def told(slam, bearing, excess_paths):
    """The map of who knows where it and the caller are, by echoes that came once."""
    known = map_with([99], [CALLER], [1e-6 * np.eye(2)])
    start = Gaussian(mean=np.zeros(3), covariance=1e-6 * np.eye(3))
    scan = make_scan(
        0.0, np.arange(len(bearing)), bearing,
        caller=1, excess_path=excess_paths, excess_path_std=EXCESS_PATH_STD,
        bearing_std=BEARING_STD,
    )  # fmt: skip
    scan = replace(scan, callers=np.array([-1, 99]))
    belief = slam.update(slam.knowing(slam.init(start), known), scan, np.random.default_rng(7))
    return belief.landmarks()


@pytest.mark.parametrize("slam", ESTIMATORS, ids=lambda slam: type(slam).__name__)
@pytest.mark.parametrize("excess_path", [-0.03, 0.0, 0.04, 0.14])
def test_an_excess_path_that_may_be_none_places_nothing(slam, excess_path):
    rows = told(slam, np.array([0.003]), np.array([excess_path]))
    assert np.sum(rows.landmark == 0) > 1, "a ray"


@pytest.mark.parametrize("slam", ESTIMATORS, ids=lambda slam: type(slam).__name__)
def test_landmarks_placed_near_the_callers_line_are_consistent(slam):
    rng, most = np.random.default_rng(3), 120
    places = np.column_stack([rng.uniform(2, 8, most), rng.uniform(0.5, 3.0, most)])
    places[::3, 1] *= 0.1
    bearing = np.arctan2(places[:, 1], places[:, 0]) + BEARING_STD * rng.normal(size=most)
    true = np.array([excess_path_of(HERE, place, CALLER) for place in places])
    rows = told(slam, bearing, np.maximum(true + EXCESS_PATH_STD * rng.normal(size=most), 0.0))
    full = placed(rows) & (rows.landmark < most)
    off = rows.mean[full] - places[rows.landmark[full]]
    squared = np.einsum("ni,nij,nj->n", off, np.linalg.inv(rows.covariance[full]), off)
    assert full.sum() > 20
    assert np.mean(squared > COMMON) < 0.05
    assert np.median(squared) < 3.0, "1.4 where all is linear"
