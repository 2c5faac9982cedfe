"""Snapshots of estimators while they run, and the excess paths and landmarks to show of each.

The excess paths of at most a single landmark are shown at a frame, as at most two ellipses around
the estimated positions of vehicle and caller: with the bearing, or with each other, they cross at
the landmark.
"""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import combinations

import numpy as np
from jaxtyping import Bool, Float, Int

from pipistrelle.detection.scans import UNLABELLED, Scan, rows_of
from pipistrelle.estimation.beliefs import (
    Belief,
    Gaussian,
    Landmarks,
    answer,
    in_sight,
    joined,
    no_landmarks,
    placed,
)
from pipistrelle.figures.maps import excess_path_ellipse

MAX_ELLIPSES = 2
"""Most ellipses at a frame."""
RECENT_FRAMES = 40
"""Frames for which the ellipses of a landmark are shown after they have initialised it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Snapshot:
    """Measurements and belief of an estimator at a frame."""

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
    """Return the measurements of a scan that have a bearing.

    Examples
    --------
    >>> from pipistrelle.detection.scans import make_scan
    >>> rows = np.array([8, 8]), np.array([0.4, np.nan])
    >>> heard_from(make_scan(0.0, *rows, excess_path=np.array([3.0, 5.0]))).landmark
    array([8])
    """
    return rows_of(scan, ~np.isnan(scan.bearing))


class MissionRecorder:
    """Keep a snapshot of each frame of estimators while they run, a few kilobytes each.

    An instance is called after each update, as the ``watch`` of a trial; ``snapshots`` contains a
    list for each (strategy, filter), in the order of their first frames.

    Parameters
    ----------
    rest : int, optional
        Number of frames between two maps of an estimator that revises its path, as each map costs
        a solution of the whole path; at least a sixtieth of the frames so far. Every fifth map the
        path is kept as well. By default the map is kept at every frame, and no path.

    Examples
    --------
    >>> from pipistrelle.estimation.beliefs import Gaussian, no_landmarks
    >>> class Lost:
    ...     gated = 0
    ...
    ...     def pose(self):
    ...         return Gaussian(mean=np.zeros(3), covariance=np.eye(3))
    ...
    ...     def landmarks(self):
    ...         return no_landmarks()
    >>> from pipistrelle.detection.scans import make_scan
    >>> watch = MissionRecorder()
    >>> watch("fused", "ekf", make_scan(0.5, np.empty(0), np.empty(0)), Lost())
    >>> [(key, len(frames)) for key, frames in watch.snapshots.items()]
    [(('fused', 'ekf'), 1)]
    """

    def __init__(self, rest: int | None = None) -> None:
        self.snapshots: dict[tuple[str, str], list[Snapshot]] = {}
        self._rest = rest
        self._asked: dict[tuple[str, str], list[int]] = {}

    def __call__(self, strategy: str, estimator: str, scan: Scan, belief: Belief) -> None:
        """Keep a snapshot."""
        frames = self.snapshots.setdefault((strategy, estimator), [])
        path, landmarks = None, None
        if self._rest is not None and hasattr(belief, "path"):
            asked = self._asked.setdefault((strategy, estimator), [])
            if asked and len(frames) - asked[-1] < max(self._rest, len(frames) // 60):
                landmarks = frames[-1].landmarks
            else:
                path = answer(belief, "path").mean[:, :2] if len(asked) % 5 == 0 else None
                asked.append(len(frames))
        pose, moving = belief.pose(), answer(belief, "moving")
        snapshot = Snapshot(
            scan=scan,
            pose=pose.mean,
            covariance=pose.covariance,
            landmarks=belief.landmarks() if landmarks is None else landmarks,
            moving=no_landmarks() if moving is None else in_sight(moving),
            cloud=answer(belief, "cloud"),
            path=path,
        )
        frames.append(snapshot)


def pruned(before: Landmarks, after: Landmarks) -> Bool[np.ndarray, " h"]:
    """Return a mask of the members without a successor: the nearest of the same landmark.

    Examples
    --------
    >>> from pipistrelle.estimation.beliefs import no_landmarks
    >>> def row(x):
    ...     point = {"mean": np.array([[x, 0.0]]), "covariance": np.eye(2)[None]}
    ...     return Landmarks(landmark=np.array([7]), weight=np.ones(1), **point)
    >>> pruned(row(1.0), row(1.5)), pruned(row(1.0), no_landmarks())
    (array([False]), array([ True]))
    """
    gone = np.ones(len(before.landmark), dtype=bool)
    if len(gone):
        away = np.linalg.norm(before.mean[:, None] - after.mean, axis=2)
        away[before.landmark[:, None] != after.landmark] = np.inf
        gone[np.argmin(away, axis=0)[np.isfinite(away.min(axis=0))]] = False
    return gone


def callers_believed(landmarks: Landmarks, labels: Int[np.ndarray, " c"]) -> Gaussian:
    """Return the estimated positions of callers that are fully initialised landmarks.

    `labels`: of the callers by number, as `Scan.callers`. Returns [m]: NaN for the vehicle and for
    other callers.

    Examples
    --------
    >>> point = {"mean": np.array([[3.0, 4.0]]), "covariance": np.eye(2)[None]}
    >>> one = Landmarks(landmark=np.array([7]), weight=np.ones(1), **point)
    >>> callers_believed(one, np.array([-1, 7, 8])).mean
    array([[nan, nan],
           [ 3.,  4.],
           [nan, nan]])
    """
    mean, covariance = np.full((len(labels), 2), np.nan), np.full((len(labels), 2, 2), np.nan)
    full = placed(landmarks)
    for number, label in enumerate(labels.tolist()):
        row = np.flatnonzero(full & (landmarks.landmark == label))
        if label != UNLABELLED and len(row):
            mean[number], covariance[number] = landmarks.mean[row[0]], landmarks.covariance[row[0]]
    return Gaussian(mean=mean, covariance=covariance)


def callers_at(frame: Snapshot) -> Gaussian:
    """Return the estimated positions of callers at a frame by number [m], as `callers_believed`."""
    return callers_believed(joined(frame.landmarks, frame.moving), frame.scan.callers)


def callers_marked(scans: Sequence[Scan]) -> bool:
    """Return whether figures mark the estimated positions of callers.

    They do with several callers, or with excess paths: their ellipses are around callers. A single
    beacon is drawn like any landmark.
    """
    several = any(np.sum(scan.callers != UNLABELLED) > 1 for scan in scans[-1:])
    return several or any(np.isfinite(scan.excess_path).any() for scan in scans)


def excess_paths_at(frame: Snapshot) -> dict[int, Int[np.ndarray, " k"]]:
    """Return the rows of a scan with excess paths that define ellipses, by landmark.

    Their landmarks are in the map and their callers have estimated positions. The first two rows
    of a landmark are the pair of ellipses that cross at the largest angle.
    """
    scan, heard = frame.scan, np.isfinite(frame.scan.excess_path)
    heard &= (scan.caller < len(scan.callers)) & np.isin(scan.landmark, frame.landmarks.landmark)
    if not heard.any() or not np.isfinite(frame.pose).all():
        return {}
    callers, found = callers_at(frame).mean, defaultdict(list)
    for row in np.flatnonzero(heard).tolist():
        if np.isfinite(callers[scan.caller[row]]).all():
            found[int(scan.landmark[row])].append(row)
    return {label: _squarest(frame, label, callers, rows) for label, rows in found.items()}


def _squarest(
    frame: Snapshot, label: int, callers: Float[np.ndarray, "c 2"], rows: list[int]
) -> Int[np.ndarray, " k"]:
    r"""Return rows of a landmark, first the pair of ellipses with the largest angle between them.

    The normal of an ellipse bisects the angle between the lines to its foci:
    :math:`(l - b)/|l - b| + (l - p)/|l - p|`.
    """
    if len(rows) <= MAX_ELLIPSES:
        return np.array(rows)
    here = frame.landmarks.landmark == label
    spot = frame.landmarks.mean[here][np.argmax(frame.landmarks.weight[here])]

    def away(points: np.ndarray) -> np.ndarray:
        legs = spot - points
        return legs / np.maximum(np.linalg.norm(legs, axis=-1, keepdims=True), 1e-9)

    normal = away(callers[frame.scan.caller[rows]]) + away(frame.pose[:2])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)
    x, y = normal.T
    pairs = combinations(range(len(rows)), 2)
    first = max(pairs, key=lambda pair: abs(x[pair[0]] * y[pair[1]] - y[pair[0]] * x[pair[1]]))
    return np.array(rows)[[*first, *(i for i in range(len(rows)) if i not in first)]]


def resolved(frames: Sequence[Snapshot]) -> list[int]:
    """Select for each frame the landmark to draw with excess-path ellipses; or `UNLABELLED`.

    In this order: a landmark that the frame's excess paths have initialised; the ray with the
    fewest members that they update; the landmark initialised last, at most `RECENT_FRAMES` frames
    ago. Between equals, the landmark shown before, then a landmark with two excess paths.

    Examples
    --------
    >>> resolved([])
    []
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
            ranks[label] = (*rank, label != shown, -min(len(rows), MAX_ELLIPSES), label)
        shown = min(ranks, key=lambda label: ranks[label], default=UNLABELLED)
        found.append(shown)
    return found


def drawn_excess_paths(
    frame: Snapshot, label: int
) -> tuple[list[Float[np.ndarray, "121 2"]], list[Float[np.ndarray, "3 2"]]]:
    """Return at most two ellipses of a landmark's excess paths, and their sound paths [m].

    A sound path leads from the caller by way of the likeliest member to the vehicle.
    """
    rows = excess_paths_at(frame).get(label, ())[:MAX_ELLIPSES]
    here = frame.landmarks.landmark == label
    callers, vehicle = callers_at(frame).mean, frame.pose[:2]
    outlines, ways = [], []
    for row in rows:
        spot = frame.landmarks.mean[here][np.argmax(frame.landmarks.weight[here])]
        caller = callers[frame.scan.caller[row]]
        outlines.append(excess_path_ellipse(vehicle, caller, float(frame.scan.excess_path[row])))
        ways.append(np.stack([caller, spot, vehicle]))
    return outlines, ways
