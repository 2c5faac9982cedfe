"""Which excess paths a picture shows: those that resolve a ray, by ellipses.

Both stand where they are believed to be at that frame. Of a frame one landmark is shown so, and
of its excess paths two at most: with its bearing, or with each other, they cross where it is.
"""

from collections import defaultdict
from collections.abc import Sequence
from itertools import combinations

import numpy as np
from jaxtyping import Float, Int

from pipistrelle.detection.scans import UNLABELLED, Scan
from pipistrelle.estimation.beliefs import Gaussian, Landmarks, joined, placed
from pipistrelle.figures.outlines import excess_path_ellipse
from pipistrelle.figures.recorder import Snapshot

MAX_ELLIPSES = 2
"""Ellipses that are shown at a time."""
RECENT_FRAMES = 40
"""Frames for which a landmark is shown that excess paths have placed: each frame's ellipses cross
there, wherever the vehicle goes."""


def callers_believed(landmarks: Landmarks, labels: Int[np.ndarray, " c"]) -> Gaussian:
    """Return where callers are believed to be: as landmarks, once they are placed.

    `labels`: of each caller, by its number, as `Scan.callers`. Returns [m]: NaN for the vehicle,
    and for who is not placed or no landmark of the map.

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
    """Return where callers are believed to be at a frame.

    Returns [m]: as `callers_believed`, by the callers' numbers.
    """
    return callers_believed(joined(frame.landmarks, frame.moving), frame.scan.callers)


def callers_marked(scans: Sequence[Scan]) -> bool:
    """Return whether a picture marks the estimated positions of callers.

    Returns: where there are several, or where excess paths were heard, whose ellipses are about
    them. The paper's one beacon is a landmark as any other.
    """
    several = any(np.sum(scan.callers != UNLABELLED) > 1 for scan in scans[-1:])
    return several or any(np.isfinite(scan.excess_path).any() for scan in scans)


def excess_paths_at(frame: Snapshot) -> dict[int, Int[np.ndarray, " k"]]:
    """Return the rows of a scan with an excess path that defines an ellipse, by landmark.

    Returns: of landmarks of the map, heard from callers that are placed. Of several the first two
    are those whose ellipses cross most squarely there.
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
    r"""Put the two rows first whose ellipses cross most squarely at a landmark.

    An ellipse's normal there halves the angle between the ways to its foci:
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
    """Choose for each frame the landmark whose excess paths are shown.

    The one that the frame's excess paths have just placed; else the ray of the fewest members that
    they weigh; else the one that they placed last, `RECENT_FRAMES` frames ago at most. Of several
    the one that was shown before, or that has two excess paths.

    `frames`: in the order of time. Returns: `UNLABELLED` where there is none.

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
    """Return the ellipses of a landmark's excess paths at a frame, and the ways of which they tell.

    Returns [m]: two at most. Returns [m]: from the caller to the likeliest place of the landmark
    and on to the vehicle.
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
