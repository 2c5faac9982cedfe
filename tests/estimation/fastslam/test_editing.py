"""Pose and map of all particles, or of the heaviest: both by one setting."""

from dataclasses import replace

import numpy as np
import pytest

from pipistrelle.estimation.beliefs import placed, some_of
from pipistrelle.estimation.fastslam.particles import normalised
from reference.missions import START, followed
from reference.swarms import (
    assert_same,
    drawing,
    members,
    never_resampling,
    small_mission,
    swarm_filter,
)


def by(estimate, particles=50, **changes):
    """The filter whose pose and map are those of a setting."""
    slam = swarm_filter(particles, **changes)
    return replace(slam, settings=slam.settings.model_copy(update={"estimate": estimate}))


def last(slam, strategy="fused", frames=60):
    *_, (belief, _) = followed(slam, small_mission(strategy, frames), START, drawing())
    return belief


@pytest.mark.parametrize("strategy", ["active", "fused", "passive"])
def test_the_map_of_the_mixture_is_the_moments_over_all_particles(strategy):
    belief = last(never_resampling(by("mixture")), strategy)
    weight, shown = normalised(belief.log_weight), belief.landmarks()
    assert shown.landmark.size
    for label in belief.landmark.tolist():
        each = [members(belief, p, label) for p in range(weight.size)]
        single = np.array([len(rows) == 1 for rows in each])
        mine = shown.landmark == label
        if weight[single].sum() <= 0.5:
            heaviest = np.argmax(np.where(single, -1.0, weight))
            np.testing.assert_array_equal(shown.mean[mine], each[heaviest][:, :2])
            np.testing.assert_allclose(shown.weight[mine].sum(), 1.0)
            continue
        rows = np.array([rows[0] for rows, one in zip(each, single, strict=True) if one])
        share = weight[single] / weight[single].sum()
        mean = share @ rows[:, :2]
        off = rows[:, :2] - mean
        own = (share @ rows[:, [2, 3, 3, 4]]).reshape(2, 2)
        np.testing.assert_allclose(shown.mean[mine], mean[np.newaxis])
        np.testing.assert_allclose(shown.covariance[mine][0], (off.T * share) @ off + own)


def test_the_map_of_the_mixture_has_the_place_and_the_blocks_of_the_joint_gaussian():
    belief = last(never_resampling(by("mixture")))
    joint, shown = belief.joint(), belief.landmarks()
    for n, label in enumerate(joint.landmark.tolist()):
        mine, at = shown.landmark == label, slice(3 + 2 * n, 5 + 2 * n)
        np.testing.assert_allclose(shown.mean[mine], joint.mean[at][np.newaxis])
        assert np.trace(shown.covariance[mine][0]) >= np.trace(joint.covariance[at, at]) - 1e-12


def test_the_heaviest_particle_gives_pose_and_map():
    belief = last(never_resampling(by("heaviest")))
    np.testing.assert_allclose(belief.pose().mean, belief.cloud()[belief.best], atol=1e-12)
    assert belief.best == int(np.argmax(belief.log_weight))
    np.testing.assert_array_equal(
        belief.landmarks().mean, replace(belief, mixed=False).landmarks().mean
    )


def test_after_a_resampling_the_pose_goes_on_with_a_copy_of_the_heaviest_particle():
    slam = by("heaviest", resample_below=1.0)
    belief = last(slam)
    mission = small_mission("fused", 61)
    ahead, _ = slam.predict(belief, mission.controls[60], mission.dt[60], drawing())
    np.testing.assert_allclose(ahead.pose().mean, ahead.cloud()[belief.best], atol=1e-9)
    assert np.hypot(*(ahead.pose().mean - belief.pose().mean)[:2]) < 1.0


def test_the_map_of_the_mixture_is_that_before_a_resampling_as_the_pose_is():
    mission, maps = small_mission("fused", 1), []
    for slam in (by("mixture", resample_below=1.0), never_resampling(by("mixture"))):
        belief, _ = slam.predict(slam.init(START), mission.controls[0], mission.dt[0], drawing())
        maps.append(slam.update(belief, mission.scans[0], drawing()).landmarks().mean)
    np.testing.assert_array_equal(*maps)


@pytest.mark.parametrize("estimate", ["heaviest", "mixture"])
def test_the_estimate_setting_changes_no_particle(estimate):
    one, other = last(by(estimate)), last(by("separate"))
    assert_same(replace(one, estimate=other.estimate, mixed=False), other)


def test_the_mixtures_map_is_consistent_and_one_particles_is_not():
    mission, squared = small_mission("active", 60), {"mixture": [], "separate": []}
    for estimate, found in squared.items():
        for seed in range(3):
            *_, (belief, _) = followed(by(estimate, particles=200), mission, START, drawing(seed))
            shown = some_of(belief.landmarks(), placed(belief.landmarks()))
            off = shown.mean - mission.landmarks[shown.landmark - 1]
            found += np.einsum("na,nab,nb->n", off, np.linalg.inv(shown.covariance), off).tolist()
    assert np.mean(squared["mixture"]) < 4.0  # 2 is right
    assert np.mean(squared["separate"]) > 50.0
