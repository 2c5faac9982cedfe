"""The filter against closed forms, a Kalman filter, the slow reference and statistics."""

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from reference.ekf_slam import SlowEkfSlam
from reference.missions import (
    BICYCLE,
    CIRCLE,
    START,
    STEP,
    STEPS_PER_FRAME,
    draw_mission,
    scan_of,
    scattered,
    steady,
)
from scipy.stats import chi2

from pipistrelle.config import RayConfig
from pipistrelle.detection.scans import Scan
from pipistrelle.estimation.ekf import EkfSlam
from pipistrelle.estimation.models import Gaussian, Motion, motion_step
from pipistrelle.geometry import range_and_bearing, wrap

SENSING = {
    "active": {"beamwidth": np.pi},
    "fused": {"beamwidth": np.radians(33), "hearing": 18.0},
    "passive": {"beamwidth": 0.0, "hearing": 18.0},
}
OPTIONS = list(
    itertools.product(
        ("fused", "passive"),
        ("instantaneous", "aggregated"),
        ("reinitialise", "heaviest"),
        (1.0, 3.0),
        (1.0, 0.999),
    )
)
FEW = [
    ("active", "instantaneous", "reinitialise", 1.0, 0.999),
    ("fused", "instantaneous", "reinitialise", 1.0, 1.0),
    ("fused", "aggregated", "heaviest", 3.0, 0.999),
    ("passive", "instantaneous", "reinitialise", 3.0, 0.999),
]
FIELDS = ("mean", "covariance", "landmark", "weight")


def paper_filter(**changes):
    known = {"motion": BICYCLE, "range_std": 0.2, "bearing_std": 0.15, "rays": RayConfig()}
    return EkfSlam(**(known | changes))


def mission_of(strategy, frames=375, seed=3, **changes):
    rng = np.random.default_rng(seed)
    field = scattered(rng, 50)
    known = SENSING[strategy] | changes
    return draw_mission(rng, BICYCLE, START, field, steady(CIRCLE, frames), **known)


def followed(slam, mission, start=START):
    """Beliefs and poses frame by frame."""
    belief = slam.init(start)
    for controls, dt, scan in zip(mission.controls, mission.dt, mission.scans, strict=True):
        belief, poses = slam.predict(belief, controls, dt)
        belief = slam.update(belief, scan)
        yield belief, poses


def assert_equal_to_reference(slam, mission, start=START):
    """Every frame of the two filters agrees to 1e-9; returns the last belief."""
    slow = SlowEkfSlam(slam.motion, slam.range_std, slam.bearing_std, slam.rays, slam.gate)
    slow.start(start.mean, start.covariance)
    for frame, (belief, poses) in enumerate(followed(slam, mission, start)):
        means, covariances = slow.predict(mission.controls[frame], mission.dt[frame])
        slow.update(mission.scans[frame])
        np.testing.assert_allclose(poses.mean, means, rtol=0, atol=1e-9)
        np.testing.assert_allclose(poses.covariance, covariances, rtol=0, atol=1e-9)
        for field in FIELDS:
            np.testing.assert_allclose(
                getattr(belief, field), getattr(slow, field), rtol=0, atol=1e-9, err_msg=field
            )
        assert belief.gated == slow.gated
    return belief


def assert_equal_whole_run(strategy, weights, partial, power, gate):
    slam = paper_filter(rays=RayConfig(weights=weights, partial=partial, power=power), gate=gate)
    mission = mission_of(strategy, outliers=0.02)
    belief = assert_equal_to_reference(slam, mission)
    assert np.unique(belief.landmark).size > 30
    assert (belief.gated > 0) == (gate < 1)


@pytest.mark.parametrize(("strategy", "weights", "partial", "power", "gate"), FEW)
def test_whole_run_equals_the_slow_reference(strategy, weights, partial, power, gate):
    assert_equal_whole_run(strategy, weights, partial, power, gate)


@pytest.mark.slow
@pytest.mark.parametrize(("strategy", "weights", "partial", "power", "gate"), OPTIONS)
def test_whole_run_equals_the_slow_reference_with_every_option(
    strategy, weights, partial, power, gate
):
    assert_equal_whole_run(strategy, weights, partial, power, gate)


def test_unicycle_that_stops_turns_and_reverses_equals_the_slow_reference():
    rng = np.random.default_rng(8)
    motion = Motion(model="unicycle", control_std=(0.1, 0.15), noise_at_rest=False)
    controls = rng.uniform([-0.5, -1], [1, 1], size=(60, STEPS_PER_FRAME, 2))
    controls[rng.random(controls.shape[:2]) < 0.3] = 0
    controls[rng.random(controls.shape[:2]) < 0.2, 1] = 0
    field = scattered(rng, 20, radius=10.0)
    mission = draw_mission(rng, motion, START, field, controls, beamwidth=2.0, hearing=10.0)
    assert_equal_to_reference(paper_filter(motion=motion), mission)


