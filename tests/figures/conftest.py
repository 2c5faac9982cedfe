"""A made-up mission that looks like one: what a filter might believe, frame by frame."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from pipistrelle.acoustics.paths import Caller
from pipistrelle.config import CallerConfig, Config, ListeningConfig, ScenarioConfig
from pipistrelle.detection.scans import Scan
from pipistrelle.estimation.beliefs import Gaussian, Landmarks, Track
from pipistrelle.experiments.drives import Truth
from pipistrelle.experiments.results.scores import Scores, TrialResult
from pipistrelle.experiments.runs import heard_world as missions
from pipistrelle.experiments.runs.trial import run_mission
from pipistrelle.figures.recorder import MissionRecorder
from pipistrelle.geometry import range_and_bearing, wrap
from reference.missions import map_with, scan_with

STEPS, PER_FRAME, STEP = 1500, 4, 0.125
REACH = {"active": 14.0, "fused": 20.0, "passive": 20.0}
DRIFT = {"active": 0.14, "fused": 0.16, "passive": 0.3}
BEACON = Caller(name="beacon", frequency=30e3, level_db=42.8, place=np.array([10.6, 10.6]))
HALF_BEAM = np.deg2rad(33.0) / 2.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Believed:
    """A belief as a filter shows it to whoever watches."""

    at: Gaussian
    map: Landmarks

    def pose(self) -> Gaussian:
        return self.at

    def landmarks(self) -> Landmarks:
        return self.map


@dataclass(frozen=True, slots=True, kw_only=True)
class Swarming(Believed):
    """A belief made of particles."""

    particles: np.ndarray
    full: float = 0.0

    def cloud(self) -> np.ndarray:
        return self.particles


@dataclass(frozen=True, slots=True, kw_only=True)
class Mission:
    """The true world and, for each strategy, its result and what was watched."""

    scene: dict
    trials: dict
    watched: dict


def drive() -> tuple[np.ndarray, np.ndarray]:
    time = STEP * np.arange(STEPS + 1)
    heading = 0.75 / 7.408 * time
    path = 7.408 * np.column_stack([np.sin(heading), -np.cos(heading)])
    return time, np.column_stack([path, wrap(heading)])


def scatter(rng: np.random.Generator) -> np.ndarray:
    points = np.empty((0, 2))
    while len(points) < 50:
        point = rng.uniform(-25.0, 25.0, 2)
        near = np.hypot(*(points - point).T).min(initial=9.0)
        if np.hypot(*point) < 25.0 and near > 3.0 and abs(np.hypot(*point) - 7.4) > 0.5:
            points = np.vstack([points, point])
    return np.vstack([points, BEACON.place])


def estimated_path(time, path, strategy, rng) -> Gaussian:
    std = DRIFT[strategy] * (0.35 + 0.4 * time / time[-1] + 0.6 * np.sin(time / 10.0) ** 2)
    white = rng.normal(size=(3, len(time) + 400))
    smooth = np.stack([np.convolve(row, np.ones(401), "valid") for row in white]) / np.sqrt(401)
    scale = np.column_stack([std, std, std / 6.0])
    covariance = scale[:, :, None] * np.eye(3) * scale[:, None, :]
    error = scale * smooth.T[: len(time)]
    return Gaussian(mean=path + error, covariance=covariance)


def ray(origin: np.ndarray, angle: float, distance: float, age: float) -> tuple:
    """Members, covariances and weights of a ray that has been watched for a share of its life."""
    ranges = 0.714 * 3.0 ** np.arange(4)
    shown = np.argsort(np.abs(np.log(ranges / distance)))[: 4 - int(2.99 * age)]
    ranges = np.sort(ranges[shown])
    unit = np.array([np.cos(angle), np.sin(angle)])
    across = np.array([-unit[1], unit[0]])
    weight = np.exp(-(0.3 + 3.0 * age) * np.abs(np.log(ranges / distance)))
    covariance = [
        (0.3 * s) ** 2 * np.outer(unit, unit) + (0.12 * s) ** 2 * np.outer(across, across)
        for s in ranges
    ]
    return origin + ranges[:, None] * unit, np.array(covariance), weight / weight.sum()


def sightings(path, points, strategy, rng) -> list[tuple]:
    """First frame, frame of full initialisation and final estimate of each landmark seen."""
    rows = []
    for label, point in enumerate(points, start=1):
        away = np.hypot(*(path[::PER_FRAME, :2] - point).T)
        lit = np.flatnonzero(away < REACH[strategy] * rng.uniform(0.75, 1.0))
        if len(lit) == 0:
            continue
        first = int(lit[0]) + int(rng.integers(0, 60))
        long = rng.uniform(30.0, 500.0) if strategy != "active" else 0.0
        wait = 0.0 if strategy == "fused" and rng.uniform() < 0.6 else long
        error = rng.normal(0.0, {"active": 0.2, "fused": 0.25, "passive": 0.5}[strategy], 2)
        rows.append((label, first, first + int(wait), point + error))
    return rows


def map_at(frame: int, path, points, rows) -> Landmarks:
    parts = []
    for label, first, full, estimate in rows:
        if frame < first:
            continue
        if frame >= full:
            size = 0.25 + 0.5 / (1 + frame - full)
            covariance = size**2 * np.array([[[1.0, 0.3], [0.3, 0.6]]])
            parts.append((np.array([label]), estimate[None], covariance, np.ones(1)))
            continue
        born = path[PER_FRAME * min(first, STEPS // PER_FRAME)]
        distance, bearing = range_and_bearing(born, points[label - 1][None])
        age = (frame - first) / (full - first)
        members = ray(born[:2], born[2] + bearing[0], distance[0], age)
        parts.append((np.full(len(members[2]), label), *members))
    if not parts:
        parts = [(np.empty(0, int), np.empty((0, 2)), np.empty((0, 2, 2)), np.empty(0))]
    label, mean, covariance, weight = (np.concatenate(part) for part in zip(*parts, strict=True))
    return map_with(label, mean, covariance, weight)


def scan_at(time, pose, points, strategy, rng) -> Scan:
    distance, bearing = range_and_bearing(pose, points)
    heard = (distance < REACH[strategy]) & (rng.uniform(size=len(points)) < 0.25)
    lit = (np.abs(bearing) < HALF_BEAM) & (distance < REACH["active"])
    heard = {"active": lit, "fused": lit | heard, "passive": heard}[strategy]
    ranged = lit & (strategy != "passive")
    return scan_with(
        np.flatnonzero(heard) + 1,
        wrap(bearing + rng.normal(0.0, 0.04, len(points)))[heard],
        np.where(ranged, distance, np.nan)[heard],
        time=float(time),
    )


def trial_of(strategy, time, path, points, rng) -> tuple[TrialResult, list]:
    pose = estimated_path(time, path, strategy, rng)
    rows = sightings(path, points, strategy, rng)
    watched = []
    for frame, k in enumerate(range(PER_FRAME, STEPS + 1, PER_FRAME)):
        scan = scan_at(time[k], path[k], points, strategy, rng)
        at = Gaussian(mean=pose.mean[k], covariance=pose.covariance[k])
        watched.append((scan, Believed(at=at, map=map_at(frame, path, points, rows))))
    end = watched[-1][1].map
    count = np.unique(end.landmark, return_counts=True)[1]
    error = np.hypot(*(pose.mean - path)[:, :2].T)
    scores = Scores(
        position_rmse_m=float(np.sqrt(np.mean(error**2))),
        heading_rmse_rad=0.02,
        map_rmse_m=0.3,
        position_rmse_aligned_m=0.2,
        map_rmse_aligned_m=0.2,
        nees_mean=3.0,
        nees_max=12.0,
        diverged=False,
        landmarks_full=int(np.sum(count == 1)),
        landmarks_total=len(count),
        measurements_per_frame=5.0,
        gated=0,
    )
    track = Track(time=time, pose=pose, landmarks=end, gated=0)
    scans = tuple(scan for scan, _ in watched)
    result = TrialResult(
        strategy=strategy,
        filter="ekf",
        track=track,
        heard=scans,
        scans=scans,
        scores=scores,
        wall_s=0.05,
    )
    return result, watched


def cloud_of(pose: Gaussian, count: int = 40) -> np.ndarray:
    return np.random.default_rng(5).multivariate_normal(pose.mean, pose.covariance, count)


def swarming(trial: TrialResult) -> TrialResult:
    """The same trial as if its filter had particles."""
    pose = trial.track.pose
    cloud = cloud_of(Gaussian(mean=pose.mean[-1], covariance=pose.covariance[-1]))
    return replace(trial, filter="fastslam", track=replace(trial.track, cloud=cloud, full=3.5))


@pytest.fixture(scope="session")
def swarms(mission) -> dict:
    """For each strategy, the trial of a filter with particles."""
    return {strategy: swarming(trial) for strategy, trial in mission.trials.items()}


@pytest.fixture(scope="session")
def watched_swarms(mission) -> dict:
    """For each strategy, what a filter with particles shows to whoever watches."""
    return {
        strategy: [
            (scan, Swarming(at=seen.at, map=seen.map, particles=cloud_of(seen.at)))
            for scan, seen in frames
        ]
        for strategy, frames in mission.watched.items()
    }


@pytest.fixture(scope="session")
def mission() -> Mission:
    rng = np.random.default_rng(7)
    time, path = drive()
    points = scatter(rng)
    made = {s: trial_of(s, time, path, points, rng) for s in ("active", "fused", "passive")}
    return Mission(
        scene={
            "truth": Truth(time=time, path=path, landmarks=(np.arange(1, len(points) + 1), points)),
            "callers": (BEACON,),
            "beamwidth": 2.0 * HALF_BEAM,
        },
        trials={strategy: trial for strategy, (trial, _) in made.items()},
        watched={strategy: frames for strategy, (_, frames) in made.items()},
    )


@pytest.fixture(scope="session")
def timed() -> tuple[missions.Mission, dict]:
    """A short mission that hears when, among three callers of which one moves; and its frames."""
    callers = (
        CallerConfig(place=(10.0, -5.0)),
        CallerConfig(name="mate", frequency=25e3, place=(5.0, -14.0)),
        CallerConfig(name="boat", frequency=20e3, course="circle", radius=16.0),
    )
    config = Config(
        seed=7,
        scenario=ScenarioConfig(steps=160, landmarks=8),
        listening=ListeningConfig(timing=True),
        callers=callers,
    )
    watch = MissionRecorder()
    done = run_mission(config, ("active", "fused"), ("ekf",), watch=watch)
    return replace(done, beamwidth=2.0 * HALF_BEAM), watch.snapshots
