"""What every estimator promises: one class of tests, met by each filter.

A new filter joins with four lines: a subclass of `EstimatorContract` whose fixture returns it.
"""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from pipistrelle.config import Config, FastSlamConfig
from pipistrelle.detection.scans import Scan, with_columns
from pipistrelle.estimation.beliefs import Gaussian, Landmarks
from pipistrelle.estimation.catalogue import entry
from pipistrelle.estimation.ekf.filter import EkfSlam, InvariantEkfSlam
from pipistrelle.estimation.fastslam.filter import FastSlam
from pipistrelle.estimation.motion import Motion, motion_jacobians, motion_noise, motion_step
from pipistrelle.estimation.smoother.filter import Smoother
from pipistrelle.experiments.drives import Drive
from pipistrelle.experiments.runs.trial import run_filter
from pipistrelle.geometry import wrap
from reference.missions import (
    BICYCLE,
    CIRCLE,
    SENSING,
    START,
    STEP,
    STEPS_PER_FRAME,
    draw_mission,
    map_with,
    measured_to,
    ray_config,
    scan_of,
    scattered,
    steady,
)
from reference.odometry import as_poses

CONTROLS, DT = np.tile(CIRCLE, (STEPS_PER_FRAME, 1)), np.full(STEPS_PER_FRAME, STEP)
SHARP = {"range_std": 0.05, "bearing_std": 0.02}
FIRST = scan_of((3, 5.0, 0.3), (8, np.nan, 1.0), (1, 2.0, -3.1))
SECOND = scan_of((8, np.nan, 1.1), (3, 4.8, 0.35), (5, np.nan, -0.5), (1, np.nan, 3.1))
THIRD = scan_of((5, 6.0, -0.6), (1, 2.2, 3.0))


def rng():
    return np.random.default_rng(11)


def small_world(seed, strategy="fused", frames=60, start=START):
    """A drive and its scans as a filter is given them, and the true poses at the scans."""
    generator = np.random.default_rng(seed)
    field = scattered(generator, 30, radius=16.0)
    around = field[np.hypot(*field.T) > 11.0]  # The drive is a circle of radius 7.4 m.
    mission = draw_mission(
        generator, BICYCLE, start, around, steady(CIRCLE, frames), **SENSING[strategy], **SHARP
    )
    drive = Drive(
        motion=BICYCLE,
        start=start,
        time=STEP * np.arange(1 + frames * STEPS_PER_FRAME),
        controls=mission.controls.reshape(-1, 2),
    )
    return drive, mission.scans, mission.path


def seen_from_outside(belief):
    """Everything that a belief answers, copied."""
    rows, pose = belief.landmarks(), belief.pose()
    arrays = (pose.mean, pose.covariance, rows.landmark, rows.mean, rows.covariance, rows.weight)
    return [np.copy(array) for array in arrays] + [np.array(belief.gated)]


def assert_same(belief, answers):
    for now, before in zip(seen_from_outside(belief), answers, strict=True):
        np.testing.assert_array_equal(now, before)


def assert_gaussian(gaussian, shape):
    """Finite float64 of a shape, heading wrapped, covariance symmetric and positive."""
    assert gaussian.mean.shape == shape
    assert gaussian.covariance.shape == (*shape, shape[-1])
    assert gaussian.mean.dtype == gaussian.covariance.dtype == np.float64
    assert np.isfinite(gaussian.mean).all()
    assert np.isfinite(gaussian.covariance).all()
    if shape[-1] == 3:
        assert ((gaussian.mean[..., 2] >= -np.pi) & (gaussian.mean[..., 2] < np.pi)).all()
    swapped = np.swapaxes(gaussian.covariance, -1, -2)
    np.testing.assert_array_equal(gaussian.covariance, swapped)
    least = np.linalg.eigvalsh(gaussian.covariance)[..., 0]
    assert (least >= -1e-14).all()