def test_correspondence_carried_in_the_state_changes_nothing():
    mission = mission_of("fused", frames=100)
    without, carried = (
        SlowEkfSlam(BICYCLE, 0.2, 0.15, RayConfig(), carry_correspondence=carry).start(
            START.mean, START.covariance
        )
        for carry in (False, True)
    )
    for controls, dt, scan in zip(mission.controls, mission.dt, mission.scans, strict=True):
        for slow in (without, carried):
            slow.predict(controls, dt)
            slow.update(scan)
        for field in FIELDS:
            np.testing.assert_allclose(
                getattr(carried, field), getattr(without, field), rtol=0, atol=1e-9
            )
    assert carried.X.size == without.X.size + np.unique(carried.landmark).size


# Kalman filter


def test_drive_along_an_axis_with_known_heading_equals_a_plain_kalman_filter():
    """Range is linear for landmarks ahead and behind; y and heading are known and stay apart."""
    rng = np.random.default_rng(1)
    motion = Motion(model="bicycle", control_std=(0.1, 0.0), wheelbase=0.2)
    slam = paper_filter(motion=motion)
    start = Gaussian(mean=np.zeros(3), covariance=np.diag([0.3**2, 0, 0]))
    ahead = np.array([1.0, 1.0, -1.0])
    truth = np.array([rng.normal(0, 0.3), 30.0, 50.0, -8.0])
    x, P = np.zeros(1), np.array([[0.3**2]])
    belief = slam.init(start)
    for frame in range(40):
        controls, dt = steady((0.8, 0.0), 1)[0], np.full(STEPS_PER_FRAME, STEP)
        truth[0] += np.sum((0.8 + rng.normal(0, 0.1, STEPS_PER_FRAME)) * STEP)
        x[0] += 0.8 * STEPS_PER_FRAME * STEP
        P[0, 0] += STEPS_PER_FRAME * (0.1 * STEP) ** 2
        z = np.abs(truth[1:] - truth[0]) + rng.normal(0, 0.2, 3)
        if frame == 0:
            x = np.concatenate([x, x[0] + ahead * z])
            P = np.full((4, 4), P[0, 0]) + np.diag([0, *[0.2**2] * 3])
        else:
            H = np.column_stack([-ahead, np.diag(ahead)])
            K = P @ H.T @ np.linalg.inv(H @ P @ H.T + 0.2**2 * np.eye(3))
            x, P = x + K @ (z - H @ x), P - K @ H @ P
        belief, _ = slam.predict(belief, controls, dt)
        bearings = np.where(ahead > 0, 0, -np.pi)
        belief = slam.update(belief, scan_of(*zip((1, 2, 3), z, bearings, strict=True)))
        along = [0, 3, 5, 7]
        np.testing.assert_allclose(belief.mean[along], x, rtol=0, atol=1e-11)
        np.testing.assert_allclose(belief.covariance[np.ix_(along, along)], P, rtol=0, atol=1e-13)


def linearised_kalman_error(scale):
    """Largest departure of the filter from a Kalman filter about the truth, in noise units."""
    rng = np.random.default_rng(5)
    motion = Motion(model="bicycle", control_std=(0.1 * scale, 0.03 * scale), wheelbase=0.2)
    std = scale * np.array([0.2, 0.15])
    P = scale**2 * START.covariance
    slam = paper_filter(motion=motion, range_std=std[0], bearing_std=std[1])
    belief = slam.init(Gaussian(mean=START.mean, covariance=P))
    points = np.array([[4.0, -4.0], [-3.0, -9.0], [6.0, -12.0]])
    nominal, dx = np.array(START.mean), np.zeros(3)
    true = nominal + scale * rng.normal(size=3) * [0.05, 0.05, 0.0436]
    worst = 0.0
    for frame in range(12):
        control = np.array([0.75, 0.2])
        by_pose = jacobian(lambda x: motion_step(motion, x, control, STEP), nominal)  # noqa: B023
        by_control = jacobian(lambda u: motion_step(motion, nominal, u, STEP), control)  # noqa: B023
        F, U = np.eye(dx.size), np.zeros((dx.size, 2))
        F[:3, :3], U[:3] = by_pose, by_control
        dx, P = F @ dx, F @ P @ F.T + U @ np.diag(np.square(motion.control_std)) @ U.T
        noisy = control + rng.normal(size=2) * motion.control_std
        true = motion_step(motion, true, noisy, STEP)
        nominal = motion_step(motion, nominal, control, STEP)
        z = np.column_stack(range_and_bearing(true, points)) + std * rng.normal(size=(3, 2))
        expected = np.column_stack(range_and_bearing(nominal, points))
        seen = scan_of(*((i + 1, z[i, 0] if frame % 2 == 0 else np.nan, z[i, 1]) for i in range(3)))
        belief, _ = slam.predict(belief, control[None], np.array([STEP]))
        belief = slam.update(belief, seen)
        dx, P = kalman_frame(dx, P, nominal, points, z - expected, std, active=frame % 2 == 0)
        ekf = belief.mean - np.concatenate([nominal, points.ravel()])
        worst = max(worst, np.abs(ekf - dx).max() / scale)
        worst = max(worst, np.abs(belief.covariance - P).max() / scale**2)
    return worst


