"""Snapshots of estimators while they run, and the excess paths to show of each.

At a frame at most two excess paths of a single landmark are shown, as ellipses around the estimated
positions of vehicle and caller: with the bearing, or with each other, they cross at the landmark.
"""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import combinations

import numpy as np
from jaxtyping import Bool, Float

from pipistrelle.detection.scans import UNLABELLED, Scan, rows_of
from pipistrelle.estimation.beliefs import (
    Belief,
    Gaussian,
    Landmarks,
    completed,
    in_sight,
    joined,
    no_landmarks,
    placed,
    revises_path,
)

RECENT_FRAMES = 40
"""Frames for which the ellipses of a landmark are shown after they have initialised it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Snapshot:
    """An estimator's measurements and belief at a frame, for figures and films."""

    scan: Scan
    pose: Float[np.ndarray, "3"]
    """Pose after the update [m, m, rad]."""
    covariance: Float[np.ndarray, "3 3"]
    """Covariance of the pose."""
    landmarks: Landmarks
    """Map after the update."""
    moving: Landmarks = field(default_factory=no_landmarks)
    """The tracked callers in sight."""
    cloud: Float[np.ndarray, "p 3"] | None = None
    """Poses of the particles [m, m, rad]; None without particles."""
    path: Float[np.ndarray, "t 2"] | None = None
    """Revised positions at the start and after every control step so far [m]; None if not
    requested, or if the estimator does not revise its path."""


def heard_from(scan: Scan) -> Scan:
    """Return the measurements of a scan that contain a bearing."""
    return rows_of(scan, ~np.isnan(scan.bearing))


