"""What must hold of the filter whatever it is told, and the traps of angles and distances."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import chi2

from pipistrelle.estimation.beliefs import Gaussian
from pipistrelle.estimation.ekf.filter import EkfSlam, InvariantEkfSlam
from pipistrelle.estimation.motion import Motion
from pipistrelle.estimation.observations.range import NEAREST
from pipistrelle.geometry import wrap
from reference.missions import (
    SENSING,
    START,
    STEP,
    STEPS_PER_FRAME,
    draw_mission,
    followed,
    measured_to,
    paper_filter,
    paper_mission,
    ray_config,
    scan_of,
    scattered,
    steady,
)

FIELDS = ("mean", "covariance", "landmark", "weight")
TURNING = Motion(model="unicycle", control_std=(0.1, 0.5))
KNOWN_POSE = Gaussian(mean=np.zeros(3), covariance=np.zeros((3, 3)))


def assert_same(belief, other):
    """Two beliefs are equal to the last bit."""
    for field in FIELDS:
        np.testing.assert_array_equal(getattr(belief, field), getattr(other, field))


@settings(max_examples=25)
@given(st.floats(-np.pi, np.pi), st.tuples(st.floats(-50, 50), st.floats(-50, 50)))
def test_estimate_turns_and_moves_with_the_start(angle, shift):
    """Bearings and ranges do not know where north is; headings pass through pi on the way."""
    c, s = np.cos(angle), np.sin(angle)
    turn = np.array([[c, -s], [s, c]])
    T = np.eye(3)
    T[:2, :2] = turn
    moved = Gaussian(
        mean=np.array([*(turn @ START.mean[:2] + shift), wrap(START.mean[2] + angle)]),
        covariance=T @ START.covariance @ T.T,
    )
    slam, mission = paper_filter(), paper_mission("fused", frames=12)
    (*_, (here, _)), (*_, (there, _)) = followed(slam, mission), followed(slam, mission, moved)
    np.testing.assert_array_equal(there.landmark, here.landmark)
    np.testing.assert_allclose(there.weight, here.weight, atol=1e-9)
    points = here.mean[3:].reshape(-1, 2) @ turn.T + shift
    np.testing.assert_allclose(there.mean[3:].reshape(-1, 2), points, atol=1e-9)
    np.testing.assert_allclose(there.mean[:2], turn @ here.mean[:2] + shift, atol=1e-9)
    assert abs(wrap(there.mean[2] - here.mean[2] - angle)) < 1e-9
    assert -np.pi <= there.mean[2] < np.pi
    G = np.kron(np.eye(1 + here.landmark.size), turn)
    G = np.insert(np.insert(G, 2, 0, axis=0), 2, 0, axis=1)
    G[2, 2] = 1
    np.testing.assert_allclose(there.covariance, G @ here.covariance @ G.T, atol=1e-9)


def test_order_of_frames_matters_and_each_frame_is_corrected_where_it_was_heard():
    mission, slam = paper_mission("active", frames=30), paper_filter()
    *_, (straight, _) = followed(slam, mission)
    error = np.hypot(*(straight.mean[:2] - mission.path[-1, :2]))
    mission.scans.reverse()
    *_, (reversed_, _) = followed(slam, mission)
    assert error < 3 * np.sqrt(np.trace(straight.covariance[:2, :2]))
    assert np.hypot(*(reversed_.mean[:2] - mission.path[-1, :2])) > 5 * error


# Traps


def test_bearing_behind_the_vehicle_is_compared_the_short_way_round():
    slam = paper_filter(motion=TURNING)
    belief = slam.update(slam.init(START), scan_of((1, 5.0, np.pi - 0.01)))
    belief, _ = slam.predict(belief, np.zeros((1, 2)), np.ones(1))
    across = slam.update(belief, scan_of((1, np.nan, -np.pi + 0.01)))
    turned = wrap(across.mean[2] - belief.mean[2])
    # Heard 0.02 rad too far to the left: the vehicle has turned to the right, by most of that.
    assert -0.02 < turned < -0.01
    assert np.hypot(*(across.mean[3:] - belief.mean[3:])) < 5 * 0.02


@pytest.mark.parametrize("turn", [-0.02, 0.02])
def test_heading_passes_through_pi_without_a_jump(turn):
    slam = paper_filter(motion=TURNING)
    heading = np.copysign(np.pi - 0.01, turn)
    start = Gaussian(mean=np.array([0, 0, heading]), covariance=START.covariance)
    belief = slam.update(slam.init(start), scan_of((1, 5.0, 0.1), (2, 3.0, -1.0)))
    belief, poses = slam.predict(belief, np.array([[0.0, turn]]), np.array([1.0]))
    assert poses.mean[0, 2] == pytest.approx(wrap(heading + turn), abs=1e-15)
    after = slam.update(belief, scan_of((1, 5.0, 0.1 - turn), (2, 3.0, -1.0 - turn)))
    np.testing.assert_allclose(after.mean, belief.mean, rtol=0, atol=1e-14)


def test_second_look_from_the_same_pose_does_not_change_it():
    slam = paper_filter()
    belief = slam.update(slam.init(START), scan_of((1, 5.0, 0.3)))
    after = slam.update(belief, scan_of((1, 5.4, 0.1)))
    np.testing.assert_allclose(after.mean[:3], belief.mean[:3], rtol=0, atol=1e-15)
    np.testing.assert_allclose(
        after.covariance[:3, :3], belief.covariance[:3, :3], rtol=0, atol=1e-17
    )


def test_correction_that_carries_the_heading_past_pi_is_wrapped():
    slam = paper_filter(motion=TURNING)
    start = Gaussian(mean=np.array([0, 0, np.pi - 1e-3]), covariance=START.covariance)
    belief = slam.update(slam.init(start), scan_of((1, 5.0, 0.0)))
    belief, _ = slam.predict(belief, np.zeros((1, 2)), np.ones(1))
    after = slam.update(belief, scan_of((1, np.nan, -0.1)))
    assert -np.pi <= after.mean[2] < -np.pi + 0.1


def test_known_landmarks_of_a_scan_are_corrected_one_after_another():
    slam = paper_filter()
    belief = slam.update(slam.init(START), scan_of((1, 5.0, 0.3), (2, 4.0, -1.0), (3, np.nan, 2.0)))
    rows = (2, 4.1, -1.1), (3, np.nan, 2.1), (1, 5.2, 0.2)
    together = slam.update(belief, scan_of(*rows))
    for row in rows:
        belief = slam.update(belief, scan_of(row))
    for field in FIELDS:
        np.testing.assert_allclose(
            getattr(together, field), getattr(belief, field), rtol=0, atol=1e-14
        )


def test_new_landmarks_are_placed_from_the_corrected_pose_in_any_order():
    slam = paper_filter()
    belief = slam.update(slam.init(START), scan_of((1, 5.0, 0.3)))
    known, new, ray = (1, 5.3, 0.2), (2, 4.0, -1.0), (3, np.nan, 2.0)
    first = slam.update(belief, scan_of(new, ray, known))
    last = slam.update(belief, scan_of(known, new, ray))
    assert_same(first, last)
    x, y, heading = first.mean[:3]
    place = [x + 4 * np.cos(heading - 1), y + 4 * np.sin(heading - 1)]
    np.testing.assert_allclose(first.mean[5:7], place, rtol=1e-15)
    assert first.landmark.tolist() == [1, 2, 3, 3, 3, 3]


@pytest.mark.parametrize("row", [(1, 0.01, 0.5), (1, np.nan, 0.5)])
def test_landmark_at_the_vehicles_position_corrects_nothing(row):
    slam = paper_filter()
    belief = slam.update(slam.init(START), scan_of((1, NEAREST / 2, 0.0), (2, 4.0, 1.0)))
    assert_same(slam.update(belief, scan_of(row)), belief)


@pytest.mark.parametrize("row", [(1, 0.01, 0.5), (1, np.nan, 0.5)])
def test_landmark_a_little_farther_corrects_and_all_stays_finite(row):
    slam = paper_filter()
    belief = slam.update(slam.init(START), scan_of((1, NEAREST * 2, 0.0), (2, 4.0, 1.0)))
    after = slam.update(belief, scan_of(row))
    assert np.isfinite(after.mean).all()
    assert np.linalg.eigvalsh(after.covariance)[0] > -1e-15
    assert not np.array_equal(after.mean, belief.mean)


def test_stopped_vehicle_without_noise_at_rest_forgets_nothing():
    exact = Motion(model="unicycle", control_std=(0.1, 0.15), noise_at_rest=False)
    slam = paper_filter(motion=exact)
    belief = slam.update(slam.init(START), scan_of((1, 5.0, 0.3), (2, np.nan, 1.0)))
    rested, poses = slam.predict(belief, np.zeros((8, 2)), np.full(8, STEP))
    assert_same(rested, belief)
    np.testing.assert_array_equal(poses.covariance, [belief.covariance[:3, :3]] * 8)


def test_stopped_vehicle_with_noise_at_rest_grows_uncertain_along_its_heading_and_in_it():
    motion = Motion(model="unicycle", control_std=(0.1, 0.15))
    slam = paper_filter(motion=motion)
    rested, _ = slam.predict(slam.init(KNOWN_POSE), np.zeros((8, 2)), np.full(8, STEP))
    expected = np.diag([8 * (0.1 * STEP) ** 2, 0, 8 * (0.15 * STEP) ** 2])
    np.testing.assert_allclose(rested.covariance, expected, rtol=1e-12, atol=0)


def test_a_vehicle_with_only_one_zero_control_is_not_at_rest():
    motion = Motion(model="unicycle", control_std=(0.1, 0.15), noise_at_rest=False)
    slam = paper_filter(motion=motion)
    turning, _ = slam.predict(slam.init(KNOWN_POSE), np.array([[0.0, 0.1]]), np.array([STEP]))
    assert turning.covariance[0, 0] == pytest.approx((0.1 * STEP) ** 2, rel=1e-3)


# Gate


def gated_bearing(slam, factor):
    """A belief, and the belief after a bearing whose innovation is factor of the gate's edge."""
    belief = slam.update(slam.init(KNOWN_POSE), scan_of((1, 4.0, 0.0), (2, 3.0, 1.0)))
    edge = np.sqrt(chi2.ppf(0.999, 1) * 2 * 0.15**2)  # S = 2 R
    return belief, slam.update(belief, scan_of((1, np.nan, factor * edge)))