def jacobian(function, at, step=1e-5):
    """Central differences."""
    units = step * np.eye(at.size)
    return np.array([(function(at + u) - function(at - u)) / (2 * step) for u in units]).T


def kalman_frame(dx, P, nominal, points, dz, std, *, active):
    """One frame of a Kalman filter on departures from the truth; the first adds the landmarks."""

    def measured(state):
        return np.concatenate(
            [
                np.column_stack(range_and_bearing(state[:3], p[None]))[0]
                for p in state[3:].reshape(-1, 2)
            ]
        )

    state = np.concatenate([nominal, points.ravel()])
    H = jacobian(measured, state)
    R = np.diag(np.tile(std**2, len(points)))
    if dx.size == 3:
        backward = np.linalg.inv(H[:, 3:])
        grow = np.vstack([np.eye(3), -backward @ H[:, :3]])
        dx = grow @ dx
        dx[3:] += backward @ dz.ravel()
        P = grow @ P @ grow.T
        P[3:, 3:] += backward @ R @ backward.T
        return dx, P
    rows = np.arange(dz.size) if active else np.arange(1, dz.size, 2)
    H, R, dz = H[rows], R[np.ix_(rows, rows)], dz.ravel()[rows]
    K = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
    return dx + K @ (dz - H @ dx), P - K @ H @ P


def test_filter_tends_to_a_linear_kalman_filter_as_the_noise_vanishes():
    coarse, fine = linearised_kalman_error(1e-2), linearised_kalman_error(1e-3)
    assert fine < 1e-2
    assert coarse / fine == pytest.approx(10, rel=0.3)


# Covariance


@pytest.mark.parametrize("strategy", SENSING)
def test_covariance_is_symmetric_and_positive_through_a_whole_mission(strategy):
    for frame, (belief, _) in enumerate(followed(paper_filter(), mission_of(strategy))):
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
            Scan(
                time=0.0,
                landmark=labels,
                range=np.where(hidden, np.nan, distance + rng.normal(0, 0.2, 20)),
                bearing=wrap(bearing + rng.normal(0, 0.15, 20)),
            ),
        )
    np.testing.assert_array_equal(belief.covariance, belief.covariance.T)
    assert np.linalg.eigvalsh(belief.covariance)[0] > 0
    error = belief.mean[3:].reshape(-1, 2) - points
    assert np.abs(error).max() < 0.5


def test_standing_vehicle_divides_the_measurement_noise_by_the_number_of_scans():
    """Closed form: P = G P_pose G^T + G_z R G_z^T / n, and the pose gains nothing."""
    d, scans = 5.0, 100_000
    slam = paper_filter()
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
    # Each update rounds entries of at most 0.05 by 2^-53: 1e5 updates drift by 6e-13 at worst.
    np.testing.assert_allclose(belief.covariance, expected, rtol=0, atol=1e-12)


# Statistics


def final_nees(assumed, runs=100):
    """NEES of the pose and of the whole state after ten seconds of active sensing, (runs, 2)."""
    motion = Motion(model="bicycle", control_std=(0.05, 0.005), wheelbase=0.2)
    start = Gaussian(mean=START.mean, covariance=np.diag([0.02**2, 0.02**2, 0.01**2]))
    true = {"range_std": 0.05, "bearing_std": 0.01}
    slam = paper_filter(motion=motion, **{name: assumed * std for name, std in true.items()})
    values = []
    for run in range(runs):
        rng = np.random.default_rng([11, run])
        mission = draw_mission(
            rng, motion, start, scattered(rng, 10, radius=12.0), steady(CIRCLE, 20),
            beamwidth=7.0, reach=40.0, **true,
        )  # fmt: skip
        *_, (belief, _) = followed(slam, mission, start)
        truth = np.concatenate([mission.path[-1], mission.landmarks[belief.landmark - 1].ravel()])
        error = belief.mean - truth
        error[2] = wrap(error[2])
        values.append(
            [
                part @ np.linalg.solve(belief.covariance[: part.size, : part.size], part)
                for part in (error[:3], error)
            ]
        )
    return np.array(values)


