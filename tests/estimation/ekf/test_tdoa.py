"""Excess paths: against the slow references, by their slopes, and where they place."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipistrelle.detection.scans import make_scan
from pipistrelle.estimation.beliefs import Gaussian
from pipistrelle.estimation.ekf.filter import EkfSlam, InvariantEkfSlam
from pipistrelle.estimation.observations.excess_path import (
    excess_path_of,
    landmark_range,
    range_by_excess_path,
)
from pipistrelle.geometry import range_and_bearing
from reference.missions import (
    BICYCLE,
    CIRCLE,
    STEADY,
    SURE,
    beside,
    draw_mission,
    followed,
    nees_of,
    paper_filter,
    paper_mission,
    ray_config,
    scattered,
    steady,
)
from reference.timed_ekf import SlowTimedEkfSlam, SlowTimedInvariantEkfSlam
from reference.timing import excess_path_jacobians, timed

KINDS = [EkfSlam, InvariantEkfSlam]
PAIRS = [(EkfSlam, SlowTimedEkfSlam), (InvariantEkfSlam, SlowTimedInvariantEkfSlam)]
NAN = np.nan
SOME = {"share": 0.7, "least": 0.5, "direct": False}
"""Which excess paths are heard: a share of those not about zero, of callers heard or not."""
law = settings(deadline=None, max_examples=100)
coordinates = st.floats(-20.0, 20.0)
points = st.tuples(coordinates, coordinates).map(np.array)


# The measurement


def apart(*places):
    return all(np.hypot(*(a - b)) > 0.5 for i, a in enumerate(places) for b in places[:i])


@law
@given(points, points, points)
def test_slopes_of_an_excess_path_are_its_differences(vehicle, landmark, caller):
    if not apart(vehicle, landmark, caller):
        return
    for place, slope in enumerate(excess_path_jacobians(vehicle, landmark, caller)):
        for axis in range(2):
            ends = [np.array([vehicle, landmark, caller]) for _ in range(2)]
            ends[0][place, axis] += 1e-6
            ends[1][place, axis] -= 1e-6
            found = (excess_path_of(*ends[0]) - excess_path_of(*ends[1])) / 2e-6
            assert slope[axis] == pytest.approx(found, abs=1e-7)


@law
@given(points, points, points)
def test_the_closed_forms_give_back_the_ranges_that_made_the_excess_path(vehicle, landmark, caller):
    e = excess_path_of(vehicle, landmark, caller)
    if not apart(vehicle, landmark, caller) or e < 0.1:
        return
    near, onward = landmark - vehicle, caller - vehicle
    found = landmark_range(e, onward, np.arctan2(near[1], near[0]))
    assert found == pytest.approx(np.hypot(*near), rel=1e-6)
    u = onward / np.hypot(*onward)
    found = range_by_excess_path(e, *near, *u, True)
    behind = near @ u < -(1.0 - 1e-6) * np.hypot(*near)  # all callers there make one excess path
    if np.hypot(*onward) < 100.0 and not behind:
        assert found == pytest.approx(np.hypot(*onward), rel=1e-5)


# Against the references


LENGTHS = [
    ((1, 2, 3), 24),
    *(pytest.param(callers, 60, marks=pytest.mark.slow) for callers in ((1,), (1, 2, 3))),
]


def check_reference(kind, reference, strategy, callers, frames, *, gate=1.0, robust="none", **rays):
    mission = paper_mission(strategy, frames=frames, range_std=0.1, bearing_std=0.05)
    mission = timed(mission, callers, np.random.default_rng(5), **SOME)
    known = {"range_std": 0.2, "bearing_std": 0.15}
    slam = paper_filter(kind, rays=ray_config(**rays), gate=gate, robust=robust, **known)
    slow = reference(BICYCLE, 0.2, 0.15, slam.rays, gate, robust=robust == "huber")
    slow.excess_path_variance = 0.05**2
    for belief, *_ in beside(slam, slow, mission):
        spread = slow.linear()[:3, :3]
        np.testing.assert_array_equal(belief.landmark, slow.landmark)
        np.testing.assert_allclose(belief.weight, slow.weight, rtol=0, atol=1e-5)
        np.testing.assert_allclose(belief.pose().mean, slow.mean[:3], rtol=0, atol=1e-5)
        np.testing.assert_allclose(belief.pose().covariance, spread, rtol=0, atol=1e-5)
        landmarks = belief.landmarks()
        np.testing.assert_allclose(landmarks.mean.ravel(), slow.mean[3:], rtol=0, atol=1e-4)
    assert belief.gated == slow.gated


@pytest.mark.parametrize(("kind", "reference"), PAIRS)
@pytest.mark.parametrize("strategy", ["fused", "passive"])
@pytest.mark.parametrize(("callers", "frames"), LENGTHS)
def test_a_run_with_excess_paths_equals_the_slow_reference(
    kind, reference, strategy, callers, frames
):
    check_reference(kind, reference, strategy, callers, frames)


@pytest.mark.parametrize(("kind", "reference"), PAIRS)
@pytest.mark.parametrize(("callers", "frames"), LENGTHS)
def test_a_robust_gated_run_with_excess_paths_equals_the_slow_reference(
    kind, reference, callers, frames
):
    known = {"gate": 0.99, "robust": "huber", "weights": "aggregated"}
    check_reference(kind, reference, "fused", callers, frames, **known)


# What it is for

CALLER, LANDMARK = np.array([6.0, -2.0]), np.array([2.0, 9.0])


def standing(kind, robust="none"):
    """A filter whose vehicle stands at the origin, sure of it, and has placed a caller, label 2."""
    slam = paper_filter(kind, range_std=0.01, bearing_std=0.01, robust=robust)
    belief = slam.init(Gaussian(mean=np.zeros(3), covariance=np.eye(3) * 1e-8))
    distance, bearing = range_and_bearing(np.zeros(3), CALLER[None])
    return slam, slam.update(belief, make_scan(0.0, np.array([2]), bearing, range=distance))


def heard(place, e, label=7, caller=1):
    """A scan of one echo from a place, with an excess path."""
    _, bearing = range_and_bearing(np.zeros(3), place[None])
    scan = make_scan(
        0.0, np.array([label]), bearing, caller=caller, excess_path=e, excess_path_std=0.05
    )
    return replace(scan, callers=np.array([-1, 2]))


def mapped(belief, label):
    """Mean and covariance of a landmark's members."""
    landmarks = belief.landmarks()
    rows = landmarks.landmark == label
    return landmarks.mean[rows], landmarks.covariance[rows]


