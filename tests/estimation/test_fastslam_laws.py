"""What must hold of the swarm whatever it is told, and what breaks the printed filter."""

from dataclasses import replace

import numpy as np
import pytest

from pipistrelle.detection.scans import Scan
from pipistrelle.estimation.fastslam import SMALLEST_STD
from pipistrelle.estimation.models import NEAREST, Gaussian, Motion, motion_jacobians
from pipistrelle.estimation.resampling import normalised
from pipistrelle.geometry import wrap
from reference.missions import BICYCLE, START, STEP, ray_config, scan_of
from reference.swarms import (
    Drawn,
    all_members,
    followed,
    members,
    never_resampling,
    small_mission,
    swarm_filter,
)

ARRAYS = ("mean", "covariance", "log_weight", "landmark", "first", "count")
KNOWN_POSE = Gaussian(mean=np.zeros(3), covariance=np.zeros((3, 3)))
AT_REST = Motion(model="unicycle", control_std=(0.1, 0.15), noise_at_rest=False)
TURNING = Motion(model="unicycle", control_std=(0.1, 0.5))


def arrays_of(belief):
    shown = belief.landmarks()
    poses = (belief.pose().mean, belief.pose().covariance)
    rows = (shown.landmark, shown.mean, shown.covariance, shown.weight)
    return [*(getattr(belief, name) for name in ARRAYS), all_members(belief), *poses, *rows]


def assert_same(belief, other):
    """Two beliefs are equal to the last bit."""
    for mine, yours in zip(arrays_of(belief), arrays_of(other), strict=True):
        np.testing.assert_array_equal(mine, yours)
    assert (belief.full, belief.gated) == (other.full, other.gated)


def assert_sound(belief):
    """Finite numbers, weights that sum to one, covariances that are covariances."""
    rows = belief.landmarks()
    for values in (belief.mean, belief.pose().mean, belief.pose().covariance, rows.mean):
        assert np.isfinite(values).all()
    assert normalised(belief.log_weight).sum() == pytest.approx(1, abs=1e-12)
    np.testing.assert_array_equal(belief.pose().covariance, belief.pose().covariance.T)
    assert np.linalg.eigvalsh(belief.pose().covariance)[0] > 0
    for particle in range(len(belief.mean)):
        for label in belief.landmark:
            _, _, xx, xy, yy, weight = members(belief, particle, label).T
            assert (xx > 0).all()
            assert (xx * yy - xy**2 > 0).all()
            assert weight.sum() == pytest.approx(1, abs=1e-12)


def drawing(seed=1):
    return np.random.default_rng(seed)


def began(slam, *rows, start=START, seed=1):
    """The belief after a first scan."""
    return slam.update(slam.init(start), scan_of(*rows), drawing(seed))


# Laws


def test_equal_generators_make_equal_missions_and_others_do_not():
    slam, mission = swarm_filter(), small_mission("fused", frames=20)
    *_, (one, _) = followed(slam, mission, drawing(1))
    *_, (same, _) = followed(slam, mission, drawing(1))
    *_, (other, _) = followed(slam, mission, drawing(2))
    assert_same(one, same)
    assert not np.array_equal(one.mean, other.mean)


def test_beliefs_given_are_never_changed():
    seen = []
    slam, mission = swarm_filter(), small_mission("fused", frames=40)
    for belief, poses in followed(slam, mission, drawing()):
        arrays = [*arrays_of(belief), poses.mean, poses.covariance]
        seen.append((arrays, [array.copy() for array in arrays]))
    for arrays, copies in seen:
        for array, before in zip(arrays, copies, strict=True):
            np.testing.assert_array_equal(array, before)
    assert START.mean.tolist() == [0.0, -7.408, 0.0]


