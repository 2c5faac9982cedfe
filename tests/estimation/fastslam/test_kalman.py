"""The particle filter against Kalman filters where all is linear and Gaussian.

On an axis: a vehicle of known heading and landmarks so far ahead and behind that their bearings
say nothing. In the plane: noise so small that the joint Gaussian filter is a Kalman filter.
"""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy.stats import chi2

from pipistrelle.detection.scans import Scan
from pipistrelle.estimation.beliefs import Gaussian
from pipistrelle.estimation.fastslam.filter import SMALLEST_STD, FastSlam
from pipistrelle.estimation.fastslam.particles import effective_particles, normalised
from pipistrelle.estimation.motion import Motion
from reference.missions import (
    NOISE,
    STEADY,
    STEP,
    STEPS_PER_FRAME,
    SURE,
    active_mission,
    draw_mission,
    followed,
    nees_of,
    paper_filter,
    scan_of,
    scattered,
    steady,
)
from reference.swarms import never_resampling, slow_twin, swarm_filter

SIZES = np.array([30, 100, 300, 1000, 3000])
FAR = np.array([1e5, 1.3e5, -1e5])
RANGE_STD, SPEED, SPEED_STD = 0.2, 0.8, 1.0
SMALL = 1e-3


@dataclass(frozen=True)
class Toy:
    """What a filter is given, frame by frame, and what a Kalman filter knows in the end."""

    slam: FastSlam
    start: Gaussian
    controls: list[np.ndarray]
    scans: list[Scan]
    kalman: Gaussian

    def run(self, particles, seed):
        """The last belief of a swarm."""
        slam, rng = resized(self.slam, particles), np.random.default_rng(seed)
        belief = slam.init(self.start)
        for control, scan in zip(self.controls, self.scans, strict=True):
            belief, _ = slam.predict(belief, control, np.full(len(control), STEP))
            belief = slam.update(belief, scan, rng)
        return belief


def resized(slam, particles):
    return replace(slam, settings=slam.settings.model_copy(update={"particles": particles}))


def axis_toy(seed, start_std, moves):
    """Ranges to two landmarks, later three, before each of some moves along x and after."""
    rng = np.random.default_rng(seed)
    x, rows, scans = rng.normal(0, start_std), [], []
    for frame in range(moves + 1):
        seen = (0, 1, 2) if frame > 1 else (0, 1)
        measured = np.abs(FAR - x) + rng.normal(0, RANGE_STD, 3)
        rows += [(frame, i, np.sign(FAR[i]) * measured[i]) for i in seen]
        scans.append(scan_of(*((i, measured[i], 0.0 if FAR[i] > 0 else -np.pi) for i in seen)))
        x += STEP * (STEPS_PER_FRAME * SPEED + rng.normal(0, SPEED_STD, STEPS_PER_FRAME).sum())
    motion = Motion(model="bicycle", control_std=(SPEED_STD, 0.0), wheelbase=0.2)
    return Toy(
        # A bearing so sharp that its spread across 100 km stays under that of the ranges.
        slam=swarm_filter(motion=motion, range_std=RANGE_STD, bearing_std=1e-7),
        start=Gaussian(mean=np.zeros(3), covariance=np.diag([start_std**2, 0, 0])),
        controls=[np.empty((0, 2)), *steady((SPEED, 0.0), moves)],
        scans=scans,
        kalman=least_squares(start_std, moves, rows),
    )


def least_squares(start_std, moves, rows):
    """Mean and variance of the last x given all: a Kalman filter's, by the normal equations."""
    unknown = np.eye(moves + 1 + len(FAR))
    moved, moved_std = STEPS_PER_FRAME * STEP * SPEED, np.sqrt(STEPS_PER_FRAME) * STEP * SPEED_STD
    equations = [(unknown[0], 0.0, max(start_std, 1e-6))]
    equations += [(unknown[k + 1] - unknown[k], moved, moved_std) for k in range(moves)]
    equations += [(unknown[moves + 1 + i] - unknown[k], z, RANGE_STD) for k, i, z in rows]
    A = np.array([row / std for row, _, std in equations])
    covariance = np.linalg.inv(A.T @ A)
    mean = covariance @ A.T @ np.array([value / std for _, value, std in equations])
    return Gaussian(mean=mean[[moves]], covariance=covariance[[moves]][:, [moves]])


def plane_toy(seed):
    """Three frames among four landmarks, all noise a thousandth of the paper's; some passive."""
    rng = np.random.default_rng(seed)
    motion = Motion(model="bicycle", control_std=(0.3 * SMALL, 0.03 * SMALL), wheelbase=0.2)
    start = Gaussian(mean=np.zeros(3), covariance=SMALL**2 * np.diag([0.05**2, 0.05**2, 0.04**2]))
    noise = {"range_std": 0.1 * SMALL, "bearing_std": 0.05 * SMALL}
    field, drive = scattered(rng, 4, radius=8.0), steady((1.5, 0.1), 3)
    mission = draw_mission(rng, motion, start, field, drive, beamwidth=7.0, reach=20.0, **noise)
    for scan in mission.scans[1:]:
        scan.range[::2] = np.nan
    slam = swarm_filter(motion=motion, **noise)
    joint = paper_filter(motion=motion, **noise)
    belief = joint.init(start)
    for control, dt, scan in zip(mission.controls, mission.dt, mission.scans, strict=True):
        belief = joint.update(joint.predict(belief, control, dt)[0], scan)
    return Toy(slam, start, list(mission.controls), mission.scans, belief.pose())


