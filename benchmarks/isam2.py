"""GTSAM's iSAM2 and batch optimiser on the mission of the EKF and the smoother.

    python -m benchmarks.isam2 ROUNDS     # CPU seconds and errors as JSON; needs gtsam

All receive the same data: controls and their noise, labels, bearings with and without range, and
standard deviations. The four steps of a frame become a single odometry factor, composed outside the
timing. Each measurement is a factor, each frame an incremental update, after which the new pose is
read. A landmark enters the graph with its first range, or, without ranges, at the first crossing of
two of its bearings at `PARALLAX` or more, with all its bearings so far. GTSAM's time counts its
calls, without the Python around them and without covariances; the times of the EKF and the smoother
are whole trials, with covariances.

The batch problems are linearised at the EKF's poses and map: GTSAM's Levenberg-Marquardt optimiser
has the factors of its graph, the smoother its measurements. GTSAM stops when the relative decrease
of the cost falls below 1e-7, the smoother below 1e-10 (`chain.CONVERGED`), and the smoother's time
includes the covariance of every pose.
"""

import json
import math
import sys
import time
from dataclasses import dataclass, field, replace
from statistics import median

import gtsam
import numpy as np

from benchmarks.calibration import calibrate
from benchmarks.worlds import scans_of, world_of
from pipistrelle.config import Config
from pipistrelle.detection.scans import Scan
from pipistrelle.estimation.beliefs import Track, placed
from pipistrelle.estimation.catalogue import entry
from pipistrelle.estimation.motion import Motion, motion_jacobians, motion_step
from pipistrelle.estimation.smoother.belief import SmootherBelief
from pipistrelle.estimation.smoother.records import Stack
from pipistrelle.evaluation.accuracy import position_error, rmse
from pipistrelle.experiments.drives import Drive
from pipistrelle.experiments.named_settings import Case
from pipistrelle.experiments.runs.heard_world import drive_of
from pipistrelle.experiments.runs.trial import run_filter, run_trial

PARALLAX = 0.5
"""Least angle between two bearings that initialise a landmark [rad]."""

Odometry = list[tuple[np.ndarray, np.ndarray]]


@dataclass
class Graph:
    """An incremental smoother, and the bearings of landmarks that are not in it yet."""

    config: Config
    isam: "gtsam.ISAM2"
    mapped: set[int] = field(default_factory=set)
    waiting: dict[int, list[tuple[int, float]]] = field(default_factory=dict)
    seconds: float = 0.0

    def update(self, factors: "gtsam.NonlinearFactorGraph", values: "gtsam.Values") -> None:
        """Add factors and values to the smoother, and add up the time."""
        began = time.process_time()
        self.isam.update(factors, values)
        self.seconds += time.process_time() - began

    def pose(self, k: int) -> np.ndarray:
        """Read the current estimate of a frame's pose, and add up the time."""
        began = time.process_time()
        pose = self.isam.calculateEstimatePose2(k)
        self.seconds += time.process_time() - began
        return np.array([pose.x(), pose.y(), pose.theta()])


def landmark_key(label: int) -> int:
    """Return the graph's key of a landmark; a pose's key is its frame's number."""
    return gtsam.symbol("l", label)


def odometry(motion: Motion, drive: Drive, steps: int) -> Odometry:
    """Compose the steps of each frame: relative pose, and covariance in the axes of its end."""
    Q, frames = np.diag(np.square(motion.control_std)), []
    dt = np.diff(drive.time)
    for first in range(0, len(drive.controls), steps):
        pose, P = np.zeros(3), np.zeros((3, 3))
        for k in range(first, first + steps):
            F, U = motion_jacobians(motion, pose, drive.controls[k], dt[k])
            pose, P = motion_step(motion, pose, drive.controls[k], dt[k]), F @ P @ F.T + U @ Q @ U.T
        c, s = math.cos(pose[2]), math.sin(pose[2])
        axes = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
        frames.append((pose, axes @ P @ axes.T))
    return frames