def test_half_a_turn_of_the_world_turns_the_swarm():
    """Headings pass through pi on the way; draws along x and y change their sign."""
    slam, mission = swarm_filter(), small_mission("fused", frames=20)
    shift, rng = np.array([30.0, -20.0]), drawing()
    turned = Gaussian(
        mean=np.array([*(shift - START.mean[:2]), wrap(START.mean[2] + np.pi)]),
        covariance=START.covariance,
    )
    here, there = slam.init(START), slam.init(turned)
    for controls, dt, scan in zip(mission.controls, mission.dt, mission.scans, strict=True):
        normal, uniform = rng.standard_normal((20, 3)), rng.random(20)
        here, _ = slam.predict(here, controls, dt)
        there, _ = slam.predict(there, controls, dt)
        here = slam.update(here, scan, Drawn(normal, uniform))
        there = slam.update(there, scan, Drawn(normal * [-1, -1, 1], uniform))
    np.testing.assert_allclose(there.log_weight, here.log_weight, atol=1e-9)
    np.testing.assert_allclose(there.mean[:, :2], shift - here.mean[:, :2], atol=1e-9)
    assert np.abs(wrap(there.mean[:, 2] - here.mean[:, 2] - np.pi)).max() < 1e-9
    np.testing.assert_allclose(all_members(there)[:, :, 2:], all_members(here)[:, :, 2:], atol=1e-9)
    np.testing.assert_allclose(there.best.mean, shift - here.best.mean, atol=1e-9)
    turn = np.diag([-1, -1, 1])
    expected = turn @ here.pose().covariance @ turn
    np.testing.assert_allclose(there.pose().covariance, expected, atol=1e-9)


def test_labels_are_only_names():
    slam, mission = swarm_filter(), small_mission("fused", frames=20)
    renamed = [replace(scan, landmark=1000 - scan.landmark) for scan in mission.scans]
    *_, (belief, _) = followed(slam, mission, drawing())
    *_, (other, _) = followed(slam, replace(mission, scans=renamed), drawing())
    np.testing.assert_array_equal(other.landmark, 1000 - belief.landmark)
    np.testing.assert_array_equal(all_members(other), all_members(belief))


def test_steps_of_a_frame_are_the_steps_one_by_one():
    slam, mission = swarm_filter(), small_mission("fused", frames=10)
    *_, (belief, _) = followed(slam, mission, drawing())
    together, poses = slam.predict(belief, mission.controls[0], mission.dt[0])
    for k in range(4):
        belief, pose = slam.predict(
            belief, mission.controls[0, k : k + 1], mission.dt[0, k : k + 1]
        )
        np.testing.assert_array_equal(pose.mean[0], poses.mean[k])
        np.testing.assert_array_equal(pose.covariance[0], poses.covariance[k])
    assert_same(belief, together)


def test_new_landmarks_are_placed_last_wherever_they_stand_in_the_scan():
    slam = swarm_filter()
    belief = began(slam, (1, 5.0, 0.3))
    known, new, ray = (1, 5.3, 0.2), (2, 4.0, -1.0), (3, np.nan, 2.0)
    first = slam.update(belief, scan_of(new, ray, known), drawing())
    last = slam.update(belief, scan_of(known, new, ray), drawing())
    assert_same(first, last)
    assert first.landmark.tolist() == [1, 2, 3]


def test_estimate_is_the_weighted_mean_and_covariance_of_the_swarm_regularised():
    slam = never_resampling(swarm_filter(50))
    *_, (belief, _) = followed(slam, small_mission("fused", frames=10), drawing())
    belief, _ = slam.predict(belief, np.tile([0.75, 0.027], (4, 1)), np.full(4, STEP))
    weight = normalised(belief.log_weight)
    assert weight.max() > 3 * weight.min()
    mean = weight @ belief.mean  # No heading is near pi here.
    spread = (belief.mean - mean).T @ (weight[:, None] * (belief.mean - mean))
    own = np.tensordot(weight, belief.covariance, 1)
    # The mean direction and the mean heading part by the third power of the spread.
    np.testing.assert_allclose(belief.pose().mean, mean, atol=0.1**3)
    expected = spread + own + SMALLEST_STD**2 * np.eye(3)
    np.testing.assert_allclose(belief.pose().covariance, expected, atol=1e-5)


def test_best_map_is_the_heaviest_particles_and_the_first_of_equals():
    slam = never_resampling(swarm_filter(10))
    belief = began(slam, (1, 5.0, 0.3), (2, np.nan, 1.0))
    np.testing.assert_array_equal(belief.best.mean, belief.member[0, :, :2])
    belief, _ = slam.predict(belief, np.tile([0.75, 0.2], (4, 1)), np.full(4, STEP))
    belief = slam.update(belief, scan_of((1, 4.7, 0.3)), drawing(2))
    best = np.argmax(belief.log_weight)
    assert best > 0
    np.testing.assert_array_equal(belief.best.mean, belief.member[best, :, :2])
    np.testing.assert_array_equal(belief.best.weight, belief.member[best, :, 5])