def assert_map(rows, known):
    """One row per hypothesis of landmarks that were heard, weights summing to one over each."""
    assert rows.landmark.dtype == np.int64
    assert rows.weight.dtype == np.float64
    assert set(rows.landmark.tolist()) <= set(known)
    assert rows.weight.shape == rows.landmark.shape
    assert_gaussian(Gaussian(mean=rows.mean, covariance=rows.covariance), (*rows.weight.shape, 2))
    assert (rows.weight >= 0).all()
    for label in set(rows.landmark.tolist()):
        assert rows.weight[rows.landmark == label].sum() == pytest.approx(1, abs=1e-12)


class EstimatorContract:
    """Subclass it with a fixture `slam` that returns the filter to test."""

    def heard(self, slam, *scans, first=FIRST):
        """The belief after some frames, each a drive and a scan."""
        belief, generator = slam.update(slam.init(START), first, rng()), rng()
        for scan in scans:
            belief, _ = slam.predict(belief, CONTROLS, DT, generator)
            belief = slam.update(belief, scan, generator)
        return belief

    def test_init_knows_the_pose_and_no_landmark(self, slam):
        belief = slam.init(START)
        np.testing.assert_allclose(belief.pose().mean, START.mean, rtol=0, atol=1e-9)
        np.testing.assert_allclose(belief.pose().covariance, START.covariance, rtol=0, atol=1e-9)
        assert belief.landmarks().landmark.size == belief.gated == 0
        assert_map(belief.landmarks(), ())

    def test_poses_have_a_row_per_step_and_the_last_is_the_beliefs(self, slam):
        belief, poses = slam.predict(self.heard(slam, SECOND), CONTROLS, DT, rng())
        assert_gaussian(poses, (STEPS_PER_FRAME, 3))
        assert_gaussian(belief.pose(), (3,))
        np.testing.assert_array_equal(poses.mean[-1], belief.pose().mean)
        np.testing.assert_array_equal(poses.covariance[-1], belief.pose().covariance)

    def test_map_contains_the_landmarks_of_the_scans(self, slam):
        for scans, known in (
            ((), (3, 8, 1)),
            ((SECOND,), (3, 8, 1, 5)),
            ((SECOND, THIRD), (3, 8, 1, 5)),
        ):
            belief = self.heard(slam, *scans)
            assert_map(belief.landmarks(), known)
            assert_gaussian(belief.pose(), (3,))
            assert belief.gated >= 0

    def test_steps_of_a_frame_are_the_steps_one_by_one(self, slam):
        belief, generator = self.heard(slam, SECOND), rng()
        together, poses = slam.predict(belief, CONTROLS, DT, rng())
        for k in range(STEPS_PER_FRAME):
            belief, pose = slam.predict(belief, CONTROLS[k : k + 1], DT[k : k + 1], generator)
            np.testing.assert_allclose(pose.mean[0], poses.mean[k], rtol=0, atol=1e-9)
            np.testing.assert_allclose(pose.covariance[0], poses.covariance[k], rtol=0, atol=1e-12)
        np.testing.assert_allclose(belief.pose().mean, together.pose().mean, rtol=0, atol=1e-9)

    def test_labels_are_only_names(self, slam):
        first, *rest = (replace(s, landmark=1000 - s.landmark) for s in (FIRST, SECOND, THIRD))
        here, there = self.heard(slam, SECOND, THIRD), self.heard(slam, *rest, first=first)
        np.testing.assert_array_equal(there.pose().mean, here.pose().mean)
        np.testing.assert_array_equal(there.pose().covariance, here.pose().covariance)
        names = np.unique(1000 - there.landmarks().landmark)
        np.testing.assert_array_equal(names, np.unique(here.landmarks().landmark))

    def test_no_controls_move_nothing(self, slam):
        before = self.heard(slam, SECOND)
        belief, poses = slam.predict(before, np.empty((0, 2)), np.empty(0), rng())
        assert_gaussian(poses, (0, 3))
        assert_same(belief, seen_from_outside(before))

    def test_empty_scan_leaves_the_belief_unchanged(self, slam):
        for before in (slam.init(START), self.heard(slam, SECOND)):
            assert_same(slam.update(before, scan_of(), rng()), seen_from_outside(before))

    def test_inputs_are_not_changed(self, slam):
        start = Gaussian(mean=START.mean.copy(), covariance=START.covariance.copy())
        controls, dt, scan = CONTROLS.copy(), DT.copy(), with_columns(SECOND)
        for before in (slam.init(start), self.heard(slam), self.heard(slam, SECOND, THIRD)):
            answers = seen_from_outside(before)
            moved, _ = slam.predict(before, controls, dt, rng())
            assert_same(before, answers)
            moved_answers = seen_from_outside(moved)
            slam.update(moved, scan, rng())
            assert_same(moved, moved_answers)
        np.testing.assert_array_equal(start.mean, START.mean)
        np.testing.assert_array_equal(start.covariance, START.covariance)
        np.testing.assert_array_equal(controls, CONTROLS)
        np.testing.assert_array_equal(dt, DT)
        np.testing.assert_array_equal(scan.numbers, SECOND.numbers)

    def test_kept_belief_continues_to_the_same_bits(self, slam):
        kept = self.heard(slam, SECOND)
        once = slam.update(slam.predict(kept, CONTROLS, DT, rng())[0], THIRD, rng())
        slam.update(slam.predict(once, CONTROLS, DT, rng())[0], SECOND, rng())
        again = slam.update(slam.predict(kept, CONTROLS, DT, rng())[0], THIRD, rng())
        assert_same(again, seen_from_outside(once))

    @pytest.mark.parametrize("strategy", SENSING)
    def test_track_of_a_mission_is_finite_and_equal_for_equal_generators(self, slam, strategy):
        drive, scans, _ = small_world(seed=5, strategy=strategy)
        track, same = (run_filter(slam, drive, scans, rng()) for _ in range(2))
        assert_gaussian(track.pose, (len(drive.time), 3))
        assert_map(track.landmarks, {label for scan in scans for label in scan.landmark.tolist()})
        np.testing.assert_array_equal(track.pose.mean, same.pose.mean)
        np.testing.assert_array_equal(track.pose.covariance, same.pose.covariance)
        np.testing.assert_array_equal(track.landmarks.mean, same.landmarks.mean)

    @pytest.mark.parametrize("noise_at_rest", [True, False])
    def test_odometry_as_poses_gives_the_same_track_and_map(self, slam, noise_at_rest):
        motion = replace(slam.motion, noise_at_rest=noise_at_rest)
        drive, scans, _ = small_world(seed=5, frames=25)
        controls = drive.controls.copy()
        controls[::7] = 0.0
        drive = replace(drive, motion=motion, controls=controls)
        told = as_poses(drive)
        assert told.controls.shape == (len(controls), 9)
        track = run_filter(replace(slam, motion=motion), drive, scans, rng())
        other = run_filter(replace(slam, motion=told.motion), told, scans, rng())
        np.testing.assert_allclose(wrap(other.pose.mean - track.pose.mean), 0.0, atol=1e-9)
        np.testing.assert_allclose(other.pose.covariance, track.pose.covariance, atol=1e-9)
        np.testing.assert_array_equal(other.landmarks.landmark, track.landmarks.landmark)
        np.testing.assert_allclose(other.landmarks.mean, track.landmarks.mean, rtol=0, atol=1e-8)

    def test_first_scan_may_come_before_any_step_and_steps_after_the_last_scan(self, slam):
        drive, scans, _ = small_world(seed=5, frames=4)
        first = replace(scans[0], time=0.0)
        track = run_filter(slam, drive, [first, *scans[:2]], rng())
        assert_gaussian(track.pose, (len(drive.time), 3))