@pytest.mark.parametrize("kind", KINDS)
def test_a_landmark_heard_once_is_placed_by_its_excess_path(kind):
    slam, belief = standing(kind)
    belief = slam.update(belief, heard(LANDMARK, excess_path_of(np.zeros(2), LANDMARK, CALLER)))
    mean, covariance = mapped(belief, 7)
    np.testing.assert_allclose(mean, [LANDMARK], atol=1e-3)
    assert 0.01 < np.sqrt(np.linalg.eigvalsh(covariance[0])[-1]) < 0.3


@pytest.mark.parametrize("kind", KINDS)
def test_robust_excess_path_initialization_needs_a_precise_bearing(kind):
    e, members = excess_path_of(np.zeros(2), LANDMARK, CALLER), {}
    for robust in ("none", "huber"):
        slam, belief = standing(kind, robust)
        for std in (0.02, 0.07, 0.3):
            _, bearing = range_and_bearing(np.zeros(3), LANDMARK[None])
            timed = {"caller": 1, "excess_path": e, "excess_path_std": 0.05, "bearing_std": std}
            scan = make_scan(0.0, np.array([7]), bearing, **timed)
            after = slam.update(belief, replace(scan, callers=np.array([-1, 2])))
            members[robust, std] = len(mapped(after, 7)[0])
    ray = len(mapped(after, 7)[0])
    assert [members["none", std] for std in (0.02, 0.07, 0.3)] == [1, 1, ray]
    assert [members["huber", std] for std in (0.02, 0.07, 0.3)] == [1, ray, ray]


@pytest.mark.parametrize("kind", KINDS)
def test_a_placed_landmarks_covariance_matches_monte_carlo_draws(kind):
    slam, belief = standing(kind)
    e, rng = excess_path_of(np.zeros(2), LANDMARK, CALLER), np.random.default_rng(3)
    _, covariance = mapped(slam.update(belief, heard(LANDMARK, e)), 7)
    spread = np.sqrt(np.linalg.eigvalsh(mapped(belief, 2)[1][0]).mean())
    bearing = np.arctan2(LANDMARK[1], LANDMARK[0])
    drawn = []
    for turned, late, *moved in rng.normal(size=(4000, 4)) * [0.01, 0.05, spread, spread]:
        r = landmark_range(e + late, CALLER + moved, bearing + turned)
        drawn.append(r * np.array([np.cos(bearing + turned), np.sin(bearing + turned)]))
    ratio = np.linalg.eigvalsh(np.linalg.solve(np.cov(np.transpose(drawn)), covariance[0]))
    assert (ratio > 0.7).all(), "the caller's own noise is not round"
    assert (ratio < 1.4).all()