def test_mean_number_of_full_landmarks_is_weighted():
    slam = never_resampling(swarm_filter(50, bearing_std=0.05))
    mission = small_mission("passive", frames=60)
    fractional = 0
    for belief, _ in followed(slam, mission, drawing()):
        weight = normalised(belief.log_weight)
        assert belief.full == pytest.approx(weight @ (belief.count == 1).sum(axis=1), abs=1e-12)
        fractional += abs(belief.full - round(belief.full)) > 0.01
    assert fractional > 3


def test_resampling_happens_below_the_threshold_and_keeps_what_the_swarm_said():
    slam, mission = swarm_filter(50, resample_below=1.0), small_mission("active", frames=5)
    belief, rng = slam.init(START), drawing()
    for controls, dt, scan in zip(mission.controls, mission.dt, mission.scans, strict=True):
        belief, _ = slam.predict(belief, controls, dt)
        normal, uniform = rng.standard_normal((50, 3)), rng.random(50)
        kept = never_resampling(slam).update(belief, scan, Drawn(normal, uniform))
        belief = slam.update(belief, scan, Drawn(normal, uniform))
    assert len(np.unique(belief.mean[:, 0])) < len(np.unique(kept.mean[:, 0])) == 50
    assert np.ptp(belief.log_weight) == 0 < np.ptp(kept.log_weight)
    np.testing.assert_array_equal(belief.pose().mean, kept.pose().mean)
    np.testing.assert_array_equal(belief.best.mean, kept.best.mean)
    assert belief.full == kept.full


# What adds no weight


def test_frames_with_only_new_landmarks_sample_place_and_weigh_nothing():
    slam = swarm_filter(30)
    normal = drawing().standard_normal((30, 3))
    scan = scan_of((1, 5.0, 0.3), (2, np.nan, 1.0))
    belief = slam.update(slam.init(START), scan, Drawn(normal, np.full(30, 0.5)))
    np.testing.assert_allclose(
        belief.mean, START.mean + normal * np.sqrt(np.diag(START.covariance)), rtol=1e-15
    )
    assert np.ptp(belief.log_weight) == 0
    assert not belief.covariance.any()
    direction = belief.mean[:, 2] + 0.3
    place = belief.mean[:, :2] + 5.0 * np.column_stack([np.cos(direction), np.sin(direction)])
    np.testing.assert_allclose(belief.member[:, 0, :2], place, rtol=0, atol=1e-14)


@pytest.mark.parametrize("partial", ["reinitialise", "heaviest"])
def test_range_of_a_partial_landmark_adds_no_weight_and_makes_it_full(partial):
    slam = swarm_filter(30, rays=ray_config(partial=partial))
    belief = began(slam, (1, 5.0, 0.3), (2, np.nan, 1.0))
    belief, _ = slam.predict(belief, np.tile([0.75, 0.2], (4, 1)), np.full(4, STEP))
    after = slam.update(belief, scan_of((2, 3.0, 1.2)), drawing(3))
    np.testing.assert_array_equal(after.log_weight, belief.log_weight)
    np.testing.assert_array_equal(after.count, 1)
    distance = np.hypot(*(after.member[:, 1, :2] - after.mean[:, :2]).T)
    # The bearing that follows the range moves the heaviest member along its own ellipse.
    np.testing.assert_allclose(distance, 3.0, atol=1e-12 if partial == "reinitialise" else 0.3)


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
    keeping = replace(pruning, rays=ray_config(prune=0.0))
    uneven = 0
    for belief, scan in drive_past(pruning, frames=20):
        pruned, kept = (slam.update(belief, scan, drawing(9)) for slam in (pruning, keeping))
        counts = belief.count[:, 1]
        uneven += len(set(pruned.count[:, 1])) > 1
        assert pruned.member.shape[1] == 1 + counts.max()
        for particle, before in enumerate(counts):
            rows = members(kept, particle, 7)
            stay = rows[:, 5] >= pruning.rays.prune / before
            found = members(pruned, particle, 7)
            np.testing.assert_array_equal(found[:, :5], rows[stay, :5])
            weight = rows[stay, 5] / rows[stay, 5].sum()
            np.testing.assert_allclose(found[:, 5], weight, rtol=1e-14)
            np.testing.assert_array_equal(members(pruned, particle, 1), members(kept, particle, 1))
    assert uneven > 3


def test_columns_shrink_when_all_particles_have_pruned():
    slam = swarm_filter(bearing_std=0.05, rays=ray_config(prune=0.1))
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


# What breaks the printed filter