def smooth(
    config: Config, drive: Drive, frames: Odometry, scans: tuple[Scan, ...]
) -> tuple[np.ndarray, Graph]:
    """Run a mission with GTSAM's defaults; return the online pose of each frame, and the graph."""
    graph = Graph(config=config, isam=gtsam.ISAM2(gtsam.ISAM2Params()))
    factors, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    start = gtsam.noiseModel.Gaussian.Covariance(drive.start.covariance)
    factors.add(gtsam.PriorFactorPose2(0, gtsam.Pose2(*drive.start.mean), start))
    values.insert(0, gtsam.Pose2(*drive.start.mean))
    graph.update(factors, values)
    online = [drive.start.mean]
    for k, ((step, covariance), scan) in enumerate(zip(frames, scans, strict=True), start=1):
        factors, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        noise = gtsam.noiseModel.Gaussian.Covariance(covariance)
        factors.add(gtsam.BetweenFactorPose2(k - 1, k, gtsam.Pose2(*step), noise))
        guess = gtsam.Pose2(*online[-1]).compose(gtsam.Pose2(*step))
        values.insert(k, guess)
        here = np.array([guess.x(), guess.y(), guess.theta()])
        poses = np.vstack((*online, here))
        for label, bearing, distance in zip(scan.landmark, scan.bearing, scan.range, strict=True):
            measure(graph, factors, values, poses, int(label), float(bearing), float(distance))
        graph.update(factors, values)
        online.append(graph.pose(k))
    return np.array(online), graph


def measure(graph: Graph, factors, values, poses, label: int, bearing: float, distance: float):
    """Add the factor of a measurement, or store it until its landmark can be initialised."""
    k, passive, key = len(poses) - 1, math.isnan(distance), landmark_key(label)
    if label not in graph.mapped:
        place = None if passive else along(poses[k], bearing, distance)
        if passive:
            graph.waiting.setdefault(label, []).append((k, bearing))
            place = crossing(poses, graph.waiting[label])
        if place is None:
            return
        graph.mapped.add(label)
        values.insert(key, place)
        for frame, earlier in graph.waiting.pop(label, []):
            add_bearing(graph, factors, frame, key, earlier)
        if passive:
            return
    if passive:
        add_bearing(graph, factors, k, key, bearing)
    else:
        stds = np.array([graph.config.filter.bearing_std, graph.config.filter.range_std])
        noise = gtsam.noiseModel.Diagonal.Sigmas(stds)
        turn = gtsam.Rot2(bearing)
        factors.add(gtsam.BearingRangeFactor2D(k, key, turn, distance, noise))


def add_bearing(graph: Graph, factors, frame: int, key: int, bearing: float) -> None:
    """Add the factor of a bearing without range."""
    noise = gtsam.noiseModel.Isotropic.Sigma(1, graph.config.filter.bearing_std)
    factors.add(gtsam.BearingFactor2D(frame, key, gtsam.Rot2(bearing), noise))


def along(pose: np.ndarray, bearing: float, distance: float) -> np.ndarray:
    """Return the point at a bearing and a range from a pose."""
    angle = pose[2] + bearing
    return pose[:2] + distance * np.array([math.cos(angle), math.sin(angle)])


def crossing(poses: np.ndarray, bearings: list[tuple[int, float]]) -> np.ndarray | None:
    """Return the crossing of a landmark's newest bearing with an earlier one; None if too oblique.

    It uses the earlier bearing with the largest angle to the newest, and a crossing ahead of both.
    """
    (k, last), best, place = bearings[-1], math.sin(PARALLAX), None
    angle = poses[k, 2] + last
    for frame, bearing in bearings[:-1]:
        other = poses[frame, 2] + bearing
        sine = math.sin(other - angle)
        dx, dy = poses[frame, :2] - poses[k, :2]
        if abs(sine) < best:
            continue
        near = (dx * math.sin(other) - dy * math.cos(other)) / sine
        far = (dx * math.sin(angle) - dy * math.cos(angle)) / sine
        if near > 0.0 and far > 0.0:
            best, place = abs(sine), along(poses[k], last, near)
    return place


