"""The filter against its slow reference, closed forms and statistics."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import chi2

from pipistrelle.estimation.beliefs import Gaussian
from pipistrelle.estimation.ekf.filter import EkfSlam, InvariantEkfSlam
from pipistrelle.estimation.motion import Motion
from pipistrelle.estimation.rays import RANGED
from pipistrelle.geometry import range_and_bearing, wrap
from reference.ekf_slam import SlowEkfSlam
from reference.invariant_ekf import SlowInvariantEkfSlam
from reference.missions import (
    ANY_RAYS,
    BICYCLE,
    CIRCLE,
    KINDS,
    NOISE,
    SENSING,
    START,
    STEADY,
    STEP,
    STEPS_PER_FRAME,
    SURE,
    active_mission,
    beside,
    draw_mission,
    followed,
    nees_of,
    paper_filter,
    paper_mission,
    ray_config,
    scan_of,
    scan_with,
    scattered,
    steady,
)
from reference.odometry import ANYONE, wandering

WEIGHTS = ("instantaneous", "aggregated")
OPTIONS = [
    (EkfSlam, *options)
    for options in itertools.product(
        ("fused", "passive"), WEIGHTS, ("anew", "moved", "bearing"), (1.0, 3.0), (1.0, 0.999)
    )
]
FEW = [
    (EkfSlam, "active", "instantaneous", "anew", 1.0, 0.999),
    (EkfSlam, "fused", "instantaneous", "anew", 1.0, 1.0),
    (EkfSlam, "fused", "aggregated", "moved", 3.0, 0.999),
    (EkfSlam, "passive", "instantaneous", "anew", 3.0, 0.999),
    *((EkfSlam, "fused", "instantaneous", name, 2.0, 1.0) for name in RANGED if name != "anew"),
    (InvariantEkfSlam, "fused", "aggregated", "bearing", 2.0, 0.999),
    (InvariantEkfSlam, "passive", "instantaneous", "anew", 2.0, 0.999),
]
MORE = [
    pytest.param(InvariantEkfSlam, *options, 2.0, 0.999, marks=pytest.mark.slow)
    for options in itertools.product(("fused", "passive"), WEIGHTS, ("anew", "bearing"))
    if options not in [case[1:4] for case in FEW[-2:]]
]
FIELDS = ("mean", "covariance", "landmark", "weight")
LENGTHS = [(EkfSlam, 30), (InvariantEkfSlam, 20)]


def assert_equal_to_reference(slam, mission, start=START):
    """Every frame of the two filters agrees to 1e-9; returns the last belief."""
    twin = SlowInvariantEkfSlam if isinstance(slam, InvariantEkfSlam) else SlowEkfSlam
    slow = twin(slam.motion, slam.range_std, slam.bearing_std, slam.rays, slam.gate)
    for belief, poses, (means, covariances) in beside(slam, slow, mission, start):
        linear, landmarks, size = slow.linear(), belief.landmarks(), len(slow.landmark)
        mapped, rows = linear[3:, 3:].reshape(size, 2, size, 2), np.arange(size)
        pairs = [
            (poses.mean, means),
            (poses.covariance, covariances),
            (belief.pose().mean, slow.mean[:3]),
            (belief.pose().covariance, linear[:3, :3]),
            (landmarks.landmark, slow.landmark),
            (landmarks.mean, slow.mean[3:].reshape(-1, 2)),
            (landmarks.covariance, mapped[rows, :, rows, :]),
            (landmarks.weight, slow.weight),
        ]
        if twin is SlowEkfSlam:
            pairs += [(getattr(belief, field), getattr(slow, field)) for field in FIELDS]
        for found, expected in pairs:
            np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9)
        assert belief.gated == slow.gated
        np.testing.assert_allclose(belief.innovations, slow.innovations, rtol=1e-6)
    return belief


def assert_equal_run(kind, mission, power, gate, **rays):
    slam = paper_filter(kind, rays=ray_config(exponent=power, **rays), gate=gate)
    belief = assert_equal_to_reference(slam, mission)
    assert (belief.gated > 0) == (gate < 1)
    return belief


@pytest.mark.parametrize(("kind", "strategy", "weights", "ranged", "power", "gate"), FEW + MORE)
def test_run_equals_the_slow_reference(kind, strategy, weights, ranged, power, gate):
    invariant = kind is InvariantEkfSlam
    frames, outliers = (24, 0.06) if invariant else (32, 0.04)
    mission = paper_mission(strategy, frames=frames, outliers=outliers)
    merge = 1.0 if invariant and weights == "aggregated" else 0.0
    rays = {"weights": weights, "range_update": ranged, "merge": merge}
    belief = assert_equal_run(kind, mission, power, gate, **rays)
    assert np.unique(belief.landmark).size > (5 if invariant else 8)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "strategy", "weights", "ranged", "power", "gate"), [*OPTIONS, FEW[0]]
)
def test_whole_run_equals_the_slow_reference_with_every_option(
    kind, strategy, weights, ranged, power, gate
):
    mission = paper_mission(strategy, outliers=0.02)
    rays = {"weights": weights, "range_update": ranged}
    belief = assert_equal_run(kind, mission, power, gate, **rays)
    assert np.unique(belief.landmark).size > 30


@pytest.mark.slow
@pytest.mark.parametrize("strategy", SENSING)
def test_whole_run_of_the_invariant_filter_equals_the_slow_reference(strategy):
    slam = paper_filter(InvariantEkfSlam)
    belief = assert_equal_to_reference(slam, paper_mission(strategy))
    assert np.unique(belief.landmark).size > 25


@pytest.mark.parametrize("weights", ["instantaneous", "aggregated"])
def test_rays_weighed_by_the_printed_likelihood_equal_the_slow_reference(weights):
    rays = ray_config(weights=weights, exponent=2.0, likelihood="printed")
    assert_equal_to_reference(paper_filter(rays=rays), paper_mission("fused", frames=30))


@settings(max_examples=10)
@given(ANY_RAYS, st.integers(0, 2**32), st.sampled_from([0.9, 1.0]))
def test_short_runs_equal_the_slow_reference_with_any_ray(rays, seed, gate):
    rng = np.random.default_rng(seed)
    field, drive = scattered(rng, 8, radius=10.0), steady(CIRCLE, 12)
    mission = draw_mission(
        rng, BICYCLE, START, field, drive, beamwidth=0.5, hearing=10.0, bearing_std=0.15
    )
    assert_equal_to_reference(paper_filter(rays=rays, gate=gate), mission)


@pytest.mark.parametrize(("kind", "frames"), LENGTHS)
def test_unicycle_that_stops_turns_and_reverses_equals_the_slow_reference(kind, frames):
    rng = np.random.default_rng(8)
    motion = Motion(model="unicycle", control_std=(0.1, 0.15), noise_at_rest=False)
    controls = rng.uniform([-0.5, -1], [1, 1], size=(frames, STEPS_PER_FRAME, 2))
    controls[rng.random(controls.shape[:2]) < 0.3] = 0
    controls[rng.random(controls.shape[:2]) < 0.2, 1] = 0
    field = scattered(rng, 20, radius=10.0)
    mission = draw_mission(rng, motion, START, field, controls, beamwidth=2.0, hearing=10.0)
    assert_equal_to_reference(paper_filter(kind, motion=motion), mission)


@pytest.mark.parametrize(("kind", "frames"), LENGTHS)
@pytest.mark.parametrize("stated", [True, False])
def test_a_drive_by_poses_equals_the_slow_reference(stated, kind, frames):
    rng = np.random.default_rng(8)
    motion = replace(ANYONE, noise_at_rest=stated)
    controls = wandering(rng, frames * STEPS_PER_FRAME, stated=stated)
    controls = controls.reshape(frames, STEPS_PER_FRAME, -1)
    field = scattered(rng, 20, radius=10.0)
    mission = draw_mission(rng, motion, START, field, controls, beamwidth=2.0, hearing=10.0)
    assert_equal_to_reference(paper_filter(kind, motion=motion), mission)


def assert_equal_references(mission, **changed):
    """Two forms of the slow filter agree to 1e-9 in every frame; return their last states."""
    one, other = (
        SlowEkfSlam(BICYCLE, 0.2, 0.15, ray_config(), **form).start(START.mean, START.covariance)
        for form in ({}, changed)
    )
    for controls, dt, scan in zip(mission.controls, mission.dt, mission.scans, strict=True):
        for slow in (one, other):
            slow.predict(controls, dt)
            slow.update(scan)
        for field in FIELDS:
            np.testing.assert_allclose(
                getattr(other, field), getattr(one, field), rtol=0, atol=1e-9
            )
    return one, other


@pytest.mark.slow
def test_reference_is_the_same_in_josephs_form():
    assert_equal_references(paper_mission("fused", frames=8), joseph=True)


@pytest.mark.slow
def test_correspondence_carried_in_the_state_changes_nothing():
    mission = paper_mission("fused", frames=100)
    without, carried = assert_equal_references(mission, carry_correspondence=True)
    assert carried.X.size == without.X.size + np.unique(carried.landmark).size


# Covariance


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("strategy", SENSING)
def test_covariance_is_symmetric_and_positive_through_a_whole_mission(strategy, kind):
    for frame, (belief, _) in enumerate(followed(paper_filter(kind), paper_mission(strategy))):
        np.testing.assert_array_equal(belief.covariance, belief.covariance.T)
        if frame % 5 == 0:
            assert np.linalg.eigvalsh(belief.covariance)[0] > 0


def test_covariance_is_symmetric_and_positive_after_a_hundred_thousand_updates():
    """Without process noise nothing lifts a covariance that rounding has pushed down."""
    rng = np.random.default_rng(2)
    motion = Motion(model="unicycle", control_std=(0.1, 0.1), noise_at_rest=False)
    slam = paper_filter(motion=motion)
    points = scattered(rng, 20, radius=12.0)
    distance, bearing = range_and_bearing(START.mean, points)
    labels = np.arange(20)
    belief = slam.init(START)
    for frame in range(5000):
        belief, _ = slam.predict(belief, np.zeros((4, 2)), np.full(4, STEP))
        hidden = (rng.random(20) < 0.5) & (frame > 0)
        belief = slam.update(
            belief,
            scan_with(
                labels,
                distance=np.where(hidden, np.nan, distance + rng.normal(0, 0.2, 20)),
                bearing=wrap(bearing + rng.normal(0, 0.15, 20)),
            ),
        )
    np.testing.assert_array_equal(belief.covariance, belief.covariance.T)
    assert np.linalg.eigvalsh(belief.covariance)[0] > 0


@pytest.mark.parametrize("scans", [10_000, pytest.param(100_000, marks=pytest.mark.slow)])
def test_standing_vehicle_divides_the_measurement_noise_by_the_number_of_scans(scans):
    """Closed form: P = G P_pose G^T + G_z R G_z^T / n, and the pose gains nothing."""
    d, slam = 5.0, paper_filter()
    belief = slam.init(Gaussian(mean=np.zeros(3), covariance=START.covariance))
    seen = scan_of((1, d, 0.0))
    for _ in range(scans):
        belief = slam.update(belief, seen)
    np.testing.assert_allclose(belief.mean, [0, 0, 0, d, 0], rtol=0, atol=1e-12)
    G = np.array([[1, 0, 0], [0, 1, d]])
    R = np.diag([0.2**2, (d * 0.15) ** 2])
    expected = np.block(
        [
            [START.covariance, START.covariance @ G.T],
            [G @ START.covariance, G @ START.covariance @ G.T + R / scans],
        ]
    )
    # Each update rounds entries of at most 0.05 by 2^-53: n updates drift by 6e-18 n at worst.
    np.testing.assert_allclose(belief.covariance, expected, rtol=0, atol=1e-17 * scans)


# Statistics


def within_chi_square_bounds(nees, freedom, confidence=0.99):
    tails = (1 - confidence) / 2, (1 + confidence) / 2
    low, high = chi2.ppf(tails, freedom * nees.size) / nees.size
    return low < nees.mean() < high


def test_filter_is_consistent_with_the_noise_it_assumes_and_not_with_a_quarter_of_it():
    """NEES of the pose and of the whole state after a hundred drives of ten seconds."""
    missions = [active_mission(run)[1] for run in range(100)]
    for assumed, consistent in ((1.0, True), (0.5, False)):
        slam = paper_filter(motion=STEADY, **{name: assumed * std for name, std in NOISE.items()})
        pose, whole = [], []
        for mission in missions:
            *_, (belief, _) = followed(slam, mission, SURE)
            places = mission.landmarks[belief.landmark - 1].ravel()
            error = belief.mean - np.concatenate([mission.path[-1], places])
            pose.append(nees_of(error[:3], belief.covariance[:3, :3]))
            whole.append(nees_of(error, belief.covariance))
        assert within_chi_square_bounds(np.array(pose), 3) == consistent
        assert within_chi_square_bounds(np.array(whole), 23) == consistent
