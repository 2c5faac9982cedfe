"""What a vehicle does not know of itself: against dense normal equations, and found from drives."""

from dataclasses import replace

import numpy as np
import pytest

from pipistrelle.config import PARAMETERS, Config, FilterConfig, InputError, PriorConfig
from pipistrelle.detection.scans import with_columns
from pipistrelle.estimation.beliefs import Gaussian
from pipistrelle.estimation.motion import Motion, motion_step
from pipistrelle.estimation.smoother.filter import Smoother
from pipistrelle.estimation.smoother.history import in_hindsight
from pipistrelle.estimation.smoother.preintegration import (
    NOTHING,
    calibration_of,
    extended,
    no_odometry,
)
from pipistrelle.estimation.smoother.sweep import converged, relinearised, smoothed
from pipistrelle.geometry import range_and_bearing, wrap
from reference import dense_smoothing
from reference.missions import (
    BICYCLE,
    CIRCLE,
    SENSING,
    START,
    draw_mission,
    followed,
    measured_to,
    paper_mission,
    ray_config,
    scattered,
    steady,
)
from reference.odometry import by_poses
from reference.timing import timed

STILL = replace(BICYCLE, noise_at_rest=False)
MOTIONS = [BICYCLE, Motion(model="unicycle", control_std=(0.1, 0.1)), by_poses(BICYCLE)]


def asking(*names, motion=BICYCLE, **stds):
    """A calibration of parameters."""
    config = Config(filter=FilterConfig(calibrate=names), prior=PriorConfig(**stds))
    return calibration_of(config, motion)


def smoother(*names, motion=BICYCLE, **changes):
    return Smoother(
        motion=motion, rays=ray_config(), calibration=asking(*names, motion=motion), **changes
    )


def mission_of(strategy, seed=4, frames=30, callers=(13, 45), std=1.0, controls=None):
    """A drive with excess paths, and bearings that lean with the speed of sound."""
    rng, stds = np.random.default_rng(seed), {"range_std": 0.05 * std, "bearing_std": 0.01 * std}
    controls = steady(CIRCLE, frames) if controls is None else controls
    mission = draw_mission(
        rng, BICYCLE, START, scattered(rng, 50), controls, **SENSING[strategy], **stds
    )
    mission = replace(mission, scans=[measured_to(scan, **stds) for scan in mission.scans])
    if callers:
        mission = timed(mission, callers, rng, std=0.05 * std)
    scans = [
        with_columns(scan, bearing_slope=rng.uniform(-2.0, 2.0, scan.landmark.size))
        for scan in mission.scans
    ]
    return replace(mission, scans=scans)


@pytest.mark.parametrize(
    ("strategy", "names"),
    [
        *((strategy, PARAMETERS) for strategy in SENSING),
        *(("fused", (name,)) for name in PARAMETERS),
        *(
            pytest.param(strategy, names, marks=pytest.mark.slow)
            for strategy in SENSING
            for names in (("speed_scale", "speed_of_sound"), *((name,) for name in PARAMETERS))
            if (strategy, len(names)) != ("fused", 1)
        ),
    ],
    ids=str,
)
def test_the_optimum_matches_dense_normal_equations(strategy, names):
    slam = smoother(*names)
    *_, (belief, _) = followed(slam, mission_of(strategy, frames=8))
    history = in_hindsight(belief.history)
    ours = converged(belief.solution, belief.history, belief.noise)
    for _ in range(30):
        ours = relinearised(ours, history, belief.noise, 0.0)
    poses, places, parameters, cost = dense_smoothing.solved(belief)
    known = smoothed(ours, belief.history)
    off = known.states - poses
    off[:, 2] = wrap(off[:, 2])
    about = np.sqrt(np.diagonal(known.covariance, axis1=1, axis2=2))
    assert np.abs(off / about).max() < 1e-5
    assert ours.cost == pytest.approx(cost, rel=1e-9)
    assert np.abs(known.places - places).max() < 1e-4
    stds = np.sqrt(known.parameter_covariance.diagonal())
    assert np.abs((known.parameters - parameters) / stds).max() < 1e-5
    x = np.concatenate([poses.ravel(), places.ravel(), parameters])
    _, J = dense_smoothing.misfits(belief.history, x)
    expected = np.linalg.inv(J.T @ J)[-stds.size :, -stds.size :]
    np.testing.assert_allclose(known.parameter_covariance, expected, rtol=1e-4, atol=1e-12)