def within_chi_square_bounds(nees, freedom, confidence=0.99):
    tails = (1 - confidence) / 2, (1 + confidence) / 2
    low, high = chi2.ppf(tails, freedom * nees.size) / nees.size
    return low < nees.mean() < high


def test_filter_is_consistent_with_the_noise_it_assumes_and_not_with_a_quarter_of_it():
    nees = final_nees(assumed=1.0)
    assert within_chi_square_bounds(nees[:, 0], 3)
    assert within_chi_square_bounds(nees[:, 1], 23)
    overconfident = final_nees(assumed=0.5)
    assert not within_chi_square_bounds(overconfident[:, 0], 3)
    assert not within_chi_square_bounds(overconfident[:, 1], 23)


# Laws


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
    slam, mission = paper_filter(), mission_of("fused", frames=12)
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


def test_labels_are_only_names():
    mission, slam = mission_of("fused", frames=30), paper_filter()
    belief, renamed = slam.init(START), slam.init(START)
    for controls, dt, scan in zip(mission.controls, mission.dt, mission.scans, strict=True):
        other = Scan(
            time=scan.time, landmark=1000 - scan.landmark, range=scan.range, bearing=scan.bearing
        )
        belief = slam.update(slam.predict(belief, controls, dt)[0], scan)
        renamed = slam.update(slam.predict(renamed, controls, dt)[0], other)
    np.testing.assert_array_equal(renamed.landmark, 1000 - belief.landmark)
    np.testing.assert_array_equal(renamed.mean, belief.mean)
    np.testing.assert_array_equal(renamed.covariance, belief.covariance)


def test_beliefs_given_are_never_changed():
    seen = []
    for belief, poses in followed(paper_filter(), mission_of("fused", frames=60)):
        arrays = [getattr(belief, field) for field in FIELDS] + [poses.mean, poses.covariance]
        seen.append((arrays, [array.copy() for array in arrays]))
        belief.pose().mean[:] = np.nan
        belief.landmarks().mean[:] = np.nan
        belief.landmarks().weight[:] = np.nan
    for arrays, copies in seen:
        for array, copy in zip(arrays, copies, strict=True):
            np.testing.assert_array_equal(array, copy)
    assert START.mean.tolist() == [0.0, -7.408, 0.0]


def test_a_belief_kept_aside_continues_to_the_same_bits():
    mission, slam = mission_of("fused", frames=40), paper_filter()
    beliefs = [belief for belief, _ in followed(slam, mission)]
    for frame in (25, 10):
        belief = beliefs[frame]
        for later in range(frame + 1, 40):
            belief, _ = slam.predict(belief, mission.controls[later], mission.dt[later])
            belief = slam.update(belief, mission.scans[later])
        for field in FIELDS:
            np.testing.assert_array_equal(getattr(belief, field), getattr(beliefs[-1], field))


def test_order_of_frames_matters_and_each_frame_is_corrected_where_it_was_heard():
    mission, slam = mission_of("active", frames=30), paper_filter()
    *_, (straight, _) = followed(slam, mission)
    error = np.hypot(*(straight.mean[:2] - mission.path[-1, :2]))
    mission.scans.reverse()
    *_, (reversed_, _) = followed(slam, mission)
    assert error < 3 * np.sqrt(np.trace(straight.covariance[:2, :2]))
    assert np.hypot(*(reversed_.mean[:2] - mission.path[-1, :2])) > 5 * error


def test_steps_of_a_frame_are_the_steps_one_by_one():
    slam, mission = paper_filter(), mission_of("fused", frames=20)
    *_, (belief, _) = followed(slam, mission)
    together, poses = slam.predict(belief, mission.controls[0], mission.dt[0])
    for k in range(STEPS_PER_FRAME):
        belief, pose = slam.predict(
            belief, mission.controls[0, k : k + 1], mission.dt[0, k : k + 1]
        )
        np.testing.assert_allclose(pose.mean[0], poses.mean[k], atol=1e-14)
        np.testing.assert_allclose(pose.covariance[0], poses.covariance[k], atol=1e-15)
    np.testing.assert_allclose(belief.covariance, together.covariance, atol=1e-14)
