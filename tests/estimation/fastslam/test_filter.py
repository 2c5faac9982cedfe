"""The particle filter against its slow reference: the same draws, the same numbers."""

import copy
import itertools
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipistrelle.detection.scans import with_columns
from pipistrelle.estimation.beliefs import Gaussian
from pipistrelle.estimation.motion import Motion
from pipistrelle.estimation.rays import RANGED
from reference.missions import (
    ANY_RAYS,
    CIRCLE,
    START,
    STEP,
    STEPS_PER_FRAME,
    Mission,
    draw_mission,
    followed,
    measured_to,
    ray_config,
    scan_of,
    scattered,
)
from reference.odometry import ANYONE, wandering
from reference.swarms import (
    Drawn,
    arrays_of,
    assert_same,
    members,
    never_resampling,
    particles_of,
    slow_twin,
    small_mission,
    swarm_filter,
    with_particles,
)

CLOSE = {"rtol": 0, "atol": 1e-9}
OPTIONS = list(
    itertools.product(
        ("fused",),
        ("instantaneous", "aggregated"),
        ("anew", "moved", "bearing"),
        ("federated", "exact"),
        (1.0, 3.0),
        (1.0,),
    )
)
FEW = [
    ("active", "instantaneous", "anew", "federated", 1.0, 0.999),
    ("fused", "instantaneous", "anew", "federated", 2.0, 1.0),
    ("fused", "aggregated", "moved", "exact", 3.0, 0.999),
    ("passive", "instantaneous", "anew", "exact", 1.0, 0.999),
    ("passive", "aggregated", "moved", "federated", 3.0, 1.0),
]


LIKELIHOODS = list(
    itertools.product(("normal", "printed"), ("marginal", "sampled"), ("federated", "exact"))
)
SWARMS = [("marginal", "federated"), ("sampled", "federated"), ("sampled", "exact")]


def assert_same_particles(belief, particles):
    """Poses, covariances, log weights and every member of every landmark."""
    np.testing.assert_allclose(belief.cloud(), [p.pose for p in particles], **CLOSE)
    np.testing.assert_allclose(particles_of(belief).covariance, [p.P for p in particles], **CLOSE)
    log_weight = [p.log_weight for p in particles]
    np.testing.assert_allclose(np.exp(belief.log_weight), np.exp(log_weight), **CLOSE)
    # Far in the tail a log weight is a sum of large terms: compare it by its own size.
    np.testing.assert_allclose(belief.log_weight, log_weight, rtol=1e-9, atol=1e-9)
    for number, p in enumerate(particles):
        assert list(p.map) == belief.landmark.tolist()
        for label, expected in p.map.items():
            rows = [(*m.mean, *m.covariance[[0, 0, 1], [0, 1, 1]], m.weight) for m in expected]
            found = members(belief, number, label)
            assert len(found) == len(rows)
            np.testing.assert_allclose(found, rows, **CLOSE)


def assert_best_is_a_heaviest(belief, particles):
    """The best map is that of a particle that no other outweighs, but for rounding."""
    heaviest = max(p.log_weight for p in particles)
    rows = np.column_stack([belief.landmarks().mean, belief.landmarks().weight])
    assert any(
        rows.shape == expected.shape and np.allclose(rows, expected, **CLOSE)
        for p in particles
        if p.log_weight > heaviest - 1e-9
        for expected in [np.array([(*m.mean, m.weight) for ms in p.map.values() for m in ms])]
    )


def assert_equal_to_reference(slam, mission, start=START):
    """Every frame of the two filters agrees, before resampling and after."""
    slow, belief = slow_twin(slam, start), slam.init(start)
    rng, other = np.random.default_rng(1), np.random.default_rng(1)
    for controls, dt, scan in zip(mission.controls, mission.dt, mission.scans, strict=True):
        belief, poses = slam.predict(belief, controls, dt, rng)
        means, covariances = slow.predict(controls, dt)
        np.testing.assert_allclose(poses.mean, means, **CLOSE)
        np.testing.assert_allclose(poses.covariance, covariances, **CLOSE)
        before = never_resampling(slam).update(belief, scan, copy.deepcopy(rng))
        belief = slam.update(belief, scan, rng)
        slow.update(scan, other)
        assert belief.gated == slow.gated
        if scan.landmark.size:
            assert_same_particles(before, slow.before)
            assert_best_is_a_heaviest(belief, slow.before)
            np.testing.assert_allclose(belief.pose().mean, slow.estimated[0], **CLOSE)
            np.testing.assert_allclose(belief.pose().covariance, slow.estimated[1], **CLOSE)
            full = [sum(len(ms) == 1 for ms in p.map.values()) for p in slow.before]
            weights = np.exp([p.log_weight for p in slow.before])
            np.testing.assert_allclose(belief.full, weights @ full, **CLOSE)
        assert_same_particles(belief, slow.particles)
    return belief, slow


