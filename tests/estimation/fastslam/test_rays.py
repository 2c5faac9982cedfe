"""Rays inside the swarm: what weighs, what is pruned, by whom."""

from dataclasses import replace

import numpy as np

from reference.missions import START, STEP, ray_config, scan_of
from reference.swarms import (
    Drawn,
    began,
    drawing,
    members,
    never_resampling,
    particles_of,
    swarm_filter,
)

# What weighs


def test_frames_with_only_new_landmarks_leave_the_weights_equal():
    slam = swarm_filter(30)
    normal = drawing().standard_normal((30, 3))
    scan = scan_of((1, 5.0, 0.3), (2, np.nan, 1.0))
    belief = slam.update(slam.init(START), scan, Drawn(normal, np.full(30, 0.5)))
    np.testing.assert_allclose(
        belief.cloud(), START.mean + normal * np.sqrt(np.diag(START.covariance)), rtol=1e-15
    )
    assert np.ptp(belief.log_weight) == 0
    assert not particles_of(belief).covariance.any()
    direction = belief.cloud()[:, 2] + 0.3
    place = belief.cloud()[:, :2] + 5.0 * np.column_stack([np.cos(direction), np.sin(direction)])
    np.testing.assert_allclose(particles_of(belief).member[:, 0, :2], place, rtol=0, atol=1e-14)


def test_a_range_initialises_a_partial_landmark_without_changing_weights():
    slam = swarm_filter(30)
    belief = began(slam, (1, 5.0, 0.3), (2, np.nan, 1.0))
    belief, _ = slam.predict(belief, np.tile([0.75, 0.2], (4, 1)), np.full(4, STEP))
    after = slam.update(belief, scan_of((2, 3.0, 1.2)), drawing(3))
    np.testing.assert_allclose(after.log_weight, belief.log_weight, rtol=1e-14)
    np.testing.assert_array_equal(particles_of(after).count, 1)
    distance = np.hypot(*(particles_of(after).member[:, 1, :2] - after.cloud()[:, :2]).T)
    np.testing.assert_allclose(distance, 3.0, atol=1e-12)


def test_landmark_heard_once_is_not_full():
    belief = began(swarm_filter(), (7, np.nan, 0.4))
    assert belief.full == 0
    assert belief.landmarks().landmark.tolist() == [7, 7, 7, 7]
    np.testing.assert_allclose(belief.landmarks().weight, 0.25, rtol=1e-15)


# Rays of their own


def drive_past(slam, frames, seed=1):
    """Beliefs while landmark 7 is heard alone from a line, and landmark 1 once in a while."""
    rng, belief = drawing(seed), began(slam, (1, 3.0, -1.0), (7, np.nan, 1.1))
    for frame in range(1, frames):
        belief, _ = slam.predict(belief, np.array([[2.0, 0.0]]), np.array([STEP]))
        x, y = START.mean[0] + frame * 2.0 * STEP, START.mean[1]
        rows = [(7, np.nan, np.arctan2(-4.9 - y, 1.3 - x))]
        yield belief, scan_of(*rows, *([(1, 3.0, -1.0)] if frame % 5 == 0 else []))
        belief = slam.update(belief, scan_of(*rows), rng)


def test_pruning_removes_rows_of_some_particles_and_changes_nothing_else():
    """Rows before and after a prune are the same numbers, but for the weights' renormalisation."""
    pruning = never_resampling(swarm_filter(bearing_std=0.05))
    keeping = replace(pruning, rays=ray_config(prune_threshold=0.0))
    uneven = 0
    for belief, scan in drive_past(pruning, frames=20):
        pruned, kept = (slam.update(belief, scan, drawing(9)) for slam in (pruning, keeping))
        counts = particles_of(belief).count[:, 1]
        uneven += len(set(particles_of(pruned).count[:, 1])) > 1
        assert pruned.member.shape[1] == 1 + counts.max()
        for particle, before in enumerate(counts):
            rows = members(kept, particle, 7)
            stay = rows[:, 5] >= pruning.rays.prune_threshold / before
            found = members(pruned, particle, 7)
            np.testing.assert_array_equal(found[:, :5], rows[stay, :5])
            weight = rows[stay, 5] / rows[stay, 5].sum()
            np.testing.assert_allclose(found[:, 5], weight, rtol=1e-14)
            np.testing.assert_array_equal(members(pruned, particle, 1), members(kept, particle, 1))
    assert uneven > 3


def test_columns_shrink_when_all_particles_have_pruned():
    slam = swarm_filter(bearing_std=0.05, rays=ray_config(prune_threshold=0.1))
    widths = [belief.member.shape[1] for belief, _ in drive_past(slam, frames=40)]
    assert widths[0] == 5
    assert widths[-1] == 2
    assert (np.diff(widths) <= 0).all()


def test_parallax_finds_the_member_that_holds_the_landmark():
    for mixture in ("federated", "exact"):
        *_, (belief, _) = drive_past(swarm_filter(100, mixture, bearing_std=0.05), frames=17)
        rows = belief.landmarks()
        heaviest = np.argmax(np.where(rows.landmark == 7, rows.weight, 0))
        assert rows.weight[heaviest] > 0.9
        assert np.hypot(*(rows.mean[heaviest] - [1.3, -4.9])) < 0.3 * 2.9
