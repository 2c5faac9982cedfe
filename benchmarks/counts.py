"""What a filter's mission cannot do without, counted while it runs: floors are told from it."""

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
    """Count the elements that the corrections of an EKF mission must change.

    Half a symmetric matrix, once for a bearing of each member and twice for a bearing with range.
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
    """Count the elementary functions that the particles of a FastSLAM mission must take.

    An arctangent for every look at a member, a logarithm for every likelihood. A landmark with a
    range is looked at twice, to refine the pose and to correct the member, and weighed once. A
    bearing takes a third look, to weigh it; a ray's member a fourth, with another likelihood, and
    five exponentials: for two weights, two shares and whether it stays. A control step turns by a
    cosine and a sine, and so does the swarm's mean.
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
