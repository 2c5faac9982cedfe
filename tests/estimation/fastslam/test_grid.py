"""A huge swarm against the exact posterior, integrated by brute force.

One landmark, a known start, noise so small that linearisation costs under a hundredth of a
deviation: what is left is the error of sampling.
"""

import numpy as np
import pytest

from pipistrelle.config import RayConfig
from pipistrelle.estimation.beliefs import Gaussian
from pipistrelle.estimation.fastslam.particles import effective_particles, normalised
from pipistrelle.estimation.motion import Motion
from reference.ekf_slam import ray_ranges
from reference.grid import Posterior, drive
from reference.missions import ray_config, scan_of
from reference.swarms import particles_of, swarm_filter, weighted

PARTICLES = 100_000
LINEARISATION = 0.01
KNOWN = np.array([0.3, -0.2, 0.4])
CONTROLS, DT, WHEELBASE = np.array([[0.75, 0.03], [0.75, -0.02]]), 1.0, 0.2
CONTROL_STD, RANGE_STD, BEARING_STD = (0.005, 0.0008), 0.005, 0.0025
# Four members, each as long as the gap to the next, which some bearings can tell apart.
NARROW = {"relative_std": 0.005, "range_ratio": 1.025, "prune_threshold": 0.0}
SHORT = RayConfig(range_bounds=(3.9, 4.2), **NARROW)


def heard_on_a_drive(seed, passive):
    """Rows (range or NaN, bearing) of a landmark 4.06 m away, from three poses."""
    rng = np.random.default_rng(seed)
    noise = rng.normal(size=(2 * len(CONTROLS), 1))
    point = KNOWN[:2] + 4.06 * np.array([np.cos(1.3), np.sin(1.3)])
    rows = []
    for pose, alone in zip(
        drive(KNOWN, CONTROLS, DT, CONTROL_STD, WHEELBASE, noise)[:, :, 0], passive, strict=True
    ):
        dx, dy = point - pose[:2]
        distance = np.nan if alone else np.hypot(dx, dy) + rng.normal(0, RANGE_STD)
        rows.append((distance, np.arctan2(dy, dx) - pose[2] + rng.normal(0, BEARING_STD)))
    return rows


def swarm_moments(rows, rays, mixture):
    """Mean (5) and covariance (5, 5) of last pose and landmark, effective particles, members."""
    motion = Motion(model="bicycle", control_std=CONTROL_STD, wheelbase=WHEELBASE)
    slam = swarm_filter(
        PARTICLES, mixture, 0.0, motion=motion, rays=rays,
        range_std=RANGE_STD, bearing_std=BEARING_STD,
    )  # fmt: skip
    rng = np.random.default_rng(7)
    belief = slam.init(Gaussian(mean=KNOWN, covariance=np.zeros((3, 3))))
    belief = slam.update(belief, scan_of((1, *rows[0])), rng)
    for control, row in zip(CONTROLS, rows[1:], strict=True):
        belief, _ = slam.predict(belief, control[None], np.array([DT]))
        belief = slam.update(belief, scan_of((1, *row)), rng)
    particle = normalised(belief.log_weight)
    mean, second, chances = np.zeros(5), np.zeros((5, 5)), []
    for member in np.moveaxis(weighted(particles_of(belief).member), 1, 0):
        weight = particle * member[:, 5]
        state = np.column_stack([belief.cloud(), member[:, :2]])
        mean += weight @ state
        second += (state * weight[:, None]).T @ state
        second[3:, 3:] += (weight @ member[:, [2, 3, 3, 4]]).reshape(2, 2)
        chances.append(weight.sum())
    return mean, second - np.outer(mean, mean), effective_particles(particle), np.array(chances)


def grid_moments(rows, placings=None):
    return Posterior(
        KNOWN, CONTROLS, DT, CONTROL_STD, WHEELBASE, rows, RANGE_STD, BEARING_STD
    ).moments(placings)


def departures(swarm, grid):
    """Largest errors over their bounds: of the mean, of the covariance, of the members' chances.

    The first two in deviations of the exact posterior; the bounds are 4.5 standard errors of
    sampling beside the cost of linearisation.
    """
    (found_mean, found_covariance, effective, found), (mean, covariance, chances) = swarm, grid
    whiten = np.linalg.inv(np.linalg.cholesky(covariance))
    sampling = 4.5 / np.sqrt(effective)
    return (
        np.abs(whiten @ (found_mean - mean)).max() / (LINEARISATION + sampling),
        np.abs(whiten @ found_covariance @ whiten.T - np.eye(5)).max()
        / (2 * LINEARISATION + np.sqrt(2) * sampling),
        np.abs(found - chances).max() / (LINEARISATION + 0.5 * sampling),
    )


@pytest.mark.parametrize(
    "passive", [(False, False, False), (False, True, True), (False, True, False)]
)
def test_posterior_of_pose_and_landmark_matches_a_brute_force_grid(passive):
    rows = heard_on_a_drive(1, passive)
    swarm = swarm_moments(rows, ray_config(), "federated")
    assert max(departures(swarm, grid_moments(rows))) < 1


def assert_only_the_exact_mixture_matches(seed):
    rows = heard_on_a_drive(seed, (True, True, True))
    grid = grid_moments(rows, [(s, SHORT.relative_std * s) for s in ray_ranges(SHORT)])
    assert np.sort(grid[2])[-2] > 0.05  # At least two members could be it.
    assert max(departures(swarm_moments(rows, SHORT, "exact"), grid)) < 1
    mean, covariance, _ = departures(swarm_moments(rows, SHORT, "federated"), grid)
    assert mean > 1
    assert covariance > 5


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(1, 10))
def test_exact_mixture_matches_the_grid_while_a_landmark_is_partial_and_federated_does_not(seed):
    assert_only_the_exact_mixture_matches(seed)
