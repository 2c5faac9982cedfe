"""The catalogue: what an entry builds is of the settings that it is given."""

import numpy as np
import pytest

from pipistrelle.config import Config, FastSlamConfig, FilterConfig, RayConfig
from pipistrelle.estimation.beliefs import Gaussian
from pipistrelle.estimation.catalogue import CATALOGUE, PAPERS, entry, gate_of
from reference.missions import BICYCLE, START, scan_of, scan_with

RNG = np.random.default_rng


def test_the_papers_two_diverge_at_the_papers_limits():
    assert {name: entry(name).nees_limit for name in PAPERS} == {"ekf": 50.0, "fastslam": 2750.0}


@pytest.mark.parametrize("name", CATALOGUE)
@pytest.mark.parametrize(("gate", "gated"), [(1.0, 0), (0.999, 2)])
def test_the_gate_of_the_settings_is_the_filters(name, gate, gated):
    slam = entry(name).build(Config(filter=FilterConfig(gate=gate)), BICYCLE)
    belief = slam.update(slam.init(START), scan_of((1, 5.0, 0.3), (2, 6.0, -0.4)), RNG(1))
    far_off = scan_with([1, 2], [2.3, -0.4], [np.nan, 12.0])
    assert slam.update(belief, far_off, RNG(2)).gated == gated


@pytest.mark.parametrize("name", CATALOGUE)
@pytest.mark.parametrize(("off", "counted"), [((0.3, 0.2), True), ((2.0, 0.0), False)])
def test_innovations_of_placed_landmarks_that_are_used_are_added_up(name, off, counted):
    """A landmark that was placed by one look is as unsure as a second one: S = 2 R."""
    config = Config(filter=FilterConfig(gate=0.999), fastslam=FastSlamConfig(particles=1))
    slam = entry(name).build(config, BICYCLE)
    sure = Gaussian(mean=np.zeros(3), covariance=1e-12 * np.eye(3))
    belief = slam.update(slam.init(sure), scan_of((1, 5.0, 0.0), (2, np.nan, 2.0)), RNG(1))
    assert belief.innovations.degrees == 0, "what is placed was not expected anywhere"
    after = slam.update(belief, scan_of((1, 5.0 + off[0], off[1]), (2, np.nan, 2.0)), RNG(2))
    squared = off[0] ** 2 / (2 * 0.2**2) + off[1] ** 2 / (2 * 0.15**2)
    expected = (squared, 2) if counted else (0, 0)
    np.testing.assert_allclose(after.innovations, expected, rtol=2e-3)


@pytest.mark.parametrize("name", CATALOGUE)
@pytest.mark.parametrize("robust", ["none", "huber"])
def test_a_gate_that_is_left_open_is_the_estimators(name, robust):
    config = Config(filter=FilterConfig(gate="auto", robust=robust))
    drops_none = (name, robust) == ("smoother", "huber")
    assert gate_of(name, config) == (1.0 if drops_none else 0.999)
    assert entry(name).build(config, BICYCLE).gate == gate_of(name, config)


@pytest.mark.parametrize("name", CATALOGUE)
def test_the_rays_of_the_settings_are_the_filters(name):
    config = Config(rays=RayConfig(range_bounds=(1.0, 9.0), relative_std=0.2, range_ratio=2.0))
    slam = entry(name).build(config, BICYCLE)
    sure = Gaussian(mean=START.mean, covariance=1e-12 * np.eye(3))
    belief = slam.update(slam.init(sure), scan_of((1, np.nan, 0.3)), RNG(1))
    away = np.hypot(*(belief.landmarks().mean - START.mean[:2]).T)
    # From 1 m / (1 - 0.2) on, twice as far each, until the last reaches 9 m / (1 + 0.2).
    np.testing.assert_allclose(away, [1.25, 2.5, 5.0, 10.0], rtol=1e-4)


def test_the_particles_of_the_settings_are_the_filters():
    slam = entry("fastslam").build(Config(fastslam=FastSlamConfig(particles=37)), BICYCLE)
    assert slam.init(START).cloud().shape == (37, 3)
