"""Every array has the shape and the type that its annotation says.

NUMBA_DISABLE_JIT=1 pytest -m shapes --jaxtyping-packages=pipistrelle,beartype.beartype
"""

from pathlib import Path

import pytest

from pipistrelle.config import (
    STRATEGIES,
    CallerConfig,
    Config,
    EmitterConfig,
    FilterConfig,
    ListeningConfig,
    ScenarioConfig,
)
from pipistrelle.estimation.catalogue import CATALOGUE
from pipistrelle.experiments.runs.replay import load, replay
from pipistrelle.experiments.runs.trial import run_mission

pytestmark = [
    pytest.mark.shapes,
    # uncompiled, the noise's hash, which wraps on purpose, warns of it
    pytest.mark.filterwarnings("ignore:overflow encountered:RuntimeWarning"),
]
LOGS = Path(__file__).parent / "data"


@pytest.mark.parametrize("taper", [0.0, 0.2])
def test_a_short_mission_keeps_to_its_annotations(taper):
    config = Config(
        scenario=ScenarioConfig(steps=8, landmarks=12, radius=12.0),
        emitter=EmitterConfig(taper=taper),
    )
    mission = run_mission(config, STRATEGIES)
    assert [trial.strategy for trial in mission.trials] == list(STRATEGIES)


@pytest.mark.parametrize("name", CATALOGUE)
def test_a_mission_that_times_callers_keeps_to_its_annotations(name):
    config = Config(
        scenario=ScenarioConfig(steps=24, landmarks=12, radius=12.0),
        callers=(CallerConfig(), CallerConfig(frequency=25e3, course="circle", radius=9.0)),
        filter=FilterConfig(noise="measured", robust="huber", gate=0.999),
        listening=ListeningConfig(excess_paths=True),
    )
    trials = run_mission(config, STRATEGIES, (name,)).trials
    assert any(trial.track.callers for trial in trials) == (name != "fastslam")


@pytest.mark.parametrize("name", ["unicycle_log", "bicycle_log", "poses_log"])
def test_a_recorded_log_keeps_to_its_annotations(name):
    log, truth = load(LOGS / name)
    trials = replay(log, truth, STRATEGIES, ("ekf", "iekf", "fastslam"), 0.6, Config()).trials
    assert len(trials) == 9