def assert_equal_whole_run(mission, particles, weights, ranged, mixture, power, gate):
    rays = ray_config(weights=weights, range_update=ranged, exponent=power)
    slam = swarm_filter(particles, mixture, rays=rays, gate=gate)
    belief, slow = assert_equal_to_reference(slam, mission)
    assert slow.resampled > 2
    assert belief.landmark.size > 8
    assert (belief.gated > 0) == (gate < 1)


@pytest.mark.parametrize(("strategy", "weights", "ranged", "mixture", "power", "gate"), FEW[::2])
def test_run_equals_the_slow_reference(strategy, weights, ranged, mixture, power, gate):
    mission = small_mission(strategy, frames=32, outliers=0.04)
    assert_equal_whole_run(mission, 5, weights, ranged, mixture, power, gate)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("strategy", "weights", "ranged", "mixture", "power", "gate"), [*OPTIONS, *FEW]
)
def test_whole_run_equals_the_slow_reference_with_every_option(
    strategy, weights, ranged, mixture, power, gate
):
    mission = small_mission(strategy, outliers=0.02)
    assert_equal_whole_run(mission, 20, weights, ranged, mixture, power, gate)


def test_rays_that_restart_at_resampling_equal_the_slow_reference():
    known = {"resampled_rays": "restart", "resample_below": 1.0}
    slam = swarm_filter(5, **known, rays=ray_config(exponent=2.0))
    _, slow = assert_equal_to_reference(slam, small_mission("fused", frames=16))
    assert slow.resampled > 2


@pytest.mark.parametrize(("ranged", "weights"), [("anew", "marginal"), ("bearing", "sampled")])
def test_particles_that_rays_do_not_weigh_equal_the_slow_reference(ranged, weights):
    rays = ray_config(exponent=2.0, range_update=ranged)
    slam = swarm_filter(5, weights=weights, weighed_by="initialised", rays=rays)
    _, slow = assert_equal_to_reference(slam, small_mission("fused", frames=16))
    assert slow.resampled > 0


@pytest.mark.parametrize(
    ("ranged", "weights", "mixture"),
    [
        pytest.param(ranged, *swarm, marks=[] if (i - j) % 3 == 0 else pytest.mark.slow)
        for i, ranged in enumerate(ranged for ranged in RANGED if ranged != "anew")
        for j, swarm in enumerate(SWARMS)
    ],
)
def test_every_range_for_a_ray_equals_the_slow_reference(ranged, weights, mixture):
    rays = ray_config(exponent=2.0, range_update=ranged)
    slam = swarm_filter(4, mixture, weights=weights, rays=rays)
    assert_equal_to_reference(slam, small_mission("fused", frames=8))


@pytest.mark.parametrize(
    ("frames", "likelihood", "weights", "mixture"),
    [
        (10, "normal", "marginal", "exact"),
        (10, "normal", "sampled", "federated"),
        (10, "printed", "marginal", "federated"),
        (10, "printed", "sampled", "exact"),
        *(pytest.param(32, *options, marks=pytest.mark.slow) for options in LIKELIHOODS),
    ],
)
def test_every_weight_with_every_likelihood_equals_the_slow_reference(
    frames, likelihood, weights, mixture
):
    rays = ray_config(exponent=2.0, likelihood=likelihood)
    slam = swarm_filter(5, mixture, weights=weights, rays=rays)
    assert_equal_to_reference(slam, small_mission("fused", frames=frames))


@settings(max_examples=8)
@given(
    ANY_RAYS,
    st.integers(0, 2**32),
    st.sampled_from([0.9, 1.0]),
    st.sampled_from(["federated", "exact"]),
    st.floats(0, 1),
)
def test_short_runs_equal_the_slow_reference_with_any_ray(
    rays, seed, gate, mixture, resample_below
):
    mission = small_mission(
        "fused", frames=8, seed=seed, landmarks=6, beamwidth=0.5, hearing=10.0, bearing_std=0.15
    )
    slam = swarm_filter(3, mixture, resample_below, rays=rays, gate=gate)
    assert_equal_to_reference(slam, mission)


def test_unicycle_that_stops_reverses_and_turns_past_pi_equals_the_slow_reference():
    rng = np.random.default_rng(8)
    motion = Motion(model="unicycle", control_std=(0.1, 0.15), noise_at_rest=False)
    controls = rng.uniform([-0.5, -1], [1, 1], size=(30, 4, 2))
    controls[rng.random(controls.shape[:2]) < 0.3] = 0
    controls[rng.random(controls.shape[0]) < 0.3] = 0
    controls[0] = 0
    start = Gaussian(mean=np.array([0, 0, np.pi - 0.01]), covariance=START.covariance)
    field = scattered(rng, 10, radius=10.0)
    mission = draw_mission(rng, motion, start, field, controls[:20], beamwidth=2.0, hearing=10.0)
    assert_equal_to_reference(swarm_filter(5, motion=motion), mission, start)