# A filter written from docs/extending.md: a reckoning of the controls, with landmarks noted where
# they were first heard at a range.


@dataclass(frozen=True, slots=True, kw_only=True)
class Noted:
    at: Gaussian
    noted: tuple[tuple[int, np.ndarray, np.ndarray], ...] = ()
    gated: int = 0

    def pose(self) -> Gaussian:
        return self.at

    def landmarks(self) -> Landmarks:
        label, mean, covariance = zip(*self.noted, strict=True) if self.noted else ((), (), ())
        return map_with(label, mean, covariance)


@dataclass(frozen=True, slots=True, kw_only=True)
class DeadReckoning:
    motion: Motion

    def init(self, pose: Gaussian) -> Noted:
        return Noted(at=pose)

    def predict(self, belief: Noted, controls, dt, rng) -> tuple[Noted, Gaussian]:
        mean, covariance = belief.at.mean, belief.at.covariance
        means, covariances = [], []
        for control, step in zip(controls, dt, strict=True):
            F, U = motion_jacobians(self.motion, mean, control, step)
            Q = motion_noise(self.motion, control)
            mean = motion_step(self.motion, mean, control, step)
            covariance = F @ covariance @ F.T + U @ Q @ U.T
            covariance = (covariance + covariance.T) / 2
            means.append(mean)
            covariances.append(covariance)
        poses = Gaussian(
            mean=np.array(means).reshape(-1, 3), covariance=np.array(covariances).reshape(-1, 3, 3)
        )
        return replace(belief, at=Gaussian(mean=mean, covariance=covariance)), poses

    def update(self, belief: Noted, scan: Scan, rng) -> Noted:
        known = {label for label, _, _ in belief.noted}
        stds = (scan.range_std, scan.bearing_std)
        new = tuple(
            (label, *self.place(belief.at, distance, bearing, std))
            for label, distance, bearing, *std in zip(
                scan.landmark.tolist(), scan.range, scan.bearing, *stds, strict=True
            )
            if label not in known and not np.isnan(distance)
        )
        return replace(belief, noted=belief.noted + new)

    def place(self, pose, distance, bearing, stds):
        x, y, heading = pose.mean
        c, s = np.cos(heading + bearing), np.sin(heading + bearing)
        G = np.array([[1, 0, -distance * s], [0, 1, distance * c]])
        Gz = np.array([[c, -distance * s], [s, distance * c]])
        R = np.diag(np.square(stds))
        P = G @ pose.covariance @ G.T + Gz @ R @ Gz.T
        return np.array([x + distance * c, y + distance * s]), (P + P.T) / 2


