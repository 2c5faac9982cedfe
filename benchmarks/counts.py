"""Counts of the operations that a filter needs in a mission, as a lower bound of its time."""

from collections.abc import Sequence

import numpy as np

from pipistrelle.config import Config
from pipistrelle.detection.scans import Scan
from pipistrelle.estimation.ekf.filter import EkfBelief
from pipistrelle.estimation.fastslam.filter import FastSlamBelief
from pipistrelle.experiments.drives import Drive
from pipistrelle.experiments.named_settings import Case
from pipistrelle.experiments.runs.trial import run_trial


def covariance_updates(case: Case, drive: Drive, scans: Sequence[Scan], config: Config) -> int:
    """Count the covariance elements that the updates of an EKF mission must change.

    An update changes half a symmetric matrix, once for a bearing of each hypothesis and twice for a
    bearing with range.
    """
    count, before = 0, np.empty(0, dtype=int)

    def add(strategy: str, name: str, scan: Scan, belief: EkfBelief) -> None:
        nonlocal count, before
        size = 3 + 2 * before.size
        members = np.array([np.count_nonzero(before == label) for label in scan.landmark], int)
        outer = np.where(np.isnan(scan.range), members, 2 * (members > 0))
        count += int(outer.sum()) * size * (size + 1) // 2
        before = belief.landmark

    run_trial(case, drive, scans, config, watch=add)
    return count


def elementary_functions(case: Case, drive: Drive, scans: Sequence[Scan], config: Config) -> int:
    """Count the elementary functions that the particles of a FastSLAM mission must evaluate.

    Each prediction of a hypothesis needs an arctangent, each likelihood a logarithm. A landmark
    with a range is predicted twice, to refine the pose and to update the landmark, and weighed
    once. A bearing needs a third prediction, to weigh it; a hypothesis of a ray a fourth, with
    another likelihood, and five exponentials: for two weights, two shares and the pruning. A
    control step needs a cosine and a sine, as does the mean of the particles.
    """
    particles = config.fastslam.particles
    count, before = 4 * particles * len(drive.controls), {}

    def add(strategy: str, name: str, scan: Scan, belief: FastSlamBelief) -> None:
        nonlocal count, before
        for label, distance in zip(scan.landmark.tolist(), scan.range.tolist(), strict=True):
            members = before.get(label, np.empty(0, dtype=int))
            bearing = np.where(members == 1, 4, 11 * members)
            count += int(bearing.sum()) if np.isnan(distance) else 3 * members.size
        lanes = belief.count.swapaxes(0, 1).reshape(belief.landmark.size, -1)[:, :particles]
        before = dict(zip(belief.landmark.tolist(), lanes, strict=True))

    run_trial(case, drive, scans, config, watch=add)
    return count
