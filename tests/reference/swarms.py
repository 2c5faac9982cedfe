"""FastSLAM 2.0 filters with the paper's settings, small enough for the slow reference."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from pipistrelle.config import FastSlamConfig
from pipistrelle.estimation.fastslam.block import LANES
from pipistrelle.estimation.fastslam.filter import FastSlam
from pipistrelle.estimation.fastslam.particles import normalised
from reference.fastslam import SlowFastSlam
from reference.missions import (
    BICYCLE,
    CIRCLE,
    SENSING,
    START,
    draw_mission,
    measured_to,
    ray_config,
    scan_of,
    scattered,
    steady,
)

ARRAYS = ("mean", "covariance", "log_weight", "landmark", "first", "count")
PACKED = ([0, 0, 1, 0, 1, 2], [0, 1, 1, 2, 2, 2])


@dataclass(frozen=True, slots=True, kw_only=True)
class Particles:
    """Particles of a belief, unpacked from its blocks into the usual arrays.

    Poses (p, 3) and (p, 3, 3), counts (p, n), hypotheses (p, c, 6): x, y, xx, xy, yy, log weight.
    """

    mean: np.ndarray
    covariance: np.ndarray
    log_weight: np.ndarray
    landmark: np.ndarray
    first: np.ndarray
    count: np.ndarray
    member: np.ndarray


def particles_of(belief):
    """Unpack the blocks of a belief."""
    number, blocks = belief.log_weight.size, len(belief.poses)
    poses = belief.poses.reshape(blocks, 9, LANES).swapaxes(1, 2).reshape(-1, 9)[:number]
    covariance = np.empty((number, 3, 3))
    for k, (a, b) in enumerate(zip(*PACKED, strict=True)):
        covariance[:, a, b] = covariance[:, b, a] = poses[:, 3 + k]
    count = belief.count.swapaxes(1, 2).reshape(blocks * LANES, -1)
    columns = belief.member.shape[1]
    member = belief.member.reshape(blocks, columns, 6, LANES).transpose(0, 3, 1, 2)
    member = member.reshape(blocks * LANES, columns, 6)[:number]
    return Particles(
        mean=poses[:, :3],
        covariance=covariance,
        log_weight=belief.log_weight,
        landmark=belief.landmark,
        first=belief.first,
        count=count[:number],
        member=member,
    )


def with_particles(belief, **changes):
    """Pack particles into the blocks of a belief, with some arrays changed."""
    particles, blocks = replace(particles_of(belief), **changes), len(belief.poses)
    lanes = np.minimum(np.arange(blocks * LANES), particles.log_weight.size - 1)
    poses = np.column_stack([particles.mean, particles.covariance[:, *PACKED]])[lanes]
    member = particles.member[lanes].reshape(blocks, LANES, -1, 6).transpose(0, 2, 3, 1)
    return replace(
        belief,
        poses=poses.reshape(blocks, LANES, 9).swapaxes(1, 2).reshape(blocks, -1),
        log_weight=particles.log_weight,
        landmark=particles.landmark,
        first=particles.first,
        count=particles.count[lanes].reshape(blocks, LANES, -1).swapaxes(1, 2).copy(),
        member=member.reshape(blocks, -1, 6 * LANES),
    )


class Drawn:
    """A random generator that returns given numbers."""

    def __init__(self, normal, uniform):
        self.normal, self.uniform = np.array(normal), np.array(uniform)

    def standard_normal(self, size):
        assert self.normal.shape == size
        return self.normal

    def random(self, size):
        assert self.uniform.shape == (size,)
        return self.uniform


@dataclass(frozen=True, kw_only=True)
class AssumingFastSlam(FastSlam):
    """FastSLAM that assumes the given noise for all scans."""

    range_std: float = 0.2
    bearing_std: float = 0.15

    def update(self, belief, scan, rng):
        assumed = measured_to(scan, self.range_std, self.bearing_std)
        return FastSlam.update(self, belief, assumed, rng)


def swarm_filter(particles=20, mixture="federated", resample_below=0.75, **changes):
    """Return a filter with the paper's settings, except for the changes of it and its particles."""
    own = {name: changes.pop(name) for name in FastSlamConfig.model_fields if name in changes}
    first = {"particles": particles, "mixture": mixture, "resample_below": resample_below}
    swarm = FastSlamConfig(**first, **own)
    slam = AssumingFastSlam(motion=BICYCLE, rays=ray_config(), settings=swarm)
    return replace(slam, **changes)