@pytest.mark.parametrize("stated", [True, False])
def test_a_drive_by_poses_equals_the_slow_reference(stated):
    rng = np.random.default_rng(8)
    motion = replace(ANYONE, noise_at_rest=stated)
    controls = wandering(rng, 20 * 4, stated=stated).reshape(20, 4, -1)
    start = Gaussian(mean=np.array([0, 0, np.pi - 0.01]), covariance=START.covariance)
    field = scattered(rng, 10, radius=10.0)
    mission = draw_mission(rng, motion, start, field, controls, beamwidth=2.0, hearing=10.0)
    assert_equal_to_reference(swarm_filter(5, motion=motion), mission, start)


@pytest.mark.parametrize("weights", ["marginal", "sampled"])
def test_one_control_step_per_measurement_equals_the_slow_reference(weights):
    """The covariance of the pose has rank 2, and its last pivot is rounding: no noise."""
    mission = small_mission("fused", frames=12)
    single = Mission(
        path=mission.path,
        controls=np.tile(CIRCLE, (12, 1, 1)),
        dt=np.full((12, 1), STEPS_PER_FRAME * STEP),
        landmarks=mission.landmarks,
        scans=mission.scans,
    )
    assert_equal_to_reference(swarm_filter(5, weights=weights), single)


def test_frames_without_measurements_equal_the_slow_reference():
    mission = small_mission("fused", frames=14)
    for frame in (0, 1, 5, 6, 7, 12):
        mission.scans[frame] = scan_of()
    assert_equal_to_reference(swarm_filter(5), mission)


# The order of the particles


def permuted(belief, order):
    particles = particles_of(belief)
    names = ("mean", "covariance", "log_weight", "count", "member")
    return with_particles(belief, **{name: getattr(particles, name)[order] for name in names})


@pytest.mark.parametrize("mixture", ["federated", "exact"])
def test_permuting_particles_with_their_draws_permutes_the_weights_exactly(mixture):
    slam = never_resampling(swarm_filter(50, mixture))
    mission, rng = small_mission("fused", frames=30), np.random.default_rng(4)
    *_, (belief, _) = followed(
        swarm_filter(50, mixture), small_mission("fused", frames=10), START, rng
    )
    order = rng.permutation(50)
    other = permuted(belief, order)
    for frame in range(10, 30):
        belief, _ = slam.predict(belief, mission.controls[frame], mission.dt[frame])
        other, _ = slam.predict(other, mission.controls[frame], mission.dt[frame])
        normal, uniform = rng.standard_normal((50, 3)), rng.random(50)
        belief = slam.update(belief, mission.scans[frame], Drawn(normal, uniform))
        other = slam.update(other, mission.scans[frame], Drawn(normal[order], uniform[order]))
        expected = permuted(belief, order)
        for mine, yours in zip(arrays_of(other)[:7], arrays_of(expected)[:7], strict=True):
            np.testing.assert_array_equal(mine, yours)
    assert np.ptp(belief.log_weight) > 1


def test_update_draws_three_normals_and_a_uniform_number_per_particle_where_it_hears_something():
    slam, belief = swarm_filter(7), None
    for scan in (scan_of(), scan_of((1, 4.0, 0.3)), scan_of((1, 4.0, 0.3), (2, np.nan, 1.0))):
        rng, other = np.random.default_rng(5), np.random.default_rng(5)
        belief = slam.update(belief or slam.init(START), scan, rng)
        if scan.landmark.size:
            other.standard_normal((7, 3))
            other.random(7)
        assert rng.bit_generator.state == other.bit_generator.state


@pytest.mark.parametrize("gate", [1.0, 0.999])
def test_a_scan_with_excess_paths_is_used_without_them(gate):
    slam, mission = swarm_filter(gate=gate), small_mission("fused", frames=8)
    plain, timed = slam.init(START), slam.init(START)
    for k, scan in enumerate(mission.scans):
        excess_path = np.where(np.isnan(scan.range), 4.0 + 0.1 * scan.landmark, np.nan)
        scan = measured_to(scan, 0.2, 0.15)
        by_others = with_columns(
            scan, excess_path=excess_path, excess_path_std=0.1, caller=np.isnan(scan.range) * 1
        )
        plain = slam.update(plain, scan, np.random.default_rng(k))
        timed = slam.update(timed, by_others, np.random.default_rng(k))
        assert_same(plain, timed)
    assert np.isfinite(by_others.excess_path).any()
