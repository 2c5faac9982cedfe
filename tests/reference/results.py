"""Synthetic result folders: missions with known paths, studies with known scores."""

from dataclasses import asdict

import numpy as np

from pipistrelle.config import Config
from pipistrelle.estimation.beliefs import Gaussian, Track
from pipistrelle.experiments.drives import Truth
from pipistrelle.experiments.results.scores import Scores, TrialResult, score
from pipistrelle.experiments.results.writing import write_results
from pipistrelle.experiments.studies.plan import cases_of
from pipistrelle.experiments.studies.study import open_store
from pipistrelle.experiments.studies.world import TrialRecord, write_world
from pipistrelle.files import RESULTS, OwnFiles
from reference.missions import map_with, scan_with

STEPS = 40
TIME = 100.0 + 0.125 * np.arange(STEPS + 1)
LABELS, PLACES = np.array([1, 2, 3]), np.array([[1.0, 1.0], [5.0, 2.0], [-4.0, 3.0]])


def loop(phase=0.0):
    """Return an arc of 6 rad with a radius of 7.4 m, with headings wrapped at pi."""
    angle = phase + np.linspace(0.0, 6.0, STEPS + 1)
    return np.column_stack(
        [7.4 * np.sin(angle), -7.4 * np.cos(angle), np.angle(np.exp(1j * angle))]
    )


def turned(path, angle, shift=(0.0, 0.0)):
    """Apply a rigid motion to a path."""
    c, s = np.cos(angle), np.sin(angle)
    xy = path[:, :2] @ np.array([[c, s], [-s, c]]) + shift
    return np.column_stack([xy, path[:, 2] + angle])


TRUTH = Truth(time=TIME, path=loop(), landmarks=(LABELS, PLACES))


def mission_folder(folder, paths, *, truth=TRUTH, config=None, time=TIME, gated=0):
    """Write a result folder as `run` does, with estimates `paths` (k, 3) by strategy and filter."""
    config, scans = config or Config(), (scan_with([1], [0.1], [4.0], time=time[4]),)
    trials = []
    for (strategy, name), path in paths.items():
        pose = Gaussian(mean=np.array(path), covariance=np.tile(np.eye(3), (len(path), 1, 1)))
        track = Track(time=time, pose=pose, gated=gated, landmarks=map_with(
            [1, 2, 3, 3], [*PLACES, PLACES[2] + 1.0], np.tile(0.04 * np.eye(2), (4, 1, 1)),
            [1.0, 1.0, 0.5, 0.5]))  # fmt: skip
        scores = score(track, truth, scans, 50.0)
        trials.append(TrialResult(
            strategy=strategy, filter=name, track=track, heard=scans, scans=scans, scores=scores,
            wall_s=0.5,
        ))  # fmt: skip
    write_results(
        OwnFiles(folder, RESULTS), config=config, command="pipistrelle run", seed=7,
        trials=trials, truth=truth, ignored_rows={},
    )  # fmt: skip
    return folder


def study_folder(folder, plan, number, worlds=None):
    """Write a study with errors `number(case, world)` [m]: NaN for diverged, None for failed."""
    open_store(folder, plan)
    for world in range(plan.iterations) if worlds is None else worlds:
        records = [_record(case, number(case, world)) for case in cases_of(plan)]
        write_world(folder, plan, world, records)
    return folder


def _record(case, value):
    """Return the record of a trial with a given error."""
    width = {"beamwidth_deg": None if case.strategy == "passive" else 33.0}
    if value is None:
        return TrialRecord(case=case, row=width | {"error": "Traceback: lost"})
    lost = value != value
    scores = Scores(
        position_rmse_m=9.0 if lost else value, heading_rmse_rad=None, map_rmse_m=value,
        position_rmse_aligned_m=value, map_rmse_aligned_m=2.0 * value, nees_mean=3.0,
        nees_max=5.0, diverged=lost, landmarks_full=5, landmarks_total=6,
        measurements_per_frame=1.0, gated=0,
    )  # fmt: skip
    return TrialRecord(case=case, row=width | asdict(scores))
