"""Errors of data association and of the map: label purity, missed and false landmarks, GOSPA.

An association has arbitrary labels. A label represents the landmark that caused most of its rows;
none, if most were clutter. If the causes of rows are unknown, landmarks are matched by position.
"""

from collections import Counter, defaultdict
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from pipistrelle.detection.scans import UNLABELLED, Scan
from pipistrelle.estimation.beliefs import Landmarks, placed
from pipistrelle.evaluation.accuracy import moved

Causes = Sequence[Int[np.ndarray, " m"]]
"""The true label of each row, or UNLABELLED, by scan."""
OFTEN = 3
"""Fewest scans with a landmark for it to count as missed."""
CUTOFF = 2.0
"""Smallest distance of a missed landmark from a false one [m]."""
STAY = np.zeros(3)
"""The motion that leaves points unchanged."""


def causes_of(scan: Scan, rows: Scan, cause: Int[np.ndarray, " n"]) -> Int[np.ndarray, " m"]:
    """Return the true label of each measurement of a scan, from the true labels of its frame.

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
    """The true landmark that each label represents, and the shares of correct measurements."""

    names: Mapping[int, int]
    """The landmark that each label represents, or UNLABELLED."""
    rows: Mapping[int, int]
    """Number of rows with each label; from positions, 1 if the label is the nearest, else 0."""
    right: float | None
    """Share of the labelled rows that are of the landmark that their label represents."""
    found: float | None
    """Share of the landmarks' rows with a label that represents their landmark."""
    heard: frozenset[int]
    """Landmarks measured in `OFTEN` scans or more; from positions, all."""


def associated(
    labels: Sequence[Int[np.ndarray, " m"]], causes: Causes, moving: Sequence[int] = ()
) -> Associated:
    """Compare the labels of all measurements, scan by scan, with their true labels.

    `moving`: callers that move, which are not landmarks.

    >>> labels, causes = [np.array([1, 2]), np.array([1, -1])], [np.array([7, 9])] * 2
    >>> of = associated(labels, causes)
    >>> of.names, of.right, of.found
    ({1: 7, 2: 9}, 1.0, 0.75)
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
    caused = sum(count for (_, cause), count in pairs.items() if cause != UNLABELLED)
    right = sum(votes[label][name] for label, name in names.items() if name != UNLABELLED)
    return Associated(
        names=names,
        rows=rows,
        right=right / sum(rows.values()) if rows else None,
        found=right / caused if caused else None,
        heard=frozenset(
            cause for cause, count in scans.items() if count >= OFTEN and cause not in moving
        ),
    )


def births_per_scan(labels: Sequence[Int[np.ndarray, " m"]]) -> float:
    """Return the number of new labels per scan in the second half of a drive.

    >>> births_per_scan([np.array([1, 2]), np.array([1]), np.array([1, 3]), np.array([3, -1])])
    0.5
    """
    half = len(labels) // 2
    before, after = (
        {label for one in part for label in one.tolist()} | {UNLABELLED}
        for part in (labels[:half], labels[half:])
    )
    return len(after - before) / max(len(labels) - half, 1)


def pairs_of(
    points: Float[np.ndarray, "n 2"], true: Float[np.ndarray, "k 2"], cutoff: float = CUTOFF
) -> tuple[Int[np.ndarray, " m"], Int[np.ndarray, " m"], Float[np.ndarray, " m"]]:
    """Pair points with true points nearer than a cutoff, minimising `gospa`.

    Returns the indices of the points, of the true points, and the squared distances [m^2].

    >>> pairs_of(np.array([[9.0, 9.0], [0.0, 1.0]]), np.zeros((1, 2)))
    (array([1]), array([0]), array([1.]))
    """
    from scipy.optimize import linear_sum_assignment  # takes a quarter of a second to load

    off = points[:, np.newaxis] - true
    squared = np.einsum("nke,nke->nk", off, off)
    squared = np.where(squared < cutoff**2, squared, cutoff**2)  # NaN is far
    rows, columns = linear_sum_assignment(squared)
    near = squared[rows, columns] < cutoff**2
    rows, columns = rows[near], columns[near]
    return rows, columns, squared[rows, columns]


def nearest_motion(
    points: Float[np.ndarray, "n 2"],
    true: Float[np.ndarray, "k 2"],
    motions: Sequence[Float[np.ndarray, "3"]],
) -> Float[np.ndarray, "3"]:
    """Select the rigid motion that brings points nearest to true points by the GOSPA metric.

    >>> nearest_motion(np.ones((1, 2)), np.full((1, 2), 5.0), [STAY, np.array([4.0, 4.0, 0.0])])
    array([4., 4., 0.])
    """
    return min(motions, key=lambda motion: gospa(moved(points, motion), true)[0])


def matched(
    landmarks: Landmarks,
    true_landmark: Int[np.ndarray, " k"],
    true_position: Float[np.ndarray, "k 2"],
    motion: Float[np.ndarray, "3"] = STAY,
) -> Associated:
    """Match the fully initialised landmarks of a map with true ones by their positions.

    `motion` is applied to the map first. A landmark without a partner in `pairs_of` that is nearer
    than the cutoff to a true landmark represents it as well: a duplicate.

    >>> from pipistrelle.estimation.beliefs import Landmarks
    >>> places = np.array([[1.0, 0.0], [9.0, 0.0], [1.0, 1.0]])
    >>> found = Landmarks(
    ...     landmark=np.arange(3), mean=places, covariance=np.tile(np.eye(2), (3, 1, 1)),
    ...     weight=np.ones(3),
    ... )
    >>> matched(found, np.array([7]), np.ones((1, 2))).names
    {0: 7, 1: -1, 2: 7}
    """
    full = placed(landmarks)
    labels, points = landmarks.landmark[full].tolist(), moved(landmarks.mean[full], motion)
    rows, columns, _ = pairs_of(points, true_position)
    partner = dict(zip(rows.tolist(), columns.tolist(), strict=True))
    near = [partner.get(row, _nearest(point, true_position)) for row, point in enumerate(points)]
    names = [UNLABELLED if k is None else int(true_landmark[k]) for k in near]
    return Associated(
        names=dict(zip(labels, names, strict=True)),
        rows={label: int(row in partner) for row, label in enumerate(labels)},
        right=None,
        found=None,
        heard=frozenset(true_landmark.tolist()),
    )


def _nearest(point: Float[np.ndarray, "2"], true: Float[np.ndarray, "k 2"]) -> int | None:
    """Return the index of the nearest true point within the cutoff; None if there is none."""
    away = np.hypot(*(true - point).T)
    near = np.flatnonzero(away < CUTOFF)
    return int(near[np.argmin(away[near])]) if near.size else None


def out_of_place(
    landmarks: Landmarks,
    found: Associated,
    true_landmark: Int[np.ndarray, " k"],
    true_position: Float[np.ndarray, "k 2"],
    motion: Float[np.ndarray, "3"] = STAY,
) -> frozenset[int]:
    """Return labels of associated landmarks that are far from all true landmarks after a motion."""
    full, known = placed(landmarks), {*true_landmark.tolist()}
    labels, points = landmarks.landmark[full].tolist(), moved(landmarks.mean[full], motion)
    return frozenset(
        label
        for label, point in zip(labels, points, strict=True)
        if found.names.get(label) in known and _nearest(point, true_position) is None
    )


def renamed(landmarks: Landmarks, found: Associated) -> Landmarks:
    """Return a map relabelled by the true landmarks that its labels represent.

    Of several labels of a landmark, the one with most rows is used. The others, and labels without
    a landmark, become negative.
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