def test_noise_of_one_step_is_sampled_in_the_two_directions_it_has():
    slam, start = swarm_filter(200), Gaussian(mean=START.mean, covariance=np.zeros((3, 3)))
    control = np.array([0.75, 0.027])
    belief, _ = slam.predict(slam.init(start), control[None], np.array([STEP]))
    normal = drawing().standard_normal((200, 3))
    sampled = slam.update(belief, scan_of((1, 5.0, 0.3)), Drawn(normal, np.full(200, 0.5)))
    _, U = motion_jacobians(BICYCLE, START.mean, control, STEP)
    noise = U * BICYCLE.control_std
    offset = (sampled.mean - belief.mean).T
    coordinates = np.linalg.lstsq(noise, offset, rcond=None)[0]
    np.testing.assert_allclose(noise @ coordinates, offset, rtol=0, atol=1e-12)
    assert np.abs(np.cov(coordinates) - np.eye(2)).max() < 4.5 * np.sqrt(2 / 200)


def test_vehicle_at_rest_without_noise_keeps_its_particles_and_divides_the_landmarks_noise():
    slam = swarm_filter(motion=AT_REST)
    belief = began(slam, (1, 5.0, 0.3))
    kept, rng = belief, drawing()
    for _ in range(9):
        rested, _ = slam.predict(belief, np.zeros((4, 2)), np.full(4, STEP))
        np.testing.assert_array_equal(rested.mean, belief.mean)
        belief = slam.update(rested, scan_of((1, 5.0, 0.3)), rng)
    np.testing.assert_array_equal(belief.mean, kept.mean)
    np.testing.assert_allclose(belief.member[:, 0, 2:5], kept.member[:, 0, 2:5] / 10, rtol=1e-9)
    np.testing.assert_allclose(belief.log_weight, kept.log_weight, atol=1e-12)


def test_landmark_covariances_stay_positive_after_a_hundred_thousand_updates():
    slam, rng = swarm_filter(3, motion=AT_REST), drawing()
    belief = slam.init(START)
    labels, bearing = np.arange(20), rng.uniform(-3, 3, 20)
    for frame in range(5000):
        scan = Scan(
            time=0.0,
            landmark=labels,
            range=np.where((rng.random(20) < 0.5) & (frame > 0), np.nan, 6 + rng.normal(0, 0.2)),
            bearing=bearing + rng.normal(0, 0.15, 20),
        )
        belief = slam.update(belief, scan, rng)
    assert_sound(belief)


def test_frames_without_measurements_change_nothing_and_their_motion_accumulates():
    slam, control = swarm_filter(), np.tile([0.75, 0.027], (4, 1))
    belief = began(slam, (1, 5.0, 0.3))
    once, _ = slam.predict(belief, control, np.full(4, STEP))
    silent = slam.update(once, scan_of(), drawing())
    assert_same(silent, once)
    twice, _ = slam.predict(silent, control, np.full(4, STEP))
    both, _ = slam.predict(belief, np.tile(control, (2, 1)), np.full(8, STEP))
    np.testing.assert_array_equal(twice.mean, both.mean)
    np.testing.assert_array_equal(twice.covariance, both.covariance)
    blank = slam.init(START)
    assert_same(slam.update(blank, scan_of(), drawing()), blank)


@pytest.mark.parametrize("row", [(1, 1e6, 0.3), (2, np.nan, -2.1)])
@pytest.mark.parametrize("mixture", ["federated", "exact"])
def test_likelihoods_that_underflow_leave_weights_that_sum_to_one(row, mixture):
    """Ten thousand deviations: every likelihood is zero in floating point."""
    slam = swarm_filter(mixture=mixture, bearing_std=1e-4, range_std=1e-4)
    belief = began(slam, (1, 5.0, 0.3), (2, np.nan, 1.0))
    for _ in range(3):
        belief, _ = slam.predict(belief, np.tile([0.75, 0.027], (4, 1)), np.full(4, STEP))
        belief = slam.update(belief, scan_of(row), drawing())
        assert_sound(belief)