@pytest.mark.parametrize("motion", MOTIONS, ids=lambda motion: motion.model)
def test_slopes_of_a_leg_match_finite_differences(motion):
    """By differences of steps that are led otherwise."""
    names = [name for name in PARAMETERS[:3] if name != "wheelbase" or motion is BICYCLE]
    codes = asking(*names, motion=motion).odometry
    controls, dt = np.tile([0.7, 0.3, 0.2][: len(motion.control_std)], (5, 1)), np.full(5, 0.3)
    slopes = extended(no_odometry(codes.size), motion, controls, dt, codes).slopes[-1]

    def led(name, size):
        other, steered = motion, controls.copy()
        if name == "speed_scale":
            steered[:, : 2 if motion.model == "poses" else 1] *= 1.0 + size
        elif name == "turn_bias":
            steered[:, -1] += size * (0.3 if motion.model == "poses" else 1.0)
        else:
            other = replace(motion, wheelbase=motion.wheelbase * (1.0 + size))
        pose = np.zeros(3)
        for control in steered:
            pose = motion_step(other, pose, control, 0.3)
        return pose

    for e, name in enumerate(names):
        expected = (led(name, 1e-6) - led(name, -1e-6)) / 2e-6
        np.testing.assert_allclose(slopes[:, e], expected, rtol=0, atol=1e-7)


@pytest.mark.parametrize("strategy", ["active", "fused"])
def test_the_pose_of_a_turned_sensor_is_calibrated(strategy):
    """Odometry tells where the vehicle heads; an arc tells how far the sensor is from its point."""
    mission = mission_of(strategy, frames=120, std=0.2)
    turned = [with_columns(scan, bearing=wrap(scan.bearing - 0.05)) for scan in mission.scans]
    slam = smoother("sensor_heading", "sensor_place")
    *_, (belief, _) = followed(slam, replace(mission, scans=turned))
    found = belief.calibration()
    value, std = found["sensor_heading"]
    assert abs(value - 0.05) < 3.0 * std
    assert std < 0.02
    for name in ("sensor_place_x", "sensor_place_y"):
        value, std = found[name]
        assert abs(value) < 3.0 * std


def arc(turn):
    """Return what takes a constant velocity to the chord that it leads along, in unit time."""
    s, c = (np.sin(turn) / turn, (1.0 - np.cos(turn)) / turn) if turn else (1.0, 0.0)
    return np.array([[s, -c], [c, s]])


def heard_late(mission, late):
    """Give each frame what was heard so much before its end [s], along the way to it."""
    scans, share = [], late / mission.dt[0].sum()
    for before, here, scan in zip(mission.path, mission.path[1:], mission.scans, strict=False):
        turn = wrap(here[2] - before[2])
        chord = dense_smoothing.turning(-before[2]) @ (here - before)[:2]
        back = here - share * np.array([0.0, 0.0, turn])
        velocity = np.linalg.solve(arc(turn), chord)
        back[:2] -= dense_smoothing.turning(here[2]) @ arc(-share * turn) @ velocity * share
        place = mission.landmarks[scan.landmark - 1]
        (then, turned), (now, seen) = (range_and_bearing(pose, place) for pose in (back, here))
        bearing = wrap(scan.bearing + turned - seen)
        scans.append(with_columns(scan, bearing=bearing, range=scan.range + then - now))
    return replace(mission, scans=scans)