def departure(belief, kalman):
    """Length of a swarm's error of the mean and of the covariance, in the Kalman filter's terms."""
    d = kalman.mean.size
    whiten = np.linalg.inv(np.linalg.cholesky(kalman.covariance))
    mean = whiten @ (belief.pose().mean[:d] - kalman.mean)
    covariance = belief.pose().covariance - SMALLEST_STD**2 * np.eye(3)
    covariance = whiten @ covariance[:d, :d] @ whiten.T - np.eye(d)
    return np.linalg.norm(mean), np.linalg.norm(covariance)


def slope(squares):
    """Slope of log rms over log N; squares are (sizes, runs)."""
    return np.polyfit(np.log(SIZES), 0.5 * np.log(squares.mean(axis=1)), 1)[0]


def convergence(toys):
    """For mean and covariance: rms per size and bootstrapped 99 % band of the slope."""
    errors = np.array(
        [
            [departure(toy.run(size, [size, run]), toy.kalman) for run, toy in enumerate(toys)]
            for size in SIZES
        ]
    )
    rng, results = np.random.default_rng(0), []
    for squares in np.moveaxis(errors**2, 2, 0):
        again = [
            slope(np.array([row[rng.integers(0, len(toys), len(toys))] for row in squares]))
            for _ in range(1000)
        ]
        low, high = np.quantile(again, [0.005, 0.995])
        results.append((np.sqrt(squares.mean(axis=1)), low, high))
    return results


def assert_converges_at_the_rate(toys):
    for rms, low, high in convergence(toys):
        assert low < -0.5 < high
        assert high - low < 0.15
        assert rms[-1] < 0.15 * rms[0]


def test_swarm_on_an_axis_converges_to_the_kalman_filter_by_root_n():
    assert_converges_at_the_rate([axis_toy(seed, start_std=0.3, moves=5) for seed in range(100)])


def test_swarm_in_the_plane_converges_to_the_kalman_filter_by_root_n():
    assert_converges_at_the_rate([plane_toy(seed) for seed in range(100)])


# The weight


def excess_of_variance(toy, mean_and_covariance, weight):
    """Relative departure of a swarm's variance of x, corrected for the finite sample."""
    _, covariance = mean_and_covariance
    spread = covariance[0, 0] - SMALLEST_STD**2
    return spread / (1 - 1 / effective_particles(weight)) / toy.kalman.covariance[0, 0] - 1


def weighing_by(slam, weights):
    """Return the same filter with other weights."""
    return replace(slam, settings=slam.settings.model_copy(update={"weights": weights}))


def slow_excesses(weights="marginal", runs=30, particles=50, **weighing):
    values = []
    for seed in range(runs):
        toy, rng = axis_toy(seed, start_std=0.0, moves=2), np.random.default_rng([1, seed])
        slam = never_resampling(weighing_by(resized(toy.slam, particles), weights))
        slow = slow_twin(slam, toy.start, **weighing)
        for control, scan in zip(toy.controls, toy.scans, strict=True):
            slow.predict(control, np.full(len(control), STEP))
            slow.update(scan, rng)
        values.append(excess_of_variance(toy, slow.estimated, slow.weights))
    return np.array(values)


def fast_excesses(weights, runs=100, particles=400):
    values = []
    for seed in range(runs):
        toy = axis_toy(seed, start_std=0.0, moves=2)
        slam = never_resampling(weighing_by(toy.slam, weights))
        toy = Toy(slam, toy.start, toy.controls, toy.scans, toy.kalman)
        belief = toy.run(particles, [1, seed])
        pose = belief.pose()
        weight = normalised(belief.log_weight)
        values.append(excess_of_variance(toy, (pose.mean, pose.covariance), weight))
    return np.array(values)


def is_unbiased(values):
    return abs(values.mean()) < 3 * values.std(ddof=1) / np.sqrt(values.size)


@pytest.mark.parametrize("weights", ["marginal", "sampled"])
def test_either_weight_leaves_the_swarm_as_wide_as_the_posterior(weights):
    assert is_unbiased(fast_excesses(weights))


def test_where_all_is_linear_the_weight_at_the_sample_is_the_marginal_likelihood():
    toy = axis_toy(4, start_std=0.3, moves=3)
    one, other = (
        replace(toy, slam=never_resampling(weighing_by(toy.slam, weights))).run(50, 1).log_weight
        for weights in ("marginal", "sampled")
    )
    np.testing.assert_allclose(normalised(other), normalised(one), rtol=1e-4)
    assert np.ptp(one) > 1.0


@pytest.mark.slow
def test_weight_at_the_sample_without_the_proposal_is_not_right():
    """The proposal has used the measurement once; weighing by it once more sharpens the swarm."""
    assert is_unbiased(slow_excesses())
    wrong = slow_excesses("sampled", forget_proposal=True)
    assert not is_unbiased(wrong)
    assert wrong.mean() == pytest.approx(-0.4, abs=0.1)


# Consistency


def final_nees(assumed, particles, runs=100):
    """Mean NEES of the pose after ten seconds of active sensing."""
    assumed_noise = {name: assumed * std for name, std in NOISE.items()}
    slam, values = swarm_filter(particles, motion=STEADY, **assumed_noise), []
    for run in range(runs):
        rng, mission = active_mission(run)
        *_, (belief, _) = followed(slam, mission, SURE, rng)
        pose = belief.pose()
        values.append(nees_of(pose.mean - mission.path[-1], pose.covariance))
    return np.mean(values)


@pytest.mark.slow
def test_large_swarm_is_consistent_and_a_small_one_or_half_the_noise_is_not():
    low, high = chi2.ppf([0.005, 0.995], 3 * 100) / 100
    assert low < final_nees(assumed=1.0, particles=3000) < high
    assert final_nees(assumed=1.0, particles=100) > high
    assert final_nees(assumed=0.5, particles=3000) > high