@pytest.mark.parametrize("sign", [-1, 1])
def test_gate_drops_and_counts_a_bearing_beyond_its_quantile_and_no_other(sign):
    slam = paper_filter(gate=0.999)
    belief, inside = gated_bearing(slam, sign * (1 - 1e-6))
    assert inside.gated == 0
    assert inside.mean[4] * sign > 0.1
    belief, outside = gated_bearing(slam, sign * (1 + 1e-6))
    assert outside.gated == 1
    assert_same(outside, belief)


def test_gate_of_one_drops_nothing():
    belief, after = gated_bearing(paper_filter(gate=1.0), 2.0)
    assert after.gated == 0
    assert not np.array_equal(after.mean, belief.mean)


@pytest.mark.parametrize(("factor", "gated"), [(1 - 1e-6, 0), (1 + 1e-6, 1)])
def test_gate_on_range_and_bearing_has_two_degrees_of_freedom(factor, gated):
    slam = paper_filter(gate=0.99)
    belief = slam.update(slam.init(KNOWN_POSE), scan_of((1, 9.0, 0.0)))
    edge = np.sqrt(chi2.ppf(0.99, 2) * 2 * 0.2**2) * factor
    assert slam.update(belief, scan_of((1, 9.0 + edge, 0.0))).gated == gated