@pytest.mark.parametrize("seed", [1, 2, 3])
@pytest.mark.parametrize("late", [0.12, -0.05])
def test_a_clock_that_is_late_or_early_is_found(late, seed):
    """By a drive now fast, now slow: at one speed, to hear later is to have started elsewhere."""
    controls = steady(CIRCLE, 100)
    controls[:, :, 0] *= np.where(np.arange(100) // 5 % 2, 1.6, 0.4)[:, None]
    drive = mission_of("active", std=0.2, callers=(), controls=controls, seed=seed)
    *_, (belief, _) = followed(smoother("time_offset"), heard_late(drive, late))
    value, std = belief.calibration()["time_offset"]
    assert abs(value - late) < 3.0 * std
    assert std < 0.02


def test_a_vehicle_at_rest_leaves_the_time_offset_at_its_prior():
    mission = mission_of("active", frames=10, callers=())
    still = replace(mission, controls=0.0 * mission.controls)
    *_, (belief, _) = followed(smoother("time_offset", motion=STILL), still)
    value, std = belief.calibration()["time_offset"]
    assert (value, std) == (pytest.approx(0.0, abs=1e-6), pytest.approx(0.1, rel=1e-3))


def test_a_speed_of_sound_is_found_by_odometry_and_by_bearings():
    mission = mission_of("active", frames=100, callers=(), std=0.2)
    scale = 345.0 / 340.0
    heard = [
        with_columns(
            scan,
            range=scan.range / scale,
            bearing=wrap(scan.bearing - scan.bearing_slope * (scale - 1.0)),
        )
        for scan in mission.scans
    ]
    config = Config(
        filter=FilterConfig(calibrate=("speed_of_sound",)), assumed={"speed_of_sound": 340.0}
    )
    slam = replace(smoother(), calibration=calibration_of(config, BICYCLE))
    *_, (belief, _) = followed(slam, replace(mission, scans=heard))
    value, std = belief.calibration()["speed_of_sound"]
    assert abs(value - 345.0) < 3.0 * std
    assert std < 1.5


def test_uninformative_measurements_leave_a_parameter_at_its_prior():
    *_, (belief, _) = followed(smoother("speed_of_sound"), paper_mission("passive", frames=20))
    value, std = belief.calibration()["speed_of_sound"]
    assert (value, std) == (pytest.approx(343.0, abs=0.2), pytest.approx(10.0, rel=1e-3))


def test_predicted_poses_know_that_the_odometry_is_calibrated():
    """With a wide prior of the turn's bias, the heading after a way without a scan is unsure."""
    start = Gaussian(mean=np.zeros(3), covariance=1e-6 * np.eye(3))
    ahead = np.tile([0.75, 0.0], (40, 1)), np.full(40, 0.125)
    slam, plain = smoother("turn_bias"), smoother()
    _, unsure = slam.predict(slam.init(start), *ahead)
    _, sure = plain.predict(plain.init(start), *ahead)
    np.testing.assert_allclose(unsure.mean, sure.mean, rtol=0, atol=1e-12)
    turn = 0.02 * 0.75 / BICYCLE.wheelbase * 5.0  # after 5 s
    more = unsure.covariance[-1, 2, 2] - sure.covariance[-1, 2, 2]
    assert more == pytest.approx(turn**2, rel=1e-6)


def test_steps_after_the_last_scan_use_the_calibrated_parameters():
    """The path goes on from its last node as the belief predicts it, but for other points."""
    long = replace(BICYCLE, wheelbase=0.22)
    slam, mission = smoother("wheelbase", motion=long), mission_of("active", frames=60, std=0.2)
    *_, (belief, _) = followed(slam, mission)
    belief, ahead = slam.predict(belief, *(np.tile([0.75, 0.1], (8, 1)), np.full(8, 0.125)))
    path = belief.path()
    size = len(ahead.mean)
    np.testing.assert_allclose(path.mean[-size:], ahead.mean, rtol=0, atol=2e-3)
    scale = np.abs(ahead.covariance).max()
    np.testing.assert_allclose(path.covariance[-size:], ahead.covariance, rtol=0, atol=0.03 * scale)
    plain = replace(belief.odometry, slopes=0.0 * belief.odometry.slopes)
    assert np.abs(belief.placed(plain, 0).mean - ahead.mean).max() > 5e-3


def test_without_parameters_nothing_is_calibrated():
    *_, (belief, _) = followed(smoother(), paper_mission("fused", frames=5))
    assert belief.calibration() == {}
    assert belief.history.calibration is not None
    assert NOTHING.stds.size == 0


def test_a_wheelbase_of_a_unicycle_is_refused():
    with pytest.raises(InputError, match=r"filter.calibrate: found \"wheelbase\" for a unicycle"):
        asking("wheelbase", motion=MOTIONS[1])