class MissionRecorder:
    """Recorder of an estimator's state at each frame of a mission, for films and pages.

    An instance is called after each update, as the ``watch`` of a trial; ``snapshots`` contains a
    list for each (strategy, filter), in the order of their first frames.

    Parameters
    ----------
    rest : int, optional
        Number of frames between two maps of an estimator that revises its path, as each map costs
        a solution of the whole path; at least a sixtieth of the frames so far. Every fifth map the
        path is kept as well. By default the map is kept at every frame, and no path.
    """

    def __init__(self, rest: int | None = None) -> None:
        self.snapshots: dict[tuple[str, str], list[Snapshot]] = {}
        self._rest = rest
        self._asked: dict[tuple[str, str], list[int]] = {}

    def __call__(self, strategy: str, estimator: str, scan: Scan, belief: Belief) -> None:
        """Store a snapshot of an estimator after its update with a scan."""
        frames = self.snapshots.setdefault((strategy, estimator), [])
        path, landmarks = None, None
        if self._rest is not None and revises_path(belief):
            asked = self._asked.setdefault((strategy, estimator), [])
            if asked and len(frames) - asked[-1] < max(self._rest, len(frames) // 60):
                landmarks = frames[-1].landmarks
            else:
                revised = belief.path() if len(asked) % 5 == 0 else None
                path = None if revised is None else revised.mean[:, :2]
                asked.append(len(frames))
        pose, belief = belief.pose(), completed(belief, Belief)
        snapshot = Snapshot(
            scan=scan,
            pose=pose.mean,
            covariance=pose.covariance,
            landmarks=belief.landmarks() if landmarks is None else landmarks,
            moving=in_sight(belief.moving()),
            cloud=belief.cloud(),
            path=path,
        )
        frames.append(snapshot)


def pruned(before: Landmarks, after: Landmarks) -> Bool[np.ndarray, " h"]:
    """Return a mask of the hypotheses in `before` that have no successor in `after`."""
    gone = np.ones(len(before.landmark), dtype=bool)
    if len(gone):
        away = np.linalg.norm(before.mean[:, None] - after.mean, axis=2)
        away[before.landmark[:, None] != after.landmark] = np.inf
        gone[np.argmin(away, axis=0)[np.isfinite(away.min(axis=0))]] = False
    return gone


def callers_at(frame: Snapshot) -> Gaussian:
    """Return the estimated position [m] of each caller at a frame, by caller number.

    Callers are fully initialised landmarks or tracked; NaN for the vehicle and other callers.
    """
    labels, rows = frame.scan.callers.tolist(), joined(frame.landmarks, frame.moving)
    mean, covariance = np.full((len(labels), 2), np.nan), np.full((len(labels), 2, 2), np.nan)
    full = placed(rows)
    for number, label in enumerate(labels):
        row = np.flatnonzero(full & (rows.landmark == label))
        if label != UNLABELLED and len(row):
            mean[number], covariance[number] = rows.mean[row[0]], rows.covariance[row[0]]
    return Gaussian(mean=mean, covariance=covariance)


def callers_marked(scans: Sequence[Scan]) -> bool:
    """Return whether figures should mark the estimated positions of callers.

    They do with several callers, or with excess paths: their ellipses are around callers. A single
    beacon is drawn like any landmark.
    """
    several = any(np.sum(scan.callers != UNLABELLED) > 1 for scan in scans[-1:])
    return several or any(np.isfinite(scan.excess_path).any() for scan in scans)


def excess_paths_at(frame: Snapshot) -> dict[int, list[int]]:
    """Return for each landmark at most two rows of a scan with excess paths to draw as ellipses.

    Their landmarks are in the map and their callers have estimated positions. Two of more rows are
    the rows with ellipses that cross at the largest angle.
    """
    scan, heard = frame.scan, np.isfinite(frame.scan.excess_path)
    heard &= (scan.caller < len(scan.callers)) & np.isin(scan.landmark, frame.landmarks.landmark)
    if not heard.any() or not np.isfinite(frame.pose).all():
        return {}
    callers, found = callers_at(frame).mean, defaultdict(list)
    for row in np.flatnonzero(heard).tolist():
        if np.isfinite(callers[scan.caller[row]]).all():
            found[int(scan.landmark[row])].append(row)
    return {
        label: rows if len(rows) <= 2 else _squarest(frame, label, callers, rows)
        for label, rows in found.items()
    }


def _squarest(
    frame: Snapshot, label: int, callers: Float[np.ndarray, "c 2"], rows: list[int]
) -> list[int]:
    r"""Return the two rows of a scan with excess-path ellipses that cross at the largest angle.

    The normal of an ellipse bisects the angle between the lines to its foci:
    :math:`(l - b)/|l - b| + (l - p)/|l - p|`.
    """

    def unit(legs: np.ndarray) -> np.ndarray:
        return legs / np.maximum(np.linalg.norm(legs, axis=-1, keepdims=True), 1e-9)

    spot = likeliest(frame, label)
    normal = unit(unit(spot - callers[frame.scan.caller[rows]]) + unit(spot - frame.pose[:2]))
    pairs = combinations(zip(rows, *normal.T.tolist(), strict=True), 2)
    square = max(pairs, key=lambda pair: abs(pair[0][1] * pair[1][2] - pair[0][2] * pair[1][1]))
    return [row for row, *_ in square]


def likeliest(frame: Snapshot, label: int) -> Float[np.ndarray, "2"]:
    """Return the mean [m] of the landmark's hypothesis with the largest weight."""
    here = frame.landmarks.landmark == label
    return frame.landmarks.mean[here][np.argmax(frame.landmarks.weight[here])]


def resolved(frames: Sequence[Snapshot]) -> list[int]:
    """Select for each frame the landmark to draw with excess-path ellipses, or `UNLABELLED`.

    In this order: a landmark that the frame's excess paths have initialised; the ray with the
    fewest members that they update; the landmark initialised last, at most `RECENT_FRAMES` frames
    ago. Between equals, the landmark shown before, then a landmark with two excess paths.
    """
    members, since, timed, ranged = {}, {}, set(), set()
    shown, found = UNLABELLED, []
    for now, frame in enumerate(frames):
        before, ellipses_of, scan = members, excess_paths_at(frame), frame.scan
        labels, counts = np.unique(frame.landmarks.landmark, return_counts=True)
        members = dict(zip(labels.tolist(), counts.tolist(), strict=True))
        timed.update(ellipses_of)
        ranged.update(scan.landmark[np.isfinite(scan.range)].tolist())
        for label in timed - ranged:
            if members.get(label) == 1 and before.get(label) != 1:
                since[label] = now
        ranks = {}
        for label, rows in ellipses_of.items():
            age = now - since.get(label, -RECENT_FRAMES - 1)
            if members[label] > 1:
                rank = (1, members[label])
            elif age <= RECENT_FRAMES:
                rank = (2 if age else 0, age)
            else:
                continue
            ranks[label] = (*rank, label != shown, -len(rows), label)
        shown = min(ranks, key=lambda label: ranks[label], default=UNLABELLED)
        found.append(shown)
    return found