def map_counts(
    landmarks: Landmarks, found: Associated, away: Collection[int] = frozenset()
) -> tuple[int, int, int]:
    """Count missed, false and duplicate landmarks among the initialised ones of a map.

    `away`: labels of landmarks far from all true ones, which count as false (`out_of_place`), as do
    landmarks caused by clutter. Missed landmarks were measured often; duplicates are on the map
    under another label.
    """
    labels = landmarks.landmark[placed(landmarks)].tolist()
    named = [UNLABELLED if n in away else found.names.get(n, UNLABELLED) for n in labels]
    true = [name for name in named if name != UNLABELLED]
    return len(found.heard - {*true}), len(named) - len(true), len(true) - len({*true})


def gospa(
    points: Float[np.ndarray, "n 2"], true: Float[np.ndarray, "k 2"], cutoff: float = CUTOFF
) -> tuple[float, float, int, int]:
    r"""Return the generalised optimal sub-pattern assignment metric of two sets of points.

    .. math:: d^2 = \min_\pi \sum_{(i, j) \in \pi} |x_i - y_j|^2
              + \tfrac{c^2}{2} (n_{missed} + n_{false})

    over all sets of pairs nearer than the cutoff c (p = 2, alpha = 2). Returns: d [m], the root of
    the sum of squared distances of pairs [m], and the numbers of missed and of false points.

    Rahmathullah, Garcia-Fernandez & Svensson, International Conference on Information Fusion
    (2017).

    >>> distance, *rest = gospa(np.array([[0.0, 1.0], [9.0, 9.0]]), np.zeros((1, 2)))
    >>> round(distance**2, 9), rest
    (3.0, [1.0, 0, 1])
    """
    _, _, pairs = pairs_of(points, true, cutoff)
    missed, false = len(true) - pairs.size, len(points) - pairs.size
    total = float(pairs.sum())
    distance = np.sqrt(total + 0.5 * cutoff**2 * (missed + false))
    return float(distance), float(np.sqrt(total)), missed, false
