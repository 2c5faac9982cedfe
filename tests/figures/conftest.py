"""Short missions with their recorded frames: all strategies, and excess paths."""

import pytest

from pipistrelle.config import CallerConfig, Config, ListeningConfig, ScenarioConfig
from pipistrelle.experiments.runs.trial import run_mission
from pipistrelle.figures.player import playback
from pipistrelle.figures.recorder import MissionRecorder


@pytest.fixture(scope="session")
def watched():
    """A mission of three strategies, each with and without particles, and its 40 frames."""
    config = Config(seed=7, scenario=ScenarioConfig(steps=160, landmarks=20))
    watch = MissionRecorder(rest=3)
    strategies, filters = ("active", "fused", "passive"), ("ekf", "fastslam")
    return run_mission(config, strategies, filters, watch=watch), watch.snapshots


@pytest.fixture(scope="session")
def trials(watched):
    """The results of that mission by strategy and filter."""
    return {(trial.strategy, trial.filter): trial for trial in watched[0].trials}


@pytest.fixture(scope="session")
def ekfs(trials):
    """The results of one filter for the three strategies."""
    return [trials[strategy, "ekf"] for strategy in ("active", "fused", "passive")]


@pytest.fixture(scope="session")
def scene(watched):
    """The truth, the beacon and the beam of that mission, for its figure and its film."""
    done, _ = watched
    return {"truth": done.drive.truth, "callers": done.callers, "beamwidth": done.beamwidth}


@pytest.fixture(scope="session")
def played(watched):
    """That mission as flat arrays."""
    return playback(*watched)


@pytest.fixture(scope="session")
def timed():
    """A mission with excess paths among three callers, one of them moving, and its 40 frames."""
    callers = (
        CallerConfig(place=(10.0, -5.0)),
        CallerConfig(name="mate", frequency=25e3, place=(5.0, -14.0)),
        CallerConfig(name="boat", frequency=20e3, course="circle", radius=16.0),
    )
    config = Config(
        seed=7,
        scenario=ScenarioConfig(steps=160, landmarks=8),
        listening=ListeningConfig(excess_paths=True),
        callers=callers,
    )
    watch = MissionRecorder()
    done = run_mission(config, ("active", "fused"), ("ekf",), watch=watch)
    return done, watch.snapshots


@pytest.fixture(scope="session")
def timed_scene(timed):
    """The truth and the callers of the mission with excess paths."""
    done, _ = timed
    return {"truth": done.drive.truth, "callers": done.callers}


@pytest.fixture(scope="session")
def timed_fused(timed):
    """The result of fused sensing with excess paths."""
    return next(trial for trial in timed[0].trials if trial.strategy == "fused")
