"""A short mission, done again while a recorder watches, and how its page is made."""

from pathlib import Path

import pytest

from pipistrelle.config import Config, ScenarioConfig
from pipistrelle.experiments.results.writing import write_results
from pipistrelle.experiments.runs.replay import rerun
from pipistrelle.experiments.runs.trial import run_mission
from pipistrelle.figures.player.playback import playback
from pipistrelle.figures.recorder import MissionRecorder
from pipistrelle.files import RESULTS, OwnFiles

FRAMES = 40


@pytest.fixture(scope="session")
def watched(tmp_path_factory):
    """What was done again, and what was seen: three strategies, and particles."""
    config = Config(seed=7, scenario=ScenarioConfig(steps=4 * FRAMES, landmarks=20))
    first = run_mission(config, ("active", "fused", "passive"), ("ekf", "fastslam"))
    folder = Path(tmp_path_factory.mktemp("mission"))
    write_results(
        OwnFiles(folder, RESULTS), config=config, command="", seed=7, trials=first.trials,
        truth=first.drive.truth, ignored_rows={},
    )  # fmt: skip
    watch = MissionRecorder(rest=3)
    return rerun(folder, watch=watch), watch.snapshots


@pytest.fixture(scope="session")
def played(watched):
    return playback(*watched)