def test_gate_counts_over_the_whole_mission():
    slam = paper_filter(gate=0.99)
    mission = paper_mission("fused", frames=60, outliers=0.1)
    counts = [belief.gated for belief, _ in followed(slam, mission)]
    assert np.all(np.diff(counts) >= 0)
    assert counts[-1] > 20
    assert [b.gated for b, _ in followed(paper_filter(), mission)][-1] == 0


# The invariant filter


def heading_variance_of_a_standing_vehicle(slam):
    """Heading's variance after 50 noisy looks at five landmarks, as a share of the start's."""
    rng = np.random.default_rng(4)
    points = scattered(rng, 5, radius=12.0)
    mission = draw_mission(
        rng, slam.motion, START, points, np.zeros((50, STEPS_PER_FRAME, 2)),
        beamwidth=7.0, reach=40.0, bearing_std=0.15,
    )  # fmt: skip
    *_, (belief, _) = followed(slam, mission)
    return belief.pose().covariance[2, 2] / START.covariance[2, 2]


def test_a_standing_vehicle_learns_nothing_of_its_heading_but_the_plain_filter_thinks_it_does():
    standing = Motion(model="bicycle", control_std=(0.1, 0.03), wheelbase=0.2, noise_at_rest=False)
    invariant = heading_variance_of_a_standing_vehicle(
        paper_filter(InvariantEkfSlam, motion=standing)
    )
    plain = heading_variance_of_a_standing_vehicle(paper_filter(motion=standing))
    assert invariant == pytest.approx(1.0, abs=1e-9)
    assert plain < 0.9