def whole_belief(config: Config, drive: Drive, scans: tuple[Scan, ...]) -> SmootherBelief:
    """Return the smoother's belief after a whole mission."""
    beliefs: list[SmootherBelief] = []
    slam = entry("smoother").build(config, drive.motion)
    run_filter(
        slam, drive, scans, np.random.default_rng(0), watch=lambda _, now: beliefs.append(now)
    )
    return beliefs[-1]


def smooth_at_once(belief: SmootherBelief, track: Track, every: int) -> float:
    """Solve the smoother's batch problem from an EKF's track; return the time [s]."""
    began = time.process_time()
    history, points = belief.history, belief.solution.points
    at = np.ascontiguousarray(track.pose.mean[::every])
    there = places_of(track)
    known = zip(history.placed, points.spots, strict=True)
    spots = np.array([there.get(label, spot) for label, spot in known])
    start = replace(points, at=Stack((at,), len(at), [len(at)]), spots=spots)
    solution = replace(belief.solution, points=start)
    replace(belief, solution=solution).path()
    return time.process_time() - began


def optimise_at_once(graph: Graph, track: Track, every: int) -> float:
    """Solve GTSAM's batch problem from an EKF's track; return the time [s]."""
    factors, values = graph.isam.getFactorsUnsafe(), graph.isam.calculateEstimate()
    for k, pose in enumerate(track.pose.mean[::every]):
        values.update(k, gtsam.Pose2(*pose))
    for label, place in places_of(track).items():
        if label in graph.mapped:
            values.update(landmark_key(label), place)
    settings = gtsam.LevenbergMarquardtParams()
    settings.setRelativeErrorTol(1e-7)
    began = time.process_time()
    gtsam.LevenbergMarquardtOptimizer(factors, values, settings).optimize()
    return time.process_time() - began


def places_of(track: Track) -> dict[int, np.ndarray]:
    """Return the positions of a track's initialised landmarks, by label."""
    sure = placed(track.landmarks)
    labels = track.landmarks.landmark[sure].tolist()
    return dict(zip(labels, track.landmarks.mean[sure], strict=True))


def compare(rounds: int) -> dict[str, float]:
    """Time all solvers on a mission, alternately: errors over the frames [m], CPU times [s]."""
    config = Config()
    world, scans = world_of(config), scans_of(config, "fused")
    drive, every = drive_of(world, config), config.scenario.steps_per_frame
    frames, case = odometry(drive.motion, drive, every), Case(strategy="fused", filter="ekf")
    last = whole_belief(config, drive, scans)
    ours, smoothed, batch, peer, around, peers_batch = [], [], [], [], [], []
    for _ in range(rounds + 1):
        began = time.process_time()
        trial = run_trial(case, drive, scans, config)
        ours.append(time.process_time() - began)
        began = time.process_time()
        run_trial(replace(case, filter="smoother"), drive, scans, config)
        smoothed.append(time.process_time() - began)
        batch.append(smooth_at_once(last, trial.track, every))
        began = time.process_time()
        online, graph = smooth(config, drive, frames, scans)
        around.append(time.process_time() - began)
        peer.append(graph.seconds)
        peers_batch.append(optimise_at_once(graph, trial.track, every))
    known = np.array([graph.pose(k) for k in range(1, len(online))])
    true, found = world.path[every::every], trial.track.pose.mean[every::every]
    return {
        "isam2_s": median(peer[1:]),
        "isam2_with_python_s": median(around[1:]),
        "isam2_batch_s": median(peers_batch[1:]),
        "ekf_s": median(ours[1:]),
        "smoother_s": median(smoothed[1:]),
        "batch_s": median(batch[1:]),
        "calibration_s": calibrate(time.process_time),
        "ekf_m": rmse(position_error(found, true)),
        "isam2_m": rmse(position_error(online[1:], true)),
        "isam2_smoothed_m": rmse(position_error(known, true)),
        "ekf_last_m": float(position_error(found, true)[-1]),
        "isam2_last_m": float(position_error(online[1:], true)[-1]),
        "mapped": len(graph.mapped),
        "waiting": len(graph.waiting),
    }


if __name__ == "__main__":
    print(json.dumps(compare(int(sys.argv[1]))))