RECKONING = DeadReckoning(motion=BICYCLE)


class TestEkfSlam(EstimatorContract):
    @pytest.fixture
    def slam(self):
        return EkfSlam(motion=BICYCLE, rays=ray_config())


class TestInvariantEkfSlam(EstimatorContract):
    @pytest.fixture
    def slam(self):
        return InvariantEkfSlam(motion=BICYCLE, rays=ray_config())


class TestSmoother(EstimatorContract):
    @pytest.fixture(params=["none", "huber"])
    def slam(self, request):
        return Smoother(motion=BICYCLE, rays=ray_config(), robust=request.param)


class TestFastSlam(EstimatorContract):
    @pytest.fixture(params=["federated", "exact"])
    def slam(self, request):
        swarm = FastSlamConfig(particles=30, mixture=request.param)
        return FastSlam(motion=BICYCLE, rays=ray_config(), settings=swarm)


class TestDeadReckoning(EstimatorContract):
    @pytest.fixture
    def slam(self):
        return RECKONING


# Worth having


def log_ratios(slam, *, deceived=False, worlds=20):
    """Log of a filter's position RMSE over that of dead reckoning, one per world.

    Deceived, it is given the scans of another world.
    """
    values = []
    # The error of the start turns the whole map and drive, and no filter can mend it.
    sure = Gaussian(mean=START.mean, covariance=1e-6 * np.eye(3))
    for seed in range(worlds):
        drive, scans, path = small_world(seed, "active", start=sure)
        if deceived:
            _, scans, _ = small_world(seed + worlds, "active", start=sure)
        scans = [measured_to(scan, **SHARP) for scan in scans]
        squares = [
            np.square(run_filter(f, drive, scans, rng()).pose.mean[::STEPS_PER_FRAME] - path)
            for f in (slam, RECKONING)
        ]
        values.append(np.log(squares[0][:, :2].mean() / squares[1][:, :2].mean()) / 2)
    return np.array(values)


def is_better(ratios):
    """By three standard errors of the mean."""
    return ratios.mean() < -3 * ratios.std(ddof=1) / np.sqrt(ratios.size)


@pytest.mark.parametrize("name", ["ekf", "fastslam"])
def test_filter_beats_dead_reckoning_and_not_with_the_scans_of_another_world(name):
    slam = entry(name).build(Config(rays=ray_config()), BICYCLE)
    assert is_better(log_ratios(slam))
    assert not is_better(log_ratios(slam, deceived=True))