@pytest.mark.parametrize("kind", KINDS)
def test_an_excess_path_between_vehicle_and_caller_places_nothing_and_moves_nothing_far(kind):
    slam, belief = standing(kind)
    between = 0.5 * CALLER + [0.02, 0.05]
    after = slam.update(belief, heard(between, excess_path_of(np.zeros(2), between, CALLER)))
    assert len(mapped(after, 7)[0]) > 1, "a ray"
    np.testing.assert_allclose(after.pose().mean, belief.pose().mean, atol=1e-6)
    np.testing.assert_allclose(mapped(after, 2)[0], [CALLER], atol=0.05)


@pytest.mark.parametrize("kind", KINDS)
def test_an_excess_path_of_an_unknown_caller_counts_as_a_bearing(kind):
    slam, belief = standing(kind)
    e = excess_path_of(np.zeros(2), LANDMARK, CALLER)
    known = heard(LANDMARK, e)
    plain = slam.update(belief, replace(known, numbers=heard(LANDMARK, NAN).numbers))
    for callers in (np.array([-1]), np.array([-1, -1]), np.array([-1, 7]), np.array([-1, 30])):
        found = slam.update(belief, replace(known, callers=callers))
        assert found.mean.tobytes() == plain.mean.tobytes()


@pytest.mark.parametrize("kind", KINDS)
def test_a_caller_that_is_a_ray_is_placed_by_a_landmark_that_is_known(kind):
    slam = paper_filter(kind, range_std=0.01, bearing_std=0.01)
    belief = slam.init(Gaussian(mean=np.zeros(3), covariance=np.eye(3) * 1e-8))
    both = range_and_bearing(np.zeros(3), np.array([LANDMARK, CALLER]))
    known = make_scan(0.0, np.array([7]), both[1][:1], range=both[0][:1])
    belief = slam.update(slam.update(belief, known), make_scan(0.0, np.array([2]), both[1][1:]))
    assert len(mapped(belief, 2)[0]) > 1
    e = np.array([excess_path_of(np.zeros(2), LANDMARK, CALLER), NAN])
    scan = make_scan(0.0, np.array([7, 2]), both[1], caller=1, excess_path=e, excess_path_std=0.05)
    after = slam.update(belief, replace(scan, callers=np.array([-1, 2])))
    np.testing.assert_allclose(mapped(after, 2)[0], [CALLER], atol=0.01)


def test_the_invariant_filter_with_excess_paths_is_consistent_and_not_with_a_tenth_of_their_noise():
    """Mean NEES of the last pose of 40 drives of twenty seconds."""
    nees, noise = [], {"range_std": 0.05, "bearing_std": 0.02}
    rays = ray_config(exponent=8.0, prune_threshold=1e-9)
    slam = paper_filter(InvariantEkfSlam, motion=STEADY, rays=rays, **noise)
    for seed in range(40):
        rng, heard_to = np.random.default_rng([7, seed]), {"beamwidth": 0.0, "hearing": 30.0}
        field, drive = scattered(rng, 12, radius=12.0), steady(CIRCLE, 40)
        mission = draw_mission(rng, STEADY, SURE, field, drive, **heard_to, **noise)
        mission = timed(mission, (1,), rng, std=0.1, **SOME)
        for factor in (1.0, 0.1):
            told = np.array([1, 1, 1, 1, 1, factor, 1, 1])[:, None]
            scans = [replace(scan, numbers=scan.numbers * told) for scan in mission.scans]
            *_, (belief, _) = followed(slam, replace(mission, scans=scans), SURE)
            pose = belief.pose()
            nees.append(nees_of(pose.mean - mission.path[-1], pose.covariance))
    assert 1.5 < np.mean(nees[::2]) < 5.0, "3, with the chance of 40 draws"
    assert np.mean(nees[1::2]) > 7.0