def never_resampling(slam):
    """Return the same filter without resampling."""
    return replace(slam, settings=slam.settings.model_copy(update={"resample_below": 0.0}))


def slow_twin(slam, start=START, **changes):
    """Return the slow reference with a filter's settings, started."""
    slow = SlowFastSlam(
        slam.motion,
        slam.range_std,
        slam.bearing_std,
        slam.rays,
        slam.gate,
        slam.settings,
        **changes,
    )
    return slow.start(start.mean, start.covariance)


def small_mission(strategy, frames=100, seed=3, landmarks=16, **changes):
    """Draw the paper's drive among few landmarks."""
    rng = np.random.default_rng(seed)
    field, drive = scattered(rng, landmarks, radius=14.0), steady(CIRCLE, frames)
    return draw_mission(rng, BICYCLE, START, field, drive, **(SENSING[strategy] | changes))


def all_members(belief):
    """Return (p, c, 6) hypotheses, log weights last, with zeros in unused columns."""
    particles = particles_of(belief)
    width = np.diff(belief.first)
    offset = np.arange(belief.member.shape[1]) - np.repeat(belief.first[:-1], width)
    used = offset < np.repeat(particles.count, width, axis=1)
    return np.where(used[:, :, None], particles.member, 0.0)


def weighted(member):
    """Return hypotheses with weights instead of their logarithms."""
    return np.concatenate([member[..., :5], np.exp(member[..., 5:])], axis=-1)


def members(belief, particle, label):
    """Return a particle's hypotheses of a landmark, (h, 6): x, y, xx, xy, yy, weight."""
    (block, lane), n = divmod(particle, LANES), belief.landmark.tolist().index(label)
    first = belief.first[n]
    rows = belief.member[block, first : first + belief.count[block, n, lane]]
    return weighted(rows.reshape(-1, 6, LANES)[:, :, lane])


def arrays_of(belief):
    shown, particles = belief.landmarks(), particles_of(belief)
    poses = (belief.pose().mean, belief.pose().covariance)
    rows = (shown.landmark, shown.mean, shown.covariance, shown.weight)
    return [*(getattr(particles, name) for name in ARRAYS), all_members(belief), *poses, *rows]


def assert_same(belief, other):
    """Assert that two beliefs are equal to the last bit."""
    for mine, yours in zip(arrays_of(belief), arrays_of(other), strict=True):
        np.testing.assert_array_equal(mine, yours)
    assert (belief.full, belief.gated) == (other.full, other.gated)


def assert_sound(belief):
    """Assert finite numbers, weights that sum to 1, and positive definite covariances."""
    rows = belief.landmarks()
    for values in (belief.cloud(), belief.pose().mean, belief.pose().covariance, rows.mean):
        assert np.isfinite(values).all()
    assert normalised(belief.log_weight).sum() == pytest.approx(1, abs=1e-12)
    np.testing.assert_array_equal(belief.pose().covariance, belief.pose().covariance.T)
    assert np.linalg.eigvalsh(belief.pose().covariance)[0] > 0
    for particle in range(belief.log_weight.size):
        for label in belief.landmark:
            _, _, xx, xy, yy, weight = members(belief, particle, label).T
            assert (xx > 0).all()
            assert (xx * yy - xy**2 > 0).all()
            assert weight.sum() == pytest.approx(1, abs=1e-12)


def drawing(seed=1):
    return np.random.default_rng(seed)


def began(slam, *rows, start=START, seed=1):
    """Return the belief after a first scan."""
    return slam.update(slam.init(start), scan_of(*rows), drawing(seed))
