r"""How well rows were associated, by what truly caused them, and how well the map agrees.

An association's labels are its own. The landmark that a label stands for is the one that caused
most of its rows; none, where most were clutter.
"""

from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from pipistrelle.detection.scans import UNLABELLED, Scan
from pipistrelle.estimation.beliefs import Landmarks, placed

Causes = Sequence[Int[np.ndarray, " m"]]
"""Of each scan what caused its rows: labels of landmarks, or UNLABELLED."""
OFTEN = 3
"""In how many scans a landmark must be heard to be missed."""
CUTOFF = 2.0
"""Distance from which on a landmark counts as missed and another as false [m]."""


def causes_of(scan: Scan, rows: Scan, cause: Int[np.ndarray, " n"]) -> Int[np.ndarray, " m"]:
    """Return what caused the rows of a scan, some of the rows of a frame.

    >>> from pipistrelle.detection.scans import make_scan, rows_of
    >>> frame = make_scan(0.0, np.full(2, -1), np.array([0.1, 0.4]))
    >>> causes_of(rows_of(frame, np.array([1])), frame, np.array([7, 9]))
    array([9])
    """
    keys = zip(rows.caller.tolist(), rows.bearing.tolist(), strict=True)
    known = dict(zip(keys, cause.tolist(), strict=True))
    asked = zip(scan.caller.tolist(), scan.bearing.tolist(), strict=True)
    return np.array([known.get(key, UNLABELLED) for key in asked], np.int64)


@dataclass(frozen=True, slots=True, kw_only=True)
class Associated:
    """What became of the rows of a drive."""

    names: Mapping[int, int]
    """The landmark that each label stands for, or UNLABELLED."""
    rows: Mapping[int, int]
    """How many rows have each label."""
    right: float | None
    """Share of the rows with a label that are of the landmark it stands for."""
    heard: frozenset[int]
    """Landmarks that were heard in `OFTEN` scans or more."""


def associated(
    labels: Sequence[Int[np.ndarray, " m"]], causes: Causes, moving: Sequence[int] = ()
) -> Associated:
    """Compare labels of all scans' rows with what caused them.

    `moving`: callers that move, which are no landmarks.

    >>> labels, causes = [np.array([1, 2]), np.array([1, -1])], [np.array([7, 9])] * 2
    >>> found = associated(labels, causes)
    >>> found.names, found.right
    ({1: 7, 2: 9}, 1.0)
    """
    votes: dict[int, Counter[int]] = defaultdict(Counter)
    pairs: Counter[tuple[int, int]] = Counter()
    scans: Counter[int] = Counter()
    for label, cause in zip(labels, causes, strict=True):
        pairs.update(zip(label.tolist(), cause.tolist(), strict=True))
        scans.update({*cause.tolist()} - {UNLABELLED})
    for (label, cause), count in pairs.items():
        if label != UNLABELLED:
            votes[label][cause] = count
    names = {label: of.most_common(1)[0][0] for label, of in votes.items()}
    rows = {label: of.total() for label, of in votes.items()}
    right = sum(votes[label][name] for label, name in names.items() if name != UNLABELLED)
    return Associated(
        names=names,
        rows=rows,
        right=right / sum(rows.values()) if rows else None,
        heard=frozenset(
            cause for cause, count in scans.items() if count >= OFTEN and cause not in moving
        ),
    )


def renamed(landmarks: Landmarks, found: Associated) -> Landmarks:
    """Return a map under the names of what its labels stand for.

    Of labels that stand for one landmark the one with most rows has its name. The others, and
    those that stand for none, have numbers below 0.
    """
    taken: set[int] = set()
    name = {}
    present = {*landmarks.landmark.tolist()}
    for label in sorted(present, key=lambda label: -found.rows.get(label, 0)):
        stands_for = found.names.get(label, UNLABELLED)
        own = stands_for != UNLABELLED and stands_for not in taken
        name[label] = stands_for if own else -2 - label
        taken.add(stands_for)
    labels = np.array([name[label] for label in landmarks.landmark.tolist()], np.int64)
    return replace(landmarks, landmark=labels)


@dataclass(frozen=True, slots=True, kw_only=True)
class MapCounts:
    """Landmarks of the map against those that are there."""

    missed: int
    """Heard often, and not on the map."""
    false: int
    """On the map, and none."""
    twice: int
    """On the map under another label, too."""


def map_counts(landmarks: Landmarks, found: Associated) -> MapCounts:
    """Count missed, false and doubled landmarks among the placed ones of a map."""
    labels = landmarks.landmark[placed(landmarks)].tolist()
    named = [found.names.get(label, UNLABELLED) for label in labels]
    true = [name for name in named if name != UNLABELLED]
    return MapCounts(
        missed=len(found.heard - {*true}),
        false=len(named) - len(true),
        twice=len(true) - len({*true}),
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Gospa:
    """The metric and its three parts."""

    distance: float
    """[m]"""
    error: float
    """Root of the sum of squared distances of pairs [m]."""
    missed: int
    false: int


def gospa(
    points: Float[np.ndarray, "n 2"], true: Float[np.ndarray, "k 2"], cutoff: float = CUTOFF
) -> Gospa:
    r"""Return the generalised optimal sub-pattern assignment metric of two sets of points.

    .. math:: d^2 = \min_\pi \sum_{(i, j) \in \pi} |x_i - y_j|^2
              + \tfrac{c^2}{2} (n_{missed} + n_{false})

    over all sets of pairs nearer than the cutoff c (p = 2, alpha = 2).

    Rahmathullah, Garcia-Fernandez & Svensson, International Conference on Information Fusion
    (2017).

    >>> found = gospa(np.array([[0.0, 1.0], [9.0, 9.0]]), np.zeros((1, 2)))
    >>> round(found.distance**2, 9), found.error, found.missed, found.false
    (3.0, 1.0, 0, 1)
    """
    from scipy.optimize import linear_sum_assignment  # a quarter of a second, if not needed

    off = points[:, np.newaxis] - true
    squared = np.minimum(np.einsum("nke,nke->nk", off, off), cutoff**2)
    rows, columns = linear_sum_assignment(squared)
    pairs = squared[rows, columns]
    pairs = pairs[pairs < cutoff**2]
    missed, false = len(true) - pairs.size, len(points) - pairs.size
    total = float(pairs.sum())
    distance = np.sqrt(total + 0.5 * cutoff**2 * (missed + false))
    return Gospa(distance=float(distance), error=float(np.sqrt(total)), missed=missed, false=false)