@pytest.mark.parametrize("strategy", SENSING)
def test_turning_and_shifting_the_world_turns_and_shifts_the_estimate_and_nothing_else(strategy):
    mission, turn, shift = paper_mission(strategy, frames=60), 2.0, np.array([300.0, -40.0])
    c, s = np.cos(turn), np.sin(turn)
    R, whole = np.array([[c, -s], [s, c]]), np.eye(3)
    whole[:2, :2] = R
    moved = Gaussian(
        mean=np.array([*(R @ START.mean[:2] + shift), wrap(START.mean[2] + turn)]),
        covariance=whole @ START.covariance @ whole.T,
    )
    *_, (belief, _) = followed(paper_filter(InvariantEkfSlam), mission)
    *_, (other, _) = followed(paper_filter(InvariantEkfSlam), mission, moved)
    pose, there = belief.pose(), other.pose()
    np.testing.assert_allclose(there.mean[:2], R @ pose.mean[:2] + shift, rtol=0, atol=1e-8)
    assert wrap(there.mean[2] - pose.mean[2] - turn) == pytest.approx(0, abs=1e-9)
    turned = whole @ pose.covariance @ whole.T
    np.testing.assert_allclose(there.covariance, turned, rtol=0, atol=1e-9)
    known, placed = belief.landmarks(), other.landmarks()
    np.testing.assert_array_equal(placed.landmark, known.landmark)
    np.testing.assert_allclose(placed.mean, known.mean @ R.T + shift, rtol=0, atol=1e-8)
    np.testing.assert_allclose(placed.weight, known.weight, rtol=0, atol=1e-9)


def test_both_filters_agree_where_the_noise_vanishes():
    """What linearisation costs is of second order; so is what the filters differ by."""

    def difference(scale):
        motion = Motion(model="bicycle", control_std=(0.1 * scale, 0.03 * scale), wheelbase=0.2)
        start = Gaussian(mean=START.mean, covariance=scale**2 * START.covariance)
        std = {"range_std": 0.2 * scale, "bearing_std": 0.15 * scale}
        rng = np.random.default_rng(6)
        mission = draw_mission(
            rng, motion, start, scattered(rng, 10), steady((0.75, 0.1), 10),
            beamwidth=7.0, reach=60.0, **std,
        )  # fmt: skip
        scans = [measured_to(scan, **std) for scan in mission.scans]
        means = []
        for kind in (EkfSlam, InvariantEkfSlam):
            slam = kind(motion=motion, rays=ray_config())
            belief = slam.init(start)
            for controls, dt, scan in zip(mission.controls, mission.dt, scans, strict=True):
                belief, _ = slam.predict(belief, controls, dt)
                belief = slam.update(belief, scan)
            means.append(belief.pose().mean)
        return np.abs(means[0] - means[1]).max() / scale

    coarse, fine = difference(1e-2), difference(1e-3)
    assert 0 < fine < 1e-2
    assert coarse / fine == pytest.approx(10, rel=0.3)