def test_swarm_whose_headings_lie_on_both_sides_of_pi_points_between_them():
    slam = swarm_filter(500, motion=TURNING)
    start = Gaussian(mean=np.array([0, 0, np.pi - 1e-3]), covariance=START.covariance)
    belief = began(slam, (1, 5.0, 0.3), start=start)
    assert belief.mean[:, 2].min() < -3 < 3 < belief.mean[:, 2].max()
    assert abs(wrap(belief.pose().mean[2] - start.mean[2])) < 4.5 * 0.0436 / np.sqrt(500)
    assert belief.pose().covariance[2, 2] == pytest.approx(0.0436**2, rel=4.5 * np.sqrt(2 / 500))
    place = [-5 * np.cos(0.3), -5 * np.sin(0.3)]
    assert np.hypot(*(belief.member[:, 0, :2].mean(axis=0) - place)) < 0.05
    belief, poses = slam.predict(belief, np.array([[0.0, 0.02]]), np.ones(1))
    assert abs(wrap(poses.mean[0, 2] - start.mean[2] - 0.02)) < 4.5 * 0.0436 / np.sqrt(500)
    after = slam.update(belief, scan_of((1, 5.0, 0.28)), drawing())
    assert (np.abs(after.mean[:, 2]) <= np.pi).all()
    assert after.pose().covariance[2, 2] < 0.1


@pytest.mark.parametrize("row", [(1, 0.01, 0.5), (1, np.nan, 0.5)])
def test_landmark_that_the_vehicle_stands_on_weighs_and_corrects_nothing(row):
    slam = swarm_filter(motion=AT_REST)
    belief = began(slam, (1, NEAREST / 2, 0.0), (2, 4.0, 1.0))
    assert_same(slam.update(belief, scan_of(row), drawing()), belief)


@pytest.mark.parametrize("row", [(1, 0.01, 0.5), (1, np.nan, 0.5)])
def test_landmark_a_little_farther_corrects_and_all_stays_sound(row):
    slam = swarm_filter(motion=AT_REST)
    belief = began(slam, (1, NEAREST * 2, 0.0), (2, 4.0, 1.0))
    after = slam.update(belief, scan_of(row), drawing())
    assert not np.array_equal(after.member, belief.member)
    assert_sound(after)


@pytest.mark.parametrize("row", [(1, 0.01, 0.5), (1, np.nan, 0.5)])
@pytest.mark.parametrize("mixture", ["federated", "exact"])
def test_ray_that_the_vehicle_stands_on_stays_sound(row, mixture):
    rays = ray_config(range_bounds=(1e-4, 20.0))
    slam = swarm_filter(mixture=mixture, motion=AT_REST, rays=rays)
    belief = began(slam, (1, np.nan, 0.0), (2, 4.0, 1.0))
    assert np.hypot(*(belief.member[0, 0, :2] - belief.mean[0, :2])) < NEAREST
    for _ in range(3):
        belief = slam.update(belief, scan_of(row), drawing())
        assert_sound(belief)


@pytest.mark.parametrize("particles", [1, 2])
def test_few_particles_have_a_pose_with_an_inverse_covariance(particles):
    slam = swarm_filter(particles)
    for belief, poses in followed(slam, small_mission("fused", frames=20), drawing()):
        assert_sound(belief)
        assert (np.linalg.eigvalsh(poses.covariance)[:, 0] > 0).all()


# Gate


def looking_apart(slam):
    """A belief of two particles, one turned by half a radian, which know landmark 1 ahead."""
    belief = began(slam, (1, 4.0, 0.0), start=KNOWN_POSE)
    mean = belief.mean.copy()
    mean[1, 2] = 0.5
    return replace(belief, mean=mean)


@pytest.mark.parametrize(("bearing", "gated"), [(0.0, 0), (-0.5, 0), (-0.25, 1), (1.0, 1)])
@pytest.mark.parametrize("distance", [4.0, np.nan])
def test_gate_drops_what_no_particle_expected_and_keeps_what_one_did(bearing, gated, distance):
    slam = never_resampling(swarm_filter(2, gate=0.99, bearing_std=0.03))
    belief = looking_apart(slam)
    after = slam.update(belief, scan_of((1, distance, bearing)), drawing())
    assert after.gated == gated
    if gated:
        np.testing.assert_array_equal(after.member, belief.member)
    else:
        assert normalised(after.log_weight)[0 if bearing == 0.0 else 1] > 0.999


def test_gate_lets_new_landmarks_and_ranges_of_partial_ones_in():
    slam = swarm_filter(gate=0.5)
    belief = began(slam, (1, 4.0, 0.0), (2, np.nan, 1.0))
    after = slam.update(belief, scan_of((2, 3.0, -2.0), (3, np.nan, 2.0)), drawing())
    assert after.gated == 0
    assert after.full == pytest.approx(2, abs=1e-12)


def test_gate_of_one_drops_nothing():
    belief = began(swarm_filter(), (1, 4.0, 0.0))
    assert swarm_filter().update(belief, scan_of((1, 4e3, 3.0)), drawing()).gated == 0
